"""Which work units a target of samples needs, unit by unit.

In: the work units of each object in their order, and the numbers of samples of those that are done.
Out: how many units of each object belong to the dataset, and which must be run next.

The rule goes in rounds. In each round every object that still has units, has not been tried in vain
for long, and is below a level runs its next unit. The level shares the target in turns: it is the
least number of samples at which the objects that have more units would fill it up. So a dataset
depends on the target alone, not on the workers, and that of a smaller target is part of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile

from drakegrasp.config import Config
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import ConfigError, listed


@dataclass(kw_only=True)
class Target:
    """The units of a target, and what is known of them.

    Attributes:
        config: Its `samples`, `samples_per_object` and `samples_patience` state the target.
        units: Work units of each object, by its name, in their order.
        found: Number of samples of each unit that is done.
    """

    config: Config
    units: Mapping[str, Sequence[ShardHeader]]
    found: dict[ShardHeader, int] = field(default_factory=dict)

    def add(self, header: ShardHeader, samples: int) -> None:
        """Add the number of samples of a unit that is done."""
        self.found[header] = samples

    def plan(self) -> tuple[dict[str, int], dict[str, int], list[ShardHeader]]:
        """Return how far the rounds are known.

        Returns:
            The number of units and of samples of each object in the complete rounds, and the units
            that the next round lacks; if there is none, the target is met.
        """
        taken, counts = dict.fromkeys(self.units, 0), dict.fromkeys(self.units, 0)
        while True:
            due = [self.units[name][taken[name]] for name in self._active(taken, counts)]
            missing = [header for header in due if header not in self.found]
            if missing or not due:
                return taken, counts, missing
            for header in due:
                taken[header.object_name] += 1
                counts[header.object_name] += self.found[header]

    def next_units(self) -> Iterator[ShardHeader]:
        """Yield the units that the next round lacks, and while some of them run, the ones after.

        A unit that the target turns out not to need costs its time and changes nothing else.
        """
        taken, _, missing = self.plan()
        yield from missing

        # The next unit of each object that is done with this round and is still below the level.
        ahead = set[ShardHeader]()
        while True:
            counts, places = dict.fromkeys(self.units, 0), dict(taken)
            for name, units in self.units.items():
                known = [
                    self.found[unit] for unit in units[: taken[name] + 1] if unit in self.found
                ]
                counts[name], places[name] = sum(known), len(known)
            free = [
                unit
                for name in self._active(places, counts)
                if places[name] == taken[name] + 1
                and (unit := self.units[name][places[name]]) not in {*self.found, *ahead}
            ]
            if not free:
                return
            ahead.add(free[0])
            yield free[0]

    def shortfall(self) -> list[str]:
        """Return what a target that has been run could not give, in words; empty if it is met."""
        taken, counts, _ = self.plan()
        total, lines = sum(counts.values()), list[str]()
        wanted, per_object = self.config.samples, self.config.samples_per_object
        patience = self.config.samples_patience
        if wanted is not None and total >= wanted:
            return lines
        if wanted is not None and per_object is None:
            lines.append(f"{total:,} of {wanted:,} samples were found")

        # Each object ended at its last palm pose, or after many in vain.
        short = [n for n in self.units if per_object is None or counts[n] < per_object]
        vain = [n for n in short if self._in_vain(self.units[n][: taken[n]]) >= patience]
        spent = [n for n in short if n not in vain and taken[n] == len(self.units[n])]
        for names, why in (
            (vain, f"given up after {patience} palm poses without a sample"),
            (spent, "all palm poses were tried, --candidates allows more"),
        ):
            if names:
                said = listed([f"{name} ({counts[name]:,})" for name in names])
                lines.append(f"too few samples, {why}: {said}")
        return lines

    def _active(self, taken: Mapping[str, int], counts: Mapping[str, int]) -> list[str]:
        """Return the objects that take part in the next round, given their units and samples."""
        left = [
            name
            for name, units in self.units.items()
            if taken[name] < len(units)
            and self._in_vain(units[: taken[name]]) < self.config.samples_patience
        ]
        level = self._level([counts[name] for name in left], sum(counts.values()))
        return [name for name in left if level is None or counts[name] < level]

    def _in_vain(self, units: Sequence[ShardHeader]) -> int:
        """Return how many palm poses the last of some units have without a sample."""
        last = takewhile(lambda unit: not self.found.get(unit, 0), reversed(units))
        return sum(unit.stop - unit.start for unit in last)

    def _level(self, counts: Sequence[int], total: int) -> int | None:
        """Return the number of samples below which an object takes part; None: any number."""
        level, wanted = self.config.samples_per_object, self.config.samples
        if wanted is None:
            return level
        if total >= wanted:
            return 0
        # Fill up the objects with the fewest first.
        rest, ordered = wanted - total, sorted(counts)
        for k, count in enumerate(ordered, start=1):
            above = ordered[k] if k < len(ordered) else None
            room = None if above is None else k * (above - count)
            if room is None or room >= rest:
                share = count + -(-rest // k)
                return share if level is None else min(share, level)
            rest -= room
        return level


def has_target(config: Config) -> bool:
    """Return whether a configuration says after how many samples to stop."""
    return config.samples is not None or config.samples_per_object is not None


def refuse_two_ends(config: Config) -> None:
    """Refuse a number of grasps together with a number of samples after which to stop.

    Raises:
        ConfigError: If both are stated.
    """
    if config.max_grasps is not None and has_target(config):
        raise ConfigError("max_grasps must be null with samples or samples_per_object, got both")


def target_of(config: Config, units: Mapping[str, Sequence[ShardHeader]]) -> Target | None:
    """Return the target that a configuration states, or None; `units` as in `Target`."""
    return Target(config=config, units=units) if has_target(config) else None
