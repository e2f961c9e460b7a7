"""Surroundings of a scene by name, from a YAML file, or from a model of Drake.

Input: `table`, a YAML file, or a model (.sdf, .urdf, .dmd.yaml) of a shelf, a bin or a fixture.
Output: `Surroundings`, plain data that need the file no more.

Everything in a model is fixed: its joints stay at their default positions, and its frame is that of
the table's top {T}, unless the file places it. Its collision shapes count. An upright box stays a
box; every other shape becomes a convex hull, so a mesh must be convex. The corners of the hull of a
round shape lie on it, and its surface is nowhere more than `FINE` above the hull.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    Mesh,
    SceneGraph,
    Shape,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from scipy.spatial import ConvexHull, QhullError

from drakegrasp.arithmetic import dot, multiply, norm, sin_cos
from drakegrasp.errors import ConfigError, MeshError, one_line
from drakegrasp.foreign_files import read_text
from drakegrasp.frames import Array, transform_points
from drakegrasp.hand.parsing import make_parser
from drakegrasp.hand.shapes import ball_corners, hull_corners
from drakegrasp.mesh.loading import load_surface
from drakegrasp.mesh.surfaces import signed_volume
from drakegrasp.objects.surroundings import BUILT_IN, CORNERS, Surroundings, surroundings_of
from drakegrasp.simulation.construction import accepts_hull
from drakegrasp.yaml_text import parse_yaml

#: How the names of files of models end.
MODELS = (".sdf", ".urdf", ".dmd.yaml")
#: Decimals of the numbers of a model [m].
DECIMALS = 9
#: Largest distance between a round shape and its hull [m]; own choice.
FINE = 5e-4
#: Smallest fraction of its hull that a mesh fills if it is convex, with the rounding of its file.
FULL = 0.999
#: Largest coordinate of a model in {T} [m]; a larger one has wrong units.
FARTHEST = 5.0
#: A box is upright if its z-axis differs from that of {T} by less than this.
UPRIGHT = 1e-9


def load_surroundings(source: str | Path) -> Surroundings:
    """Return surroundings by their name, or from a YAML file or a model of Drake.

    A YAML file may name a `model` beside its own boxes and hulls; its path starts at the YAML file.
    A model alone has the extent of the table, and objects are dropped.

    Raises:
        ConfigError: If the name is unknown, or the file cannot be used.
    """
    if str(source) in BUILT_IN:
        return BUILT_IN[str(source)]
    path = Path(source)
    if not path.is_file():
        raise ConfigError(
            f"surroundings must be {', '.join(BUILT_IN)}, a YAML file or a model "
            f"({', '.join(MODELS)}), got {str(source)!r}"
        )
    found = _load_model(path) if path.name.endswith(MODELS) else _load_yaml(path)
    for i, hull in enumerate(found.hulls):
        if not accepts_hull(Convex(hull.vertices.T, "hull")):
            raise ConfigError(
                f"{path}: hull {i} must be a solid of which Drake can make tetrahedra, got "
                f"{len(hull.vertices)} points in a plane or too near to each other"
            )
    return found


def _load_yaml(path: Path) -> Surroundings:
    try:
        tree = parse_yaml(read_text(path))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(
            f"{path}: must be YAML, got text that is not ({one_line(error)})"
        ) from None

    # What the model has is added to what the file itself has.
    model = tree.pop("model", None) if isinstance(tree, dict) else None
    found = surroundings_of(path.stem, tree, str(path))
    if model is None:
        return found
    fixed = _load_model(path.parent / str(model))
    return replace(found, boxes=found.boxes + fixed.boxes, hulls=found.hulls + fixed.hulls)


def _load_model(path: Path) -> Surroundings:
    """Return a model with the extent of the table."""
    boxes, hulls = list[dict[str, Any]](), list[dict[str, Any]]()
    for X_TS, shape, corners in _shapes_of(path):
        if isinstance(shape, Box) and np.abs(X_TS[2, :3] - [0.0, 0.0, 1.0]).max() < UPRIGHT:
            yaw = float(np.degrees(np.arctan2(X_TS[1, 0], X_TS[0, 0])))
            place = {"position": _rounded(X_TS[:3, 3]), "yaw_deg": yaw}
            boxes.append({"size": _rounded(shape.size()), **place})
        else:
            hulls.append({"vertices": _rounded(transform_points(X_TS, corners))})

    # The same way as from a YAML file, so that a stored scene is read back with the same bits.
    tree = {**BUILT_IN["table"].tree(), "boxes": boxes, "hulls": hulls}
    found = surroundings_of(path.stem.removesuffix(".dmd"), tree, str(path))
    if not found.walls:
        raise ConfigError(f"{path}: must have collision shapes, got none")
    reach = max(float(np.abs(wall.corners).max()) for wall in found.walls)
    if reach > FARTHEST:
        raise ConfigError(
            f"{path}: must be within {FARTHEST:g} m of the table's centre, got a shape that "
            f"reaches {reach:.3g} m: check units and scales of its meshes"
        )
    return found


def _rounded(values: Array) -> list[Any]:
    # A zero has no sign.
    return (np.round(values, DECIMALS) + 0.0).tolist()


def _shapes_of(path: Path) -> list[tuple[Array, Shape, Array]]:
    """Return the collision shapes of a model.

    Returns:
        Of each shape its pose X_TS (4, 4), the shape, and the corners (n, 3) of its hull in its own
        frame [m].
    """
    plant, graph = MultibodyPlant(1e-3), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(graph)
    parser = make_parser(plant)
    # package://NAME/ is the folder of this name above the file.
    for folder in path.resolve().parents:
        if folder.name and not parser.package_map().Contains(folder.name):
            parser.package_map().Add(folder.name, folder)
    try:
        parser.AddModels(path)
        plant.Finalize()
        context = plant.CreateDefaultContext()
    except (RuntimeError, ValueError, SystemExit) as error:  # SystemExit: failed assertion in Drake
        raise ConfigError(
            f"{path}: must be a model that Drake reads, got {one_line(error)}"
        ) from None

    found, inspector = [], graph.model_inspector()
    for body in map(plant.get_body, map(BodyIndex, range(plant.num_bodies()))):
        X_TL = plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()
        for geometry in plant.GetCollisionGeometriesForBody(body):
            X_LS = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
            shape, hull = inspector.GetShape(geometry), hull_corners(inspector, geometry)
            corners = _corners(shape, hull, f"{path}: {inspector.GetName(geometry)}")
            found.append((multiply(X_TL, X_LS), shape, corners))
    return found


def _corners(shape: Shape, hull: Array | None, where: str) -> Array:
    """Return the corners (n, 3) of the hull of a shape in its own frame [m].

    Args:
        shape: The shape.
        hull: The corners of the hull of a mesh; None for another shape.
        where: What the shape is, for messages.
    """
    if isinstance(shape, Box):
        return shape.size() * CORNERS
    if isinstance(shape, Sphere | Capsule | Cylinder | Ellipsoid):
        return _round_corners(shape)

    # A hull in place of a mesh must not close its hollows.
    if hull is None:
        got = type(shape).__name__
        raise ConfigError(f"{where} must be a box, a round solid or a convex mesh, got {got}")
    if isinstance(shape, Mesh):
        try:
            vertices, faces = load_surface(shape.source().path())
            full = abs(signed_volume(vertices, faces)) / float(ConvexHull(vertices).volume)
        except (QhullError, MeshError) as error:
            raise ConfigError(
                f"{where} must have a mesh that can be read, got {one_line(error)}"
            ) from None
        if full < FULL:
            raise ConfigError(
                f"{where} must be convex, as its hull is simulated, got a mesh that fills "
                f"{full:.1%} of its hull: make it of convex pieces"
            )
    return hull


def _round_corners(shape: Sphere | Capsule | Cylinder | Ellipsoid) -> Array:
    """Return points (n, 3) on a round shape, so many that no part of it is far above their hull."""
    # Each is an ellipsoid that slides along z, a cylinder a flat one.
    if isinstance(shape, Ellipsoid):
        axes, half = np.array([shape.a(), shape.b(), shape.c()]), 0.0
    else:
        axes = shape.radius() * np.array([1.0, 1.0, float(not isinstance(shape, Cylinder))])
        half = 0.0 if isinstance(shape, Sphere) else 0.5 * shape.length()

    def farthest(directions: Array) -> Array:
        """Return the points (n, 3) that are farthest along directions (n, 3)."""
        lengths = np.maximum(norm(axes * directions), 1e-300)[:, None]
        end = half * np.sign(directions[:, 2:]) * [0.0, 0.0, 1.0]
        return np.asarray(axes**2 * directions / lengths + end)

    count = 32
    while True:
        if isinstance(shape, Cylinder):
            sine, cosine = sin_cos(2.0 * np.pi * np.arange(count) / count)
            ring = np.column_stack([cosine, sine, np.ones(count)])
            corners = farthest(np.concatenate([ring, ring * [1.0, 1.0, -1.0]]))
        else:
            corners = farthest(ball_corners(1.0, count) / axes)
        # Above each face of the hull, the shape ends where it is farthest along the normal.
        planes = ConvexHull(corners).equations
        above = dot(planes[:, :3], farthest(planes[:, :3])) + planes[:, 3]
        # What is far too large is refused later.
        if above.max() <= FINE or np.abs(corners).max() > FARTHEST:
            return corners
        count *= 2
