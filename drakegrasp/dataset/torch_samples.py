"""The samples of a split as tensors of torch, which only this module imports.

Input: a `GraspDataset` and the names of fields. Output: a `torch.utils.data.Dataset`, whose items
torch itself collates and moves between processes. The module can also be imported without torch, so
that every module of the package can; `GraspDataset.to_torch` raises an error if torch is missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.schema import DATA_FIELDS

if TYPE_CHECKING:
    from drakegrasp.dataset.reader import GraspDataset

try:
    import torch
    from torch.utils.data import Dataset
except ModuleNotFoundError:
    Dataset = object

#: Fields that are read when a sample is requested; all other fields fit into memory.
_IMAGES = frozenset(field.name for field in DATA_FIELDS if field.sample)


class TorchSamples(Dataset):
    """Samples as dictionaries from field names to tensors; a text field is a str.

    Each process opens the file itself, and keeps the fields that are not images in memory: 72 bytes
    a sample for `grasps`.

    Args:
        data: The split.
        fields: Names of the fields, as `GraspDataset.column` takes them.

    Attributes:
        data, fields: The arguments.
    """

    def __init__(self, data: GraspDataset, fields: Sequence[str]) -> None:
        self.data, self.fields = data, tuple(fields)
        self._columns: dict[str, AnyArray] = {}

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> dict[str, Any]:
        row = self.data.row_of(index)
        return {name: self._value(name, row) for name in self.fields}

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_columns": {}}

    def _value(self, name: str, row: int) -> torch.Tensor | str:
        """Return a field of a sample; a tensor is a copy that the caller may change."""
        if name in _IMAGES:
            return torch.from_numpy(self.data.value(name, row))
        if name not in self._columns:
            self._columns[name] = self.data.column(name)
        value = self._columns[name][row]
        return str(value) if isinstance(value, str) else torch.from_numpy(np.array(value))
