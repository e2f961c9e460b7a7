"""An object as convex parts: MuJoCo collides only these. Needs the extra `[peer]`."""

from __future__ import annotations

import hashlib
import io
from importlib import metadata
from pathlib import Path

import coacd
import numpy as np

from drakegrasp.foreign_files import read_npz
from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.files import write_atomic

#: Largest concavity of a convex part over the object's size, the seed, and the largest number of
#: corners of a part.
SETTINGS = {"threshold": 0.02, "seed": 0, "max_convex_hull": 64}


def convex_parts(model: ObjectModel) -> list[Array]:
    """Return the corners of an object's convex parts, each (n, 3) in {O} [m]."""
    coacd.set_log_level("error")
    mesh = coacd.Mesh(model.collision_vertices, model.collision_faces)
    parts = coacd.run_coacd(mesh, **SETTINGS)
    return [np.asarray(corners, dtype=float) for corners, _ in parts]


def kept_convex_parts(model: ObjectModel, keep: Path) -> list[Array]:
    """Return the convex parts of an object, cached in a folder, since dividing takes many seconds.

    Args:
        model: The object.
        keep: The folder, created with the first object. A file without valid parts is rewritten.

    Raises:
        OSError: If the folder cannot be written.
    """
    path = keep / f"{_digest(model)}.npz"
    try:
        return _read_parts(path)
    except Exception:  # missing, or damaged in any way: it can be computed again
        parts = convex_parts(model)

    # The parts are read in the order in which they are written.
    buffer = io.BytesIO()
    np.savez(buffer, *parts)
    write_atomic(path, buffer.getvalue())
    return parts


def _read_parts(path: Path) -> list[Array]:
    """Return the parts in a file.

    Raises:
        Exception: Of any kind, if the file is missing or holds something else.
    """
    content = read_npz(path)
    parts = [content[f"arr_{k}"] for k in range(len(content))]
    if not parts:
        raise ValueError(f"{path}: must hold the corners of convex parts, got none")
    return parts


def _digest(model: ObjectModel) -> str:
    """Return 32 hex digits that identify everything that determines an object's parts."""
    digest = hashlib.sha256(repr((SETTINGS, metadata.version("coacd"))).encode())
    for array in (model.collision_vertices, model.collision_faces):
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]
