"""HDF5 files of a dataset: opened, compared with the schema, read and written.

Input: a path, or an open file and the fields of its groups. Output: an open file that contains
every group, dataset and attribute of the schema with its type and shape, or every `Difference`; its
columns. Commands reject a file at the first difference, and `drakegrasp check` lists all of them.
Imports only NumPy and h5py.

HDF5 spends most of the time of reading an image on decompression. libdeflate is four times as fast,
with the same result; it is used if the package `deflate` is installed.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from io import BufferedReader
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import (
    CAMERAS,
    CLUTTER_REACH_TABLES,
    DATA_TABLES,
    LETTERS,
    REACH_TABLES,
    SCENE_TABLES,
    TRIAL_TABLES,
    Field,
    Tables,
    validate_schema_version,
)
from drakegrasp.errors import DataError, first_line, printable
from drakegrasp.foreign_files import parse_json, validate_regular
from drakegrasp.runtime.files import SEAL_SIZE, open_sealed
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


# Files


def open_hdf5(
    path: Path, *, again: bool = False, content: BufferedReader | None = None
) -> h5py.File:
    """Open a file of a dataset for reading; the caller closes it.

    An untrusted file may use links or external storage, or claim rows that it does not hold. Our
    files never do, so such a file is rejected.

    Args:
        path: Path of the file.
        again: Whether the same work has opened the file before; then it is not searched for these.
        content: The file, if it is open already.

    Raises:
        OSError: If the file cannot be read.
        DataError: If the file has links, values stored outside of it, or more rows than it can
            hold.
    """
    validate_regular(path)
    try:
        file = h5py.File(content or path, "r")
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


@contextmanager
def opened(
    path: Path, what: str, *, again: bool = False, content: BufferedReader | None = None
) -> Iterator[h5py.File]:
    """Open an HDF5 file while the block runs; HDF5 errors in the block become a DataError.

    Args:
        path: Path of the file.
        what: What the file must be, in words.
        again: See `open_hdf5`.
        content: See `open_hdf5`.

    Raises:
        DataError: If the file is missing or damaged.
    """
    if path.is_dir():
        raise DataError(f"{path}: must be {what}, got a folder; name the file in it")
    try:
        with open_hdf5(path, again=again, content=content) as file:
            yield file
    except DataError:
        raise
    except Exception as error:
        if not says_damage(error):
            raise
        raise DataError(f"{path}: must be {what}, got none ({first_line(error)})") from None


@contextmanager
def opened_sealed(
    path: Path, what: str, *, verify: bool = True
) -> Iterator[tuple[h5py.File, bytes]]:
    """Open a sealed file once, to verify and to read it; yield it and its seal.

    Args:
        path: Path of the file.
        what: What the file is, in words.
        verify: Whether to verify the seal first: an intact file is as it was written.

    Raises:
        DataError: If the file is missing, or a bit of it has changed.
    """
    with open_sealed(path, what, verify=verify) as content:
        seal = content.read(SEAL_SIZE)
        with opened(path, f"a complete {what}", again=not verify, content=content) as file:
            yield file, seal


class Difference(NamedTuple):
    """A difference between a file and the schema.

    Attributes:
        path: Path of the group or the dataset; empty for the whole file.
        what: What the file must have there, in words.
        got: What the file has there instead.
    """

    path: str
    what: str
    got: str

    def __str__(self) -> str:
        return f"{self.path + ': ' if self.path else ''}{self.what}, got {self.got}"


# Attributes


def _is_json(value: Any, kind: type) -> bool:
    try:
        return type(parse_json(value)) is kind
    except (TypeError, ValueError):
        return False


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and value.isprintable()


#: What an attribute must be, in words, and whether a value is.
_KINDS: Mapping[str, Callable[[Any], bool]] = {
    "a text": _is_text,
    "a mapping in JSON": lambda value: _is_text(value) and _is_json(value, dict),
    "a list in JSON": lambda value: _is_text(value) and _is_json(value, list),
    "a whole number that is not negative": lambda v: isinstance(v, np.integer) and bool(v >= 0),
    "a positive number": lambda value: isinstance(value, np.floating) and bool(value > 0.0),
    "a matrix of 3 x 3 numbers": lambda value: (
        isinstance(value, np.ndarray) and value.shape == (3, 3) and value.dtype.kind == "f"
    ),
    "X, Y, Z and yaw": lambda value: np.shape(value) == (4,) and bool(np.isfinite(value).all()),
    "a pose of 12 numbers": lambda value: (
        np.shape(value) == (12,) and bool(np.isfinite(value).all())
    ),
    "one of oto, otm": lambda value: isinstance(value, str) and value in CAMERAS,
    "one of class, object": lambda value: isinstance(value, str) and value in ("class", "object"),
}
#: Kinds of attributes by their names.
Kinds = Mapping[str, str]
#: Attributes of all three files.
ORIGIN: Kinds = {
    **dict.fromkeys(("config", "versions", "fingers"), "a mapping in JSON"),
    **dict.fromkeys(("config_hash", "signature", "shards"), "a text"),
    "joints": "a list in JSON",
    "seed": "a whole number that is not negative",
    "K": "a matrix of 3 x 3 numbers",
    "near": "a positive number",
    "far": "a positive number",
}
#: Attributes of the data files.
OF_CAMERA: Kinds = {**ORIGIN, "camera": "one of oto, otm", "split_by": "one of class, object"}
#: Attributes of scenes.hdf5, whose views have their own camera matrices.
OF_SCENES: Kinds = {key: kind for key, kind in ORIGIN.items() if key != "K"}
#: Attributes of files of arms, which have no images.
OF_REACH: Kinds = {
    **{key: kind for key, kind in OF_SCENES.items() if key not in ("near", "far", "signature")},
    **dict.fromkeys(("arm", "arm_sha256", "arm_urdf", "flange"), "a text"),
    "arm_joints": "a list in JSON",
    "base": "X, Y, Z and yaw",
    "mount": "a pose of 12 numbers",
}
#: Attributes of files of arms about scenes of several objects.
OF_CLUTTER_REACH: Kinds = {**OF_REACH, "signature": "a text", "clutter": "a mapping in JSON"}


class Layout(NamedTuple):
    """What a kind of file holds.

    Attributes:
        what: Description of such a file, for messages.
        kinds: Kinds of its attributes.
        tables: Fields of its groups.
    """

    what: str
    kinds: Kinds
    tables: Tables


#: Layouts of grasping_oto.hdf5 and grasping_otm.hdf5, trials.hdf5, scenes.hdf5, reach/NAME.hdf5,
#: reach/clutter/NAME.hdf5.
SAMPLES = Layout("a data file of drakegrasp", OF_CAMERA, DATA_TABLES)
TRIALS = Layout("the trials of a dataset", ORIGIN, TRIAL_TABLES)
SCENES = Layout("the scenes of a dataset", OF_SCENES, SCENE_TABLES)
REACH = Layout("the reach of an arm", OF_REACH, REACH_TABLES)
CLUTTER_REACH = Layout("the reach of an arm in scenes", OF_CLUTTER_REACH, CLUTTER_REACH_TABLES)


def mistakes(file: h5py.File, layout: Layout) -> Iterator[Difference]:
    """Yield the attributes of a file that are missing or hold something else, and `differences`."""
    for key, kind in layout.kinds.items():
        value = file.attrs.get(key)
        if not _KINDS[kind](value):
            got = printable(" ".join(repr(value).split())[:60]) if key in file.attrs else "none"
            yield Difference("", f"attribute {key} must be {kind}", got)
    yield from differences(file, layout.tables)


@contextmanager
def _opened_whole(path: Path, layout: Layout) -> Iterator[h5py.File]:
    """Open a file, see `opened`, and reject it if it differs from the schema."""
    with opened(path, layout.what) as file:
        # Check the version first: another version may have other attributes, and a foreign file
        # has none.
        if "schema_version" not in file.attrs:
            raise DataError(f"{path}: must be a data file of drakegrasp, got another HDF5 file")
        validate_schema_version(path, file.attrs["schema_version"])
        raise_first_mistake(path, mistakes(file, layout))
        yield file


#: Context managers that open a file of a dataset, given its path. They raise a DataError if the
#: file is missing, damaged, or differs from its layout.
open_samples, open_trials, open_scenes, open_reach, open_clutter_reach = (
    partial(_opened_whole, layout=layout)
    for layout in (SAMPLES, TRIALS, SCENES, REACH, CLUTTER_REACH)
)


def raise_first_mistake(path: Path, mistakes: Iterable[object]) -> None:
    """Reject a file that has any mistake; the error reports the first one.

    Raises:
        DataError: If there is a mistake.
    """
    if (first := next(iter(mistakes), None)) is not None:
        raise DataError(f"{path}: {printable(str(first))}")


# Groups and datasets


def differences(file: h5py.File, tables: Tables) -> Iterator[Difference]:
    """Yield the differences between the groups and datasets of a file and their fields.

    The first dataset of a group tells the number of its rows, and the first field with a letter in
    its shape the length of this letter in the file.
    """
    lengths: dict[str, int] = {}
    for name, fields in tables.items():
        group, place, rows = file.get(name), f"/{name}", None
        if not isinstance(group, h5py.Group):
            yield Difference(place, "the group must be there", "none")
            continue
        for f in fields:
            path, found = f"{place}/{f.name}", _dataset(group, f.name)
            if found is None:
                if not f.optional or f.name in group:
                    yield Difference(path, "the dataset must be there", "none")
                continue

            # Its type, and its shape.
            dtype, shape = found.dtype, found.shape
            text = h5py.check_string_dtype(dtype) is not None
            if text != (f.dtype == "str") or not (text or dtype == np.dtype(f.dtype)):
                yield Difference(path, f"type must be {f.dtype}", str(dtype))
            rows = shape[0] if rows is None and shape else rows
            lengths = {**_letters_in(f, shape), **lengths}
            due = (rows or 0, *f.row_shape({**dict.fromkeys(LETTERS, 0), **lengths}))
            if shape != due:
                yield Difference(path, f"shape must be {due}", str(shape))


def _dataset(group: h5py.Group, name: str) -> h5py.h5d.DatasetID | None:
    """Return a dataset of a group, or None; much faster than `group[name]`."""
    try:
        item = h5py.h5o.open(group.id, name.encode())
    except KeyError:
        return None
    return item if isinstance(item, h5py.h5d.DatasetID) else None


def _letters_in(field: Field, shape: tuple[int, ...] | None) -> dict[str, int]:
    """Return the lengths of the letters in a field's shape, given the shape of its dataset."""
    if shape is None or len(shape) != 1 + len(field.axes):
        return {}
    axes = zip(field.axes, shape[1:], strict=True)
    found = {axis: length for axis, length in axes if isinstance(axis, str)}
    return {"k": found["6k"] // 6} if "6k" in found else found


def sizes_in(group: h5py.Group, fields: Iterable[Field]) -> dict[str, int]:
    """Return the lengths of the letters in the shapes of the fields that a group has."""
    found: dict[str, int] = {}
    for field in fields:
        if any(isinstance(axis, str) for axis in field.axes) and field.name in group:
            found |= _letters_in(field, group[field.name].shape)
    return found


# Columns


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
    sizes = {**dict.fromkeys(LETTERS, 0), **sizes_in(group, fields)}
    return field.empty(len(range(count)[rows]), sizes)


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


def read_codes(dataset: h5py.Dataset, codes: int | Sequence[int]) -> npt.NDArray[Any]:
    """Return a column (n,) of codes, and reject codes without a defined meaning.

    Args:
        dataset: The column.
        codes: The number of valid codes, which are counted from 0, or the valid codes themselves.

    Raises:
        DataError: If a code has no defined meaning.
    """
    values: npt.NDArray[Any] = dataset[:]
    validate_codes(Path(dataset.file.filename), dataset.name, values, codes)
    return values


def validate_codes(
    path: Path,
    name: str,
    values: npt.NDArray[Any],
    codes: int | Sequence[int],
    first: int = 0,
) -> None:
    """Reject codes without a defined meaning, see `read_codes`; `first` is the first row.

    Raises:
        DataError: If there is such a code.
    """
    if isinstance(codes, int):
        bad, must = (values < 0) | (values >= codes), f"0 to {codes - 1}"
    else:
        bad, must = ~np.isin(values, codes), f"one of {', '.join(str(int(c)) for c in codes)}"
    if bad.any():
        row = int(np.argmax(bad))
        raise DataError(f"{path}: {name} must be {must}, got {values[row]} in row {first + row}")


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
