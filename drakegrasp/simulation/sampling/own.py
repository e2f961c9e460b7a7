"""Palm poses of a sampler of the user's own.

In: a class that the user gives as `file.py:Name`. Out: its poses, checked, as those of a sampler of
the package. docs/explanation/sampling.md has an example.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.config import CandidateConfig
from drakegrasp.errors import ConfigError, GraspError
from drakegrasp.frames import Array, read_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.registry import own_class, run_own
from drakegrasp.seeding import Stream


def own_sampler(stored: str, code: Mapping[str, str]) -> type[Any]:
    """Return the class of a sampler of the user's own.

    Raises:
        ConfigError: If it cannot be imported, or is of another signature.
    """
    key, arguments = "candidates.method", ("model", "X_TO", "stream")
    return own_class(stored, code, key=key, arguments=arguments, method="poses")


class OwnPoses:
    """The poses that a sampler of the user's own yields, one after the other.

    Attributes:
        log_density: The class's own; 0 if it has none.
        limit: Number of poses that it has, up to `candidates.max`.
    """

    def __init__(
        self, stored: str, model: ObjectModel, X_TO: Array, config: CandidateConfig, stream: Stream
    ) -> None:
        """Draw the poses.

        Args:
            stored: Its name in the configuration.
            model: The object.
            X_TO: Its resting pose, (4, 4).
            config: Number of poses, and the text of the class.
            stream: Its random numbers.

        Raises:
            ConfigError: If it cannot be run, or yields something other than poses.
        """
        found, name = own_sampler(stored, config.code), stored.partition("@")[0]
        sampler = run_own(stored, found, model, X_TO, stream)
        made = run_own(stored, lambda: list(islice(sampler.poses(), config.max)))
        self._poses = np.array([_pose(f"{name}: pose {i}", X) for i, X in enumerate(made)]).reshape(
            -1, 4, 4
        )
        self.limit: int | None = len(self._poses)
        self.log_density = getattr(sampler, "log_density", 0.0)
        if not isinstance(self.log_density, float) or not math.isfinite(self.log_density):
            raise ConfigError(f"{name}: log_density must be a finite float, got {self.log_density}")

    def poses(self, count: int) -> Array:
        """Return the first poses (count, 4, 4)."""
        return self._poses[:count]

    def counts(self, count: int) -> tuple[int, int, int]:
        """Return the number of poses three times: nothing is known of what was not yielded."""
        return count, count, count


def _pose(name: str, X_OG: npt.ArrayLike) -> Array:
    """Return what a sampler yielded as a pose (4, 4) with an exact rotation."""
    try:
        X = read_pose(X_OG, name)
    except GraspError as error:
        raise ConfigError(str(error)) from None
    if X.shape != (4, 4):
        raise ConfigError(f"{name} must be one pose, 4 x 4 numbers, got {len(X)} of them")
    return X
