"""What a build is asked for: its configuration, and the names of objects.

Input: the configuration that a caller states. Output: one that ends and that names the postures, or
an error before anything is written.
"""

from __future__ import annotations

from collections.abc import Sequence

from drakegrasp.config import MOST_PALMS, Config
from drakegrasp.dataset.successes import own_filters
from drakegrasp.errors import ConfigError, MeshError, listed
from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.simulation.candidates import validate_samplers
from drakegrasp.simulation.drive import drive_of

#: Name that requests the built-in objects instead of a directory of meshes.
BUILTIN = "builtin"
#: Number of samples of each object that a build makes if nothing else ends it.
SAMPLES_PER_OBJECT = 20


def build_config(config: Config, postures: Attempts | None = None) -> Config:
    """Return the configuration of a build, which ends and names its postures.

    Without a target and a number of palm poses, samplers without an end would go on for hours, so
    each object then ends with `SAMPLES_PER_OBJECT` samples.

    Args:
        config: Configuration that the caller states.
        postures: Postures to try instead of palm poses of samplers.

    Raises:
        ConfigError: If the configuration names other postures, or a class that cannot be used.
        HandError: If the hand cannot be used, or a sampler cannot be used with it.
    """
    config = _with_postures(config, postures)
    rules = config.candidates
    endless = "closing" in rules.method and rules.postures is None
    if endless and rules.max == MOST_PALMS and not config.has_target:
        config = config.model_copy(update={"samples_per_object": SAMPLES_PER_OBJECT})

    # The hand, and classes that are not of this package.
    drive_of(load_hand(config.hand_source), config.lift)
    if rules.postures is None:
        validate_samplers(config)
    own_filters(config.filters)
    return config


def _with_postures(config: Config, postures: Attempts | None) -> Config:
    """Return a configuration that names the given postures.

    Raises:
        ConfigError: If it names other postures.
    """
    digest, named = None if postures is None else postures.digest(), config.candidates.postures
    if named not in (None, digest):
        must = "left out; the postures that are given decide" if digest else "given with postures"
        raise ConfigError(f"candidates.postures must be {must}, got {named!r}")
    if digest is None:
        return config
    # A posture has no stand-off, so there is one attempt per posture.
    rules = config.candidates
    changed = {"postures": digest, "standoffs": rules.standoffs[:1]}
    return config.model_copy(update={"candidates": rules.model_copy(update=changed)})


def validate_known(only: Sequence[str], names: Sequence[str]) -> None:
    """Check that each name is the name of an object.

    Raises:
        MeshError: If no object has one of the names.
    """
    unknown = [name for name in only if name not in names]
    if unknown:
        known = listed(names)
        raise MeshError(f"only must be names of objects ({known}), got {unknown[0]!r}")
