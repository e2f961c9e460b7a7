"""Rules of grasping_oto.hdf5 and grasping_otm.hdf5: numbers, frames, images, splits.

Input: a data file and, if there is one, the dataset around it. Output: tasks that judge its
samples, each by itself and against its trial and the mesh; the rules of its splits; points and
distances in one image, which the rules of scenes also use. `run` compares each sample with its
shard.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.ndimage import binary_erosion

from drakegrasp.config import Config
from drakegrasp.dataset.assembly.split import split_samples
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
from drakegrasp.frames import P_WT, X_WT, Array, invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.objects.model import ObjectModel, fit_contacts
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.verdict import is_precision, is_stable
from drakegrasp.table import Table
from drakegrasp.vision.camera import LOOKS_VERTICALLY, intrinsics, project, unproject
from drakegrasp.vision.depth_sensor import DepthSensor, clean_depth

#: Samples in a batch: some 20 MB of images.
SAMPLE_ROWS = 64
#: Samples in a task.
TASK_ROWS = 4 * SAMPLE_ROWS
#: Limits for rounding: of an inertia's asymmetry, and of moments that no body could have.
RELATIVE_TOLERANCE = 1e-5
#: float32 rounds slip [m] and turn [rad] by 2e-7 at most.
MOTION_TOLERANCE = 1e-6
#: With the right lens, depth images reproduce the table and the mesh to 1e-6 m. An error of half a
#: pixel moves them by 1 to 3 mm.
DEPTH_TOLERANCE = 3e-4  # [m]
#: A contact on the object's outline may be rounded to a pixel beside the mask, and the collision
#: mesh and `filters.max_surface_distance` allow it to be off the full mesh.
MASK_TOLERANCE = 2.0  # [px]
#: A contact is on the visible surface or behind it. The depth image jumps at outlines, so the
#: nearest surface within this many pixels counts. BEFORE_SURFACE covers the 2 mm of
#: `filters.max_surface_distance` and the slope of the surface within those pixels.
SILHOUETTE = 2  # [px]
BEFORE_SURFACE = 5e-3  # [m]
#: The image frame's origin is the unprojected centroid of the mask: only rounding separates them.
CENTROID_TOLERANCE = 0.05  # [px]
#: Mask pixels per image whose distance from the mesh is measured; all are tested against the box.
MEASURED_PIXELS = 16
#: The table's slab (models/table.urdf): half edges and centre in {T} [m].
TABLE_HALF = np.array([0.8, 0.8, 0.05])
P_TTABLE = np.array([0.0, 0.0, -0.05])


def samples_tasks(
    data: CheckedFile, dataset: Dataset | None, trials: CheckedFile | None, findings: Findings
) -> Iterator[Task]:
    """Yield the tasks that judge all samples of a file; none if its lens is unknown.

    Args:
        data: The file.
        dataset: The dataset around the file, if there is one.
        trials: trials.hdf5, if samples are to be compared with it; their shards say more.
        findings: Findings so far, with the bad rows of both files.
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
    """Apply every rule to samples: first to single numbers, then to what follows from them.

    Args:
        data: The file.
        split: Name of the split.
        rows: (n,), rows of the split.
        dataset: See `samples_tasks`.
        copied: The rule that samples repeat their trials, if it is to be applied.
        findings: Findings so far, with the rows that are already bad.
    """
    meshes = [] if dataset is None else [partial(on_meshes, load=dataset.loader())]
    values = [rigid, ranges, image_values, mass_properties, fixed_frames, hold]
    with data.opened() as file:
        for batch in data.batches(file, split, rows, SAMPLE_ROWS, findings):
            sound = batch.judge(findings, [finite], values, [camera_pair, image_frames], copied)
            # Rules of the image content, which need valid frames.
            shown = without_noise(sound)
            shown.judge(findings, [contacts_in_image, table_pixels], meshes)
    return findings


def _copies_trial(batch: Batch, trials: CheckedFile, bad: AnyArray) -> Iterator[Violation]:
    """A sample belongs to a success and repeats its numbers; bad trials are already findings."""
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
    """All numbers of a sample are finite, except for contacts of fingers that it leaves out."""
    used = ~unused_fingers(batch["grasp_props/unused"], batch["grasps"].shape[1] // 6)
    yield from complete(batch, closed=used, lifted=used)


def mass_properties(batch: Batch) -> Iterator[Violation]:
    """Inertias are symmetric and possible for a body.

    The principal moments of a body are positive, and none is larger than the sum of the others.
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
    """A sample is within the limits of the hold in `filters`, and its labels match its hold."""
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

    # At a limit, rounding decides.
    success = np.full(len(batch), Outcome.SUCCESS.value)
    bad = precision != is_precision(success, links)
    yield from batch.broken("precision must follow from other_links_held", bad, precision)
    surely, perhaps = (
        is_stable(success, links, slip + by, turn + by)
        for by in (MOTION_TOLERANCE, -MOTION_TOLERANCE)
    )
    what = "stable must follow from other_links_held, slip and turn"
    yield from batch.broken(what, (surely & ~stable) | (stable & ~perhaps), stable)


# Consistency of a sample's frames


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
    """Both cameras share position and view direction; otm has world up at the top."""
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
    """Contacts of one object's samples are on its mesh, and their normals point outward.

    A normal counts as outward if it agrees with either of the faces of `ContactFit.normal_angle`.
    """
    # Contacts in {O}, and how they fit the mesh.
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


# One image


def points_of(depth: AnyArray, chosen: AnyArray, K: Array, X_AC: Array) -> Array:
    """Return the points p_AQ (m, 3) [m] of the pixels of an image where `chosen` (h, w) is true."""
    v, u = np.nonzero(chosen)
    p_CQ = unproject(K, np.column_stack([u, v]), depth[v, u])
    return np.asarray(p_CQ @ X_AC[:3, :3].T + X_AC[:3, 3])


def off_table(p_TQ: Array) -> float:
    """Return the largest distance [m] of points (m, 3) from the surface of the table's slab."""
    outside = np.abs(p_TQ - P_TTABLE) - TABLE_HALF
    distance = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
    distance += np.abs(np.minimum(outside.max(axis=1, initial=-np.inf), 0.0))
    return float(distance.max(initial=0.0))


def some_of(points: Array) -> Array:
    """Return MEASURED_PIXELS of points (m, 3), evenly spaced from the first to the last."""
    return points[np.linspace(0, len(points) - 1, MEASURED_PIXELS).astype(int)]


def off_mesh(chosen: list[Array], model: ObjectModel) -> Array:
    """Return for each of n images the largest distance (n,) [m] of its points p_OQ from a mesh."""
    _, distance, _ = model.visual.nearest.on_surface(np.concatenate(chosen))
    return np.asarray(distance.reshape(len(chosen), -1).max(axis=1))


def border_of(mask: AnyArray) -> AnyArray:
    """Return which object pixels of a mask (h, w) of 0 and 1 have a neighbour outside of it."""
    return (mask == 1) & ~binary_erosion(mask, np.ones((3, 3)), border_value=1)


# Content of the samples' images


def object_in_camera(batch: Batch) -> Array:
    """Return X_CO (n, 4, 4), the pose of the object in the frame of the file's camera."""
    X_CT, X_WO = (
        batch.pose(f"object_props/frame_{name}")
        for name in (f"cam2work_{batch.of.camera}", "world2obj")
    )
    return X_CT @ invert_pose(X_WT) @ X_WO


def contacts_of(batch: Batch) -> tuple[Array, Array]:
    """Return p_CQ [m] and nhat_Q_C of `grasps`, (n, k, 3) each."""
    vectors = batch["grasps"].astype(float).reshape(len(batch), 2, -1, 3)
    return vectors[:, 0], vectors[:, 1]


def has_depth(depth: AnyArray, config: Config) -> AnyArray:
    """Return which pixels have a depth; all of them if the configuration cannot lose depths."""
    loses = config.randomize.depth_noise is not None or config.randomize.depth_baseline > 0.0
    lost = depth >= np.float32(config.camera.far)
    return np.asarray(~lost) if loses else np.ones_like(lost)


def image_values(batch: Batch) -> Iterator[Violation]:
    """Colours are within 0..1 and depths within near..far; a mask has an object pixel."""
    near, far = np.float32(batch.config.camera.near), np.float32(batch.config.camera.far)
    for what, channels, low, high in (
        ("colours must be within 0..1", slice(3), 0.0, 1.0),
        (f"depths must be within {near:g}..{far:g} m", slice(3, 4), near, far),
    ):
        values = batch["images"][:, channels].reshape(len(batch), -1)
        least, most = values.min(axis=1), values.max(axis=1)
        got = [f"{a:.6g}..{b:.6g}" for a, b in zip(least, most, strict=True)]
        yield from batch.broken(what, (least < low) | (most > high), got.__getitem__)
    empty = np.logical_not(batch["masks"].any(axis=(1, 2)))
    yield from batch.broken("mask must have an object pixel", empty, "an empty mask")


def image_frames(batch: Batch) -> Iterator[Violation]:
    """The image frame is in front of the camera, faces away, and in otm is at the centroid."""
    name = "frame_cam2img_otm"
    X_CI, K = batch.pose(f"object_props/{name}"), intrinsics(batch.config.camera)
    ahead = X_CI[:, 2, 3]
    yield from batch.broken(f"{name} must start before the camera [m]", ahead <= 0.0, ahead)
    turned = np.abs(X_CI[:, :3, 0] - [0.0, 0.0, 1.0]).max(axis=1)
    got = [np.array2string(own, precision=4) for own in X_CI[:, :3, 0]]
    what = f"{name} must have +Ix along +Cz"
    yield from batch.broken(what, turned > UNIT_TOLERANCE, got.__getitem__)

    # The frame was estimated from the otm mask, so only the otm file can confirm its origin.
    if batch.of.camera == "otm":
        off = np.zeros(len(batch))
        for i in np.flatnonzero(ahead > 0.0):
            centroid = np.argwhere(batch["masks"][i]).mean(axis=0)[::-1]
            off[i] = np.linalg.norm(project(K, X_CI[i, None, :3, 3])[0] - centroid)
        what = f"{name} must start within {CENTROID_TOLERANCE} px of the mask's centroid"
        yield from batch.broken(what, off > CENTROID_TOLERANCE, off)


def without_noise(batch: Batch) -> Batch:
    """Return the samples with the drawn noise removed from their depth images."""
    noise, seeds = batch["conditions/depth_noise"], batch["conditions/depth_seed"]
    if not noise.any():
        return batch
    images, number = batch["images"].copy(), CAMERAS.index(batch.of.camera)
    for i in range(len(batch)):
        sensor = DepthSensor(noise=float(noise[i]), seed=int(seeds[i]))
        images[i, 3] = clean_depth(images[i, 3], sensor, number, batch.config.camera)
    return replace(batch, columns={**batch.columns, "images": images})


def contacts_in_image(batch: Batch) -> Iterator[Violation]:
    """Contacts project onto the mask, and are on the visible surface or behind it."""
    (p_CQ, _), K = contacts_of(batch), intrinsics(batch.config.camera)
    for finger in range(p_CQ.shape[1]):
        # Distance of each contact from the mask [px], and in front of the surface there [m].
        z = p_CQ[:, finger, 2]
        beside, before = np.zeros((2, len(batch)))
        for i in np.flatnonzero(z > 0.0):
            (pixel,) = project(K, p_CQ[i, finger, None])
            v, u = np.nonzero(batch["masks"][i])
            beside[i] = np.hypot(u - pixel[0], v - pixel[1]).min()
            if beside[i] <= MASK_TOLERANCE:
                nearest = nearest_depth(batch["images"][i, 3], batch.config, pixel)
                before[i] = nearest - z[i] if np.isfinite(nearest) else 0.0

        mesh = f"not lie more than {BEFORE_SURFACE:g} m before the surface in the depth image"
        for what, bad, got in (
            ("be before the camera [m]", z <= 0.0, z),
            (f"project within {MASK_TOLERANCE:g} px of the mask", beside > MASK_TOLERANCE, beside),
            (mesh, before > BEFORE_SURFACE, before),
        ):
            yield from batch.broken(f"contact of finger {finger + 1} must {what}", bad, got)


def nearest_depth(depth: AnyArray, config: Config, pixel: Array) -> float:
    """Return the smallest depth [m] around a pixel (2,), which is clipped into the image.

    It is infinite if no pixel around has a depth.
    """
    u, v = np.clip(np.rint(pixel), 0, len(depth) - 1).astype(int)
    rows, columns = (slice(max(at - SILHOUETTE, 0), at + SILHOUETTE + 1) for at in (v, u))
    around = depth[rows, columns]
    return float(around.min(initial=np.inf, where=has_depth(around, config)))


def table_pixels(batch: Batch) -> Iterator[Violation]:
    """Pixels outside of the mask that are nearer than far show the table."""
    X_TC = invert_pose(batch.pose(f"object_props/frame_cam2work_{batch.of.camera}"))
    camera, off = batch.config.camera, np.zeros(len(batch))
    K = intrinsics(camera)
    for i, depth in enumerate(batch["images"][:, 3]):
        beside = (batch["masks"][i] == 0) & (depth < np.float32(camera.far))
        off[i] = off_table(points_of(depth, beside, K, X_TC[i]))
    what = f"points beside the mask must be on the table within {DEPTH_TOLERANCE:g} m"
    yield from batch.broken(what, off > DEPTH_TOLERANCE, off)


def object_pixels(batch: Batch, model: ObjectModel) -> Iterator[Violation]:
    """Pixels in the mask show the object: all are in its box, and some are on its mesh."""
    X_OC, K = invert_pose(object_in_camera(batch)), intrinsics(batch.config.camera)
    beyond, chosen = np.zeros(len(batch)), []
    for i, depth in enumerate(batch["images"][:, 3]):
        seen = (batch["masks"][i] == 1) & has_depth(depth, batch.config)
        # If an image has lost all its depths, a corner of the mesh takes the place of its points.
        if not seen.any():
            chosen.append(some_of(model.visual_vertices[:1]))
            continue
        border = border_of(batch["masks"][i])
        p_OQ = points_of(depth, seen, K, X_OC[i])
        slack = np.where(border, depth / K[0, 0], 0.0)[seen]
        beyond[i] = beyond_box(p_OQ, X_OC[i][:3, 3], model.half_extents, slack)

        # The distance from the mesh is measured inside the border, if there are pixels inside.
        chosen.append(some_of(p_OQ[~border[seen]] if (seen & ~border).any() else p_OQ))
    off, outside = off_mesh(chosen, model), beyond > DEPTH_TOLERANCE
    for where, bad, got in (
        ("in the object's box", outside, beyond),
        ("on the object's mesh", (off > DEPTH_TOLERANCE) & ~outside, off),
    ):
        what = f"points in the mask must be {where} within {DEPTH_TOLERANCE:g} m"
        yield from batch.broken(what, bad, got)


def beyond_box(p_OQ: Array, p_OC: Array, half_extents: Array, slack: Array) -> float:
    """Return how far the worst point is outside of the object's box [m]; 0 if all are inside.

    A renderer moves corners by fractions of a pixel, so a pixel whose ray just misses the object
    can show it. The depth of such a pixel is that of a face seen at a grazing angle, continued
    beyond the face's edge. So a point may be moved along its ray, but not sideways, into the box
    and its tolerance.

    Args:
        p_OQ: Points (m, 3) [m].
        p_OC: Position of the camera, (3,) [m].
        half_extents: Half extents of the box, (3,) [m].
        slack: How far each point may be moved, (m,) [m] of depth.
    """
    # Where the ray of each point enters and leaves the box.
    along = p_OQ - p_OC
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    walls = np.stack([-1.0, 1.0])[:, None, None] * (half_extents + DEPTH_TOLERANCE)
    cuts = (walls - p_OQ) / along
    enters, leaves = cuts.min(axis=0).max(axis=1), cuts.max(axis=0).min(axis=1)
    wrong = np.maximum(enters, -slack) > np.minimum(leaves, slack)
    return float((np.abs(p_OQ) - half_extents).max(axis=1).max(where=wrong, initial=0.0))


# Splits


def splits(data: CheckedFile, entries: Mapping[str, ObjectEntry]) -> Iterator[Violation]:
    """Each trial is at most one sample, and the test split has the objects drawn from the seed.

    Args:
        data: The data file.
        entries: Entries of the known objects, by name.
    """
    # Each trial occurs once; this loop also collects the objects and their classes by split.
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

    # By object: neither an object nor its group, e.g. its morphs, is in two splits.
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

    # By class: the draw depends only on the objects, of which one or all are tested.
    kinds = {name: kind for members in objects.values() for name, kind in members.items()}
    names = sorted(kinds)
    meshes = [entries[name].mesh_name if name in entries else name for name in names]
    config = data.config.split.model_copy(update={"by": "class"})
    numbers, classes = np.arange(len(names), dtype=np.int32), [kinds[name] for name in names]
    drawn = split_samples(numbers, meshes, classes, meshes, {}, config, data.config.seed)
    due = {names[i] for i in drawn["test"].tolist()}
    for split, members in objects.items():
        for name in sorted(members):
            if (name in due) != (split == "test"):
                what = f"{name} of class {kinds[name]} must be in "
                what += "/test" if name in due else "no test split"
                yield of_file(data.name, what, "another split", f"/{split}")


def group_of(entries: Mapping[str, ObjectEntry], name: str) -> str:
    """Return the group of an object, see `Manifest.groups`; its name if it is unknown."""
    entry = entries.get(name)
    return name if entry is None else entry.group or entry.mesh_name
