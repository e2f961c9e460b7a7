"""Wavefront files: each line is read as it stands, so an index counts back from its own line."""

from __future__ import annotations

import codecs
from array import array
from collections.abc import Iterator

import numpy as np

from drakegrasp.mesh.declared.polygons import Declared, triangulate

#: Statements of surfaces that are no polygons, and of another file.
_NOT_READ = frozenset((b"surf", b"curv", b"bzp", b"bsp", b"cdp", b"res", b"call"))


def declared_obj(content: bytes) -> Declared:
    """Return the surface of a Wavefront file.

    Raises:
        ValueError: If a line cannot be read; it gives the line.
    """
    positions, corners, counts = array("d"), array("q"), array("q")
    for number, line in _lines(content):
        words = line.split()
        if not words:
            continue
        kind = words[0].lower()
        try:
            if kind == b"v":
                x, y, z = words[1:4]
                positions.extend((float(x), float(y), float(z)))
            elif kind in (b"f", b"fo"):
                total = len(positions) // 3
                for word in words[1:]:
                    index = int(word.partition(b"/")[0])
                    if index == 0 or index < -total:
                        raise ValueError(index)
                    corners.append(index - 1 if index > 0 else total + index)
                counts.append(len(words) - 1)
        except (ValueError, OverflowError) as error:
            text = line.strip()[:60].decode(errors="replace")
            what = "x y z as numbers" if kind == b"v" else "vertices before it or numbers from 1"
            raise ValueError(f"line {number}, {text!r}, which must have {what}") from error
        if kind in _NOT_READ:
            raise ValueError(f"line {number}, {kind.decode()!r}, which is no polygon")

    return triangulate(
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        np.array(corners, dtype=np.int64),
        np.array(counts, dtype=np.int64),
    )


def _lines(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield each statement with the number of its last line: a backslash continues it."""
    begun = b""
    for number, line in enumerate(content.removeprefix(codecs.BOM_UTF8).splitlines(), start=1):
        said = begun + line.partition(b"#")[0].rstrip()
        if said.endswith(b"\\"):
            begun = said[:-1] + b" "
            continue
        begun = b""
        yield number, said
    yield 0, begun
