"""HDF5 files of a dataset: opening a file, writing a field, reading rows of images fast.

HDF5 spends most of the time of reading an image on decompression. libdeflate is four times as fast,
with the same result; it is used if the package `deflate` is installed.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.schema import Field
from drakegrasp.errors import DataError, first_line, printable
from drakegrasp.foreign_files import NAME_RULE, is_name, refuse_irregular
from drakegrasp.table import AnyArray as AnyArray
from drakegrasp.table import Table

try:
    import deflate
except ModuleNotFoundError:
    deflate = None

#: Largest number of bytes that the compression of HDF5 packs into one byte (zlib: 1,032 to 1).
MOST_PACKED = 1_032
#: Level of compression: higher levels save a tenth of the bytes for twice the time.
GZIP_LEVEL = 1
#: Number of rows in a chunk of a column of small values.
COLUMN_CHUNK = 2048


def open_hdf5(path: Path, *, again: bool = False) -> h5py.File:
    """Open a file of a dataset for reading; the caller closes it.

    An untrusted file may use links or external storage, or claim rows that it does not hold. Our
    files never do, so such a file is rejected.

    Args:
        path: Path of the file.
        again: Whether the same work has opened the file before; then it is not searched for these.

    Raises:
        OSError: If the file cannot be read.
        DataError: If the file has links, values stored outside of it, or more rows than it can
            hold.
    """
    refuse_irregular(path)
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        if "unable to lock file" not in str(error):
            raise
        raise OSError(
            "another program has it open to write: close it there, or, on a disk without locks, "
            "set HDF5_USE_FILE_LOCKING=FALSE"
        ) from None
    if again:
        return file

    # Search the file for links, values elsewhere and claimed rows.
    try:
        elsewhere = _find_elsewhere(file)
    except BaseException as error:
        file.close()
        if says_damage(error):
            raise OSError(first_line(error)) from None
        raise
    if elsewhere is not None:
        file.close()
        raise DataError(f"{path}: must hold its own values, got {printable(elsewhere)}")
    return file


def says_damage(error: BaseException) -> bool:
    """Return whether an error says that an HDF5 file is damaged.

    h5py then raises errors of many kinds, even a KeyError or a TypeError, but always from its code.
    """
    if isinstance(error, OSError | UnicodeDecodeError | MemoryError):
        return True
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return last is not None and "h5py" in Path(last.tb_frame.f_code.co_filename).parts


def _find_elsewhere(file: h5py.File) -> str | None:
    """Describe the first link, external dataset or impossible size in a file, or return None."""
    size = file.id.get_filesize()
    groups, seen = [(file.id, "")], set()
    while groups:
        group, path = groups.pop()
        for key in group:
            name = f"{path}/{key.decode(errors='replace')}"
            link = group.links.get_info(key)
            if link.type != h5py.h5l.TYPE_HARD:
                return f"a link at {name}"

            # An object may have several names, and a group may contain itself. A hard link has the
            # object's address; to ask the object, HDF5 would read the index of all its chunks.
            item = h5py.h5o.open(group, key)
            address = link.u
            if isinstance(item, h5py.h5g.GroupID) and address not in seen:
                groups.append((item, name))
            elif isinstance(item, h5py.h5d.DatasetID):
                made = item.get_create_plist()
                if made.get_external_count() > 0 or made.get_layout() == h5py.h5d.VIRTUAL:
                    return f"values outside of it at {name}"
                rows = int(item.get_space().get_simple_extent_npoints())
                if rows * int(item.get_type().get_size()) > MOST_PACKED * size:
                    return f"more rows than a file of {size:,} byte can hold at {name}"
            seen.add(address)
    return None


def read_texts(dataset: h5py.Dataset) -> tuple[str, ...]:
    """Return the texts of a dataset for display: all are printable, so none controls a terminal.

    Raises:
        DataError: If one of them is not text or cannot be printed.
    """
    path = dataset.file.filename
    try:
        texts = tuple(dataset.asstr()[:].tolist())
    except (TypeError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: must hold names, got others ({error})") from None
    for text in texts:
        if not text.isprintable():
            raise DataError(f"{path}: a name must be printable, got {text!r}")
    return texts


def read_names(dataset: h5py.Dataset) -> tuple[str, ...]:
    """Return the names of objects in a dataset of texts; they may become names of files.

    Raises:
        DataError: If one of them is not a valid name.
    """
    names = read_texts(dataset)
    for name in names:
        if not is_name(name):
            raise DataError(f"{dataset.file.filename}: a name must be {NAME_RULE}, got {name!r}")
    return names


def read_columns(
    group: h5py.Group,
    fields: Sequence[Field],
    names: Iterable[str] | None = None,
    rows: slice = slice(None),
) -> Table:
    """Return columns (n, ...) of a group of any file: trials, samples, scenes, or a shard.

    A column that the group lacks is derived from others, or empty if its field is optional.

    Args:
        group: The group.
        fields: All fields of the group, from which the shape of an empty column follows.
        names: Names of the columns; None for all fields.
        rows: The rows.

    Raises:
        DataError: If a column is missing.
        OSError: If a column cannot be read.
    """
    known = {field.name: field for field in fields}
    return Table({name: _column(group, known[name], rows, fields) for name in names or known})


def _column(group: h5py.Group, field: Field, rows: slice, fields: Sequence[Field]) -> AnyArray:
    if field.name in group:
        return _stored(group, field.name, rows, text=field.dtype == "str")
    if field.derive is not None and all(name in group for name in field.needs):
        columns = {name: _stored(group, name, rows) for name in field.needs}
        return field.derive(columns).astype(field.dtype, copy=False)
    if not field.optional:
        path = f"{group.name}/{field.name}"
        raise DataError(f"{group.file.filename}: {path} must be there, got none")
    (count, *_) = next(each.shape for each in group.values() if isinstance(each, h5py.Dataset))
    return field.empty(len(range(count)[rows]), sizes_in(group, fields))


def _stored(group: h5py.Group, name: str, rows: slice, *, text: bool = False) -> AnyArray:
    """Return rows of a column; a whole one in a third of the time that `group[name][:]` takes."""
    if text or rows != slice(None):
        dataset = group[name]
        return np.asarray((dataset.asstr() if text else dataset)[rows])
    column = h5py.h5d.open(group.id, name.encode())
    values = np.empty(column.shape, dtype=column.dtype)
    try:
        if values.size:
            column.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    except RuntimeError as error:
        raise OSError(str(error)) from None  # what HDF5 says of a damaged file
    return values


def sizes_in(group: h5py.Group, fields: Iterable[Field]) -> dict[str, int]:
    """Return the lengths of the letters in the shapes of the fields that a group has."""
    found: dict[str, int] = {}
    for field in fields:
        if any(isinstance(axis, str) for axis in field.axes) and field.name in group:
            axes = zip(field.axes, group[field.name].shape[1:], strict=False)
            found |= {axis: length for axis, length in axes if isinstance(axis, str)}
    return {"k": found["6k"] // 6, **found} if "6k" in found else found


def create_field(
    group: h5py.Group, field: Field, shape: tuple[int, ...], rows: int = 0
) -> h5py.Dataset:
    """Create the resizable dataset of a field, with a number of rows.

    Unit, frame and meaning become attributes. Each image is a chunk of its own, because loaders
    read single samples in random order.

    Args:
        group: Group of the dataset.
        field: The field.
        shape: Shape of one row.
        rows: Number of rows.
    """
    text = field.dtype == "str"
    dataset = group.create_dataset(
        field.name,
        shape=(0, *shape),
        maxshape=(None, *shape),
        dtype=h5py.string_dtype() if text else np.dtype(field.dtype),
        chunks=(1 if field.sample else COLUMN_CHUNK, *shape),
        compression="gzip",
        compression_opts=GZIP_LEVEL,
        shuffle=not text,
    )
    dataset.attrs.update({"unit": field.unit, "frame": field.frame, "meaning": field.meaning})
    if "j" in field.axes and "joints" in group.file.attrs:
        dataset.attrs["joints"] = group.file.attrs["joints"]
    dataset.resize(rows, axis=0)
    return dataset


def write_field(group: h5py.Group, field: Field, values: AnyArray) -> h5py.Dataset:
    """Create the dataset of a field from all of its rows (n, ...), see `create_field`."""
    dataset = create_field(group, field, values.shape[1:], len(values))
    if len(values):
        dataset[...] = values
    dataset.flush()  # see `write_fixed`
    return dataset


def packed_chunk(values: AnyArray, rows: int) -> bytes:
    """Return the bytes that HDF5 stores for a chunk of a column, as `create_field` packs it.

    Args:
        values: (n, ...), rows of the chunk.
        rows: Number of rows of the chunk, at least n; rows beyond the end of a column are zero.
    """
    whole = np.zeros((rows, *values.shape[1:]), dtype=values.dtype)
    whole[: len(values)] = values
    # The first bytes of all numbers are stored first, then the second bytes, and so on.
    planes = whole.reshape(-1).view(np.uint8).reshape(-1, values.dtype.itemsize).T
    return zlib.compress(planes.tobytes(), GZIP_LEVEL)


def write_fixed(group: h5py.Group, field: Field, values: AnyArray) -> None:
    """Create the dataset of a field from all of its rows (n, ...); no row can be added later.

    It is one chunk, or one for each image, and has no attributes, so HDF5 spends less than half of
    the bytes that it needs for the dataset of `write_field`.
    """
    if not len(values):
        group.create_dataset(field.name, data=values, dtype=field.dtype)
        return
    dataset = group.create_dataset(
        field.name,
        data=values,
        dtype=field.dtype,
        chunks=(1 if field.sample else len(values), *values.shape[1:]),
        compression="gzip",
        compression_opts=GZIP_LEVEL,
        shuffle=True,
    )
    # HDF5 finds places for the chunks when the last reference to the dataset is gone. A profiler in
    # another thread, such as that of Dask's workers, keeps references for a while, and the places
    # would depend on the time.
    dataset.flush()


class ImageRows:
    """The rows of a field of images, each of which is a chunk of its own.

    Args:
        dataset: The field in an open file.
    """

    def __init__(self, dataset: h5py.Dataset) -> None:
        self._dataset = dataset
        self._shape = dataset.shape[1:]
        self._origin = (0,) * len(self._shape)
        self._bytes = dataset.dtype.itemsize * int(np.prod(self._shape))

        # The filters of `create_field`. A file that was packed in another way is left to HDF5.
        pipeline = dataset.id.get_create_plist()
        filters = [pipeline.get_filter(k)[0] for k in range(pipeline.get_nfilters())]
        self._inflated_here = (
            deflate is not None
            and filters == [h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_DEFLATE]
            and dataset.chunks == (1, *self._shape)
            and dataset.dtype in (np.dtype("<f4"), np.dtype("<u2"), np.dtype("u1"))
        )

    def __getitem__(self, row: int) -> AnyArray:
        """Return the image of a row as a new array.

        Raises:
            OSError: If the chunk is damaged.
        """
        chunk = self._chunk(row) if self._inflated_here else None
        if chunk is None:
            return np.asarray(self._dataset[row])
        image = np.empty(self._shape, dtype=self._dataset.dtype)
        _unshuffle(self._inflate(chunk, row), image)
        return image

    def _chunk(self, row: int) -> bytes | None:
        """Return the stored bytes of a row; None if a filter was skipped, or nothing is stored."""
        try:
            skipped, chunk = self._dataset.id.read_direct_chunk((row, *self._origin))
        except RuntimeError:
            return None
        return None if skipped else chunk

    def _inflate(self, chunk: bytes, row: int) -> bytearray:
        try:
            content: bytearray = deflate.zlib_decompress(chunk, self._bytes)
        except deflate.DeflateError as error:
            raise OSError(f"the chunk of row {row} cannot be inflated ({error})") from None
        if len(content) != self._bytes:
            raise OSError(f"the chunk of row {row} must have {self._bytes} B, got {len(content)}")
        return content


def _unshuffle(content: bytearray, image: AnyArray) -> None:
    """Write numbers from a buffer with the first bytes of all numbers first, then the second."""
    *planes, highest = np.frombuffer(content, dtype=np.uint8).reshape(image.itemsize, -1)
    numbers = image.view(f"<u{image.itemsize}").reshape(-1)
    numbers[:] = highest
    for plane in reversed(planes):
        numbers <<= 8
        numbers |= plane
