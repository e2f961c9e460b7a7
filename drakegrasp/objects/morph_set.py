"""Morphs of all meshes of a directory: meshes come in, a directory of new ones goes out.

The files are `<class>_<name>_m<k>.obj` in metres, +z up. An `objects.yaml` beside them keeps the
class of the mesh that each comes from, else each would be a class of its own, and its name as their
group: in a split by object all morphs of a mesh, and the mesh itself, stay together.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from drakegrasp.errors import MeshError
from drakegrasp.mesh.wavefront import obj_text
from drakegrasp.objects.morph import Original, load_original, morph_object
from drakegrasp.objects.sources import MANIFEST_NAME, MeshSource, find_meshes
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.runtime.progress import Report, silent


@dataclass(frozen=True, kw_only=True)
class MorphReport:
    """What was written.

    Attributes:
        morphs: Number of morphs.
        first_draws: Number of those whose first draw could be used.
        crossing: Number of faces that pass through others in a mesh, by its name, if any: its
            morphs have about as many.
        refused: Why a mesh has no morphs, a line each.
    """

    morphs: int
    first_draws: int
    crossing: dict[str, int]
    refused: tuple[str, ...]


def morph_meshes(
    directory: str | Path,
    out: str | Path,
    *,
    per_mesh: int,
    seed: int = 0,
    units: str = "m",
    manifest: str | Path | None = None,
    progress: Report = silent,
) -> MorphReport:
    """Write morphs of all meshes of a directory; the same bytes for the same seed.

    Args:
        directory: The meshes, as for `find_meshes`.
        out: Directory of the morphs: new or empty. It appears whole or not at all.
        per_mesh: Morphs of each mesh.
        seed: Of the draws.
        units: Unit of the meshes' lengths.
        manifest: Their YAML file, if it is not beside them.
        progress: Is told of each morph.

    Raises:
        MeshError: If there is no mesh, `out` holds anything, or no mesh can be morphed.
    """
    # What is wanted, and what comes of it.
    sources = find_meshes(directory, units=units, manifest=manifest)
    total, draws, refused = len(sources) * per_mesh, list[int](), list[str]()
    entries: dict[str, dict[str, Any]] = {}
    crossing: dict[str, int] = {}

    with _whole_directory(Path(out)) as folder:
        # Mesh by mesh; one that has no morphs costs no other.
        for source in sources:
            try:
                original = load_original(source)
                morphs = _morphs_of(source, original, per_mesh, seed)
                _refuse_known(source, {name for name, _, _ in morphs} & entries.keys())
                for name, text, count in morphs:
                    (folder / f"{name}.obj").write_text(text, encoding="ascii")
                    entries[name] = _entry(source)
                    draws.append(count)
                    progress(len(draws), total)
            except MeshError as reason:
                refused.append(str(reason))
                total -= per_mesh
                continue
            if original.crossing:
                crossing[source.name] = original.crossing

        # The manifest, which keeps their classes and groups.
        if not draws:
            raise MeshError(f"{directory}: one mesh must have morphs, got none: {refused[0]}")
        content = {"units": "m", "objects": entries}
        text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True)
        (folder / MANIFEST_NAME).write_text(text, encoding="utf-8")
    return MorphReport(
        morphs=len(draws),
        first_draws=draws.count(1),
        crossing=crossing,
        refused=tuple(refused),
    )


def _morphs_of(
    source: MeshSource, original: Original, per_mesh: int, seed: int
) -> list[tuple[str, str, int]]:
    """Return name, Wavefront text and number of draws of each morph of a mesh."""
    made = []
    for number in range(1, per_mesh + 1):
        # Also checks the name, which is that of a file.
        name = f"{source.class_name}_{source.name}_m{number}"
        MeshSource(name=name, class_name=source.class_name, path=source.path)
        morphed = morph_object(original, source.name, number, seed)
        made.append((name, obj_text(morphed.vertices, morphed.faces, normals=False), morphed.draws))
    return made


def _refuse_known(source: MeshSource, names: set[str]) -> None:
    """Refuse a mesh if any morphs of another one have these names."""
    if names:
        raise MeshError(
            f"{source.name} of class {source.class_name}: its morphs must have names of their own, "
            f"got {min(names)}, which another mesh has; rename it"
        )


def _entry(source: MeshSource) -> dict[str, Any]:
    """Return what the manifest says of a morph: what is known of its original."""
    keys = ("mass", "density", "friction", "licence")
    said = {key: getattr(source, key) for key in keys if getattr(source, key) is not None}
    return {"class": source.class_name, "group": source.group or source.name, **said}


@contextmanager
def _whole_directory(out: Path) -> Iterator[Path]:
    """Yield a new directory that becomes `out` when the block ends well.

    Raises:
        MeshError: If `out` holds anything, or cannot be written.
    """
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise MeshError(f"{out}: must be new or an empty directory, got one that holds others")
        with atomic_folder(out) as folder:
            yield folder
    except OSError as error:
        raise MeshError(
            f"{out}: must be a directory that can be written, got: {error.strerror}"
        ) from error
