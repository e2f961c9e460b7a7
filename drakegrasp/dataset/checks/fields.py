"""The walk over the fields of a group: what each value must be by the schema, whatever its name.

In: a `Batch`, its fields, and how far each row got. Out: a `Violation` for every row in which a
field lacks its values or has too many, is out of its range, or is no rotation or no unit normal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from drakegrasp.dataset.checks.rows import AnyArray, Batch, Violation, all_per_row
from drakegrasp.dataset.schema import SPLITS, Field
from drakegrasp.filters import Removal
from drakegrasp.frames import Array
from drakegrasp.outcomes import Stage

#: float32 rounds unit vectors and rotations by 2e-7; this leaves room for products.
UNIT_TOLERANCE = 1e-5
#: What is positive, for a least value.
POSITIVE = 5e-324
#: Least and largest value of fields; NaN has no limits.
RANGES = {
    **dict.fromkeys(("slip", "slip_released", "certified_friction"), (0.0, np.inf)),
    **dict.fromkeys(("turn", "turn_released"), (0.0, np.pi)),
    **dict.fromkeys(("closed_penetration", "lifted_penetration"), (0.0, np.inf)),
    "certified_share": (0.0, 1.0),
    "p_hold_probability": (POSITIVE, 1.0),
    "object_props/work2mass": (POSITIVE, np.inf),
    "masks": (0, 1),
    "removal": (0, max(Removal)),
    "split": (0, len(SPLITS) - 1),
}


def complete(
    batch: Batch, fields: Sequence[Field], stage: AnyArray, contacts: dict[str, AnyArray]
) -> Iterator[Violation]:
    """Fields of numbers have values from their stage on, and none before.

    Args:
        batch: Rows of a group.
        fields: Its fields.
        stage: (n,), the stage that each row reached.
        contacts: (n, k), the fingers that have a contact, by instant: `closed`, `lifted`.
    """
    for f in fields:
        if f.derive is not None or f.name not in batch.columns:
            continue  # see `derived`; it is in no older file
        values, reached, late = batch[f.name], stage >= f.stage, f.stage is not Stage.PLACED
        by_finger = f.per_finger or f.axes == ("6k",)

        # What a value must be depends on its kind.
        if not f.dtype.startswith("float"):
            if not late:
                continue
            bad = ~reached & ~all_per_row(values == 0)
            what = f"{f.name} must be 0 before the stage {f.stage.name.lower()}"
        elif f.some:
            bad = ~reached & ~np.isnan(values)
            what = f"{f.name} must be NaN before the stage {f.stage.name.lower()}"
        elif by_finger:
            there = contacts["lifted" if "lifted" in f.name or "held" in f.name else "closed"]
            there = reached[:, None] & there
            if f.axes == ("6k",):
                there = np.tile(np.repeat(there, 3, axis=1), 2)
            bad = _is_not_as_due(values, there)
            what = f"{f.name} must be finite where the finger touches and NaN elsewhere"
        else:
            bad = _is_not_as_due(values, reached)
            what = f"{f.name} must be finite"
            what += f" from the stage {f.stage.name.lower()} on and NaN before" if late else ""
        yield from batch.broken(what, bad, lambda i: "the contrary")


def _is_not_as_due(values: AnyArray, due: AnyArray) -> AnyArray:
    """Return where (n,) values (n, ...) are not finite that are due, or not NaN that are not."""
    if due.all():
        return ~all_per_row(np.isfinite(values))
    due = due.reshape(*due.shape, *(1,) * (values.ndim - due.ndim))
    return ~all_per_row(np.where(due, np.isfinite(values), np.isnan(values)))


def ranges(batch: Batch, fields: Sequence[Field]) -> Iterator[Violation]:
    """Fields are within RANGES."""
    for f in fields:
        if f.name in RANGES and f.name in batch.columns and len(batch):
            values = batch[f.name].reshape(len(batch), -1)
            # In single precision the largest turn is beyond itself.
            low, high = (values.dtype.type(limit) for limit in RANGES[f.name])
            positive = RANGES[f.name][0] == POSITIVE
            what = f"above 0..{high:.4g}" if positive else f"{low:g}..{high:.4g}"
            bad = (values < low) | (values > high) | (positive & (values <= 0))
            worst = np.where(bad.any(axis=1), values[range(len(values)), bad.argmax(axis=1)], 0)
            yield from batch.broken(f"{f.name} must be {what}", bad.any(axis=1), worst)


def derived(batch: Batch, fields: Sequence[Field]) -> Iterator[Violation]:
    """Fields that follow from others by the schema have the values that it derives."""
    for f in fields:
        if f.derive is not None:
            yield from batch.follows(f.name, f.derive(batch.columns), ", ".join(f.needs))


def rigid(batch: Batch, fields: Sequence[Field]) -> Iterator[Violation]:
    """Poses are rigid motions, and normals have length one; NaN means there is none."""
    for f in fields:
        if f.name not in batch.columns:
            continue
        if f.axes[-1:] == (12,):
            yield from _rotation(batch, f.name)
        elif f.axes == ("6k",):
            vectors = batch[f.name].astype(float).reshape(len(batch), 2, -1, 3)
            yield from _unit_length(batch, f.name, vectors[:, 1])
        elif f.axes == ("k", 3) and "nhat" in f.name:
            yield from _unit_length(batch, f.name, batch[f.name].astype(float))


def _rotation(batch: Batch, name: str) -> Iterator[Violation]:
    """The poses of a field have orthonormal rotations with determinant +1."""
    R = batch.pose(name).reshape(len(batch), -1, 4, 4)[..., :3, :3]
    R = np.where(np.isfinite(R).all(axis=(2, 3), keepdims=True), R, np.eye(3))
    skew = np.abs(np.swapaxes(R, 2, 3) @ R - np.eye(3)).max(axis=(1, 2, 3))
    determinant = np.linalg.det(R).min(axis=1)
    yield from batch.broken(
        f"{name} must have an orthonormal rotation with determinant +1",
        (skew > UNIT_TOLERANCE) | (determinant < 0.0),
        lambda i: f"one that is off by {skew[i]:.3g}, with determinant {determinant[i]:.4g}",
    )


def _unit_length(batch: Batch, name: str, normals: Array) -> Iterator[Violation]:
    """Normals (n, k, 3) by finger have length one."""
    lengths = np.linalg.norm(normals, axis=2)
    for k, own in enumerate(lengths.T):
        what = f"{name} of finger {k + 1} must have length 1 within {UNIT_TOLERANCE:g}"
        yield from batch.broken(what, np.abs(own - 1.0) > UNIT_TOLERANCE, own)
