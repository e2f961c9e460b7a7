"""What a mesh file declares: polygons come in, triangles go out; nothing is silently ignored.

This module has what the readers of all formats share, and the reader of STL.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import manifold3d
import numpy as np

from drakegrasp.frames import Array
from drakegrasp.mesh.surfaces import Faces

#: A fan has turned a triangle over if its negative area exceeds this fraction of the polygon's.
TURNED = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Declared:
    """The surface that a file declares.

    Args:
        vertices: (n, 3), in the file's order.
        faces: (m, 3), in the file's order.
        fans: Whether every polygon is a fan from its first corner.
    """

    vertices: Array
    faces: Faces
    fans: bool = True


def triangulate(vertices: Array, corners: Faces, counts: Faces) -> Declared:
    """Return the triangles of polygons, which may be concave and slightly bent.

    Args:
        vertices: (n, 3).
        corners: Vertices of all polygons, one polygon after the other.
        counts: Number of corners of each polygon; polygons of fewer than three have no area.

    Raises:
        ValueError: If a corner is not a vertex of the file.
    """
    if len(corners) and not (corners.min() >= 0 and corners.max() < len(vertices)):
        bad = corners.max() if corners.min() >= 0 else corners.min()
        raise ValueError(f"a face with vertex number {bad + 1} of {len(vertices)}")

    # A fan from the first corner, as all programs read convex polygons.
    starts = np.cumsum(counts) - counts
    shares = np.maximum(counts - 2, 0)
    polygon = np.repeat(np.arange(len(counts)), shares)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(shares) - shares, shares)
    first = starts[polygon]
    faces = np.stack((corners[first], corners[first + step + 1], corners[first + step + 2]), axis=1)
    if (counts <= 3).all():
        return Declared(vertices=vertices, faces=faces)

    # A fan that turns a triangle over covers area outside of its polygon.
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    with np.errstate(all="ignore"):
        area = np.cross(b - a, c - a)
        whole = np.zeros((len(counts), 3))
        np.add.at(whole, polygon, area)
        turned = (area * whole[polygon]).sum(axis=1) < -TURNED * (whole[polygon] ** 2).sum(axis=1)
    concave = np.unique(polygon[turned])
    ends = np.cumsum(shares)
    for k in concave:
        outline = corners[starts[k] : starts[k] + counts[k]]
        faces[ends[k] - shares[k] : ends[k]] = outline[_cut(vertices[outline], whole[k])]
    return Declared(vertices=vertices, faces=faces, fans=not len(concave))


def _cut(p: Array, normal: Array) -> Faces:
    """Return the triangles (k - 2, 3) of a concave polygon (k, 3).

    Raises:
        ValueError: If the polygon cannot be triangulated.
    """
    # Project onto two axes that turn counter-clockwise about the normal.
    x = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    y = np.cross(normal, x)
    flat = np.stack([(p - p[0]) @ (axis / np.linalg.norm(axis)) for axis in (x, y)], axis=1)
    cut = np.asarray(manifold3d.triangulate([flat], allow_convex=False), dtype=np.int64)
    if len(cut) != len(p) - 2:
        raise ValueError(f"a polygon of {len(p)} corners that crosses itself")
    return cut


def read_floats(words: Iterable[bytes]) -> list[float]:
    """Return words as numbers.

    Raises:
        ValueError: If a word is not a number; the message has the word.
    """
    numbers = []
    for word in words:
        try:
            numbers.append(float(word))
        except ValueError:
            said = repr(word[:40].decode(errors="replace"))
            raise ValueError(f"{said} in place of a number") from None
    return numbers


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
    # A rest that is shorter than a triangle is padding, and so are zeros.
    if len(content) < _HEADER or held < count or (held > count and bytes(data[end:]).strip(b"\0")):
        raise ValueError(f"{held:,} triangles, but its header declares {count:,}")
    return np.frombuffer(data, _RECORD, count)["corners"].reshape(-1, 3).astype(np.float64)


def _text_corners(content: bytes) -> Array:
    text = content.removeprefix(codecs.BOM_UTF8).lower().replace(b"\r", b"\n")
    text = re.sub(rb"\bend[ \t]+(?=(?:solid|facet|loop)\b)", b"end", text)
    # The name of a solid may consist of any words.
    text, solids = re.subn(rb"^[ \t]*solid\b.*$", b"", text, flags=re.M)
    text, ends = re.subn(rb"\bendsolid\b.*$", b"", text, flags=re.M)
    if solids != ends:
        raise ValueError(f"text that begins {solids:,} solids and ends {ends:,}")

    # Each facet must have an end and three corners.
    facets, ends, corners = (
        len(re.findall(rb"\b%b\b" % word, text)) for word in (b"facet", b"endfacet", b"vertex")
    )
    found = re.findall(rb"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", text)
    if not 3 * facets == 3 * ends == corners == len(found):
        raise ValueError(
            f"text that begins {facets:,} facets, ends {ends:,}, of {corners:,} corners"
        )
    return np.array(read_floats(chain.from_iterable(found))).reshape(-1, 3)
