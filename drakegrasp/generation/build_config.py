"""The configuration by which a build runs.

Input: the configuration that a caller states. Output: one that ends and that names the postures, or
an error before anything is written.
"""

from __future__ import annotations

from drakegrasp.config import MOST_PALMS, Config
from drakegrasp.dataset.successes import own_filters
from drakegrasp.errors import ConfigError
from drakegrasp.generation.request import Part
from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.simulation.candidates import refuse_samplers
from drakegrasp.simulation.drive import drive_of

#: Number of samples of each object that a build makes if nothing else ends it.
SAMPLES_PER_OBJECT = 20


def build_config(
    config: Config, postures: Attempts | None = None, part: Part | None = None
) -> Config:
    """Return the configuration of a build, which ends and names its postures.

    Without a target and a number of palm poses, samplers without an end would go on for hours, so
    each object then ends with `SAMPLES_PER_OBJECT` samples.

    Args:
        config: Configuration that the caller states.
        postures: Postures to try instead of palm poses of samplers.
        part: Part of the work units to run; all if None.

    Raises:
        ConfigError: If the configuration names other postures, limits both grasps and samples, or
            names a class that cannot be used; or if its work units depend on results, so that it
            has no parts.
        HandError: If the hand cannot be used, or a sampler cannot be used with it.
    """
    config = _with_postures(config, postures)
    rules = config.candidates
    endless = "closing" in rules.method and rules.postures is None
    if endless and rules.max == MOST_PALMS and not config.has_target:
        config = config.model_copy(update={"samples_per_object": SAMPLES_PER_OBJECT})

    # At most one end, and none for a part.
    ends = {key: getattr(config, key) for key in ("samples", "samples_per_object", "max_grasps")}
    ends = {key: value for key, value in ends.items() if value is not None}
    if "max_grasps" in ends and len(ends) > 1:
        raise ConfigError("max_grasps must be null with samples or samples_per_object, got both")
    for key, value in ends.items():
        if part is not None:
            raise ConfigError(
                "part must be of a build with a number of palm poses (--candidates N) and no other "
                f"end, got {key}={value}, whose work units depend on the results of all parts"
            )

    # The hand, and classes that are not of this package.
    drive_of(load_hand(config.hand_source), config.lift)
    if rules.postures is None:
        refuse_samplers(config)
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
