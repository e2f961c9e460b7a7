"""The convex parts of an object, as MuJoCo collides convex shapes only (CoACD)."""

from __future__ import annotations

import hashlib
import io
from importlib import metadata
from pathlib import Path

import coacd
import numpy as np

from drakegrasp.foreign_files import read_content
from drakegrasp.frames import Array
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.files import write_atomic

#: Largest concavity of a convex part over the object's size, and the largest number of its corners.
CONCAVITY, CORNERS = 0.02, 64


def convex_parts(model: ObjectModel) -> list[Array]:
    """Return the corners of an object's convex parts, each (n, 3) in {O} [m]."""
    coacd.set_log_level("error")
    mesh = coacd.Mesh(model.collision_vertices, model.collision_faces)
    parts = coacd.run_coacd(mesh, threshold=CONCAVITY, seed=0, max_convex_hull=CORNERS)
    return [np.asarray(corners, dtype=float) for corners, _ in parts]


def kept_convex_parts(model: ObjectModel, keep: Path) -> list[Array]:
    """Return the convex parts of an object, which a folder keeps: cutting takes many seconds.

    Args:
        model: The object.
        keep: The folder, made with the first object. A file that is damaged is written again.

    Raises:
        OSError: If the folder cannot be written.
    """
    path = keep / f"{_digest(model)}.npz"
    try:
        with np.load(io.BytesIO(read_content(path)), allow_pickle=False) as content:
            return [content[name] for name in content.files]
    except Exception:  # missing, or damaged in any way: it can be made again
        parts = convex_parts(model)

    # The file's order is that of the parts.
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{f"{k:06d}": part for k, part in enumerate(parts)})
    keep.mkdir(parents=True, exist_ok=True)
    write_atomic(path, buffer.getvalue())
    return parts


def _digest(model: ObjectModel) -> str:
    """Return 32 hex digits that name all that decides an object's parts."""
    rules = CONCAVITY, CORNERS, metadata.version("coacd")
    digest = hashlib.sha256(repr(rules).encode())
    for array in (model.collision_vertices, model.collision_faces):
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:32]
