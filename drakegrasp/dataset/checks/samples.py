"""Rules of the numbers of a sample: its grasp, frames and mass properties.

In: a `Batch` of samples of one data file, and the object's model, the trials or the samples of the
other data file to compare with. Out: a `Violation` for every row that is wrong. A rule relies on
those that `data_file` applies before it: it is given no row that breaks one of them. No file is
read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.config import CameraConfig
from drakegrasp.dataset.assembly.samples import sample_values
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
from drakegrasp.frames import P_WT, X_WT, Array, invert_pose, pack_pose, unpack_pose
from drakegrasp.objects.contact_fit import fit_contacts
from drakegrasp.objects.model import ObjectModel
from drakegrasp.vision.camera import LOOKS_VERTICALLY, camera_pose_otm, camera_pose_oto

#: How skew an inertia may be, and by how much its moments may be none of a body, for rounding.
RELATIVE_TOLERANCE = 1e-5
#: How far a number may be from the same derived again, in units in the last place of its field's
#: largest value.
LAST_PLACES = 2
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


def class_of_object(batch: Batch, model: ObjectModel) -> Iterator[Violation]:
    """The class is that of the object."""
    class_names = batch["object_props/class_name"]
    yield from batch.broken(
        f"class_name of {model.name} must be {model.class_name!r}",
        class_names != model.class_name,
        lambda i: repr(class_names[i]),
    )


# A sample against its trial, and against its row in the other data file


def follows_from_trial(
    batch: Batch,
    trials: Mapping[str, AnyArray],
    models: Mapping[str, ObjectModel],
    camera: str,
    config: CameraConfig,
) -> Iterator[Violation]:
    """Every number of a sample is what assembling its trial gives.

    Of the mask's frame, which does not follow from the trial, the sample's own is taken.

    Args:
        batch: The samples.
        trials: Columns of their trials, a row per sample.
        models: Their objects, by name.
        camera: `oto` or `otm`, the camera of their grasps.
        config: The camera.
    """
    # Derive the samples again.
    rows = []
    for i, name in enumerate(batch["object_props/object_name"]):
        trial = {key: values[i] for key, values in trials.items()}
        X_TG = multiply(unpack_pose(trial["X_TO"]), unpack_pose(trial["X_OG"]))
        X_C0C = unpack_pose(trial["X_C0C"])
        look = {
            "X_TC_oto": pack_pose(camera_pose_oto(X_TG, config, X_C0C)),
            "X_TC_otm": pack_pose(camera_pose_otm(X_TG, config, X_C0C)),
            "X_CI_otm": batch["object_props/frame_cam2img_otm"][i],
        }
        rows.append(sample_values(models[name], trial, look, camera))

    # A last bit may differ between machines, where values are derived.
    for name in rows[0] if rows else ():
        values = batch[name]
        due = np.array([row[name] for row in rows]).astype(values.dtype).reshape(values.shape)
        differs = ~all_per_row(values == due)
        off = np.zeros(len(batch))
        if values.dtype.kind == "f":
            off, scale = (np.abs(v).reshape(len(v), -1).max(axis=1) for v in (values - due, due))
            differs = ~(off <= LAST_PLACES * np.spacing(scale))
        yield from batch.broken(
            f"{name} must follow from its trial",
            differs,
            lambda i, off=off: f"a difference of {off[i]:.4g}",  # type: ignore[misc]
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
