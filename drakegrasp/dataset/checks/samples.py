"""Rules of the numbers of a sample: its grasp, frames, mass properties, and how it holds.

In: a `Batch` of samples of one data file, and for some rules the object's model. Out: a `Violation`
for every row that is wrong. A rule relies on those that `data_file` applies before it. That a
sample follows from its trial is for `assembled`. No file is read.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from drakegrasp.config import FilterConfig
from drakegrasp.dataset.checks.findings import Violation
from drakegrasp.dataset.checks.rows import (
    POSITION_TOLERANCE,
    UNIT_TOLERANCE,
    Batch,
    all_per_row,
    rotation,
    unit_length,
)
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS
from drakegrasp.filters import rules_of_hold
from drakegrasp.frames import P_WT, X_WT, Array, invert_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.objects.model import ObjectModel, fit_contacts
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.verdict import is_precision, is_stable
from drakegrasp.table import Table
from drakegrasp.vision.camera import LOOKS_VERTICALLY

#: How skew an inertia may be, and by how much its moments may be none of a body, for rounding.
RELATIVE_TOLERANCE = 1e-5
#: float32 rounds slip [m] and turn [rad] by 2e-7 at most.
MOTION_TOLERANCE = 1e-6
GRASPS = ("grasps", "grasps_held")
POSES = (
    *(f.name for f in DATA_FIELDS if f.name.startswith("object_props/frame_")),
    *("grasp_props/X_CG", "grasp_props/X_CG_held"),
)


# Values, one by one


def finite(batch: Batch) -> Iterator[Violation]:
    """No number of a sample is NaN or infinite but the contacts of fingers that it leaves out."""
    for f in DATA_FIELDS:
        # What a row may lack is compared with its trial.
        if f.dtype.startswith("float") and not f.some:
            sound = np.isfinite(batch[f.name])
            if f.name in GRASPS:
                # A contact of a finger that its preshape leaves out is NaN.
                unused = unused_fingers(batch["grasp_props/unused"], sound.shape[1] // 6)
                sound = sound ^ np.tile(np.repeat(unused, 3, axis=1), 2)
            bad = ~all_per_row(sound)
            yield from batch.broken(
                f"{f.name} must be finite", bad, lambda i: "NaN or an infinite value"
            )


def directions(batch: Batch) -> Iterator[Violation]:
    """Normals have length one, and the rotation of every pose is one."""
    for name, what in (("grasps", "normal of finger"), ("grasps_held", "normal held by finger")):
        lengths = np.linalg.norm(batch.contacts(name)[1], axis=2)
        unused = unused_fingers(batch["grasp_props/unused"], lengths.shape[1])
        yield from unit_length(batch, np.where(unused, 1.0, lengths), what)
    for name in POSES:
        yield from rotation(batch, name)


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


def hold(batch: Batch, filters: FilterConfig) -> Iterator[Violation]:
    """A sample keeps the limits of the hold in `filters`, and is called as it holds."""
    other_links = batch["grasp_props/other_links_held"]
    slip, turn = (batch[f"grasp_props/{name}"].astype(float) for name in ("slip", "turn"))
    least = Table(
        other_links=other_links, slip=slip - MOTION_TOLERANCE, turn=turn - MOTION_TOLERANCE
    )
    for rule in rules_of_hold():
        if rule.is_on(filters) and least.has(*rule.needs):
            what = f"a sample must pass the filter {rule.removal.label}"
            yield from batch.broken(
                what, rule.refuses(least, filters), lambda i: "one that does not"
            )

    # On the limit rounding decides.
    success = np.full(len(batch), Outcome.SUCCESS.value)
    precision, stable = (batch[f"grasp_props/{name}"] for name in ("precision", "stable"))
    what, bad = "precision must follow from other_links_held", is_precision(success, other_links)
    yield from batch.broken(what, precision != bad, precision)
    surely, perhaps = (
        is_stable(success, other_links, slip + by, turn + by)
        for by in (MOTION_TOLERANCE, -MOTION_TOLERANCE)
    )
    what = "stable must follow from other_links_held, slip and turn"
    yield from batch.broken(what, (surely & ~stable) | (stable & ~perhaps), stable)


# The frames of a sample among each other


def fixed_frames(batch: Batch) -> Iterator[Violation]:
    """The table-top frame is at P_WT; work2cam and cam2work are inverse to each other."""
    off = np.abs(batch.frame("world2work") - X_WT).max(axis=(1, 2))
    yield from batch.broken(
        f"frame_world2work must be the identity at {P_WT.tolist()} m",
        off > POSITION_TOLERANCE,
        lambda i: f"a pose that is off by {off[i]:.4g}",
    )
    for camera in CAMERAS:
        product = batch.frame(f"work2cam_{camera}") @ batch.frame(f"cam2work_{camera}")
        apart = np.abs(product - np.eye(4)).max(axis=(1, 2))
        yield from batch.broken(
            f"frame_work2cam_{camera} times frame_cam2work_{camera} must be the identity",
            apart > POSITION_TOLERANCE,
            lambda i, apart=apart: f"a product that is off by {apart[i]:.4g}",  # type: ignore[misc]
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
    n_O = np.einsum("nij,nkj->nki", X_OC[:, :3, :3], n_C)
    p_OQ = np.einsum("nij,nkj->nki", X_OC[:, :3, :3], p_CQ) + X_OC[:, None, :3, 3]
    fit = fit_contacts(model, p_OQ.reshape(-1, 3), n_O.reshape(-1, 3))
    shape = p_OQ.shape[:2]
    off: Array = fit.distance.reshape(shape)
    angle = np.degrees(fit.normal_angle).reshape(shape)

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
