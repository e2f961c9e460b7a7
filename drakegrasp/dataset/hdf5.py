"""A field of the schema in an HDF5 file: writing it, and reading the rows of images fast.

HDF5 spends most of the time of reading an image on inflating it. libdeflate does that four times
as fast; it is used where the package `deflate` is installed, with the same result.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import Field

try:
    import deflate
except ModuleNotFoundError:
    deflate = None

AnyArray = npt.NDArray[Any]
#: Rows in a chunk of a column of small values.
COLUMN_CHUNK = 2048


def create_field(group: h5py.Group, field: Field, shape: tuple[int, ...]) -> h5py.Dataset:
    """Create the dataset of a field, without rows; it can be resized.

    Unit, frame and meaning become attributes. An image is one chunk, because loaders read single
    samples in random order.

    Args:
        group: Where to create it.
        field: The field.
        shape: Shape of one row.
    """
    text = field.dtype == "str"
    dataset = group.create_dataset(
        field.name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=h5py.string_dtype() if text else np.dtype(field.dtype),
        chunks=(1 if field.sample else COLUMN_CHUNK, *shape),
        compression="gzip",
        compression_opts=1,
        shuffle=not text,
    )
    dataset.attrs.update({"unit": field.unit, "frame": field.frame, "meaning": field.meaning})
    return dataset


def write_field(group: h5py.Group, field: Field, values: AnyArray) -> h5py.Dataset:
    """Create the dataset of a field from all of its rows (n, ...), see `create_field`."""
    dataset = create_field(group, field, values.shape[1:])
    dataset.resize(len(values), axis=0)
    if len(values):
        dataset[...] = values
    return dataset


class ImageRows:
    """The rows of a field of images, each a chunk of its own.

    Args:
        dataset: The field in an open file.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._shape = dataset.shape[1:]
        self._origin = (0,) * len(self._shape)
        self._bytes = dataset.dtype.itemsize * int(np.prod(self._shape))

        # What `create_field` writes. A file that was packed otherwise is left to HDF5.
        pipeline = dataset.id.get_create_plist()
        filters = [pipeline.get_filter(k)[0] for k in range(pipeline.get_nfilters())]
        self._inflated_here = (
            deflate is not None
            and filters == [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]
            and dataset.chunks == (1, *self._shape)
            and dataset.dtype in (np.dtype("<f4"), np.dtype("u1"))
        )

    def __getitem__(self, row: int) -> AnyArray:
        """Return the image of a row, an array of its own.

        Raises:
            OSError: If the chunk is damaged.
        """
        chunk = self._chunk(row) if self._inflated_here else None
        return np.asarray(self._dataset[row]) if chunk is None else self._inflate(chunk, row)

    def _chunk(self, row: int) -> bytes | None:
        """Return what is stored of a row; None if no filter was applied, or nothing is."""
        try:
            skipped, chunk = self._dataset.id.read_direct_chunk((row, *self._origin))
        except RuntimeError:
            return None
        return None if skipped else chunk

    def _inflate(self, chunk: bytes, row: int) -> AnyArray:
        try:
            content = deflate.zlib_decompress(chunk, self._bytes)
        except deflate.DeflateError as error:
            raise OSError(f"the chunk of row {row} cannot be inflated ({error})") from None
        if len(content) != self._bytes:
            raise OSError(f"the chunk of row {row} must have {self._bytes} B, got {len(content)}")
        return _unshuffle(content, self._dataset.dtype).reshape(self._shape)


def _unshuffle(content: bytearray, dtype: np.dtype[Any]) -> AnyArray:
    """Return the numbers whose first bytes come first in a buffer, then the second ones."""
    planes = np.frombuffer(content, dtype=np.uint8).reshape(dtype.itemsize, -1)
    if dtype.itemsize == 1:
        return planes[0]
    numbers = planes[3].astype(np.uint32)
    for k in (2, 1, 0):
        numbers <<= 8
        numbers |= planes[k]
    return numbers.view(np.float32)
