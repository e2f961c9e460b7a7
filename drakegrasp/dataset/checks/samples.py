"""Rules of the numbers of a sample: its grasp, frames and mass properties.

In: a `Batch` of samples of one data file, and the object's model, the trials or the samples of the
other data file to compare with. Out: a `Violation` for every row that is wrong. A rule relies on
those that `data_file` applies before it: it is given no row that breaks one of them. No file is
read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from drakegrasp.config import CameraConfig
from drakegrasp.dataset.checks.findings import (
    POSITION_TOLERANCE,
    UNIT_TOLERANCE,
    AnyArray,
    Batch,
    Violation,
    all_per_row,
    rotation,
    unit_length,
)
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, SHARED_FIELDS
from drakegrasp.frames import P_WT, X_WT, Array, invert_pose, unpack_pose
from drakegrasp.objects.contact_fit import fit_contacts
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.camera import LOOKS_VERTICALLY, camera_pose_otm, camera_pose_oto

#: Mass properties are float32 copies of the object's own.
RELATIVE_TOLERANCE = 1e-5
FRAMES = tuple(f.name for f in DATA_FIELDS if f.name.startswith("object_props/frame_"))


# Values, one by one


def finite(batch: Batch) -> Iterator[Violation]:
    """No number of a sample is NaN or infinite."""
    for f in DATA_FIELDS:
        if f.dtype.startswith("float"):
            bad = ~all_per_row(np.isfinite(batch[f.name]))
            yield from batch.broken(
                f"{f.name} must be finite", bad, lambda i: "NaN or an infinite value"
            )


def normals(batch: Batch) -> Iterator[Violation]:
    """Normals have length one."""
    lengths = np.linalg.norm(batch.contacts()[1], axis=2)
    yield from unit_length(batch, lengths, "normal of finger")


def frames(batch: Batch) -> Iterator[Violation]:
    """The rotation of every frame is orthonormal with determinant +1."""
    for name in FRAMES:
        yield from rotation(batch, name)


def work_frame(batch: Batch) -> Iterator[Violation]:
    """The table-top frame is at P_WT."""
    off = np.abs(batch.frame("world2work") - X_WT).max(axis=(1, 2))
    yield from batch.broken(
        f"frame_world2work must be the identity at {P_WT.tolist()} m",
        off > POSITION_TOLERANCE,
        lambda i: f"a pose that is off by {off[i]:.4g}",
    )


def mass_properties(batch: Batch) -> Iterator[Violation]:
    """Masses are positive; inertias are symmetric and possible for a body.

    The principal moments of a body are positive, and none is more than the sum of the others.
    """
    mass = batch["object_props/work2mass"][:, 0].astype(float)
    yield from batch.broken("work2mass must be positive [kg]", mass <= 0.0, mass)
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


# The frames of a sample among each other


def inverse_frames(batch: Batch) -> Iterator[Violation]:
    """work2cam and cam2work are inverse to each other."""
    for camera in CAMERAS:
        product = batch.frame(f"work2cam_{camera}") @ batch.frame(f"cam2work_{camera}")
        off = np.abs(product - np.eye(4)).max(axis=(1, 2))
        yield from batch.broken(
            f"frame_work2cam_{camera} times frame_cam2work_{camera} must be the identity",
            off > POSITION_TOLERANCE,
            lambda i, off=off: f"a product that is off by {off[i]:.4g}",  # type: ignore[misc]
        )


def camera_pair(batch: Batch) -> Iterator[Violation]:
    """Both cameras have one place and one view direction; otm has world up at the top."""
    oto, otm = (batch.frame(f"work2cam_{camera}") for camera in CAMERAS)
    off = np.abs(oto[:, :3, 2:] - otm[:, :3, 2:]).max(axis=(1, 2))
    yield from batch.broken(
        "both cameras must have the same place and view",
        off > POSITION_TOLERANCE,
        lambda i: f"poses that are off by {off[i]:.4g}",
    )
    tilt = np.abs(otm[:, 2, 0])
    yield from batch.broken(
        "the otm camera must have world up at the top of its image",
        (tilt > LOOKS_VERTICALLY + UNIT_TOLERANCE) | (otm[:, 2, 1] > LOOKS_VERTICALLY),
        lambda i: f"+Cx and +Cy that rise by {otm[i, 2, 0]:.4g} and {otm[i, 2, 1]:.4g}",
    )


# The samples of one object, against its mesh


def contacts_on_mesh(
    batch: Batch, camera: str, model: ObjectModel, max_distance: float
) -> Iterator[Violation]:
    """Contacts are on the mesh, and their normals point out of it.

    A normal counts as outward if it agrees with either face of `ContactFit.normal_angle`.

    Args:
        batch: Samples of one object.
        camera: `oto` or `otm`, the camera of their grasps.
        model: The object.
        max_distance: Largest distance of a contact from the mesh [m].
    """
    # Contacts in {O}, and how they lie there.
    X_OC = invert_pose(batch.object_in_camera(camera))
    p_CQ, n_C = batch.contacts()
    p_OQ, n_O = move_each(X_OC, p_CQ), rotate_each(X_OC, n_C)
    shape = p_OQ.shape[:2]
    fit = fit_contacts(model, p_OQ.reshape(-1, 3), n_O.reshape(-1, 3))
    off, angle = fit.distance.reshape(shape), np.degrees(fit.normal_angle).reshape(shape)

    limit = max_distance + POSITION_TOLERANCE
    for k in range(shape[1]):
        yield from batch.broken(
            f"contact of finger {k + 1} must be on the object's mesh within {max_distance:g} m",
            off[:, k] > limit,
            off[:, k],
        )
        yield from batch.broken(
            f"normal of finger {k + 1} must point out of the object, within 90 deg of its face's",
            (angle[:, k] > 90.0) & (off[:, k] <= limit),
            lambda i, k=k: f"{angle[i, k]:.4g} deg",  # type: ignore[misc]
        )


def object_values(batch: Batch, model: ObjectModel) -> Iterator[Violation]:
    """Class and mass properties are those of the object at rest."""
    # Mass properties in {T}.
    X_TO = invert_pose(X_WT) @ batch.frame("world2obj")
    R_TO = X_TO[:, :3, :3]
    com = R_TO @ model.p_OOcm + X_TO[:, :3, 3]
    # The mass is that of the trial, and the inertia in proportion.
    factor = batch["object_props/work2mass"][:, 0].astype(float) / model.mass
    inertia = (R_TO @ model.I_OOcm_O @ np.swapaxes(R_TO, 1, 2)).reshape(-1, 9) * factor[:, None]
    scale = RELATIVE_TOLERANCE * np.trace(model.I_OOcm_O) * max(1.0, factor.max())
    for name, unit, values, tolerance in (
        ("work2com", "m", com, POSITION_TOLERANCE),
        ("work2inertia", "kg m^2", inertia, scale),
    ):
        off = np.abs(batch[f"object_props/{name}"] - values).max(axis=1)
        yield from batch.broken(
            f"{name} must be the resting object's within {tolerance:.1g} {unit}",
            off > tolerance,
            lambda i, off=off: f"a difference of {off[i]:.4g}",  # type: ignore[misc]
        )

    class_names = batch["object_props/class_name"]
    yield from batch.broken(
        f"class_name of {model.name} must be {model.class_name!r}",
        class_names != model.class_name,
        lambda i: repr(class_names[i]),
    )


# A sample against its trial, and against its row in the other data file


def same_as_trial(
    batch: Batch, trials: Mapping[str, AnyArray], camera: str, config: CameraConfig
) -> Iterator[Violation]:
    """Pose, cameras and contacts of a sample follow from its trial.

    Args:
        batch: The samples.
        trials: Columns of their trials, a row per sample.
        camera: `oto` or `otm`, the camera of their grasps.
        config: The camera.
    """
    # The object's pose and both cameras' poses.
    X_TO, X_OG = unpack_pose(trials["X_TO"]), unpack_pose(trials["X_OG"])
    poses = {"frame_world2obj": X_WT @ X_TO}
    starts = list(zip(X_TO @ X_OG, unpack_pose(trials["X_C0C"]), strict=True))
    for name, pose in zip(CAMERAS, (camera_pose_oto, camera_pose_otm), strict=True):
        X_TC = [pose(X_TG, config, X_C0C) for X_TG, X_C0C in starts]
        poses[f"frame_work2cam_{name}"] = np.array(X_TC).reshape(-1, 4, 4)
    for name, expected in poses.items():
        off = np.abs(batch.pose(f"object_props/{name}") - expected).max(axis=(1, 2))
        yield from batch.broken(
            f"{name} must follow from its trial within {POSITION_TOLERANCE:g} m",
            off > POSITION_TOLERANCE,
            lambda i, off=off: f"a pose that is off by {off[i]:.4g}",  # type: ignore[misc]
        )

    # The contacts, in the camera frame.
    X_CO = batch.frame(f"cam2work_{camera}") @ X_TO
    p_CQ, n_C = move_each(X_CO, trials["closed_p_OQ"]), rotate_each(X_CO, trials["closed_nhat_Q_O"])
    points, normals = batch.contacts()
    off = np.maximum(np.abs(points - p_CQ).max(axis=(1, 2)), np.abs(normals - n_C).max(axis=(1, 2)))
    yield from batch.broken(
        f"grasp must be its trial's contacts within {POSITION_TOLERANCE:g} m",
        ~(off <= POSITION_TOLERANCE),
        lambda i: f"a difference of {off[i]:.4g}",
    )


def same_properties(batch: Batch, other: Batch) -> Iterator[Violation]:
    """Both data files hold the same trial and the same properties in a row."""
    same_trial = batch["trial_id"] == other["trial_id"]
    yield from other.broken(
        f"trial_id must be that of {batch.file}", ~same_trial, other["trial_id"]
    )
    for name in (f.name for f in SHARED_FIELDS if f.name != "trial_id"):
        differs = same_trial & ~all_per_row(batch[name] == other[name])
        yield from batch.broken(
            f"{name} must be equal to that of {other.file}", differs, lambda i: "another value"
        )


def move_each(X_AB: Array, p_BQ: Array) -> Array:
    """Return points p_AQ (n, k, 3) [m] of p_BQ (n, k, 3), each row with its own pose (n, 4, 4)."""
    return rotate_each(X_AB, p_BQ) + X_AB[:, None, :3, 3]


def rotate_each(X_AB: Array, v_B: Array) -> Array:
    """Return vectors (n, k, 3) of frame B in frame A, each row with its own pose (n, 4, 4)."""
    return np.asarray(np.einsum("nij,nkj->nki", X_AB[:, :3, :3], v_B))
