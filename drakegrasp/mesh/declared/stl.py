"""STL files, binary and text."""

from __future__ import annotations

import codecs
import re
from itertools import chain

import numpy as np

from drakegrasp.frames import Array
from drakegrasp.mesh.declared.numbers import read_floats
from drakegrasp.mesh.declared.polygons import Declared

_RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_HEADER = 84


def declared_stl(content: bytes) -> Declared:
    """Return the surface of an STL file, whose triangles share no vertices.

    Raises:
        ValueError: If the file holds more or fewer triangles than it declares.
    """
    count = int.from_bytes(content[80:_HEADER], "little")
    exact = len(content) == _HEADER + count * _RECORD.itemsize
    begin = content[:4096].lower()
    if not exact and b"\0" not in begin and b"solid" in begin:
        corners = _text_corners(content)
    else:
        corners = _binary_corners(content, count)
    faces = np.arange(len(corners), dtype=np.int64).reshape(-1, 3)
    return Declared(vertices=corners, faces=faces)


def _binary_corners(content: bytes, count: int) -> Array:
    data = memoryview(content)[_HEADER:]
    held, end = len(data) // _RECORD.itemsize, count * _RECORD.itemsize
    # Less than a triangle behind the last one is padding, and so are zeros.
    if len(content) < _HEADER or held < count or (held > count and bytes(data[end:]).strip(b"\0")):
        raise ValueError(f"{held:,} triangles, but its header declares {count:,}")
    return np.frombuffer(data, _RECORD, count)["corners"].reshape(-1, 3).astype(np.float64)


def _text_corners(content: bytes) -> Array:
    text = content.removeprefix(codecs.BOM_UTF8).lower().replace(b"\r", b"\n")
    text = re.sub(rb"\bend[ \t]+(?=(?:solid|facet|loop)\b)", b"end", text)
    # The name of a solid may be any words.
    text, solids = re.subn(rb"^[ \t]*solid\b.*$", b"", text, flags=re.M)
    text, ends = re.subn(rb"\bendsolid\b.*$", b"", text, flags=re.M)
    if solids != ends:
        raise ValueError(f"text that begins {solids:,} solids and ends {ends:,}")

    # Each facet ends, and has three corners.
    facets, ends, corners = (
        len(re.findall(rb"\b%b\b" % word, text)) for word in (b"facet", b"endfacet", b"vertex")
    )
    found = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", text)
    if not 3 * facets == 3 * ends == corners == len(found):
        raise ValueError(
            f"text that begins {facets:,} facets, ends {ends:,}, of {corners:,} corners"
        )
    return np.array(read_floats(chain.from_iterable(found))).reshape(-1, 3)
