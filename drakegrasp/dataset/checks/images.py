"""Rules of the images of a sample: they show the object and the table.

In: a `Batch` of samples of one data file, the `Lens` of its camera, and for some rules the mesh of
the object. Out: a `Violation` for every row that is wrong. No file is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import binary_erosion

from drakegrasp.config import CameraConfig, Config
from drakegrasp.dataset.checks.findings import Violation
from drakegrasp.dataset.checks.rows import UNIT_TOLERANCE, AnyArray, Batch
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.frames import Array, invert_pose
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """The camera of a data file.

    Attributes:
        camera: `oto` or `otm`.
        size: Edge of the images [px].
        K: Camera matrix (3, 3) [px].
        near, far: Range of the depth image [m].
        loses: Whether pixels that show something may have no depth, which is `far` then.
    """

    camera: str
    size: int
    K: Array
    near: np.float32
    far: np.float32
    loses: bool

    @cached_property
    def rays_C(self) -> Array:
        """What to multiply with a depth image for the points that it shows, (3, S, S)."""
        v, u = np.indices((self.size, self.size)).reshape(2, -1)
        rays = unproject(self.K, np.column_stack([u, v]), np.ones(len(u)))
        return rays.T.reshape(3, self.size, self.size)

    @classmethod
    def of(cls, camera: str, config: Config) -> Lens:
        """Return the lens of a configuration; its range is rounded to float32, as images are."""
        rules = config.randomize
        return cls(
            camera=camera,
            size=config.camera.size,
            K=intrinsics(config.camera),
            near=np.float32(config.camera.near),
            far=np.float32(config.camera.far),
            loses=rules.depth_noise is not None or rules.depth_baseline > 0.0,
        )

    def has_depth(self, depth: AnyArray) -> AnyArray:
        """Return where a depth image (S, S) has a depth; everywhere if no pixel may lose its."""
        return depth < self.far if self.loses else np.ones_like(depth, dtype=np.bool_)


def image_values(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """Colours are within 0..1 and depths within near..far."""
    colour, depth = batch["images"][:, :3], batch["images"][:, 3]
    for what, values, low, high in (
        ("colours must be within 0..1", colour, 0.0, 1.0),
        (f"depths must be within {lens.near:g}..{lens.far:g} m", depth, lens.near, lens.far),
    ):
        flat = values.reshape(len(batch), -1)
        least, most = flat.min(axis=1), flat.max(axis=1)
        yield from batch.broken(
            what,
            (least < low) | (most > high),
            lambda i, least=least, most=most: f"{least[i]:.6g}..{most[i]:.6g}",  # type: ignore[misc]
        )


def mask_values(batch: Batch) -> Iterator[Violation]:
    """A mask holds only 0 and 1, and at least one 1."""
    largest = batch["masks"].reshape(len(batch), -1).max(axis=1)
    yield from batch.broken("mask must hold 0 and 1 only", largest > 1, largest)
    yield from batch.broken(
        "mask must have an object pixel", largest == 0, lambda i: "an empty mask"
    )


def image_frames(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """The image frame is before the camera, faces away from it, and in otm is at the centroid."""
    # Place and direction.
    X_CI = batch.frame("cam2img_otm")
    yield from batch.broken(
        "frame_cam2img_otm must start before the camera [m]", X_CI[:, 2, 3] <= 0.0, X_CI[:, 2, 3]
    )
    turned = np.abs(X_CI[:, :3, 0] - [0.0, 0.0, 1.0]).max(axis=1)
    yield from batch.broken(
        "frame_cam2img_otm must have +Ix along +Cz",
        turned > UNIT_TOLERANCE,
        lambda i: np.array2string(X_CI[i, :3, 0], precision=4),
    )

    # The frame was estimated from the otm mask, so only that file can confirm its origin.
    if lens.camera == "otm":
        ahead = X_CI[:, 2, 3] > 0.0
        off = np.zeros(len(batch))
        for i in np.flatnonzero(ahead):
            v, u = np.nonzero(batch["masks"][i])
            off[i] = np.linalg.norm(project(lens.K, X_CI[i, None, :3, 3])[0] - [u.mean(), v.mean()])
        yield from batch.broken(
            f"frame_cam2img_otm must start within {CENTROID_TOLERANCE} px of the mask's centroid",
            off > CENTROID_TOLERANCE,
            off,
        )


# What the images show


def without_noise(batch: Batch, lens: Lens, config: CameraConfig) -> Batch:
    """Return the samples with depth images from which the noise is taken that was drawn."""
    noise, seeds = batch["conditions/depth_noise"], batch["conditions/depth_seed"]
    if not noise.any():
        return batch
    images = batch["images"].copy()
    for i in range(len(batch)):
        sensor = DepthSensor(noise=float(noise[i]), seed=int(seeds[i]))
        number = CAMERAS.index(lens.camera)
        images[i, 3] = clean_depth(images[i, 3], sensor, number, config)
    return replace(batch, columns={**batch.columns, "images": images})


def contacts_in_image(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """Contacts project onto the mask, and lie on the visible surface or behind it."""
    p_CQ, _ = batch.contacts()
    for finger in range(p_CQ.shape[1]):
        # How far each contact is beside the mask [px], and before the surface there [m].
        z = p_CQ[:, finger, 2]
        beside, before = np.zeros(len(batch)), np.zeros(len(batch))
        for i in np.flatnonzero(z > 0.0):
            (pixel,) = project(lens.K, p_CQ[i, finger, None])
            v, u = np.nonzero(batch["masks"][i])
            beside[i] = np.hypot(u - pixel[0], v - pixel[1]).min()
            if beside[i] <= MASK_TOLERANCE:
                nearest = _nearest_depth(batch["images"][i, 3], lens, pixel)
                before[i] = nearest - z[i] if np.isfinite(nearest) else 0.0

        yield from batch.broken(
            f"contact of finger {finger + 1} must be before the camera [m]", z <= 0.0, z
        )
        yield from batch.broken(
            f"contact of finger {finger + 1} must project within {MASK_TOLERANCE:g} px of the mask",
            beside > MASK_TOLERANCE,
            beside,
        )
        yield from batch.broken(
            f"contact of finger {finger + 1} must not lie more than {BEFORE_SURFACE:g} m before "
            "the surface in the depth image",
            before > BEFORE_SURFACE,
            before,
        )


def table_pixels(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """Pixels beside the mask, nearer than far, show the table."""
    X_TC = invert_pose(batch.frame(f"cam2work_{lens.camera}"))
    off = np.zeros(len(batch))
    for i in range(len(batch)):
        depth = batch["images"][i, 3]
        p_TQ = _points(X_TC[i], lens, depth, (batch["masks"][i] == 0) & (depth < lens.far))

        # Distance from the surface of the slab, from outside and from inside.
        outside = np.abs(p_TQ - P_TTABLE) - TABLE_HALF
        distance = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
        distance += np.abs(np.minimum(outside.max(axis=1, initial=-np.inf), 0.0))
        off[i] = distance.max(initial=0.0)

    yield from batch.broken(
        f"points beside the mask must be on the table within {DEPTH_TOLERANCE:g} m",
        off > DEPTH_TOLERANCE,
        off,
    )


def object_pixels(batch: Batch, lens: Lens, model: ObjectModel) -> Iterator[Violation]:
    """Pixels in the mask show the object: all are in its box, and some are on its mesh."""
    # All pixels against the box, which is cheap; keep some for the mesh.
    X_OC = invert_pose(batch.object_in_camera(lens.camera))
    beyond, chosen = np.zeros(len(batch)), []
    for i in range(len(batch)):
        depth = batch["images"][i, 3]
        seen = (batch["masks"][i] == 1) & lens.has_depth(depth)
        # A corner of the mesh stands for an image whose depths are all lost.
        if not seen.any():
            chosen.append(np.repeat(model.visual_vertices[:1], MEASURED_PIXELS, axis=0))
            continue
        border = _border(batch["masks"][i])
        p_OQ = _points(X_OC[i], lens, depth, seen)
        slack = np.where(border, depth / lens.K[0, 0], 0.0)[seen]
        beyond[i] = _beyond_box(p_OQ, X_OC[i][:3, 3], model.half_extents, slack)

        # The mesh is measured inside the border, if there is any inside.
        inside = p_OQ[~border[seen]] if (seen & ~border).any() else p_OQ
        measured = np.linspace(0, len(inside) - 1, MEASURED_PIXELS).astype(int)
        chosen.append(inside[measured])
    yield from batch.broken(
        f"points in the mask must be in the object's box within {DEPTH_TOLERANCE:g} m",
        beyond > DEPTH_TOLERANCE,
        beyond,
    )

    # The chosen pixels against the mesh.
    _, distance, _ = model.visual.nearest.on_surface(np.concatenate(chosen))
    off = distance.reshape(len(batch), -1).max(axis=1)
    yield from batch.broken(
        f"points in the mask must be on the object's mesh within {DEPTH_TOLERANCE:g} m",
        (off > DEPTH_TOLERANCE) & (beyond <= DEPTH_TOLERANCE),
        off,
    )


def _border(mask: AnyArray) -> AnyArray:
    """Return which pixels of a mask (S, S) have a neighbour outside of it, (S, S) bool."""
    return (mask == 1) & ~binary_erosion(mask, np.ones((3, 3)), border_value=1)


def _beyond_box(p_OQ: Array, p_OC: Array, half_extents: Array, slack: Array) -> float:
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


def _nearest_depth(depth: AnyArray, lens: Lens, pixel: Array) -> float:
    """Return the least depth [m] around a pixel (2,), which is clipped into the image.

    It is infinite where no pixel around has a depth.
    """
    size = len(depth)
    u, v = np.clip(np.rint(pixel), 0, size - 1).astype(int)
    low = np.maximum([v - SILHOUETTE, u - SILHOUETTE], 0)
    around = depth[low[0] : v + SILHOUETTE + 1, low[1] : u + SILHOUETTE + 1]
    return float(around.min(initial=np.inf, where=lens.has_depth(around)))


def _points(X_AC: Array, lens: Lens, depth: AnyArray, chosen: AnyArray) -> Array:
    """Return the points p_AQ (m, 3) of the pixels where `chosen` (S, S) is true."""
    p_CQ = lens.rays_C[:, chosen] * depth[chosen]
    return np.asarray((X_AC[:3, :3] @ p_CQ).T + X_AC[:3, 3])
