"""PLY files: polygons of any size, strips, and elements of other kinds, text or binary."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from drakegrasp.mesh.declared import Declared, read_floats, triangulate
from drakegrasp.mesh.surfaces import Faces

#: Names of the types of numbers.
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "int64": "i8", "uint64": "u8",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8", "float16": "f2",
}  # fmt: skip
#: Names of the property that has the corners of a polygon or strip.
_CORNERS = ("vertex_indices", "vertex_index")
_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


class _Property(NamedTuple):
    name: str
    dtype: np.dtype
    length: np.dtype | None  # type of a list's length; None if the property is not a list


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


#: Values of the properties by name; for lists also the length of each, else None.
_Columns = dict[str, tuple[np.ndarray, Faces | None]]


def declared_ply(content: bytes) -> Declared:
    """Return the surface of a PLY file.

    Raises:
        ValueError: If the file contains more or less than its header declares.
    """
    elements, order, data = _read_header(content)
    source = _Text(data) if not order else _Binary(data)

    # Elements that are not part of the surface are read to get to the next one.
    vertices, corners, counts = np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64)
    for element in elements:
        columns = source.read(element)
        if element.name == "vertex":
            missing = [axis for axis in "xyz" if axis not in columns]
            if missing and element.rows:
                raise ValueError(f"vertices without {missing[0]}")
            if element.rows:
                vertices = np.stack([columns[axis][0] for axis in "xyz"], axis=1, dtype=np.float64)
        elif element.name in ("face", "tristrips") and element.rows:
            more, their = _polygons(element, columns)
            corners, counts = np.concatenate((corners, more)), np.concatenate((counts, their))
    source.finish()
    return triangulate(vertices, corners, counts)


def _read_header(content: bytes) -> tuple[list[_Element], str, bytes]:
    """Return the elements, the order of bytes (empty for text), and the bytes after the header."""
    head, end, rest = content.partition(b"end_header")
    if not end or not head.lstrip().lower().startswith(b"ply"):
        raise ValueError("no header of a PLY file")
    if rest[:2] == b"\r\n":  # one line end: the next byte may be data
        rest = rest[2:]
    elif rest[:1] in (b"\n", b"\r"):
        rest = rest[1:]

    elements: list[_Element] = []
    order = None
    for line in head.decode("latin-1").splitlines()[1:]:
        match line.split():
            case ["format", name, *_] if name in _FORMATS:
                order = _FORMATS[name]
            case ["element", name, count]:
                elements.append(_Element(name, int(count), []))
            case ["property", "list", length, kind, name] if elements:
                types = [np.dtype((order or "") + _TYPES[t]) for t in (kind, length)]
                elements[-1].properties.append(_Property(name, *types))
            case ["property", kind, name] if elements and kind in _TYPES:
                dtype = np.dtype((order or "") + _TYPES[kind])
                elements[-1].properties.append(_Property(name, dtype, None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"the line {line.strip()[:60]!r} in its header")
    if order is None:
        raise ValueError("a header without format")
    return elements, order, rest


class _Binary:
    """Elements of a binary file."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def read(self, element: _Element) -> _Columns:
        """Return the values of the next element."""
        columns = self._equal_rows(element)
        return self._any_rows(element) if columns is None else columns

    def finish(self) -> None:
        """Raise an error if there are bytes after the last element."""
        rest = len(self._data[self._at :].rstrip(b"\0 \t\r\n"))
        if rest:
            raise ValueError(f"{rest:,} bytes more than its header declares")

    def _take(self, dtype: np.dtype, count: int) -> np.ndarray:
        size = dtype.itemsize * count
        if count < 0 or self._at + size > len(self._data):
            raise ValueError("fewer bytes than its header declares")
        self._at += size
        return np.frombuffer(self._data, dtype, count, self._at - size)

    def _equal_rows(self, element: _Element) -> _Columns | None:
        """Return the values if all rows have lists as long as those of the first, else None."""
        start = self._at
        fields: list[Any] = []
        lengths: dict[int, int] = {}
        for k, one in enumerate(element.properties):
            if one.length is not None:
                row = np.dtype(fields).itemsize if fields else 0
                self._at = start + row
                lengths[k] = int(self._take(one.length, 1)[0]) if element.rows else 0
                fields.append((f"n{k}", one.length))
                if not 0 <= lengths[k] <= len(self._data):
                    raise ValueError(f"a list of {lengths[k]} numbers")
            fields.append((f"v{k}", one.dtype, (lengths[k],)) if k in lengths
                          else (f"v{k}", one.dtype))  # fmt: skip

        self._at = start
        dtype = np.dtype(fields)
        if start + dtype.itemsize * element.rows > len(self._data):
            if not lengths:
                raise ValueError("fewer bytes than its header declares")
            return None
        rows = self._take(dtype, element.rows)
        if any((rows[f"n{k}"] != length).any() for k, length in lengths.items()):
            self._at = start
            return None
        return {
            one.name: (
                rows[f"v{k}"].reshape(-1),
                np.full(element.rows, lengths[k]) if k in lengths else None,
            )
            for k, one in enumerate(element.properties)
        }

    def _any_rows(self, element: _Element) -> _Columns:
        values: list[list[np.ndarray]] = [[] for _ in element.properties]
        for _ in range(element.rows):
            for one, column in zip(element.properties, values, strict=True):
                count = 1 if one.length is None else int(self._take(one.length, 1)[0])
                column.append(self._take(one.dtype, count))
        return {
            one.name: (
                np.concatenate(column),
                None if one.length is None else np.array([len(row) for row in column]),
            )
            for one, column in zip(element.properties, values, strict=True)
        }


class _Text:
    """Elements of a text file, with one row per line."""

    def __init__(self, data: bytes) -> None:
        self._lines = [line for line in data.splitlines() if line.strip()]
        self._at = 0

    def read(self, element: _Element) -> _Columns:
        """Return the values of the next element."""
        lines = self._lines[self._at : self._at + element.rows]
        if len(lines) < element.rows:
            raise ValueError(f"{len(lines):,} of {element.rows:,} lines of {element.name!r}")
        self._at += element.rows

        # Read one property after the other along each line.
        values: list[list[float]] = [[] for _ in element.properties]
        lengths: list[list[int]] = [[] for _ in element.properties]
        for line in lines if element.properties else ():
            words, at = line.split(), 0
            for k, one in enumerate(element.properties):
                count = 1
                if one.length is not None:
                    count = int(words[at]) if at < len(words) else -1
                    lengths[k].append(count)
                    at += 1
                if count < 0 or at + count > len(words):
                    raise ValueError(f"a line of {element.name!r} that is too short: {_said(line)}")
                values[k] += read_floats(words[at : at + count])
                at += count
            if at != len(words):
                raise ValueError(f"a line of {element.name!r} that is too long: {_said(line)}")
        return {
            one.name: (
                np.array(values[k], dtype=np.float64),
                None if one.length is None else np.array(lengths[k], dtype=np.int64),
            )
            for k, one in enumerate(element.properties)
        }

    def finish(self) -> None:
        """Raise an error if there are lines after the last element."""
        rest = len(self._lines) - self._at
        if rest:
            raise ValueError(f"{rest:,} lines more than its header declares")


def _said(line: bytes) -> str:
    return repr(line.strip()[:60].decode(errors="replace"))


def _polygons(element: _Element, columns: _Columns) -> tuple[Faces, Faces]:
    """Return the corners of all polygons of an element, and the number of corners of each."""
    names = [name for name in _CORNERS if name in columns]
    lists = [name for name, (_, lengths) in columns.items() if lengths is not None]
    name = names[0] if names else lists[0] if len(lists) == 1 else None
    lengths = columns[name][1] if name else None
    if name is None or lengths is None:
        raise ValueError(f"{element.name!r} without vertex_indices")
    corners, lengths = columns[name][0].astype(np.int64), lengths.astype(np.int64)
    return (corners, lengths) if element.name == "face" else _unroll(corners, lengths)


def _unroll(corners: Faces, lengths: Faces) -> tuple[Faces, Faces]:
    """Return the triangles of strips; -1 starts a new strip."""
    triangles: list[Faces] = []
    for strip in np.split(corners, np.cumsum(lengths)[:-1]):
        for run in np.split(strip, np.flatnonzero(strip < 0)):
            triangles.append(strip_faces(run[run >= 0]))
    faces = np.concatenate(triangles)
    return faces.reshape(-1), np.full(len(faces), 3, dtype=np.int64)


def strip_faces(strip: Faces) -> Faces:
    """Return the triangles (n - 2, 3) of a strip of n vertices; every second one is turned over."""
    faces = np.stack((strip[:-2], strip[1:-1], strip[2:]), axis=1) if len(strip) > 2 else None
    if faces is None:
        return np.zeros((0, 3), dtype=np.int64)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces
