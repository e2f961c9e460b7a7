"""What is checked of grasping_oto.hdf5 and grasping_otm.hdf5: numbers, frames, images, splits.

In: a data file and, if there is one, the dataset around it. Out: tasks that judge its samples, each
by itself and against its trial and the mesh; the rules of its splits. That a sample is what its
shard gives is for `run`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from drakegrasp.dataset.assembly.split import split_samples
from drakegrasp.dataset.checks.images import (
    contacts_in_image,
    contacts_of,
    image_frames,
    image_values,
    object_in_camera,
    object_pixels,
    table_pixels,
    without_noise,
)
from drakegrasp.dataset.checks.rows import (
    POSITION_TOLERANCE,
    UNIT_TOLERANCE,
    AnyArray,
    Batch,
    CheckedFile,
    Dataset,
    Findings,
    LoadModel,
    Rows,
    Rule,
    Task,
    Violation,
    complete,
    of_file,
    ranges,
    rigid,
)
from drakegrasp.dataset.manifest import ObjectEntry
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, SPLITS
from drakegrasp.filters import rules_of_hold
from drakegrasp.frames import P_WT, X_WT, invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.objects.model import ObjectModel, fit_contacts
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.verdict import is_precision, is_stable
from drakegrasp.table import Table
from drakegrasp.vision.camera import LOOKS_VERTICALLY

#: Samples in a batch: some 20 MB of images.
SAMPLE_ROWS = 64
#: Samples in a task.
TASK_ROWS = 4 * SAMPLE_ROWS
#: How skew an inertia may be, and by how much its moments may be none of a body, for rounding.
RELATIVE_TOLERANCE = 1e-5
#: float32 rounds slip [m] and turn [rad] by 2e-7 at most.
MOTION_TOLERANCE = 1e-6


def samples_tasks(
    data: CheckedFile, dataset: Dataset | None, trials: CheckedFile | None, findings: Findings
) -> Iterator[Task]:
    """Yield the tasks that judge all samples of a file; none if its lens is not known.

    Args:
        data: The file.
        dataset: The dataset around the file, if there is one.
        trials: trials.hdf5, where the samples are to be compared with it; their shards tell more.
        findings: Has the bad rows of both files.
    """
    copied = list[Rule]()
    if trials is not None:
        bad = findings.bad(trials.name, "/trials")
        copied.append(partial(_copies_trial, trials=trials, bad=bad))
    for split, count in data.counts.items() if data.config is not None else ():
        for start in range(0, count, TASK_ROWS):
            rows = np.arange(start, min(start + TASK_ROWS, count))
            known = findings.of_rows(data.name, f"/{split}", start, start + len(rows))
            yield len(rows), partial(_judge, data, split, rows, dataset, copied, known)


def _judge(
    data: CheckedFile,
    split: str,
    rows: Rows,
    dataset: Dataset | None,
    copied: list[Rule],
    findings: Findings,
) -> Findings:
    """Apply every rule to samples: first to numbers by themselves, then to what follows.

    Args:
        data: The file.
        split: Name of the split.
        rows: Of the split, (n,).
        dataset: See `samples_tasks`.
        copied: The rule that they repeat their trials, if it is to be applied.
        findings: Has the rows that are bad already.
    """
    meshes = [] if dataset is None else [partial(on_meshes, load=dataset.loader())]
    values = [rigid, ranges, image_values, mass_properties, fixed_frames, hold]
    with data.opened() as file:
        for batch in data.batches(file, split, rows, SAMPLE_ROWS, findings):
            sound = batch.judge(findings, [finite], values, [camera_pair, image_frames], copied)
            # What the images show, which needs right frames.
            shown = without_noise(sound)
            shown.judge(findings, [contacts_in_image, table_pixels], meshes)
    return findings


def _copies_trial(batch: Batch, trials: CheckedFile, bad: AnyArray) -> Iterator[Violation]:
    """A sample is of a success, and repeats its numbers; trials that are bad are a finding."""
    ids = batch["trial_id"]
    unknown = (ids < 0) | (ids >= trials.counts["trials"])
    yield from batch.broken("trial_id must be a row of /trials", unknown, ids)
    known = batch.where(~unknown & ~np.isin(ids, bad))
    rows, position = np.unique(known["trial_id"], return_inverse=True)
    if not len(rows):
        return
    copied = {f.name: f.of for f in DATA_FIELDS if f.of and f.name in batch.columns}
    with trials.opened() as file:
        own = trials.read(file, "trials", rows, ["outcome", *copied.values()])
    failed = own["outcome"][position] != Outcome.SUCCESS
    yield from known.broken("trial_id must be that of a success", failed, known["trial_id"])
    due = {name: own[of][position][~failed] for name, of in copied.items()}
    yield from known.where(~failed).follow(due, "its trial")


# Values, one by one


def finite(batch: Batch) -> Iterator[Violation]:
    """No number of a sample is NaN or infinite but the contacts of fingers that it leaves out."""
    used = ~unused_fingers(batch["grasp_props/unused"], batch["grasps"].shape[1] // 6)
    yield from complete(batch, closed=used, lifted=used)


def mass_properties(batch: Batch) -> Iterator[Violation]:
    """Inertias are symmetric and possible for a body.

    The principal moments of a body are positive, and none is more than the sum of the others.
    """
    inertia = batch["object_props/work2inertia"].astype(float).reshape(-1, 3, 3)
    skew = np.abs(inertia - np.swapaxes(inertia, 1, 2)).max(axis=(1, 2))
    scale = np.trace(inertia, axis1=1, axis2=2)
    moments = np.linalg.eigvalsh(inertia)
    slack = moments[:, 0] + moments[:, 1] - moments[:, 2]
    bad = (skew > RELATIVE_TOLERANCE * scale) | (slack < -RELATIVE_TOLERANCE * scale)
    yield from batch.broken(
        "work2inertia must be symmetric with moments of a real body [kg m^2]",
        bad | (moments[:, 0] <= 0.0),
        lambda i: f"moments {np.array2string(moments[i], precision=4)}, skew by {skew[i]:.3g}",
    )


def hold(batch: Batch) -> Iterator[Violation]:
    """A sample keeps the limits of the hold in `filters`, and is called as it holds."""
    filters = batch.config.filters
    links, slip, turn, precision, stable = (
        batch[f"grasp_props/{name}"]
        for name in ("other_links_held", "slip", "turn", "precision", "stable")
    )
    slip, turn = slip.astype(float), turn.astype(float)
    least = Table(other_links=links, slip=slip - MOTION_TOLERANCE, turn=turn - MOTION_TOLERANCE)
    for rule in rules_of_hold():
        if rule.is_on(filters) and least.has(*rule.needs):
            what = f"a sample must pass the filter {rule.removal.label}"
            yield from batch.broken(what, rule.refuses(least, filters), "one that does not")

    # On the limit rounding decides.
    success = np.full(len(batch), Outcome.SUCCESS.value)
    bad = precision != is_precision(success, links)
    yield from batch.broken("precision must follow from other_links_held", bad, precision)
    surely, perhaps = (
        is_stable(success, links, slip + by, turn + by)
        for by in (MOTION_TOLERANCE, -MOTION_TOLERANCE)
    )
    what = "stable must follow from other_links_held, slip and turn"
    yield from batch.broken(what, (surely & ~stable) | (stable & ~perhaps), stable)


# The frames of a sample among each other


def fixed_frames(batch: Batch) -> Iterator[Violation]:
    """The table-top frame is at P_WT; work2cam and cam2work are inverse to each other."""
    X_WT_stored = batch.pose("object_props/frame_world2work")
    apart = {f"frame_world2work must be the identity at {P_WT.tolist()} m": X_WT_stored - X_WT}
    for camera in CAMERAS:
        names = f"frame_work2cam_{camera}", f"frame_cam2work_{camera}"
        X_TC, X_CT = (batch.pose(f"object_props/{name}") for name in names)
        apart[f"{names[0]} times {names[1]} must be the identity"] = X_TC @ X_CT - np.eye(4)
    for what, difference in apart.items():
        off = np.abs(difference).max(axis=(1, 2))
        yield from batch.broken(what, off > POSITION_TOLERANCE, off)


def camera_pair(batch: Batch) -> Iterator[Violation]:
    """Both cameras have one place and one view direction; otm has world up at the top."""
    oto, otm = (batch.pose(f"object_props/frame_work2cam_{camera}") for camera in CAMERAS)
    off = np.abs(oto[:, :3, 2:] - otm[:, :3, 2:]).max(axis=(1, 2))
    what = "both cameras must have the same place and view"
    yield from batch.broken(what, off > POSITION_TOLERANCE, off)
    right, down = otm[:, 2, 0], otm[:, 2, 1]
    yield from batch.broken(
        "the otm camera must have world up at the top of its image",
        (np.abs(right) > LOOKS_VERTICALLY + UNIT_TOLERANCE) | (down > LOOKS_VERTICALLY),
        lambda i: f"+Cx and +Cy that rise by {right[i]:.4g} and {down[i]:.4g}",
    )


def on_meshes(batch: Batch, load: LoadModel) -> Iterator[Violation]:
    """The images show the meshes of the objects, and the contacts are on them."""
    names = batch["object_props/object_name"]
    for name in dict.fromkeys(names.tolist()):
        if (model := load(name)) is not None:
            own = batch.where(names == name)
            yield from object_pixels(own, model)
            yield from contacts_on_mesh(own, model)


def contacts_on_mesh(batch: Batch, model: ObjectModel) -> Iterator[Violation]:
    """Contacts of samples of one object are on its mesh, and their normals point out of it.

    A normal counts as outward if it agrees with either face of `ContactFit.normal_angle`.
    """
    # Contacts in {O}, and how they lie there.
    X_OC = invert_pose(object_in_camera(batch))
    p_CQ, n_C = contacts_of(batch)
    n_O = np.einsum("nij,nkj->nki", X_OC[:, :3, :3], n_C)
    p_OQ = np.einsum("nij,nkj->nki", X_OC[:, :3, :3], p_CQ) + X_OC[:, None, :3, 3]
    fit = fit_contacts(model, p_OQ.reshape(-1, 3), n_O.reshape(-1, 3))
    off, angle = fit.distance.reshape(len(batch), -1), fit.normal_angle.reshape(len(batch), -1)

    distance = batch.config.filters.max_surface_distance
    beyond = off > distance + POSITION_TOLERANCE
    inward = (np.degrees(angle) > 90.0) & (off <= distance + POSITION_TOLERANCE)
    for k in range(off.shape[1]):
        what = f"contact of finger {k + 1} must be on the object's mesh within {distance:g} m"
        yield from batch.broken(what, beyond[:, k], off[:, k])
        what = f"normal of finger {k + 1} must point out of the object, within 90 deg of its face's"
        yield from batch.broken(what, inward[:, k], np.degrees(angle[:, k]))


# Splits


def splits(data: CheckedFile, entries: Mapping[str, ObjectEntry]) -> Iterator[Violation]:
    """A trial is one sample, and the test split has the objects that the seed draws.

    Args:
        data: The data file.
        entries: The objects by name, as far as they are known.
    """
    # Each trial once; meanwhile gather the objects and their classes by split.
    seen: dict[int, str] = {}
    objects: dict[str, dict[str, str]] = {}
    with data.opened() as file:
        for split in data.counts:
            for row, number in enumerate(file[split]["trial_id"][:].tolist()):
                if number in seen:
                    what = "trial_id must be unique in all splits"
                    got = f"{number}, which is in /{seen[number]} too"
                    group = f"/{split}"
                    yield Violation(file=data.name, group=group, row=row, what=what, got=got)
                seen.setdefault(number, f"{split} row {row}")
            keys = ("object_name", "class_name")
            names, classes = (file[split][f"object_props/{key}"].asstr()[:] for key in keys)
            objects[split] = dict(zip(names.tolist(), classes.tolist(), strict=True))

    # By object: no object in two splits, nor another one of its mesh.
    if data.attributes.get("split_by") == "object":
        home: dict[str, str] = {}
        for split, members in objects.items():
            for group in sorted({group_of(entries, name) for name in members}):
                if home.setdefault(group, split) != split:
                    what = "an object and its group must be in one split"
                    yield of_file(data.name, what, f"{group}, in /{home[group]} too", f"/{split}")
        return
    if data.config is None or len(objects) < len(SPLITS):
        return

    # By class: the draw depends on nothing but the objects, of which one or all are tested.
    kinds = {name: kind for members in objects.values() for name, kind in members.items()}
    names = sorted(kinds)
    meshes = [entries[name].mesh_name if name in entries else name for name in names]
    config = data.config.split.model_copy(update={"by": "class"})
    numbers, classes = np.arange(len(names), dtype=np.int32), [kinds[name] for name in names]
    drawn = split_samples(numbers, meshes, classes, meshes, config, data.config.seed)
    due = {names[i] for i in drawn["test"].tolist()}
    for split, members in objects.items():
        for name in sorted(members):
            if (name in due) != (split == "test"):
                what = f"{name} of class {kinds[name]} must be in "
                what += "/test" if name in due else "no test split"
                yield of_file(data.name, what, "another split", f"/{split}")


def group_of(entries: Mapping[str, ObjectEntry], name: str) -> str:
    """Return what an object shares with others of its mesh; its name if it is unknown."""
    entry = entries.get(name)
    return name if entry is None else entry.group or entry.mesh_name
