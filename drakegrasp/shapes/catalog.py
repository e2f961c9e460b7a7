"""The built-in objects: everyday things of drawn sizes, so that a dataset needs no meshes.

An object is a class, an index from 1 and a seed: its sizes are drawn from the ranges of
`drakegrasp.shapes.classes`. Its name is `<number>_<class>_<index>`. The same index and
seed give the same object, however many others there are. `export_builtin` writes the meshes as
Wavefront files, the same bytes every time.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import trimesh

from drakegrasp.config import BuiltinConfig
from drakegrasp.errors import MeshError
from drakegrasp.objects.sources import MeshSource, find_mesh
from drakegrasp.runtime.files import write_atomic
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.seeding import Stream, object_key
from drakegrasp.shapes.classes import CLASSES, ObjectClass
from drakegrasp.shapes.modelling.solids import DECIMALS

#: Of the built-in objects, which are part of the package.
LICENCE = "BSD-3-Clause"


@dataclass(frozen=True, kw_only=True)
class BuiltinObject:
    """One drawn object.

    Attributes:
        object_class: Its class.
        index: Its number among the objects of the class, from 1.
        seed: Seed of the draw.
    """

    object_class: ObjectClass
    index: int
    seed: int = 0

    @property
    def name(self) -> str:
        """The name of the object and the stem of its file, such as "1_mug_2"."""
        return f"{self.object_class.number}_{self.object_class.name}_{self.index}"

    @property
    def sizes(self) -> dict[str, float | int]:
        """The drawn parameters by name: lengths in [m], angles in [rad]."""
        stream = Stream(self.seed, object_key(self.object_class.name), self.index)
        return {name: span.draw(stream) for name, span in self.object_class.parameters.items()}

    def build(self) -> trimesh.Trimesh:
        """Return the mesh [m], standing on z = 0, z up."""
        return self.object_class.shape(**self.sizes)


def draw_builtin(config: BuiltinConfig | None = None) -> list[BuiltinObject]:
    """Return the built-in objects of a configuration, the default's if None, class by class."""
    config = config or BuiltinConfig()
    return [
        BuiltinObject(object_class=object_class, index=index, seed=config.seed)
        for object_class in CLASSES
        for index in range(1, config.per_class + 1)
    ]


def builtin_object(name: str, *, seed: int = 0) -> BuiltinObject:
    """Return the built-in object of a name such as "1_mug_2".

    Raises:
        MeshError: If there is no such class; the message lists the classes.
    """
    index = name.rpartition("_")[2]
    for object_class in CLASSES:
        number = int(index) if index.isdecimal() else 0
        item = BuiltinObject(object_class=object_class, index=number, seed=seed)
        if number >= 1 and item.name == name:
            return item
    stems = ", ".join(f"{c.number}_{c.name}" for c in CLASSES)
    raise MeshError(
        f"a built-in object must be a class and a number from 1, e.g. 1_mug_2, got {name!r}; "
        f"the classes: {stems}"
    )


def export_builtin(
    directory: str | os.PathLike[str],
    names: Iterable[str] | None = None,
    *,
    config: BuiltinConfig | None = None,
    progress: Report = silent,
) -> list[Path]:
    """Write built-in objects as `<name>.obj` and return the paths, in the order asked for.

    A file appears whole or not at all, and holds the same bytes every time.

    Args:
        directory: Where to write; made if it is missing.
        names: Which objects; all of the configuration by default.
        config: How many of each class, and the seed of their sizes; the defaults if None.
        progress: Is told how many meshes there are.

    Raises:
        MeshError: If a name is unknown; nothing is written then.
    """
    # Look up all names before anything is written.
    config = config or BuiltinConfig()
    if names is None:
        chosen = draw_builtin(config)
    else:
        chosen = [builtin_object(name, seed=config.seed) for name in names]
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)

    paths = []
    for item in chosen:
        path = folder / f"{item.name}.obj"
        write_atomic(path, wavefront(item.build()))
        paths.append(path)
        progress(len(paths), len(chosen))
    return paths


def builtin_sources(
    folder: str | os.PathLike[str],
    config: BuiltinConfig,
    progress: Report = silent,
    only: Collection[str] = (),
) -> list[MeshSource]:
    """Return the built-in objects as meshes in a folder, which is made, sorted by name.

    Args:
        folder: The folder.
        config: How many of each class, and the seed of their sizes.
        progress: Is told how many meshes there are.
        only: Names of the objects; all of the configuration if empty.
    """
    names = sorted(set(only)) or None
    paths = export_builtin(folder, names, config=config, progress=progress)
    sources = [replace(find_mesh(path), licence=LICENCE) for path in paths]
    return sorted(sources, key=lambda source: source.name)


def wavefront(mesh: trimesh.Trimesh) -> bytes:
    """Return a mesh as Wavefront text; not trimesh's, which may change by release."""
    d = DECIMALS
    lines = [f"v {x:.{d}f} {y:.{d}f} {z:.{d}f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")
