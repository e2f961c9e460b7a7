"""Counts the progress of a build.

Input: the header and the outcomes of each completed work unit, in any order. Output: counts, the
figures of the progress bar, and whether an object needs more grasps.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile

from drakegrasp.config import Config
from drakegrasp.dataset.assembly.survey import headers_by_object
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import ConfigError, listed
from drakegrasp.generation.extrapolation import Extrapolation
from drakegrasp.generation.work_unit import UnitSummary
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import WorkerPool
from drakegrasp.runtime.progress import Report

#: Outcomes of attempts that ended because of the machine or an error of the simulator.
ENDED = (Outcome.CRASHED, Outcome.TIMEOUT)
#: Fraction of an object's attempts from which on these outcomes cause a warning, and a number
#: below which they do not, unless all attempts end so. None of the millions of attempts behind the
#: benchmarks had such an outcome.
ENDED_SHARE, FEW_ENDED = 0.02, 10


class Counts:
    """Counts of completed work; their memory does not grow with the number of work units.

    For `max_grasps` it stores, for each object, the candidate up to which all units are done and
    the grasps of these units. It also stores the grasps of later units that are done; these are
    few, because they only wait for units that are still running.

    Attributes:
        simulated: Work units that were run now.
        reused: Work units that were done before.
        damaged: Damaged shards.
        errors: Number of solver errors by message.
        target: Units for a requested number of samples; None if no number is requested.
    """

    def __init__(self, manifest: Manifest, pool: WorkerPool | None, report: Report) -> None:
        """Begin to count.

        Args:
            manifest: Manifest of the dataset, which states the amount of work.
            pool: Workers, whose number is shown; None: it is not shown.
            report: Called with the figures.
        """
        self.simulated = self.reused = 0
        self.damaged: list[str] = []
        self.errors: Counter[str] = Counter()
        self.target: Target | None = None
        if manifest.config.has_target:
            units = {of[0].object_name: of for of in headers_by_object(manifest) if of}
            self.target = Target(manifest.config, units)

        # What the bar shows.
        self._pool, self._report = pool, report
        self._extrapolation = Extrapolation(manifest)
        self._wanted = manifest.config.samples
        self._outcomes: Counter[Outcome] = Counter()
        self._samples = self._reused_attempts = 0

        # For each object: all attempts, and those that ended because of the machine.
        self._attempts: Counter[str] = Counter()
        self._ended: Counter[str] = Counter()

        # For `max_grasps`, for each object: the grasps before the first gap, its place, and the
        # grasps of units beyond it.
        self._max_grasps = manifest.config.max_grasps
        self._grasps: Counter[str] = Counter()
        self._gap: Counter[str] = Counter()
        self._beyond: dict[str, dict[int, tuple[int, int]]] = {}

    def add(self, summary: UnitSummary, *, reused: bool = False) -> None:
        """Count a completed unit; if `reused`, an earlier build completed it."""
        header, outcomes, samples = summary.header, summary.outcomes, summary.samples
        self.reused += reused
        self.simulated += not reused
        self.errors.update(summary.errors)
        if self.target is not None and samples is not None:
            self.target.found[header] = samples
        grasps = outcomes.get(Outcome.SUCCESS, 0)
        self._samples += samples or 0
        self._outcomes.update(outcomes)
        attempts = sum(outcomes.values())
        self._extrapolation.add(header, attempts, grasps if samples is None else samples)
        self._attempts[header.object_name] += attempts
        self._ended[header.object_name] += sum(outcomes.get(outcome, 0) for outcome in ENDED)
        self._reused_attempts += reused * attempts
        if self._max_grasps is not None:
            self._close_gap(header, grasps)
        self.show()

    def unexplained(self) -> list[str]:
        """Return a warning for each object with too many crashes or timeouts."""
        lines = []
        for name, ended in self._ended.items():
            attempts = self._attempts[name]
            if ended and (ended == attempts or ended >= max(FEW_ENDED, ENDED_SHARE * attempts)):
                lines.append(
                    f"{name}: {ended:,} of {attempts:,} attempts crashed or timed out, which is no "
                    f"property of grasps. See `drakegrasp doctor`; remove shards/{name} there, and "
                    "the same command tries them again"
                )
        return lines

    def show(self) -> None:
        """Report the completed attempts and the number of workers."""
        figures = {"grasps": self._outcomes[Outcome.SUCCESS]}
        for outcome in ENDED:
            if self._outcomes[outcome]:
                figures[outcome.label] = self._outcomes[outcome]
        if self._wanted is not None:
            figures[f"of {self._wanted:,} samples"] = self._samples
        if self._pool is not None:
            figures["workers"] = self._pool.size
        done, total = self._attempts.total(), self._extrapolation.total()
        self._report(done, total, found=self._reused_attempts, **figures)

    def needs(self, header: ShardHeader) -> bool:
        """Return whether a unit's object has too few grasps in the units before the first gap."""
        return self._max_grasps is None or self._grasps[header.object_name] < self._max_grasps

    def _close_gap(self, header: ShardHeader, grasps: int) -> None:
        name = header.object_name
        beyond = self._beyond.setdefault(name, {})
        beyond[header.start] = (header.stop, grasps)
        while (unit := beyond.pop(self._gap[name], None)) is not None:
            self._gap[name], more = unit
            self._grasps[name] += more


class Target:
    """The work units for a requested number of samples, and the samples found so far.

    Attributes:
        units: Work units of each object in their order, by the name of the object.
        found: Number of samples of each completed unit.
    """

    def __init__(self, config: Config, units: Mapping[str, Sequence[ShardHeader]]) -> None:
        """Begin without any samples.

        Args:
            config: Configuration, whose `samples`, `samples_per_object` and `samples_patience`
                define the target.
            units: See the attributes.
        """
        self._config, self.units, self.found = config, units, dict[ShardHeader, int]()

    def plan(self) -> tuple[dict[str, int], dict[str, int], list[ShardHeader]]:
        """Return the result of the complete rounds and the missing units of the next round.

        Returns:
            The number of units and of samples of each object in the complete rounds, and the units
            of the next round that are not done; if there are none, no further round is needed.
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
        """Yield the missing units of the next round, and then, while some of them run, later units.

        A unit that the target turns out not to need costs time, but does not change the result.
        """
        taken, _, missing = self.plan()
        yield from missing

        # Yield the next unit of each object whose unit of this round is done and that still takes
        # part.
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
        """Return lines that state which part of the target was not reached; empty if none."""
        taken, counts, _ = self.plan()
        total, lines = sum(counts.values()), list[str]()
        wanted, per_object = self._config.samples, self._config.samples_per_object
        patience = self._config.samples_patience
        if wanted is not None and total >= wanted:
            return lines
        if wanted is not None and per_object is None:
            lines.append(f"{total:,} of {wanted:,} samples were found")

        # Each object ended at its last palm pose, or after many palm poses without a sample.
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
        """Return the objects that take part in the next round.

        Args:
            taken: Number of units of each object in the rounds so far.
            counts: Number of samples of each object in these units.
        """
        left = [
            name
            for name, units in self.units.items()
            if taken[name] < len(units)
            and self._in_vain(units[: taken[name]]) < self._config.samples_patience
        ]
        level = self._level([counts[name] for name in left], sum(counts.values()))
        return [name for name in left if level is None or counts[name] < level]

    def _in_vain(self, units: Sequence[ShardHeader]) -> int:
        """Return the number of palm poses tried after the last unit with a sample."""
        last = takewhile(lambda unit: not self.found.get(unit, 0), reversed(units))
        return sum(unit.stop - unit.start for unit in last)

    def _level(self, counts: Sequence[int], total: int) -> int | None:
        """Return the number of samples below which an object takes part; None: any number."""
        level, wanted = self._config.samples_per_object, self._config.samples
        if wanted is None:
            return level
        if total >= wanted:
            return 0
        # Fill up the objects with the fewest samples first.
        rest, ordered = wanted - total, sorted(counts)
        for k, count in enumerate(ordered, start=1):
            above = ordered[k] if k < len(ordered) else None
            room = None if above is None else k * (above - count)
            if room is None or room >= rest:
                share = count + -(-rest // k)
                return share if level is None else min(share, level)
            rest -= room
        return level


def refuse_two_ends(config: Config) -> None:
    """Reject a configuration that limits both the number of grasps and the number of samples.

    Raises:
        ConfigError: If both are stated.
    """
    if config.max_grasps is not None and config.has_target:
        raise ConfigError("max_grasps must be null with samples or samples_per_object, got both")
