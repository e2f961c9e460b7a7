"""A kind of bad input, and the kinds that every text file can have."""

from __future__ import annotations

import shutil
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


class Workplace:
    """A directory that is spoiled again and again, and put back.

    Args:
        pristine: What it holds when it is sound; it is not changed.
        folder: Where the copy goes.
    """

    def __init__(self, pristine: Path, folder: Path) -> None:
        self.pristine, self.folder = pristine, folder
        shutil.copytree(pristine, folder, symlinks=True)
        self.sound = self.state()

    def state(self) -> dict[str, tuple[int, ...]]:
        """Return what changes when something below the folder is written or replaced."""
        state = {}
        for path in self.folder.rglob("*"):
            status = path.lstat()
            times = () if path.is_dir() else (status.st_mtime_ns, status.st_size, status.st_ino)
            state[str(path.relative_to(self.folder))] = (status.st_mode, *times)
        return state

    def restore(self) -> None:
        """Put back what differs."""
        now = self.state()
        for name in sorted(now.keys() | self.sound.keys()):
            if now.get(name) == self.sound.get(name):
                continue
            path, source = self.folder / name, self.pristine / name
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
            if source.is_dir():
                shutil.copytree(source, path)
            elif source.exists():
                shutil.copyfile(source, path)
        self.sound = self.state()
