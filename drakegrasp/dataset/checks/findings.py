"""Violations, the batches of rows in which rules look for them, and their collection.

In: rows of a group of a file, as a `Batch`, and for each whether it is bad. Out: `Violation`s,
one line each with file, row and figure, collected by `Findings`. The rules themselves are in the
modules that `run` lists; here is what more than one of them uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.frames import X_WT, Array, invert_pose, unpack_pose

AnyArray = npt.NDArray[Any]
#: float32 rounds unit vectors and rotations by 2e-7; this leaves room for products.
UNIT_TOLERANCE = 1e-5
#: float32 rounds points within a metre or two by 1e-7 m; this leaves room for products.
POSITION_TOLERANCE = 1e-5  # [m]
#: Rows listed per broken invariant and group; further rows are only counted.
MAX_LISTED = 20


@dataclass(frozen=True, kw_only=True)
class Violation:
    """One broken invariant.

    Attributes:
        file: Path within the dataset's directory.
        group: Group or split within the file, e.g. `/train`; empty for the whole file.
        row: Row of the group; None for all of it.
        what: The invariant in words, with its unit.
        got: The value that breaks it.
    """

    file: str
    group: str = ""
    row: int | None = None
    what: str
    got: str

    def __str__(self) -> str:
        place = " ".join(p for p in (self.file, self.group) if p)
        row = "" if self.row is None else f" row {self.row}"
        return f"{place}{row}: {self.what}, got {self.got}"


def of_file(file: str, what: str, got: str, group: str = "") -> Violation:
    """Return a violation of a file, or of a group of it, as a whole."""
    return Violation(file=file, group=group, what=what, got=got)


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Some rows of one group.

    Attributes:
        file: Path within the dataset's directory.
        group: Group of the file, e.g. `/train`.
        rows: (n,), numbers of the rows in the group.
        columns: Values by field, (n, ...) each.
    """

    file: str
    group: str
    rows: npt.NDArray[np.int64]
    columns: Mapping[str, AnyArray]

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> AnyArray:
        return self.columns[name]

    def pose(self, name: str) -> Array:
        """Return the poses (n, 4, 4) in a field."""
        return unpack_pose(self.columns[name])

    def frame(self, name: str) -> Array:
        """Return the poses (n, 4, 4) of a frame of `object_props`."""
        return self.pose(f"object_props/frame_{name}")

    def object_in_camera(self, camera: str) -> Array:
        """Return X_CO (n, 4, 4) of the object in a camera's frame."""
        return self.frame(f"cam2work_{camera}") @ invert_pose(X_WT) @ self.frame("world2obj")

    def contacts(self, name: str = "grasps") -> tuple[Array, Array]:
        """Return p_CQ [m] and nhat_Q_C of `grasps` or `grasps_held`, (n, k, 3) each."""
        vectors = self.columns[name].astype(float).reshape(len(self), 2, -1, 3)
        return vectors[:, 0], vectors[:, 1]

    def without(self, rows: set[int]) -> Batch:
        """Return the batch without rows of these numbers."""
        keep = ~np.isin(self.rows, sorted(rows))
        return Batch(
            file=self.file,
            group=self.group,
            rows=self.rows[keep],
            columns={name: values[keep] for name, values in self.columns.items()},
        )

    def broken(
        self, what: str, bad: AnyArray, got: Callable[[int], str] | AnyArray
    ) -> Iterator[Violation]:
        """Yield a violation for each row where `bad` (n,) is true.

        Args:
            what: The invariant in words.
            bad: (n,) bool.
            got: The values (n,) that break it, or their text by index into the batch.
        """
        for i in np.flatnonzero(bad).tolist():
            figure = got(i) if callable(got) else f"{got[i].item():.6g}"
            yield Violation(
                file=self.file, group=self.group, row=int(self.rows[i]), what=what, got=figure
            )


@dataclass
class Findings:
    """The violations of a check, up to MAX_LISTED per invariant and group of a file."""

    _listed: dict[tuple[str, str, str], list[Violation]] = field(default_factory=dict)
    _more: dict[tuple[str, str, str], int] = field(default_factory=dict)

    def add(self, violations: Iterable[Violation]) -> set[int]:
        """Collect violations; return the rows that they are in."""
        rows = set()
        for violation in violations:
            key = (violation.file, violation.group, violation.what)
            listed = self._listed.setdefault(key, [])
            if len(listed) < MAX_LISTED:
                listed.append(violation)
            else:
                self._more[key] = self._more.get(key, 0) + 1
            if violation.row is not None:
                rows.add(violation.row)
        return rows

    def merge(self, other: Findings) -> None:
        """Take over what a part of the check found; what two parts say of a file counts once."""
        for key, found in other._listed.items():
            listed = self._listed.setdefault(key, [])
            new = [v for v in found if v.row is not None or v not in listed]
            room = max(0, MAX_LISTED - len(listed))
            listed += new[:room]
            more = len(new[room:]) + other._more.get(key, 0)
            if more:
                self._more[key] = self._more.get(key, 0) + more

    def violations(self) -> list[Violation]:
        """Return the listed violations, with a line for those that were only counted."""
        result = []
        for key, listed in self._listed.items():
            result += listed
            if key in self._more:
                file, group, what = key
                got = f"{self._more[key]} more rows that break it"
                result.append(Violation(file=file, group=group, what=what, got=got))
        return result


def all_per_row(values: AnyArray) -> AnyArray:
    """Return for each row (n,) whether all of its values (n, ...) are true."""
    return np.asarray(values.all(axis=tuple(range(1, values.ndim))))


def unit_length(batch: Batch, lengths: Array, what: str) -> Iterator[Violation]:
    """Lengths (n, k) by finger are one."""
    for k in range(lengths.shape[1]):
        yield from batch.broken(
            f"{what} {k + 1} must have length 1 within {UNIT_TOLERANCE:g}",
            np.abs(lengths[:, k] - 1.0) > UNIT_TOLERANCE,
            lengths[:, k],
        )


def rotation(batch: Batch, name: str) -> Iterator[Violation]:
    """The pose of that name has an orthonormal rotation with determinant +1."""
    R = batch.pose(name)[:, :3, :3]
    # Poses that are NaN are none: `trials.stages` says where they must be.
    R = np.where(np.isfinite(R).all(axis=(1, 2), keepdims=True), R, np.eye(3))
    skew = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    determinant = np.linalg.det(R)
    yield from batch.broken(
        f"{name} must have an orthonormal rotation with determinant +1",
        (skew > UNIT_TOLERANCE) | (determinant < 0.0),
        lambda i: f"one that is off by {skew[i]:.3g}, with determinant {determinant[i]:.4g}",
    )
