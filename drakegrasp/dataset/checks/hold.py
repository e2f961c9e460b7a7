"""Rules of how a sample holds: its labels and limits, and the palm at the end of the lift.

In: a `Batch` of samples of one data file, and the trials to compare with. Out: a `Violation` for
every row that is wrong. A rule relies on those that `data_file` applies before it. No file is read.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from drakegrasp.config import FilterConfig
from drakegrasp.dataset.checks.findings import (
    AnyArray,
    Batch,
    Violation,
    rotation,
    unit_length,
)
from drakegrasp.dataset.filters import breaks_hold, breaks_surface
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.verdict import is_precision, is_stable

#: float32 rounds slip [m] and turn [rad] by 2e-7 at most.
MOTION_TOLERANCE = 1e-6


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
