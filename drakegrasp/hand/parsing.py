"""Parsing the model of a hand with Drake.

In: an SDFormat or URDF file. Out: its links and joints in a plant, and nothing else of it: motors
and couplings come from the hand file.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drakegrasp.errors import HandError, first_line
from drakegrasp.runtime.environment import allow_network

#: Hands of which a process keeps what it has computed: a build has one, in some preshapes.
KEPT_HANDS = 32


def _is_no_twin(record: logging.LogRecord) -> bool:
    """Return whether a message of Drake says what no exception says again."""
    return not record.getMessage().startswith("SDFormat Error")


logging.getLogger("drake").addFilter(_is_no_twin)


@dataclass(frozen=True)
class ModelFile:
    """The model of a hand.

    Attributes:
        path: The SDFormat or URDF file.
        packages: Name and folder of each package of a package:// URI.
        stamp: Sizes and times of the hand's files: a model that has changed is another one.
    """

    path: Path
    packages: tuple[tuple[str, Path], ...] = ()
    stamp: tuple[int, ...] = ()


def make_parser(plant: MultibodyPlant) -> Parser:
    """Return a parser for a plant that also works under `DRAKE_ALLOW_NETWORK=none`.

    A Drake parser registers a remote package, which raises under that setting even though our
    models do not use the package. Nothing is downloaded.
    """
    with allow_network("package_map"):
        return Parser(plant)


def add_model(plant: MultibodyPlant, model: ModelFile) -> ModelInstanceIndex:
    """Add the links and joints of a hand's model to a plant; return its model instance.

    Motors and couplings (`<mimic>`) of the file are left out: those of the hand file replace them.

    Args:
        plant: Not finalized. Shapes are added if it is a source of a scene graph.
        model: The file.

    Raises:
        HandError: If the file cannot be read, e.g. as a mesh is missing.
    """
    # Read the file; package:// URIs are resolved in the packages that are known.
    if not model.path.is_file():
        raise HandError(f"model: must be an SDFormat or URDF file, got {str(model.path)!r}")
    parser = make_parser(plant)
    for name, folder in model.packages:
        parser.package_map().Add(name, str(folder))
    actuators = set(plant.GetJointActuatorIndices())
    constraints = set(plant.GetConstraintIds())
    try:
        (instance,) = parser.AddModels(model.path)
    except (RuntimeError, ValueError) as error:
        raise HandError(f"model: must be a file of one model, got {first_line(error)}") from None

    # Leave out its motors and couplings.
    for index in set(plant.GetJointActuatorIndices()) - actuators:
        plant.RemoveJointActuator(plant.get_joint_actuator(index))
    for constraint in set(plant.GetConstraintIds()) - constraints:
        plant.RemoveConstraint(constraint)
    return instance


@lru_cache(maxsize=KEPT_HANDS)
def position_order(model: ModelFile, palm_link: str) -> tuple[str, ...]:
    """Return the names of a model's joints in the order of its positions, that of every `q`.

    It is that of the tree of links whose root is the palm, which need not be that of the file: a
    wrist of the model hangs from its palm.

    Args:
        model: The file.
        palm_link: The link by which the hand is held.

    Raises:
        HandError: As `add_model`.
    """
    plant = MultibodyPlant(0.0)
    instance = add_model(plant, model)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(palm_link, instance))
    plant.Finalize()
    return tuple(plant.GetPositionNames(instance, False, False))
