"""Simple objects and attempts that several test modules simulate."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.config import Config
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.objects.model import ObjectModel, prepare_object
from drakegrasp.objects.sources import MeshSource
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.candidates import R_OG0, Drawing, palm_attempts

#: Edge of the cube that the hand can grasp from above [m].
CUBE = 0.07
#: Stand-off at which the pads meet the cube's sides a little above its middle [m].
STANDOFF = 0.06


def model_of(mesh: trimesh.Trimesh, folder: Path, name: str = "1_thing_a") -> ObjectModel:
    """Return a mesh [m] as a prepared object of 1 kg."""
    path = folder / f"{name}.obj"
    mesh.export(path)
    return prepare_object(MeshSource(name=name, class_name="thing", path=path))


def box_model(folder: Path, extents: npt.ArrayLike, name: str = "1_box_a") -> ObjectModel:
    """Return a box with edges of a few millimetres less than a fingertip."""
    mesh = trimesh.creation.box(extents)
    return model_of(mesh.subdivide().subdivide(), folder, name)


def standing(model: ObjectModel) -> npt.NDArray[np.float64]:
    """Return X_TO of an object that stands on the table as its mesh file has it, but yawed.

    By 30 degrees, so that no number in {O} is by chance that in {T} or {W}.
    """
    yaw = rotation_about([0.0, 0.0, 1.0], np.pi / 6.0)
    return make_pose(yaw, [0.0, 0.0, float(model.half_extents[2])])


def drawn_attempts(
    model: ObjectModel, X_TO: npt.NDArray[np.float64], config: Config
) -> Iterator[Attempt]:
    """Yield all attempts that a build draws for an object: a test takes as many as it needs."""
    candidates = Drawing(model, X_TO, config).candidates()
    every, rules = range(len(candidates)), config.candidates
    return palm_attempts(candidates, every, rules, name=model.name, seed=config.seed)


def from_above(model: ObjectModel, standoff: float, *, spread: float = 0.0) -> Attempt:
    """Return an attempt with the palm over the object's top, looking down on its middle."""
    return Attempt(
        candidate=0,
        standoff_index=0,
        standoff=standoff,
        spread=spread,
        X_OG=make_pose(R_OG0, [0.0, 0.0, float(model.half_extents[2]) + standoff]),
        ray_hits=True,
        seed=0,
    )


def write_above(folder: Path, standoff: float, x: float = 0.0) -> str:
    """Write a sampler of one palm pose over an object's top, moved along Ox [m].

    Returns:
        Its value of `candidates.method`.
    """
    path = folder / "above.py"
    path.write_text(
        "from drakegrasp.frames import make_pose\n"
        "from drakegrasp.simulation.candidates import R_OG0\n"
        "class Above:\n"
        "  def __init__(self, model, X_TO, stream, config):\n"
        f"    self.height = float(model.half_extents[2]) + {standoff}\n"
        "  def poses(self):\n"
        f"    yield make_pose(R_OG0, [{x}, 0.0, self.height])\n"
    )
    return f"{path}:Above"
