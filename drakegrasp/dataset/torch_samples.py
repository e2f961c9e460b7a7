"""The samples of a split as tensors of torch, which only this module imports.

Input: a `GraspDataset` and the names of fields. Output: a `torch.utils.data.Dataset`, whose items
torch itself collates and moves between processes. The module can also be imported without torch, so
that every module of the package can; `GraspDataset.to_torch` raises an error if torch is missing.

A loader requests all samples of a batch at once. Their images are read directly into the block of
the batch; in a worker this block is in memory that the worker shares with the training process.
Images read one by one would be written three times each, always into new pages, which takes as long
as decompressing them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import DATA_FIELDS

if TYPE_CHECKING:
    from drakegrasp.dataset.reader import GraspDataset

try:
    import torch
    from torch.utils.data import Dataset, get_worker_info
    from torch.utils.data._utils.collate import collate, default_collate_fn_map
except ModuleNotFoundError:
    Dataset = object
    default_collate_fn_map = {}

#: Fields of a sample by name.
_FIELDS = {field.name: field for field in DATA_FIELDS}
#: Fields that are read when a sample is requested; all other fields fit into memory.
_IMAGES = frozenset(name for name, field in _FIELDS.items() if field.sample)


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
        self._columns: dict[str, npt.NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> dict[str, Any]:
        row = self.data.row_of(index)
        return {name: self._tensor(name, row) for name in self.fields}

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """Return the samples of a batch, as torch's loaders request them.

        Each sample is a dictionary like `self[i]`. Its tensors are rows of one block, which torch's
        default collation returns unchanged.
        """
        rows = [self.data.row_of(index) for index in indices]
        block = {name: self._tensors(name, rows) for name in self.fields}
        views = [{name: values[k] for name, values in block.items()} for k in range(len(rows))]
        return [_Row(view, block, views) for view in views]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_columns": {}}

    def _tensor(self, name: str, row: int) -> torch.Tensor | str:
        """Return a field of a sample; the tensor is a copy that the caller may change."""
        if name in _IMAGES:
            return torch.from_numpy(self.data.value(name, row))
        value = self._column(name)[row]
        return str(value) if isinstance(value, str) else torch.from_numpy(np.array(value))

    def _tensors(self, name: str, rows: Sequence[int]) -> torch.Tensor | list[str]:
        """Return a field of several samples as a new tensor; shared memory if in a worker."""
        # Texts form a list, as torch collates them.
        if _FIELDS[name].dtype == "str":
            return [str(text) for text in self._column(name)[rows]]

        # Only a worker passes its tensors to another process.
        field, size = _FIELDS[name], {"S": self.data.image_size}
        shape = field.row_shape(size) if name in _IMAGES else self._column(name).shape[1:]
        values = torch.from_numpy(np.empty((len(rows), *shape), dtype=field.dtype))
        if get_worker_info() is not None:
            values.share_memory_()

        if name in _IMAGES:
            self.data.read_images(name, rows, values.numpy())
        else:
            values.numpy()[...] = self._column(name)[rows]
        return values

    def _column(self, name: str) -> npt.NDArray[Any]:
        """Return all rows of a field that is not an image."""
        if name not in self._columns:
            self._columns[name] = self.data.column(name)
        return self._columns[name]


class _Row(dict[str, Any]):
    """A sample whose tensors are rows of the block of its batch.

    Attributes:
        block: Fields of the whole batch.
        views: Dictionaries of the batch's samples as they were read, in order.
    """

    def __init__(
        self, values: dict[str, Any], block: dict[str, Any], views: list[dict[str, Any]]
    ) -> None:
        super().__init__(values)
        self.block, self.views = block, views

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy as a plain dictionary."""
        return dict, (dict(self),)


def _collate_rows(batch: list[_Row], *, collate_fn_map: dict[Any, Any] | None = None) -> Any:
    """Return the block of a batch; if a sample was changed, collate the samples one by one."""
    views = batch[0].views
    whole = len(batch) == len(views) and all(
        row.keys() == view.keys() and all(row[name] is value for name, value in view.items())
        for row, view in zip(batch, views, strict=True)
    )
    if whole:
        return batch[0].block
    return collate([dict(row) for row in batch], collate_fn_map=collate_fn_map)


# This is the documented way to register a type with torch's default collation.
default_collate_fn_map[_Row] = _collate_rows
