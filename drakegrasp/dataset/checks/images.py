"""What images show: the object and the table, where a sample or a scene says that they are.

In: the depth images [m] and masks of samples or of views. Out: points and distances of one image,
for the rules of scenes; a `Violation` for every sample that is wrong. No file is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_erosion

from drakegrasp.config import Config
from drakegrasp.dataset.checks.rows import UNIT_TOLERANCE, AnyArray, Batch, Violation
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.frames import X_WT, Array, invert_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.camera import intrinsics, project, unproject
from drakegrasp.vision.depth_sensor import DepthSensor, clean_depth

#: With the right lens, depth images reproduce the table and the mesh to 1e-6 m. An error of half a
#: pixel moves them by 1 to 3 mm.
DEPTH_TOLERANCE = 3e-4  # [m]
#: A contact on the object's outline may be rounded to a pixel beside the mask, and the collision
#: mesh and `filters.max_surface_distance` allow it to be off the full mesh.
MASK_TOLERANCE = 2.0  # [px]
#: A contact is on the visible surface or behind it. At outlines the depth image jumps, so the
#: nearest surface within this many pixels counts. BEFORE_SURFACE is the 2 mm of
#: `filters.max_surface_distance` and the slope of the surface within those pixels.
SILHOUETTE = 2  # [px]
BEFORE_SURFACE = 5e-3  # [m]
#: The image frame's origin is the unprojected centroid of the mask: only rounding separates them.
CENTROID_TOLERANCE = 0.05  # [px]
#: Mask pixels per image whose distance from the mesh is measured; all are tested against the box.
MEASURED_PIXELS = 16
#: The table's slab (models/table.sdf): half edges and centre in {T} [m].
TABLE_HALF = np.array([0.8, 0.8, 0.05])
P_TTABLE = np.array([0.0, 0.0, -0.05])


# One image


def points_of(depth: AnyArray, chosen: AnyArray, K: Array, X_AC: Array) -> Array:
    """Return the points p_AQ (m, 3) [m] of the pixels of an image where `chosen` (h, w) is true."""
    v, u = np.nonzero(chosen)
    p_CQ = unproject(K, np.column_stack([u, v]), depth[v, u])
    return np.asarray(p_CQ @ X_AC[:3, :3].T + X_AC[:3, 3])


def off_table(p_TQ: Array) -> float:
    """Return how far the worst of points (m, 3) is off the surface of the table's slab [m]."""
    outside = np.abs(p_TQ - P_TTABLE) - TABLE_HALF
    distance = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
    distance += np.abs(np.minimum(outside.max(axis=1, initial=-np.inf), 0.0))
    return float(distance.max(initial=0.0))


def some_of(points: Array) -> Array:
    """Return MEASURED_PIXELS of points (m, 3), evenly from the first to the last."""
    return points[np.linspace(0, len(points) - 1, MEASURED_PIXELS).astype(int)]


def off_mesh(chosen: list[Array], model: ObjectModel) -> Array:
    """Return how far (n,) the worst of some points p_OQ of each of n images is off a mesh [m]."""
    _, distance, _ = model.visual.nearest.on_surface(np.concatenate(chosen))
    return np.asarray(distance.reshape(len(chosen), -1).max(axis=1))


def border_of(mask: AnyArray) -> AnyArray:
    """Return which pixels of a mask (h, w) of 0 and 1 have a neighbour outside of it."""
    return (mask == 1) & ~binary_erosion(mask, np.ones((3, 3)), border_value=1)


# Samples


def object_in_camera(batch: Batch) -> Array:
    """Return X_CO (n, 4, 4) of the object in the frame of the file's camera."""
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
    """Return where depths of a sample are some; everywhere if no pixel may lose its."""
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
    """The image frame is before the camera, faces away from it, and in otm is at the centroid."""
    name = "frame_cam2img_otm"
    X_CI, K = batch.pose(f"object_props/{name}"), intrinsics(batch.config.camera)
    ahead = X_CI[:, 2, 3]
    yield from batch.broken(f"{name} must start before the camera [m]", ahead <= 0.0, ahead)
    turned = np.abs(X_CI[:, :3, 0] - [0.0, 0.0, 1.0]).max(axis=1)
    got = [np.array2string(own, precision=4) for own in X_CI[:, :3, 0]]
    what = f"{name} must have +Ix along +Cz"
    yield from batch.broken(what, turned > UNIT_TOLERANCE, got.__getitem__)

    # The frame was estimated from the otm mask, so only that file can confirm its origin.
    if batch.of.camera == "otm":
        off = np.zeros(len(batch))
        for i in np.flatnonzero(ahead > 0.0):
            centroid = np.argwhere(batch["masks"][i]).mean(axis=0)[::-1]
            off[i] = np.linalg.norm(project(K, X_CI[i, None, :3, 3])[0] - centroid)
        what = f"{name} must start within {CENTROID_TOLERANCE} px of the mask's centroid"
        yield from batch.broken(what, off > CENTROID_TOLERANCE, off)


def without_noise(batch: Batch) -> Batch:
    """Return the samples with depth images from which the noise is taken that was drawn."""
    noise, seeds = batch["conditions/depth_noise"], batch["conditions/depth_seed"]
    if not noise.any():
        return batch
    images, number = batch["images"].copy(), CAMERAS.index(batch.of.camera)
    for i in range(len(batch)):
        sensor = DepthSensor(noise=float(noise[i]), seed=int(seeds[i]))
        images[i, 3] = clean_depth(images[i, 3], sensor, number, batch.config.camera)
    return replace(batch, columns={**batch.columns, "images": images})


def contacts_in_image(batch: Batch) -> Iterator[Violation]:
    """Contacts project onto the mask, and lie on the visible surface or behind it."""
    (p_CQ, _), K = contacts_of(batch), intrinsics(batch.config.camera)
    for finger in range(p_CQ.shape[1]):
        # How far each contact is beside the mask [px], and before the surface there [m].
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
    """Return the least depth [m] around a pixel (2,), which is clipped into the image.

    It is infinite where no pixel around has a depth.
    """
    u, v = np.clip(np.rint(pixel), 0, len(depth) - 1).astype(int)
    rows, columns = (slice(max(at - SILHOUETTE, 0), at + SILHOUETTE + 1) for at in (v, u))
    around = depth[rows, columns]
    return float(around.min(initial=np.inf, where=has_depth(around, config)))


def table_pixels(batch: Batch) -> Iterator[Violation]:
    """Pixels beside the mask, nearer than far, show the table."""
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
        # A corner of the mesh stands for an image whose depths are all lost.
        if not seen.any():
            chosen.append(some_of(model.visual_vertices[:1]))
            continue
        border = border_of(batch["masks"][i])
        p_OQ = points_of(depth, seen, K, X_OC[i])
        slack = np.where(border, depth / K[0, 0], 0.0)[seen]
        beyond[i] = beyond_box(p_OQ, X_OC[i][:3, 3], model.half_extents, slack)

        # The mesh is measured inside the border, if there is any inside.
        chosen.append(some_of(p_OQ[~border[seen]] if (seen & ~border).any() else p_OQ))
    off, outside = off_mesh(chosen, model), beyond > DEPTH_TOLERANCE
    for where, bad, got in (
        ("in the object's box", outside, beyond),
        ("on the object's mesh", (off > DEPTH_TOLERANCE) & ~outside, off),
    ):
        what = f"points in the mask must be {where} within {DEPTH_TOLERANCE:g} m"
        yield from batch.broken(what, bad, got)


def beyond_box(p_OQ: Array, p_OC: Array, half_extents: Array, slack: Array) -> float:
    """Return how far the worst point is outside of the object's box [m], 0 if none is.

    A renderer moves corners to fractions of a pixel, so a pixel whose ray just misses the object
    can show it. Its depth is then that of a face seen nearly from its edge, continued beyond that
    edge. So a point may be moved along its ray, but not aside, into the box and its tolerance.

    Args:
        p_OQ: Points (m, 3) [m].
        p_OC: The camera, (3,) [m].
        half_extents: Of the box, (3,) [m].
        slack: By how much each point may be moved, (m,) [m] of depth.
    """
    # Where the ray of each point enters the box and leaves it.
    along = p_OQ - p_OC
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    along = np.where(np.abs(along) < 1e-12, 1e-12, along)
    walls = np.stack([-1.0, 1.0])[:, None, None] * (half_extents + DEPTH_TOLERANCE)
    cuts = (walls - p_OQ) / along
    enters, leaves = cuts.min(axis=0).max(axis=1), cuts.max(axis=0).min(axis=1)
    wrong = np.maximum(enters, -slack) > np.minimum(leaves, slack)
    return float((np.abs(p_OQ) - half_extents).max(axis=1).max(where=wrong, initial=0.0))
