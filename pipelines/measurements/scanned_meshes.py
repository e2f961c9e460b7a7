r"""Create ten meshes with the faults of 3-D scans, and measure how they are prepared.

\b
    python pipelines/measurements/scanned_meshes.py DIR

Each is a household object of about 16,000 faces, like those of the YCB object set. It is created by
marching through a grid of voxels, with their ripple and 0.2 to 0.5 mm of noise on the surface; then
it is reduced to its number of faces, welded where two sheets of the surface touch, and opened at
the bottom that stood on the turntable. Four objects are thin-walled, like a mug. The script prints
a line per mesh: status, collision faces, deviation of the collision surface, seconds, notes.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from pathlib import Path

import click
import fast_simplification
import manifold3d
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from drakegrasp.errors import MeshError
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import find_meshes

#: Signed distance of a point (x, y, z) from a surface [m], positive inside.
Shape = Callable[[float, float, float], float]

#: Approximate number of faces of each mesh, and the number before it is reduced.
FACES, MARCHED = 16_500, 50_000
#: Height above the table below which the scanner sees nothing [m].
UNSEEN = 1.5e-3
#: Vertices of two sheets closer than this are welded, so that the surface touches itself [m].
TOUCHING = 5e-4
#: Amplitude of the voxels' ripple, and its period in voxels [m, -].
RIPPLE, PERIOD = 2e-4, 2.3


def main(folder: Path) -> None:
    """Create the meshes in a folder and print the result of each."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (name, (shape, box, noise)) in enumerate(SCANS.items(), start=1):
        scan(shape, box, noise, seed=number).export(folder / f"{number}_{name}_scan.ply")

    for source in find_meshes(folder):
        start = time.process_time()
        try:
            model = prepare_object(source)
        except MeshError as error:
            found = f"refused: {error}"
        else:
            found = (
                f"{len(model.visual_faces):,} faces, for contact {len(model.collision_faces):,} "
                f"within {model.collision_error * 1e3:.2f} mm; {'; '.join(model.notes)}"
            )
        sys.stdout.write(f"{source.name} ({time.process_time() - start:.1f} s): {found}\n")
        sys.stdout.flush()


def scan(shape: Shape, box: tuple[float, ...], noise: float, *, seed: int) -> trimesh.Trimesh:
    """Return the scan of a shape.

    Args:
        shape: Signed distance [m].
        box: Bounds (x, y, z, x, y, z) [m].
        noise: Standard deviation of the surface noise [m].
        seed: Seed of the noise.
    """
    # March through the voxels; their size is adapted to the wanted number of faces.
    voxel = 5e-3
    for _ in range(3):
        solid = manifold3d.Manifold.level_set(_rippled(shape, voxel), list(box), voxel)
        voxel *= math.sqrt(solid.num_tri() / MARCHED)
    mesh = solid.to_mesh64()
    vertices, faces = np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, np.int64)

    # Add noise along the normals, then reduce the number of faces.
    surface = trimesh.Trimesh(vertices, faces, process=False)
    rng = np.random.default_rng(seed)
    vertices = vertices + noise * rng.standard_normal((len(vertices), 1)) * surface.vertex_normals
    vertices, faces = fast_simplification.simplify(vertices, faces, target_count=FACES)

    # Weld sheets that touch, and open the bottom.
    faces = _weld_touching(trimesh.Trimesh(vertices, faces, process=False))
    seen = (vertices[faces][:, :, 2] > UNSEEN).any(axis=1)
    scanned = trimesh.Trimesh(vertices, faces[seen], process=False)
    scanned.remove_unreferenced_vertices()
    return scanned


def _rippled(shape: Shape, voxel: float) -> Shape:
    """Return a shape with the ripple that its voxels cause."""
    wave = 2.0 * math.pi / (PERIOD * voxel)

    def rippled(x: float, y: float, z: float) -> float:
        ripple = math.sin(wave * x) + math.sin(wave * y) + math.sin(wave * z)
        return shape(x, y, z) + RIPPLE * ripple / 3.0

    return rippled


def _weld_touching(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the faces after welding corners where two sheets of the surface touch."""
    normals, merged = mesh.vertex_normals, np.arange(len(mesh.vertices))
    pairs = cKDTree(mesh.vertices).query_pairs(TOUCHING, output_type="ndarray")
    for a, b in np.sort(pairs).tolist():
        if normals[a] @ normals[b] < 0.0:
            merged[b] = merged[a]
    faces = merged[mesh.faces]
    return np.asarray(faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)])


# Shapes: signed distances, positive inside [m]


def _tube(x: float, y: float, z: float, radius: float, wall: float, height: float) -> float:
    """Return the signed distance of a cup that is open above, with a floor as thick as its wall."""
    r = math.hypot(x, y)
    outer = min(radius - r, z, height - z)
    inner = min(radius - wall - r, z - wall)
    return min(outer, -inner)


def _ring(x: float, y: float, z: float, radius: float, tube: float) -> float:
    """Return the signed distance of a ring about the y axis."""
    return tube - math.hypot(math.hypot(x, z) - radius, y)


def _segment(x: float, y: float, z: float, end: tuple[float, float, float], r: float) -> float:
    """Return the signed distance of a capsule that begins at the origin."""
    ex, ey, ez = end
    t = min(1.0, max(0.0, (x * ex + y * ey + z * ez) / (ex * ex + ey * ey + ez * ez)))
    return r - math.sqrt((x - t * ex) ** 2 + (y - t * ey) ** 2 + (z - t * ez) ** 2)


def _block(x: float, y: float, z: float, a: float, b: float, c: float) -> float:
    """Return the signed distance of a box that stands on the table."""
    return min(a - abs(x), b - abs(y), z, c - z)


def _mug(x: float, y: float, z: float) -> float:
    handle = _ring(x - 0.043, y, z - 0.042, 0.022, 0.0045)
    handle = min(handle, math.hypot(x, y) - 0.0395)
    return max(_tube(x, y, z, 0.041, 0.0030, 0.081), handle)


def _bowl(x: float, y: float, z: float) -> float:
    r = math.sqrt(x * x + y * y + (z - 0.075) ** 2)
    shell = min(0.078 - r, r - 0.0755, 0.054 - z)
    foot = min(0.030 - math.hypot(x, y), z, 0.006 - z)
    return max(min(shell, z), foot)


def _cup(x: float, y: float, z: float) -> float:
    return _tube(x, y, z, 0.030 + 0.12 * z, 0.0020, 0.075)


def _pitcher(x: float, y: float, z: float) -> float:
    handle = min(_ring(x - 0.050, y, z - 0.085, 0.045, 0.008), math.hypot(x, y) - 0.0525)
    return max(_tube(x, y, z, 0.056 - 0.02 * math.sin(20.0 * z), 0.004, 0.170), handle)


def _bottle(x: float, y: float, z: float) -> float:
    body = min(0.034 - math.hypot(x, y), z, 0.140 - z)
    return max(body, min(0.014 - math.hypot(x, y), z, 0.195 - z))


def _can(x: float, y: float, z: float) -> float:
    rim = 0.0015 if z > 0.098 or z < 0.003 else 0.0
    return min(0.033 + rim - math.hypot(x, y), z, 0.101 - z)


def _carton(x: float, y: float, z: float) -> float:
    return _block(x, y, z, 0.080, 0.030, 0.210)


def _banana(x: float, y: float, z: float) -> float:
    thick = 0.018 - 0.9 * abs(x) ** 2 / 0.18
    bend = 2.2 * x * x
    return thick - math.hypot(y - bend, z - 0.017)


def _drill(x: float, y: float, z: float) -> float:
    grip = _segment(x, y, z - 0.02, (0.012, 0.0, 0.11), 0.021)
    barrel = _segment(x + 0.035, y, z - 0.150, (0.12, 0.0, 0.0), 0.027)
    battery = _block(x - 0.005, y, z, 0.042, 0.032, 0.034)
    return max(grip, barrel, battery)


def _clamp(x: float, y: float, z: float) -> float:
    # Two jaws that touch at their tips.
    jaws = [
        _segment(x, y - s * 0.016, z - 0.010, (0.075, -s * 0.0110, 0.0), 0.0048) for s in (1, -1)
    ]
    arms = [_segment(x, y - s * 0.016, z - 0.010, (-0.07, s * 0.020, 0.0), 0.007) for s in (1, -1)]
    return max(*jaws, *arms, _segment(x, y + 0.016, z - 0.010, (0.0, 0.032, 0.0), 0.009))


#: Shape, bounds [m] and noise [m] by name.
SCANS: dict[str, tuple[Shape, tuple[float, ...], float]] = {
    "mug": (_mug, (-0.045, -0.045, -0.003, 0.073, 0.045, 0.085), 0.5e-3),
    "bowl": (_bowl, (-0.08, -0.08, -0.003, 0.08, 0.08, 0.058), 0.4e-3),
    "cup": (_cup, (-0.043, -0.043, -0.003, 0.043, 0.043, 0.079), 0.4e-3),
    "pitcher": (_pitcher, (-0.08, -0.08, -0.003, 0.108, 0.08, 0.174), 0.4e-3),
    "bottle": (_bottle, (-0.038, -0.038, -0.003, 0.038, 0.038, 0.2), 0.3e-3),
    "can": (_can, (-0.038, -0.038, -0.003, 0.038, 0.038, 0.105), 0.3e-3),
    "carton": (_carton, (-0.085, -0.034, -0.003, 0.085, 0.034, 0.214), 0.5e-3),
    "banana": (_banana, (-0.09, -0.025, -0.003, 0.09, 0.035, 0.04), 0.2e-3),
    "drill": (_drill, (-0.07, -0.037, -0.003, 0.118, 0.037, 0.182), 0.5e-3),
    "clamp": (_clamp, (-0.082, -0.05, -0.003, 0.084, 0.05, 0.022), 0.2e-3),
}


if __name__ == "__main__":
    click.command(help=__doc__)(
        click.argument("folder", type=click.Path(path_type=Path), metavar="DIR")(main)
    )()
