"""What must hold in the images of a sample: what is seen is the object and the table.

In: a `Batch` of samples of one data file and the `Lens` it was taken with, for what is seen
of the object its mesh too. Out: a `Violation` for every row and figure that is wrong. No
file is read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drakegrasp.config import CameraConfig
from drakegrasp.dataset.checks.findings import UNIT_TOLERANCE, AnyArray, Batch, Violation
from drakegrasp.frames import Array, invert_pose, transform_points
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.camera import intrinsics, project, unproject

#: Depth images reproduce the table and the mesh to 1e-6 m when the lens is right. Half a pixel
#: of error moves them by 1 to 3 mm, so this tells the two apart.
DEPTH_TOLERANCE = 3e-4  # [m]
#: A contact on the object's outline falls beside the mask by rounding, and a contact point may
#: be off the full mesh by what the collision mesh and `filters.max_surface_distance` allow.
MASK_TOLERANCE = 2.0  # [px]
#: A contact is on the surface that is seen or behind it; at outlines the depth image jumps, so
#: the nearest surface within this many pixels counts, and the same 2 mm and a slope are allowed.
SILHOUETTE = 2  # [px]
BEFORE_SURFACE = 5e-3  # [m]
#: The image frame's origin is the mask's centroid itself, unprojected.
CENTROID_TOLERANCE = 0.05  # [px]
#: Mask pixels per image whose distance from the mesh is measured; the box test takes all.
MEASURED_PIXELS = 16
#: The table's slab (models/table.sdf): half edges and centre in {T} [m].
TABLE_HALF = np.array([0.8, 0.8, 0.05])
P_TTABLE = np.array([0.0, 0.0, -0.05])


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """The camera of a data file: its name, matrix K (3, 3) [px] and range [m]."""

    camera: str
    K: Array
    near: np.float32
    far: np.float32

    @classmethod
    def of(cls, camera: str, config: CameraConfig) -> Lens:
        """Return the lens of a configuration; images hold its range rounded to float32."""
        return cls(
            camera=camera,
            K=intrinsics(config),
            near=np.float32(config.near),
            far=np.float32(config.far),
        )


def image_values(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """Colours are within 0..1, depths within near..far."""
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
    """A mask holds nothing but 0 and 1, and at least one 1."""
    largest = batch["masks"].reshape(len(batch), -1).max(axis=1)
    yield from batch.broken("mask must hold 0 and 1 only", largest > 1, largest)
    yield from batch.broken(
        "mask must have an object pixel", largest == 0, lambda i: "an empty mask"
    )


def image_frames(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """The image frame is before the camera, faces away, and in otm starts at the centroid."""
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


# What is seen


def contacts_in_image(batch: Batch, lens: Lens) -> Iterator[Violation]:
    """Contacts project onto the mask, and lie on the surface that is seen or behind it."""
    p_CQ, _ = batch.contacts()
    for finger in range(p_CQ.shape[1]):
        z = p_CQ[:, finger, 2]
        beside, before = np.zeros(len(batch)), np.zeros(len(batch))
        for i in np.flatnonzero(z > 0.0):
            (pixel,) = project(lens.K, p_CQ[i, finger, None])
            v, u = np.nonzero(batch["masks"][i])
            beside[i] = np.hypot(u - pixel[0], v - pixel[1]).min()
            if beside[i] <= MASK_TOLERANCE:
                before[i] = _nearest_depth(batch["images"][i, 3], pixel) - z[i]
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
    """What is seen beside the object, nearer than far, is the table."""
    X_TC = invert_pose(batch.frame(f"cam2work_{lens.camera}"))
    off = np.zeros(len(batch))
    for i in range(len(batch)):
        depth = batch["images"][i, 3]
        p_TQ = _seen_points(X_TC[i], lens, depth, (batch["masks"][i] == 0) & (depth < lens.far))
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
    """What is seen in the mask is the object: in its bounding box, and on its surface."""
    X_OC = invert_pose(batch.object_in_camera(lens.camera))
    beyond, chosen = np.zeros(len(batch)), []
    for i in range(len(batch)):
        p_OQ = _seen_points(X_OC[i], lens, batch["images"][i, 3], batch["masks"][i] == 1)
        beyond[i] = (np.abs(p_OQ) - model.half_extents).max()
        chosen.append(p_OQ[np.linspace(0, len(p_OQ) - 1, MEASURED_PIXELS).astype(int)])
    yield from batch.broken(
        f"points in the mask must be in the object's box within {DEPTH_TOLERANCE:g} m",
        beyond > DEPTH_TOLERANCE,
        beyond,
    )
    _, distance, _ = model.visual.nearest.on_surface(np.concatenate(chosen))
    off = distance.reshape(len(batch), -1).max(axis=1)
    yield from batch.broken(
        f"points in the mask must be on the object's mesh within {DEPTH_TOLERANCE:g} m",
        (off > DEPTH_TOLERANCE) & (beyond <= DEPTH_TOLERANCE),
        off,
    )


def _nearest_depth(depth: AnyArray, pixel: Array) -> float:
    """Return the least depth [m] around a pixel, clipped into the image."""
    size = len(depth)
    u, v = np.clip(np.rint(pixel), 0, size - 1).astype(int)
    low = np.maximum([v - SILHOUETTE, u - SILHOUETTE], 0)
    return float(depth[low[0] : v + SILHOUETTE + 1, low[1] : u + SILHOUETTE + 1].min())


def _seen_points(X_AC: Array, lens: Lens, depth: AnyArray, chosen: AnyArray) -> Array:
    """Return the points p_AQ (m, 3) of the pixels where `chosen` (S, S) is true."""
    v, u = np.nonzero(chosen)
    return transform_points(X_AC, unproject(lens.K, np.column_stack([u, v]), depth[v, u]))
