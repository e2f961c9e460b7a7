"""Counts the progress of a build.

Input: the header and the outcomes of each completed work unit, in any order. Output: counts, the
figures of the progress bar, and warnings.
"""

from __future__ import annotations

from collections import Counter

from drakegrasp.dataset.manifest import Manifest
from drakegrasp.generation.target import Target
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

    Attributes:
        simulated: Work units that were run now.
        reused: Work units that were done before.
        damaged: Damaged shards.
        errors: Number of solver errors by message.
    """

    def __init__(
        self, manifest: Manifest, target: Target | None, pool: WorkerPool | None, report: Report
    ) -> None:
        """Begin to count.

        Args:
            manifest: Manifest of the dataset, which states the number of palm poses.
            target: Target of the build, which states the number of samples; None without one.
            pool: Workers, whose number is shown; None: it is not shown.
            report: Called with the number of samples of a target, else of palm poses, that are done
                and that are due.
        """
        self.simulated = self.reused = 0
        self.damaged: list[str] = []
        self.errors: Counter[str] = Counter()
        self._pool, self._report, self._target = pool, report, target
        self._palms = sum(entry.candidates for entry in manifest.objects)
        self._outcomes: Counter[Outcome] = Counter()
        self._done = 0

        # For each object: all attempts, and those that ended because of the machine.
        self._attempts: Counter[str] = Counter()
        self._ended: Counter[str] = Counter()

    def add(self, summary: UnitSummary, *, reused: bool = False) -> None:
        """Count a completed unit; if `reused`, an earlier build completed it."""
        header, outcomes = summary.header, summary.outcomes
        self.reused += reused
        self.simulated += not reused
        self.errors.update(summary.errors)
        self._outcomes.update(outcomes)
        self._done += header.stop - header.start
        self._attempts[header.object_name] += sum(outcomes.values())
        self._ended[header.object_name] += sum(outcomes.get(outcome, 0) for outcome in ENDED)
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
        """Report what is done, and the number of workers."""
        figures = {"attempts": self._attempts.total(), "grasps": self._outcomes[Outcome.SUCCESS]}
        for outcome in ENDED:
            if self._outcomes[outcome]:
                figures[outcome.label] = self._outcomes[outcome]
        if self._pool is not None:
            figures["workers"] = self._pool.size
        done, total = self._progress()
        self._report(done, total, **figures)

    def _progress(self) -> tuple[int, int | None]:
        """Return how much is done, and how much is due; None until each object has been tried."""
        if self._target is None:
            return self._done, self._palms
        return self._target.found, self._target.wanted if self._target.has_begun else None
