"""How many attempts a running build makes until its end, extrapolated from those it has made."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from math import ceil, inf

from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.shards import ShardHeader


class Extrapolation:
    """The attempts of a build so far, and their expected number at its end.

    Each object is expected to yield as many samples or grasps per palm pose as it has so far, until
    it has its share of the requested number.
    """

    def __init__(self, manifest: Manifest) -> None:
        """Begin without attempts.

        Args:
            manifest: Manifest of the dataset, which states the palm poses of each object.
        """
        config = manifest.config
        self._poses = {entry.name: entry.candidates for entry in manifest.objects}
        self._standoffs = len(config.candidates.standoffs)

        # The ends: a number of samples in all, and a number of samples or grasps of each object.
        self._wanted, self._has_target = config.samples, config.has_target
        self._each = config.samples_per_object or config.max_grasps
        self._has_end = self._wanted is not None or self._each is not None
        self._patience = config.samples_patience

        # For each object: palm poses tried, those since the last with a sample, and what was found.
        self._tried: Counter[str] = Counter()
        self._vain: Counter[str] = Counter()
        self._found: Counter[str] = Counter()
        self._attempts = 0

    def add(self, unit: ShardHeader, attempts: int, found: int) -> None:
        """Count a completed work unit.

        Args:
            unit: Header of the unit.
            attempts: Number of its attempts.
            found: Number of its samples, or of its grasps if the build does not count samples.
        """
        name, poses = unit.object_name, unit.stop - unit.start
        self._tried[name] += poses
        self._found[name] += found
        self._vain[name] = 0 if found else self._vain[name] + poses
        self._attempts += attempts

    def total(self) -> int | None:
        """Return the expected number of attempts at the end of the build.

        Returns:
            The number; None as long as a build with a target of samples has not tried each object.
        """
        tried = self._tried.total()
        if not self._has_end:
            left = float(sum(self._poses.values()) - tried)
        elif self._has_target and any(self._untried()):
            return None
        else:
            left = self._poses_left()
        per_pose = self._attempts / tried if tried else self._standoffs
        return self._attempts + ceil(left * per_pose)

    def _untried(self) -> list[int]:
        """Return the numbers of palm poses of the objects that have not been tried."""
        return [poses for name, poses in self._poses.items() if not self._tried[name]]

    def _poses_left(self) -> float:
        """Return the expected number of further palm poses of a build that ends before the last."""
        if self._wanted is not None and self._found.total() >= self._wanted:
            return 0.0

        # An object that has yielded nothing goes on to its end.
        names = [name for name in self._poses if self._tried[name]]
        rest = {name: self._rest(name) for name in names}
        left = float(sum(rest[name] for name in names if not self._found[name]))
        fruitful = [name for name in names if self._found[name] and rest[name]]
        for name, missing in self._missing(fruitful).items():
            left += min(rest[name], missing * self._tried[name] / self._found[name])

        # An object that has not been tried is expected to take as many palm poses as the others.
        each = (self._tried.total() + left) / len(names) if names else inf
        return left + sum(min(poses, each) for poses in self._untried())

    def _rest(self, name: str) -> int:
        """Return the largest number of further palm poses of an object, if it yields no more."""
        rest = self._poses[name] - self._tried[name]
        if not self._has_target:
            return rest
        patience = self._patience - self._vain[name]
        return rest if self._found[name] and patience > 0 else max(0, min(rest, patience))

    def _missing(self, names: Sequence[str]) -> dict[str, float]:
        """Return what each of some objects is expected to yield until the build ends."""
        share = inf if self._each is None else float(self._each)
        if self._wanted is not None and names:
            share = min(share, self._wanted / len(names))
        missing = {name: max(share - self._found[name], 0.0) for name in names}
        if self._wanted is None:
            return missing

        # Less is missing if some objects have more than their share, or others have samples, too.
        left = self._wanted - self._found.total()
        scale = min(1.0, left / max(sum(missing.values()), 1.0))
        return {name: scale * count for name, count in missing.items()}
