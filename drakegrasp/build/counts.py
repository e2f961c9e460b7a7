"""What a build has done so far, in numbers.

In: the header and the outcomes of each work unit that is done, in any order. Out: counts, what the
progress bar shows, and whether an object wants more grasps.
"""

from __future__ import annotations

from collections import Counter

from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import Crew
from drakegrasp.runtime.progress import Report

#: How many of many things are named in one line.
NAMED = 10


class Tally:
    """What is done, in numbers: nothing here grows with the number of work units.

    For `max_grasps` it knows, by object, how far its units are done without a gap, how many
    grasps these have, and the units beyond the gap, which are those in flight.
    """

    def __init__(self, manifest: Manifest, crew: Crew | None, report: Report) -> None:
        """Begin to count.

        Args:
            manifest: Says how much there is to do.
            crew: Its size is shown, if there is one.
            report: Called with the figures.
        """
        self.simulated = self.reused = self.damaged = 0
        self.named: list[str] = []
        self.errors: Counter[str] = Counter()
        self._crew, self._report = crew, report
        self._wanted, self._step = manifest.config.max_grasps, manifest.config.unit_candidates
        standoffs = len(manifest.config.candidates.standoffs)
        self._total = standoffs * sum(entry.candidates for entry in manifest.objects)
        self._outcomes: Counter[Outcome] = Counter()
        self._found = 0
        self._grasps: Counter[str] = Counter()
        self._gap: Counter[str] = Counter()
        self._beyond: dict[str, dict[int, int]] = {}

    def add_damaged(self, name: str) -> None:
        """Count a harmed shard; the first are named."""
        self.damaged += 1
        if len(self.named) < NAMED:
            self.named.append(name)

    def add(
        self, header: ShardHeader, outcomes: dict[Outcome, int], *, found: bool = False
    ) -> None:
        """Count a unit that is done, now or before."""
        self._outcomes.update(outcomes)
        self._found += found * sum(outcomes.values())
        if self._wanted is not None:
            self._close_gap(header, outcomes.get(Outcome.SUCCESS, 0))
        self.show()

    def show(self) -> None:
        """Report what is done, and by how many workers."""
        figures = {"grasps": self._outcomes[Outcome.SUCCESS]}
        for outcome in (Outcome.CRASHED, Outcome.TIMEOUT):
            if self._outcomes[outcome]:
                figures[outcome.label] = self._outcomes[outcome]
        if self._crew is not None:
            figures["workers"] = self._crew.size
        self._report(self._outcomes.total(), self._total, found=self._found, **figures)

    def wants(self, header: ShardHeader) -> bool:
        """Return whether a unit's object lacks grasps in the units before the first gap."""
        return self._wanted is None or self._grasps[header.object_name] < self._wanted

    def _close_gap(self, header: ShardHeader, grasps: int) -> None:
        name = header.object_name
        beyond = self._beyond.setdefault(name, {})
        beyond[header.start] = grasps
        while (found := beyond.pop(self._gap[name], None)) is not None:
            self._grasps[name] += found
            self._gap[name] += self._step
