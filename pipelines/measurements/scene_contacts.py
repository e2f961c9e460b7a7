"""Check whether the contacts in scenes.hdf5 lie where a camera's mask shows the object.

\b
    python pipelines/measurements/scene_contacts.py OUT --rows 4000

For some random rows of /visible, each contact is projected with K and X_TC and compared with the
mask, and the line from it to the camera is intersected with the triangles of the object's mesh. The
check is independent of drakegrasp and needs only h5py and NumPy. The script prints JSON: how many
contacts are stored as visible and as hidden, and the pixels between visible ones and the mask. It
also prints, for several distances within which mesh near the contact is ignored, the fraction of
hidden contacts that have a free line, and of visible contacts that have none.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
#: Distances from the contact within which mesh is ignored [m].
NEARER = (1e-3, 2e-3, 3e-3, 5e-3)


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--rows", type=click.IntRange(min=1), default=4000, show_default=True)
def main(out: Path, rows: int) -> None:
    """Run the script."""
    with h5py.File(out / "scenes.hdf5") as file:
        views = file["visible/view"][:]
        chosen = np.random.default_rng(0).permutation(len(views))[:rows]
        # Rows of a view are together, in the order of the views.
        chosen = chosen[np.argsort(views[chosen], kind="stable")]
        parts = [look(out, file, int(view), chosen) for view in np.unique(views[chosen])]
    told, pixels, free = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    result = {
        "visible": int(told.sum()),
        "hidden": int((~told).sum()),
        "most_pixels_from_mask": round(float(pixels[told].max()), 2),
        "hidden_with_a_free_line": shares(free[~told]),
        "visible_without": shares(~free[told]),
    }
    click.echo(json.dumps(result, indent=1))


def shares(cases: Array) -> dict[str, float]:
    """Return the fractions of cases (n, m) by the distances of NEARER in millimetres."""
    found = cases.mean(axis=0).tolist()
    return {f"{1e3 * d:g} mm": round(s, 4) for d, s in zip(NEARER, found, strict=True)}


def look(out: Path, file: h5py.File, view: int, rows: Array) -> tuple[Array, Array, Array]:
    """Return the stored visibility of a view's contacts, pixels from the mask, and free lines."""
    own = rows[file["visible/view"][:][rows] == view]
    grasps = file["visible/grasp"][:][own]
    contacts = file["grasps/p_TQ"][:][grasps].astype(float).reshape(-1, 3)
    told = file["visible/visible"][:][own].ravel()
    there = np.isfinite(contacts).all(axis=1)
    contacts, told = contacts[there], told[there]

    # The mesh in {T}, and the pose of the camera.
    scene = int(file["views/scene"][view])
    name = file["objects/name"].asstr()[int(file["scenes/object"][scene, 0])]
    X_TO, X_TC = (
        row.reshape(3, 4) for row in (file["scenes/X_TO"][scene, 0], file["views/X_TC"][view])
    )
    mesh = np.load(out / "objects" / f"{name}.npz")
    corners = (mesh["visual_vertices"] @ X_TO[:, :3].T + X_TO[:, 3])[mesh["visual_faces"]]

    # Pixels from the mask, and lines to the camera.
    p_CQ = (contacts - X_TC[:, 3]) @ X_TC[:, :3]
    uv = p_CQ @ file["views/K"][view].reshape(3, 3).T
    v, u = np.nonzero(file["views/mask"][view])
    apart = np.hypot(u - uv[:, :1] / uv[:, 2:], v - uv[:, 1:2] / uv[:, 2:])
    free = np.array([free_lines(p, X_TC[:, 3], corners) for p in contacts], dtype=np.bool_)
    return told, apart.min(axis=1, initial=np.inf), free.reshape(-1, len(NEARER))


def free_lines(point: Array, camera: Array, corners: Array) -> Array:
    """Return per distance of NEARER whether triangles (m, 3, 3) beyond it leave a free line."""
    way = camera - point
    length = np.linalg.norm(way)
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    slope = normal @ (way / length)
    with np.errstate(divide="ignore", invalid="ignore"):
        along = np.einsum("ij,ij->i", normal, a - point) / slope
        met = point + along[:, None] * way / length
        sides = [
            np.einsum("ij,ij->i", np.cross(q - p, met - p), normal)
            for p, q in ((a, b), (b, c), (c, a))
        ]
        inside = np.isfinite(along) & (np.min(sides, axis=0) >= 0.0) & (along < length)
    farthest = along[inside].max(initial=-np.inf)
    return np.array([farthest <= nearer for nearer in NEARER])


if __name__ == "__main__":
    main()
