"""Rules of how a sample holds: its words and limits, and the grasp at the end of the lift.

In: a `Batch` of samples of one data file, and the trials to compare with. Out: a `Violation` for
every row that is wrong. A rule relies on those that `data_file` applies before it. No file is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from drakegrasp.config import FilterConfig
from drakegrasp.dataset.checks.findings import (
    POSITION_TOLERANCE,
    AnyArray,
    Batch,
    Violation,
    rotation,
    unit_length,
)
from drakegrasp.dataset.checks.samples import move_each, rotate_each
from drakegrasp.dataset.filters import breaks_hold, breaks_surface
from drakegrasp.dataset.schema import LINEAGE_NAMES
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.verdict import is_precision, is_stable

#: float32 rounds slip [m] and turn [rad] by 2e-7 at most.
MOTION_TOLERANCE = 1e-6
#: float32 rounds forces [N] and joint positions [rad or m] by this share of them.
RELATIVE_TOLERANCE = 1e-5
#: Fields of `grasp_props` that are a trial's values as they are, and their names there.
COPIES = {
    "precision": "precision",
    "stable": "stable",
    "slip": "slip",
    "turn": "turn",
    "slip_released": "slip_released",
    "turn_released": "turn_released",
    "other_links_held": "lifted_other_links",
    "q": "closed_q",
    "q_held": "lifted_q",
    "area": "closed_area",
    "area_held": "lifted_area",
    **{name: name for name in LINEAGE_NAMES},
}


def poses(batch: Batch) -> Iterator[Violation]:
    """The palm's poses have orthonormal rotations, and the normals of held grasps length one."""
    for name in ("grasp_props/X_CG", "grasp_props/X_CG_held"):
        yield from rotation(batch, name)
    lengths = np.linalg.norm(batch.contacts("grasps_held")[1], axis=2)
    yield from unit_length(batch, lengths, "normal held by finger")


def words(batch: Batch) -> Iterator[Violation]:
    """`precision` and `stable` follow from the other links and the motion in the hand."""
    other_links = batch["grasp_props/other_links_held"]
    slip, turn = (batch[f"grasp_props/{name}"].astype(float) for name in ("slip", "turn"))
    precision, stable = (batch[f"grasp_props/{name}"] for name in ("precision", "stable"))
    success = np.full(len(batch), Outcome.SUCCESS.value)
    yield from batch.broken(
        "precision must follow from other_links_held",
        precision != is_precision(success, other_links),
        precision,
    )

    # On the limit rounding decides.
    surely, perhaps = (
        is_stable(success, other_links, slip + by, turn + by)
        for by in (MOTION_TOLERANCE, -MOTION_TOLERANCE)
    )
    yield from batch.broken(
        "stable must follow from other_links_held, slip and turn",
        (surely & ~stable) | (stable & ~perhaps),
        stable,
    )


def limits(batch: Batch, filters: FilterConfig) -> Iterator[Violation]:
    """Samples keep the limits of the hold in `filters`."""
    other_links = batch["grasp_props/other_links_held"]
    motion = (batch[f"grasp_props/{name}"].astype(float) for name in ("slip", "turn"))
    slip, turn = (values - MOTION_TOLERANCE for values in motion)
    for reason, bad in breaks_hold(filters, other_links, slip, turn):
        yield from batch.broken(
            f"a sample must pass the filter {reason.label}", bad, lambda i: "one that does not"
        )


def surface_limits(
    batch: Batch, trials: Mapping[str, AnyArray], filters: FilterConfig
) -> Iterator[Violation]:
    """Samples keep the limits of the contacts in `filters`, given the columns of their trials."""
    largest = (trials[name].max(axis=1) for name in ("surface_distance", "normal_angle"))
    for reason, bad in breaks_surface(filters, *largest):
        yield from batch.broken(
            f"a sample must pass the filter {reason.label}",
            bad,
            lambda i: "a trial that does not",
        )


def same_as_trial(batch: Batch, trials: Mapping[str, AnyArray], camera: str) -> Iterator[Violation]:
    """What is held follows from the trial, through the object's resting pose.

    Args:
        batch: The samples.
        trials: Columns of their trials, a row per sample.
        camera: `oto` or `otm`, the camera of their grasps.
    """
    # Contacts and palm in the camera's frame.
    X_CO = batch.frame(f"cam2work_{camera}") @ unpack_pose(trials["X_TO"])
    points, normals = batch.contacts("grasps_held")
    p_CQ = move_each(X_CO, trials["lifted_p_OQ"])
    n_C = rotate_each(X_CO, trials["lifted_nhat_Q_O"])
    expected = {
        "grasps_held": (np.stack([points, normals]), np.stack([p_CQ, n_C])),
        "X_CG": (batch.pose("grasp_props/X_CG"), X_CO @ unpack_pose(trials["X_OG"])),
        "X_CG_held": (
            batch.pose("grasp_props/X_CG_held"),
            X_CO @ unpack_pose(trials["X_OG_lifted"]),
        ),
    }
    for name, (values, due) in expected.items():
        axes = tuple(a for a in range(values.ndim) if a != (1 if name == "grasps_held" else 0))
        yield from _differs(batch, name, np.abs(values - due).max(axis=axes), POSITION_TOLERANCE)

    # Forces.
    for name, column in (("f_Q_C", "closed_f_Q_O"), ("f_Q_C_held", "lifted_f_Q_O")):
        due = rotate_each(X_CO, trials[column])
        off = np.abs(batch[f"grasp_props/{name}"] - due).max(axis=(1, 2))
        scale = np.linalg.norm(due, axis=2).max(axis=1)
        yield from _differs(batch, name, off, RELATIVE_TOLERANCE * (1.0 + scale))

    # Copies.
    for name, column in COPIES.items():
        values = batch[f"grasp_props/{name}"].astype(float).reshape(len(batch), -1)
        due = trials[column].astype(float).reshape(len(batch), -1)
        off = np.abs(values - due).max(axis=1)
        yield from _differs(batch, name, off, RELATIVE_TOLERANCE * np.abs(due).max(axis=1))


def _differs(batch: Batch, name: str, off: Array, tolerance: Array | float) -> Iterator[Violation]:
    yield from batch.broken(
        f"{name} must follow from its trial",
        ~(off <= tolerance),
        lambda i: f"a difference of {off[i]:.4g}",
    )
