"""What a build has done so far, in numbers.

In: the header and the outcomes of each work unit that is done, in any order. Out: counts, the
figures of the progress bar, and whether an object needs more grasps.
"""

from __future__ import annotations

from collections import Counter
from math import ceil

from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import NAMED
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import WorkerPool
from drakegrasp.runtime.progress import Report

#: Outcomes of attempts that the machine, or an error of the simulator, ended.
ENDED = (Outcome.CRASHED, Outcome.TIMEOUT)
#: Share of an object's attempts that may end so, and a number that always may. Of the millions of
#: attempts behind the benchmarks none did.
ENDED_SHARE, FEW_ENDED = 0.02, 10


class Counts:
    """Numbers of what is done; their memory does not grow with the number of work units.

    For `max_grasps` it keeps, by object, up to which candidate all units are done, the grasps of
    these units, and those of the units beyond the first gap, which are few: units in flight.

    Attributes:
        simulated: Work units that were run now.
        reused: Work units that were done before.
        damaged: Damaged shards.
        named: The first damaged shards.
        errors: Number of solver errors by message.
    """

    def __init__(self, manifest: Manifest, pool: WorkerPool | None, report: Report) -> None:
        """Begin to count.

        Args:
            manifest: Says how much there is to do.
            pool: Its size is shown, if there is one.
            report: Called with the figures.
        """
        self.simulated = self.reused = self.damaged = 0
        self.named: list[str] = []
        self.errors: Counter[str] = Counter()

        # Progress: attempts of the first round, all by outcome, and those that were there before.
        self._pool, self._report = pool, report
        standoffs = len(manifest.config.candidates.standoffs)
        self._total = standoffs * sum(entry.candidates for entry in manifest.objects)
        self._standoffs, self._done = standoffs, 0
        self._outcomes: Counter[Outcome] = Counter()
        self._reused_attempts = 0

        # What ends a build before all attempts are made: samples in all, and by object samples, or
        # grasps.
        config = manifest.config
        self._wanted, self._each = config.samples, config.samples_per_object or config.max_grasps
        self._found = Counter(dict.fromkeys((entry.name for entry in manifest.objects), 0))

        # By object: all attempts, and those that the machine ended and not the physics.
        self._attempts: Counter[str] = Counter()
        self._ended: Counter[str] = Counter()

        # For `max_grasps`, by object: grasps before the first gap, where it is, and those beyond.
        self._max_grasps = manifest.config.max_grasps
        self._grasps: Counter[str] = Counter()
        self._gap: Counter[str] = Counter()
        self._beyond: dict[str, dict[int, tuple[int, int]]] = {}

    def add_damaged(self, name: str) -> None:
        """Count a damaged shard."""
        self.damaged += 1
        if len(self.named) < NAMED:
            self.named.append(name)

    def add(
        self,
        header: ShardHeader,
        outcomes: dict[Outcome, int],
        *,
        reused: bool = False,
        samples: int | None = None,
    ) -> None:
        """Count the attempts of a unit that is done, now or before (`reused`), and its samples."""
        grasps = outcomes.get(Outcome.SUCCESS, 0)
        self._found[header.object_name] += grasps if samples is None else samples
        self._outcomes.update(outcomes)
        self._attempts[header.object_name] += sum(outcomes.values())
        self._ended[header.object_name] += sum(outcomes.get(outcome, 0) for outcome in ENDED)
        first_round = self._standoffs * (header.stop - header.start)
        self._done += first_round
        self._reused_attempts += reused * first_round
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
        """Report what is done, and by how many workers."""
        figures = {"grasps": self._outcomes[Outcome.SUCCESS]}
        for outcome in (Outcome.CRASHED, Outcome.TIMEOUT):
            if self._outcomes[outcome]:
                figures[outcome.label] = self._outcomes[outcome]
        if self._wanted is not None:
            figures[f"of {self._wanted:,} samples"] = self._found.total()
        if self._pool is not None:
            figures["workers"] = self._pool.size
        self._report(self._done, self._expected(), found=self._reused_attempts, **figures)

    def _expected(self) -> int:
        """Return how many attempts the build will make, if it goes on to find as much as it did.

        It makes all of them, or ends when it has found what is wanted.
        """
        ends = []
        if self._wanted is not None:
            ends.append((self._found.total(), self._wanted))
        if self._each is not None:
            enough = sum(min(found, self._each) for found in self._found.values())
            ends.append((enough, self._each * len(self._found)))
        made = [self._done * max(wanted / found, 1.0) for found, wanted in ends if found]
        return min(self._total, *map(ceil, made)) if made else self._total

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
