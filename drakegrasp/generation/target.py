"""The target of a build: how many palm poses of each object the dataset takes.

A target is a number of samples in all (`samples`), or of each object (`samples_per_object`). Input:
the palm poses whose attempts were hits (samples), as work units end, in any order. Output: the
units that are still needed, and in the end the number of palm poses of each object after which its
rows end.

The samples are spread evenly: every object contributes up to one level, which rises where others
are exhausted. The result follows from the hits alone, not from the order or the number of units
that were done beyond it. What a dataset already has is never taken out of it.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from math import inf

from drakegrasp.config import Config
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import listed


@dataclass(eq=False)
class _Object:
    """What is known of an object's palm poses.

    Attributes:
        floor: Number of palm poses that the dataset already has.
        patience: Number of palm poses in a row without a hit after which the object is given up.
        units: Its work units, in order.
        endless: Whether more palm poses can be drawn than those of the units.
        found: The palm poses of the hits of each completed unit, by its first and last palm pose.
        done: Number of units before the first one that is not done.
        hits: Palm poses of the hits among these, ascending.
        last: Number of palm poses up to the last hit before the object is given up.
        given_up: Number of palm poses after which it is given up; None if it is not.
    """

    floor: int
    patience: int
    units: Sequence[ShardHeader] = ()
    endless: bool = True
    found: dict[tuple[int, int], tuple[int, ...]] = field(default_factory=dict)
    done: int = 0
    hits: list[int] = field(default_factory=list)
    last: int = 0
    given_up: int | None = None

    def update(self) -> None:
        """Count the units that follow those that were done before and are done now."""
        while self.done < len(self.units) and self.has(self.units[self.done]):
            unit = self.units[self.done]
            own = self.found[unit.start, unit.stop]
            for palm in (*own, unit.stop):
                if self.given_up is None and palm - self.last >= self.patience:
                    self.given_up = self.last + self.patience
                if self.given_up is None and palm < unit.stop:
                    self.last = palm + 1
            self.hits += own
            self.done += 1

    def has(self, unit: ShardHeader) -> bool:
        """Return whether a unit is done."""
        return (unit.start, unit.stop) in self.found

    @property
    def known(self) -> int:
        """Number of palm poses before the first unit that is not done."""
        return self.units[self.done - 1].stop if self.done else 0

    @property
    def drawn(self) -> int:
        """Number of palm poses that are drawn."""
        return self.units[-1].stop if self.units else 0

    @property
    def end(self) -> int | None:
        """Number of palm poses after which the object is exhausted; None if it is not."""
        if self.given_up is not None:
            return max(self.given_up, self.floor)
        return self.drawn if self.known == self.drawn and not self.endless else None

    def within(self, palms: int) -> int:
        """Return the number of hits among the first palm poses."""
        return bisect_left(self.hits, palms)

    def whole(self, hits: int) -> int:
        """Return a number of hits, with all others of the palm pose of the last one."""
        return self.within(self.hits[hits - 1] + 1) if 0 < hits <= len(self.hits) else hits

    def taken(self, hits: int) -> int | None:
        """Return the palm poses that yield a number of hits; None if more must be tried."""
        if self.known < self.floor:
            return None
        if hits <= self.within(self.floor):
            return self.floor
        # Hits after an object was given up do not count, or the result would depend on chance.
        if self.end is not None and hits > self.within(self.end):
            return self.end
        return self.hits[hits - 1] + 1 if hits <= len(self.hits) else None


class Target:
    """The target of a build, and what is known of each object."""

    def __init__(self, config: Config, floors: Mapping[str, int]) -> None:
        """Begin without any palm poses.

        Args:
            config: Configuration, whose `samples`, `samples_per_object` and `samples_patience`
                define the target.
            floors: Number of palm poses of each object that the dataset already has, by name.
        """
        self._config = config
        self._objects = {
            name: _Object(floor, config.samples_patience) for name, floor in floors.items()
        }
        self._lost = dict.fromkeys(floors, 0)
        self._current: dict[str, int] | None = None  # the shares, until something changes

    def set_units(self, name: str, units: Sequence[ShardHeader], *, endless: bool) -> None:
        """State an object's work units, and whether more palm poses can be drawn."""
        item = self._objects[name]
        item.units, item.endless = units, endless
        item.update()
        self._current = None

    def add(self, unit: ShardHeader, hits: Sequence[int]) -> None:
        """Note the palm poses of the hits of a completed unit."""
        item = self._objects[unit.object_name]
        item.found[unit.start, unit.stop] = tuple(sorted(hits))
        item.update()
        self._current = None

    def lose(self, lost: Mapping[str, int]) -> bool:
        """State how many hits of each object are no samples after all; return whether more are."""
        before = dict(self._lost)
        self._lost |= {name: max(count, before[name]) for name, count in lost.items()}
        self._current = None
        return self._lost != before

    @property
    def has_begun(self) -> bool:
        """Whether each object has been tried."""
        return all(item.known or not item.units for item in self._objects.values())

    @property
    def wanted(self) -> int:
        """Number of hits at which the build ends, if every object yields its share."""
        each = self._config.samples_per_object
        of_all = inf if each is None else each * len(self._objects)
        return int(min(of_all, inf if self._config.samples is None else self._config.samples))

    @property
    def found(self) -> int:
        """Number of hits so far, up to the wanted number of each object."""
        shares = self._shares()
        return sum(min(len(item.hits), shares[name]) for name, item in self._objects.items())

    def taken(self) -> dict[str, int | None]:
        """Return the palm poses of each object in the dataset; None where more must be tried."""
        taken = self._taken(self._shares())
        if None in taken.values():
            return taken
        # All hits up to here are known, also the others of each palm pose with several.
        return self._taken(self._even_shares(whole=True))

    def dry(self) -> list[str]:
        """Return the objects that need more palm poses than are drawn."""
        return [
            name
            for name, taken in self.taken().items()
            if taken is None and self._objects[name].known == self._objects[name].drawn
        ]

    def next_units(self) -> Iterator[ShardHeader]:
        """Yield units that are needed, and as long as others run, units that may be.

        A unit that turns out not to be needed costs time, but does not change the result.
        """
        given: dict[str, list[ShardHeader]] = {name: [] for name in self._objects}
        while True:
            shares, best = self._shares(), None
            for name, taken in self._taken(shares).items():
                item = self._objects[name]
                if taken is not None:
                    continue
                running = [unit for unit in given[name] if not item.has(unit)]
                free = next(
                    (
                        unit
                        for unit in islice(item.units, item.done, None)
                        if not item.has(unit) and unit not in running
                    ),
                    None,
                )
                given[name] = running
                # The units that run are expected to yield as many hits as those before.
                rate = (len(item.hits) + 1) / (item.known + 2)
                expected = len(item.hits) + rate * sum(unit.stop - unit.start for unit in running)
                due = not running or expected < shares[name]
                if free is not None and due and (best is None or len(running) < best[0]):
                    best = len(running), free
            if best is None:
                return
            given[best[1].object_name].append(best[1])
            yield best[1]

    def warnings(self) -> list[str]:
        """Return lines that state which part of the target was not reached."""
        config, lines = self._config, list[str]()
        counts, spent, vain = dict[str, int](), list[str](), list[str]()
        shares = self._even_shares(whole=True)
        for name, taken in self._taken(shares).items():
            item = self._objects[name]
            found = item.within(taken or 0)
            counts[name] = found - self._lost[name]
            if found < shares[name]:
                (spent if item.given_up is None else vain).append(name)

        # The target of all objects together may be reached without those.
        total = sum(counts.values())
        if config.samples is not None and total < config.samples:
            lines.append(f"{total:,} of {config.samples:,} samples were found")
        if config.samples is None or total < config.samples:
            for names, why in (
                (vain, f"given up after {config.samples_patience} palm poses without one"),
                (spent, "all palm poses were tried"),
            ):
                if names:
                    said = listed([f"{name} ({counts[name]:,})" for name in names])
                    lines.append(f"too few samples, {why}: {said}")
        return lines

    def _taken(self, shares: Mapping[str, int]) -> dict[str, int | None]:
        return {name: item.taken(shares[name]) for name, item in self._objects.items()}

    def _shares(self) -> dict[str, int]:
        if self._current is None:
            self._current = self._even_shares()
        return self._current

    def _even_shares(self, *, whole: bool = False) -> dict[str, int]:
        """Return the number of hits for which each object is tried, as even as possible.

        An exhausted object has fewer.

        Args:
            whole: Whether to count all hits of the last palm pose of each object.
        """
        # What the dataset has must be known first: if a share could fall again, an object might be
        # tried longer than in another run of the same command.
        if any(item.known < item.floor for item in self._objects.values()):
            return dict.fromkeys(self._objects, 0)
        wanted = self._config.samples
        each = self._config.samples_per_object or wanted or 0
        shares = {name: each + lost for name, lost in self._lost.items()}
        if wanted is None:
            return shares

        # Every object contributes what the dataset has, or up to a level, or what it has at most.
        least = {name: item.within(item.floor) for name, item in self._objects.items()}
        most = {
            name: shares[name] if item.end is None else min(shares[name], item.within(item.end))
            for name, item in self._objects.items()
        }

        def contributed(level: int, name: str) -> int:
            hits = min(level + self._lost[name], most[name])
            return max(least[name], self._objects[name].whole(hits) if whole else hits)

        # The highest level at which the objects together have at most the wanted number; the first
        # ones contribute one more.
        rest = wanted + sum(self._lost.values())
        low, high = 0, rest + 1
        while high - low > 1:
            middle = (low + high) // 2
            total = sum(contributed(middle, name) for name in shares)
            low, high = (middle, high) if total <= rest else (low, middle)
        rest -= sum(contributed(low, name) for name in shares)
        for name in shares:
            more = contributed(low + 1, name) - contributed(low, name) if rest > 0 else 0
            level = low + 1 if rest > 0 else low
            shares[name] = min(level + self._lost[name], shares[name])
            rest -= more
        return shares
