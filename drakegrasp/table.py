"""A table: n rows by the names of their columns, for rows of any kind.

Attempts, trials, successes and verdicts are rows with the fields of `drakegrasp.dataset.schema`,
and with columns that are computed from these fields. Imports only NumPy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, overload

import numpy as np
import numpy.typing as npt

AnyArray = npt.NDArray[Any]


class Table(Mapping[str, AnyArray]):
    """n rows by the names of their columns: a mapping of names to arrays (n, ...).

    Columns are also attributes, e.g. `table.slip`. A table does not change; its arrays are not
    copied.

    Args:
        columns: Arrays (n, ...) by their names.
        named: More arrays, as keyword arguments.

    Raises:
        ValueError: If the columns differ in their number of rows.
    """

    def __init__(self, columns: Mapping[str, npt.ArrayLike] | None = None, **named: Any) -> None:
        arrays = {name: np.asarray(values) for name, values in {**(columns or {}), **named}.items()}
        counts = {len(values) for values in arrays.values()}
        if len(counts) > 1:
            said = ", ".join(f"{name} {len(values)}" for name, values in arrays.items())
            raise ValueError(f"columns must have the same number of rows, got {said}")
        self._columns, self.count = arrays, counts.pop() if counts else 0

    @overload
    def __getitem__(self, key: str) -> AnyArray: ...

    @overload
    def __getitem__(self, key: slice | Sequence[int] | AnyArray) -> Table: ...

    def __getitem__(self, key: str | slice | Sequence[int] | AnyArray) -> AnyArray | Table:
        """Return a column by its name, or a table of some rows: a slice, indices or a mask."""
        if isinstance(key, str):
            return self._columns[key]
        rows = key if isinstance(key, slice) else np.asarray(key)
        return Table({name: values[rows] for name, values in self._columns.items()})

    def __getattr__(self, name: str) -> AnyArray:
        # Pickle and copy look for methods before there are columns.
        if name.startswith("_"):
            raise AttributeError(name)
        if name not in self._columns:
            raise AttributeError(f"no column {name!r}: there are {', '.join(self.names)}")
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        """Return the number of columns, as for every mapping; `count` is the number of rows."""
        return len(self._columns)

    def __repr__(self) -> str:
        return f"Table of {self.count} rows: {', '.join(self.names)}"

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the columns, in order."""
        return (*self._columns,)

    def has(self, *names: str) -> bool:
        """Return whether the table has all columns of these names."""
        return all(name in self._columns for name in names)

    def with_columns(
        self, columns: Mapping[str, npt.ArrayLike] | None = None, **named: Any
    ) -> Table:
        """Return the table with more columns, or with some of its columns replaced."""
        return Table({**self._columns, **(columns or {}), **named})

    def only(self, *names: str) -> Table:
        """Return the table with only the columns of these names, as far as it has them."""
        return Table({name: self._columns[name] for name in names if name in self._columns})


def join(tables: Sequence[Table]) -> Table:
    """Return the concatenated rows of tables with the same columns."""
    first, *_ = tables
    return Table({name: np.concatenate([table[name] for table in tables]) for name in first})
