"""Several objects at rest together: dropped one after another, or stood side by side.

Input: objects with their resting poses, and surroundings. Output: their poses, or why they do not
come to rest. The first object stands in one of its resting poses, which are what a single object's
drop ends in. The others fall in random orientations from just above whatever they touch first, with
the steps and the surfaces of an object's own drops. All objects move until all are at rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform

from drakegrasp.arithmetic import dot, multiply
from drakegrasp.config import Config
from drakegrasp.errors import MeshError, first_line
from drakegrasp.frames import X_WT, Array, make_pose, rotation_about, transform_points
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import Neighbourhood, Surroundings
from drakegrasp.seeding import Stream
from drakegrasp.simulation.construction import build_object_scene
from drakegrasp.simulation.contacts import object_meets_something
from drakegrasp.simulation.scene import ObjectScene, neighbour_poses, object_pose, reset_object
from drakegrasp.simulation.settle import (
    RANDOM_STEP,
    on_grid,
    rotation_of,
    wait_for_rest,
)

#: Number of places that are drawn for an object before a scene is given up.
MOST_PLACES = 40
#: Objects stand at least this far apart [m]; own choice.
GAP = 2e-3
#: Step by which an object is lowered until it touches something [m].
LOWERING = 5e-3
#: Deepest an object at rest may be in the table [m].
MAX_DEPTH = 2e-3
#: Part of the area, from its centre, in which objects are dropped.
DROP_AREA = 0.6


class PileError(Exception):
    """The objects of a scene did not come to rest, or there was no room for them."""


def pile_up(
    models: Sequence[ObjectModel],
    resting: Sequence[Array],
    surroundings: Surroundings,
    config: Config,
    stream: Stream,
) -> Array:
    """Return the poses X_TO (n, 4, 4) of objects at rest, rounded to the grid of resting poses.

    Args:
        models: The n objects.
        resting: A resting pose (4, 4) of each object.
        surroundings: What is around them, and whether they are dropped.
        config: How objects settle.
        stream: Where draws come from.

    Raises:
        PileError: If there is no room, or the objects do not come to rest where they may lie.
    """
    X_TN = np.zeros((0, 4, 4))
    physics = config.physics.model_copy(update={"time_step": RANDOM_STEP})
    for i, (model, X_TO) in enumerate(zip(models, resting, strict=True)):
        around = Neighbourhood(models=tuple(models[:i]), X_TN=X_TN, walls=surroundings.walls)
        try:
            scene = build_object_scene(model, physics, around=around)
            if i == 0 or not surroundings.drops:
                X_TO = _stand(scene, X_TO, surroundings, stream)
                X_TN = np.concatenate([X_TN, X_TO[None]])
                continue
            _lower(scene, X_TN, surroundings, stream)
            wait_for_rest(scene, config)
        # Also a failed assertion in Drake, which arrives as SystemExit.
        except (RuntimeError, MeshError, SystemExit) as error:
            raise PileError(first_line(error)) from None
        X_TN = np.concatenate([neighbour_poses(scene), object_pose(scene)[None]])
        _validate(models[: i + 1], X_TN, surroundings)
    return np.array([on_grid(X) for X in X_TN])


def _stand(scene: ObjectScene, X_TO: Array, surroundings: Surroundings, stream: Stream) -> Array:
    """Return a resting pose with a yaw and a place at which the object touches nothing else."""
    for _ in range(MOST_PLACES):
        u = stream.uniform(3)
        turn = make_pose(rotation_about([0.0, 0.0, 1.0], 2.0 * np.pi * u[0]), np.zeros(3))
        X = multiply(turn, X_TO)
        X[:2, 3] = surroundings.extent * (2.0 * u[1:] - 1.0)
        raised = X.copy()
        raised[2, 3] += GAP
        reset_object(scene, multiply(X_WT, raised))
        if not object_meets_something(scene):
            return on_grid(X)
    raise PileError(f"{scene.model.name} must have room in the {surroundings.name}, got none")


def _lower(scene: ObjectScene, X_TN: Array, surroundings: Surroundings, stream: Stream) -> None:
    """Put the object, turned at random, just above what it meets when it is lowered."""
    u = stream.uniform(2)
    R_TO = rotation_of(stream.normal(4))
    lowest = float(dot(scene.model.collision_vertices, R_TO[2]).min())
    tops = [
        transform_points(X, each.model.collision_vertices)[:, 2].max()
        for each, X in zip(scene.neighbours, X_TN, strict=True)
    ]
    tops += [wall.corners[:, 2].max() for wall in surroundings.walls]
    X_TO = make_pose(R_TO, [0.0, 0.0, max(tops) + LOWERING - lowest])
    X_TO[:2, 3] = DROP_AREA * surroundings.extent * (2.0 * u - 1.0)
    reset_object(scene, multiply(X_WT, X_TO))
    while not object_meets_something(scene) and X_TO[2, 3] + lowest > 0.0:
        X_TO[2, 3] -= LOWERING
        place = RigidTransform(multiply(X_WT, X_TO))
        scene.plant.SetFreeBodyPose(scene.context, scene.object, place)
    X_TO[2, 3] += LOWERING
    reset_object(scene, multiply(X_WT, X_TO))
    scene.simulator.Initialize()


def _validate(models: Sequence[ObjectModel], X_TN: Array, surroundings: Surroundings) -> None:
    for model, X in zip(models, X_TN, strict=True):
        if np.any(np.abs(X[:2, 3]) > surroundings.extent):
            raise PileError(f"{model.name} must stay in the {surroundings.name}, got out of it")
        depth = -float(transform_points(X, model.collision_vertices)[:, 2].min())
        if depth > MAX_DEPTH:
            raise PileError(
                f"{model.name} must lie on the table, got {1e3 * depth:.2g} mm below its top"
            )
