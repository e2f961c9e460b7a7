"""The folders whose files a vendor's model may use.

In: the path or URI of a mesh. Out: the file. Nothing is fetched, and no file outside of the folders
is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import unquote

from drakegrasp.errors import HandError


@dataclass(frozen=True, kw_only=True)
class Folders:
    """The folders whose files a model may use.

    Attributes:
        model: That of the model.
        packages: Of package:// URIs, by name.
        given: Those that the user named.
    """

    model: Path
    packages: Mapping[str, Path]
    given: tuple[Path, ...]

    def find(self, uri: str, base: Path) -> Path:
        """Return the file of a URI or path; relative ones start at `base`.

        Raises:
            HandError: If it is a URI of another kind, or lies outside of the folders.
        """
        # A package is one that is known, or a folder of its name above the model.
        scheme, separator, rest = uri.partition("://")
        if separator and scheme not in ("package", "file", "model"):
            raise HandError(
                f"model: mesh {uri!r} must be a file, got an address: nothing is fetched"
            )
        if separator and scheme != "file":
            name, _, rest = rest.partition("/")
            folder = self.packages.get(name) or self._above(name)
            if folder is None:
                raise HandError(
                    f"model: mesh {uri!r} must lie in a known package: say where it is with "
                    f"--package {name}=FOLDER"
                )
            path, allowed = folder / unquote(rest), [folder]
        else:
            path, allowed = base / unquote(rest if separator else uri), [self.model]

        # What a link or `..` leads to is what counts.
        try:
            real = path.resolve()
        except (OSError, RuntimeError, ValueError):
            raise HandError(f"model: mesh {uri!r} must be a path, got none") from None
        allowed += [*self.given, *self.packages.values()]
        if not any(real.is_relative_to(folder.resolve()) for folder in allowed):
            raise HandError(
                f"model: mesh {uri!r} must lie in the model's folder, got {str(real)!r}: allow "
                f"its folder with --root FOLDER"
            )
        return real

    def _above(self, name: str) -> Path | None:
        """Return the folder of a name in which the model lies; None if there is none."""
        return next((f for f in (self.model, *self.model.parents) if f.name == name), None)
