"""Rules of scenes.hdf5: what is on the table, what the cameras see, the closed hands.

Input: the file, and the dataset that contains it, if any. Output: tasks that judge one scene each.
Grasps are derived again from their trials, and the contacts that a camera sees from its images, by
the functions that create scenes; pictures are compared with the mesh and the table.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.checks.rows import (
    POSITION_TOLERANCE,
    AnyArray,
    Batch,
    Check,
    CheckedFile,
    Dataset,
    Findings,
    Violation,
    complete,
    of_file,
    ranges,
    rigid,
)
from drakegrasp.dataset.checks.samples import (
    DEPTH_TOLERANCE,
    border_of,
    group_of,
    off_mesh,
    off_table,
    points_of,
    some_of,
)
from drakegrasp.dataset.manifest import ObjectEntry
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.dataset.scenes import GRASPS_FOLLOW_FROM, LIFTED, grasps_of_trials
from drakegrasp.dataset.schema import DEPTH_UNIT
from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal
from drakegrasp.frames import Array, invert_pose, make_pose, transform_points, unpack_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.vision.camera import visible_contacts

#: Half a step of the stored depths is added.
PICTURE_TOLERANCE = DEPTH_TOLERANCE + DEPTH_UNIT / 2.0  # [m]
#: How far rounding may move a contact. Visibility is tested with the camera moved this far in every
#: direction.
ROUNDED = 1e-5  # [m]


def judge(data: CheckedFile, check: Check, dataset: Dataset | None) -> None:
    """Judge scenes.hdf5, with the dataset around it if there is one."""
    if len(data.counts) < len(data.fields):
        return  # already a finding
    check.total += data.counts["scenes"]
    entries = dataset.manifest.objects if dataset else ()
    before = len(check.findings.violations())
    if dataset is not None:
        check.findings.add(_other_state(data, dataset.out))
    with check.readable(data):
        check.findings.add(_tables(data, {entry.name: entry for entry in entries}))
    if len(check.findings.violations()) == before and data.config is not None:
        scenes = range(data.counts["scenes"])
        check.judge((1, partial(_judge, data, scene, dataset)) for scene in scenes)


def _judge(data: CheckedFile, scene: int, dataset: Dataset | None) -> Findings:
    """Apply the rules of a scene: to its objects, to its grasps, then to each of its views."""
    findings = Findings()
    with data.opened() as file:
        rows = {g: np.flatnonzero(file[g]["scene"][:] == scene) for g in ("views", "grasps")}
        place = data.read(file, "scenes", np.array([scene]))
        grasps = data.read(file, "grasps", rows["grasps"])
        of_place, of_grasps, of_views = [ranges, rigid, complete], [labels, rigid], [table_pixels]
        if dataset is not None:
            name = file["objects/name"].asstr()[int(place["object"][0, 0])]
            of_place.append(partial(resting_scene, dataset=dataset, name=name))
            of_grasps.append(partial(follow_trials, place=place, trials=Trials(dataset.out)))
            if (model := dataset.loader()(name)) is not None:
                of_views.append(partial(object_pixels, X_TO=place.pose("X_TO")[0, 0], model=model))
        place.judge(findings, of_place)
        grasps.judge(findings, of_grasps)

        views, seen = rows["views"], file["visible/view"][:]
        values = partial(image_values, objects=place["object"].shape[1])
        for batch in data.batches(file, "views", views, len(views) or 1, findings):
            visible = {
                view: file["visible/visible"][np.flatnonzero(seen == view)]
                for view in batch.rows.tolist()
            }
            seen_by = partial(seen_contacts, of=visible, grasps=grasps)
            batch.judge(findings, [rigid, values, complete], [*of_views, seen_by])
    return findings


def _other_state(data: CheckedFile, out: Path) -> Iterator[Violation]:
    """The file was made from the present trials."""
    of = Trials(out).attributes
    if any(str(data.attributes.get(key)) != str(of.get(key)) for key in ("shards", "signature")):
        differs = str(data.attributes.get("shards")) != str(of.get("shards"))
        what = f"attribute {'shards' if differs else 'signature'} must be that of {TRIALS_FILE}"
        yield of_file(data.name, what, "another; run `drakegrasp scenes` again")


def _tables(data: CheckedFile, entries: Mapping[str, ObjectEntry]) -> Iterator[Violation]:
    """No object is in two splits; each view has a row for each grasp of its scene, in order.

    Args:
        data: The file, with all of its groups.
        entries: Entries of the known objects, by name.
    """
    of = {("scenes", "object"): "objects", ("views", "scene"): "scenes"}
    of |= {("grasps", "scene"): "scenes"}
    with data.opened() as file:
        columns = {key: file[key[0]][key[1]][:] for key in of}
        split, names = file["scenes/split"][:], file["objects/name"].asstr()[:].tolist()
        got = np.column_stack([file["visible"][name][:] for name in ("view", "grasp")])

    # Row numbers must exist.
    for (group, name), counted in of.items():
        values = columns[group, name]
        if ((values < 0) | (values >= data.counts[counted])).any():
            yield of_file(data.name, f"{name} must be rows of /{counted}", "others", f"/{group}")
            return

    # Splits, by the groups of the objects.
    home: dict[str, int] = {}
    for own, number in zip(columns["scenes", "object"].tolist(), split.tolist(), strict=True):
        for name in (names[i] for i in own):
            if home.setdefault(group_of(entries, name), number) != number:
                what = "an object and its group must be in one split"
                yield of_file(data.name, what, f"{name} in two", "/scenes")

    # /visible.
    due = [np.zeros((0, 2), dtype=np.int64)]
    for view, scene in enumerate(columns["views", "scene"].tolist()):
        own = np.flatnonzero(columns["grasps", "scene"] == scene)
        due.append(np.column_stack([np.full(len(own), view), own]))
    if not np.array_equal(got, np.concatenate(due)):
        what = "rows must be each view with each grasp of its scene, in order"
        yield of_file(data.name, what, "others", "/visible")


# Scenes and grasps


def resting_scene(place: Batch, dataset: Dataset, name: str) -> Iterator[Violation]:
    """The object has a resting pose of the manifest, turned about Tz and moved on the table."""
    entry = next(entry for entry in dataset.manifest.objects if entry.name == name)
    resting = int(place["resting"][0, 0])
    known, what = resting < len(entry.resting), "resting must be one of its object's"
    yield from place.broken(what, np.array([not known]), place["resting"][:, 0])
    if known:
        # The upward direction and the height do not change.
        due = np.array(entry.resting[resting].X_TO)[8:]
        off = np.abs(place["X_TO"][:, 0, 8:] - due).max(axis=1)
        what = "X_TO must be the object's resting pose, turned about Tz and moved on the table"
        yield from place.broken(what, off > POSITION_TOLERANCE, off)
    off = np.abs(place["mass"][:, 0] - entry.mass)
    yield from place.broken("mass must be the object's [kg]", off > 0.0, place["mass"][:, 0])


def labels(grasps: Batch) -> Iterator[Violation]:
    """Labels follow from the outcome."""
    held, tested, outcome = (grasps[name] for name in ("held", "tested", "outcome"))
    wrong = held != (outcome == Outcome.SUCCESS)
    yield from grasps.broken("held must be that of a success", wrong, outcome)
    wrong = (tested & ~np.isin(outcome, LIFTED)) | (held & ~tested)
    yield from grasps.broken("tested must be that of a lift to a verdict", wrong, outcome)
    for name in ("precision", "stable", "sample"):
        what = f"{name} must be that of a grasp that holds"
        yield from grasps.broken(what, grasps[name] & ~held, grasps[name])


def follow_trials(grasps: Batch, place: Batch, trials: Trials) -> Iterator[Violation]:
    """Palms, joints, contacts, forces and labels are those of the trials, put into the scene."""
    ids = grasps["trial_id"]
    unknown = (ids < 0) | (ids >= len(trials))
    yield from grasps.broken("trial_id must be a row of trials.hdf5", unknown, ids)
    grasps = grasps.where(~unknown)
    if not len(grasps):
        return
    own = trials[grasps["trial_id"]].columns([*GRASPS_FOLLOW_FROM, "removal"])
    X_TO = np.tile(place.pose("X_TO")[0, 0], (len(grasps), 1, 1))
    due = grasps_of_trials(own, X_TO, own["removal"] == Removal.KEPT)
    yield from grasps.follow(due, "its trial and the pose of the object")


# Views


def image_values(views: Batch, objects: int) -> Iterator[Violation]:
    """Depths are 0 or within near..far; masks name objects of the scene, which have depths."""
    near, far = views.config.scenes.near, views.config.scenes.far
    depth = views["depth"].reshape(len(views), -1) * DEPTH_UNIT
    mask = views["mask"].reshape(len(views), -1)
    low, high = np.where(depth > 0.0, depth, far).min(axis=1), depth.max(axis=1)
    bad = (low < near - DEPTH_UNIT) | (high > far + DEPTH_UNIT)
    what = f"depths must be 0 or within {near:g}..{far:g} m"
    yield from views.broken(what, bad, lambda i: f"{low[i]:.4g}..{high[i]:.4g}")
    most = mask.max(axis=1)
    yield from views.broken("mask must be 0 to the number of objects", most > objects, most)
    blind = ((mask > 0) & (depth == 0.0)).any(axis=1)
    yield from views.broken("pixels of an object must have a depth", blind, "0")


def _points(views: Batch, i: int, chosen: AnyArray) -> Array:
    """Return the points p_TQ (m, 3) [m] of the pixels of a view where `chosen` (h, w) is true."""
    K, X_TC = views["K"][i].reshape(3, 3), unpack_pose(views["X_TC"][i])
    return points_of(views["depth"][i] * DEPTH_UNIT, chosen, K, X_TC)


def table_pixels(views: Batch) -> Iterator[Violation]:
    """Pixels outside of the mask that have a depth show the table."""
    beside = (views["mask"] == 0) & (views["depth"] > 0)
    off = np.array([off_table(_points(views, i, own)) for i, own in enumerate(beside)])
    what = f"points beside the mask must be on the table within {PICTURE_TOLERANCE:g} m"
    yield from views.broken(what, off > PICTURE_TOLERANCE, off)


def object_pixels(views: Batch, X_TO: Array, model: ObjectModel) -> Iterator[Violation]:
    """Some pixels inside the border of the mask are on the object's mesh."""
    chosen, owner, X_OT = [], [], invert_pose(X_TO)
    for i, mask in enumerate(views["mask"]):
        p_TQ = _points(views, i, (mask == 1) & ~border_of(mask == 1))
        if len(p_TQ):
            chosen.append(transform_points(X_OT, some_of(p_TQ)))
            owner.append(i)
    off = np.zeros(len(views))
    if chosen:
        off[owner] = off_mesh(chosen, model)
    what = f"points in the mask must be on the object's mesh within {PICTURE_TOLERANCE:g} m"
    yield from views.broken(what, off > PICTURE_TOLERANCE, off)


def seen_contacts(views: Batch, of: Mapping[int, AnyArray], grasps: Batch) -> Iterator[Violation]:
    """The contacts marked as visible are those that the camera sees, by its images.

    Args:
        views: Views of a scene.
        of: For each view, (g, k) bool, whether each contact is marked as visible.
        grasps: All g grasps of the scene.
    """
    wrong = np.zeros(len(views), dtype=np.int64)
    contacts = (grasps[name].astype(float) for name in ("p_TQ", "nhat_Q_T"))
    p_TQ, nhat_Q_T = contacts
    for i, view in enumerate(views.rows.tolist()):
        X_TC, K = unpack_pose(views["X_TC"][i]), views["K"][i].reshape(3, 3)
        depth, mask = views["depth"][i] * DEPTH_UNIT, views["mask"][i]
        near = [
            visible_contacts(p_TQ, nhat_Q_T, multiply(X_TC, moved), K, depth, mask)
            for moved in (make_pose(np.eye(3), p) for p in product((-ROUNDED, ROUNDED), repeat=3))
        ]
        said = of[view]
        wrong[i] = ((said & ~np.any(near, axis=0)) | (~said & np.all(near, axis=0))).sum()
    what = "visible contacts must follow from the images of the view"
    yield from views.broken(what, wrong > 0, wrong)
