"""A Drake parser that needs no network."""

from __future__ import annotations

from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drakegrasp.runtime.environment import allow_network


def make_parser(plant: MultibodyPlant) -> Parser:
    """Return a parser for a plant that also works under `DRAKE_ALLOW_NETWORK=none`.

    A Drake parser registers a remote package, which raises under that setting even though our
    models do not use the package. Nothing is downloaded.
    """
    with allow_network("package_map"):
        return Parser(plant)
