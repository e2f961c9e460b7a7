"""A kind of bad input, and the kinds that every text file can have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

#: Spoils a file.
Spoil = Callable[[Path], object]


@dataclass(frozen=True)
class Kind:
    """A way to spoil a file, and its name in the table."""

    name: str
    spoil: Spoil


def _folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _loop(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def _cut(share: float) -> Spoil:
    def cut(path: Path) -> None:
        content = path.read_bytes()
        path.write_bytes(content[: int(share * len(content))])

    return cut


def whole_file(name: str, content: str | bytes) -> Kind:
    """Return a kind whose file has this content."""
    data = content if isinstance(content, bytes) else content.encode()
    return Kind(name, lambda path: path.write_bytes(data))


#: Any file may be one of these.
ANY_FILE = (
    whole_file("empty", b""),
    Kind("a directory", _folder),
    Kind("a link to itself", _loop),
    Kind("cut to a tenth", _cut(0.1)),
    Kind("cut in half", _cut(0.5)),
    whole_file("random bytes", bytes(range(128, 256)) * 8),
    whole_file("zeros", bytes(4096)),
)

#: And a text file that must be JSON or YAML of mappings.
ANY_TEXT = (
    *ANY_FILE,
    Kind("Latin-1", lambda path: path.write_bytes(path.read_bytes() + '\n"ü'.encode("latin-1"))),
    Kind("UTF-16", lambda path: path.write_bytes(path.read_text().encode("utf-16"))),
    whole_file("nested too deeply", b"[" * 100_000),
    whole_file("a list", b"[1, 2]"),
    whole_file("a text", b'"manifest"'),
    whole_file("a number of 10,000 digits", b"9" * 10_000),
)
