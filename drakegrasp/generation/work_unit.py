"""Work units: each runs the attempts at a range of one object's candidates and writes a shard.

A work unit is plain data, so it can be sent to another process. The content of its shard depends
only on its header and the configuration. It does not depend on the process that runs the unit, on
earlier units, or on how often the process died (see `drakegrasp.runtime.journal`).
"""

from __future__ import annotations

import os
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from drakegrasp.config import Config, FilterConfig
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import object_files, shards_folder
from drakegrasp.dataset.schema import LOOK_FIELDS, ROBUST_FIELDS
from drakegrasp.dataset.shards import Shard, ShardHeader, write_shard
from drakegrasp.dataset.successes import UnitSummary, read_summary, summary_of
from drakegrasp.errors import DataError, MachineError
from drakegrasp.filters import Removal
from drakegrasp.generation.attempts import (
    TrialSetup,
    judge_sample,
    list_attempts,
    look_at,
    screen_attempts,
    trial_rows,
    trial_setup,
    try_attempt,
)
from drakegrasp.generation.directory import DatasetTask
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread, trim_memory
from drakegrasp.runtime.files import disk_full_named
from drakegrasp.runtime.journal import ATTEMPT, Journal, Verdict, inject_fault, open_journal
from drakegrasp.simulation.attempt import Attempt, is_drawn
from drakegrasp.simulation.scene_cache import repeat_disturbed
from drakegrasp.simulation.screen import Screening
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.table import AnyArray, Table

#: An attempt hangs if it takes this many times its limit of computing time; an attempt that does
#: not hang checks the limit itself.
HANG_FACTOR = 1.5
#: Computing time after which any other step of a unit is considered to hang [s].
STAGE_SECONDS = 600.0
#: Filters for the samples that are repeated: all default filters except those of images, which
#: repeats do not have, and of outliers, which need all grasps of an object.
REPEAT_FILTERS = FilterConfig(outlier_sigma=0.0)
#: Descriptions of the steps that are not attempts, for error messages.
_STEPS = {
    "build": "building its scene",
    "screen": "screening its attempts",
    "look": "rendering its images",
    "measure": "measuring its contacts",
    "write": "writing its shard",
}


@dataclass(frozen=True, kw_only=True)
class WorkUnit(DatasetTask):
    """The input of a task that runs attempts.

    Attributes:
        header: Object and range of candidates.
        restartable: Whether the process that runs the unit is restarted when it dies. If so, a
            crash or a hang ends only the attempt; if not, it propagates to the caller.
    """

    header: ShardHeader
    restartable: bool = False

    @property
    def inputs(self) -> tuple[Path, ...]:
        """The files of the object, and the journal if there is one."""
        name, journal = self.header.object_name, self.header.journal_path(self.out)
        return *object_files(self.out, name), journal

    @property
    def outputs(self) -> tuple[Path, ...]:
        """The shard and the journal."""
        return self.header.path(self.out), self.header.journal_path(self.out)


#: Only one unit runs at a time, because two threads in one scene would mix up their results.
_one_unit = threading.Lock()


@one_thread
def run_unit(unit: WorkUnit) -> UnitSummary:
    """Run all attempts of a unit, render its successes, repeat samples, and write its shard.

    A unit whose shard is complete is not run again.

    Raises:
        DataError: If the object's files are damaged, or Drake cannot build its scene.
        BlankImageError: If OpenGL renders blank images.
        DiskFullError: If there is no space for the shard.
        MachineError: If a step other than an attempt kills the process repeatedly.
    """
    out, header = unit.out, unit.header
    with _one_unit, disk_full_named(out):
        try:
            # A process may have died after writing the shard and before returning.
            summary = read_summary(out, header, unit.config)
        except DataError:
            summary = None
        path = header.journal_path(out)
        if summary is None:
            with open_journal(path, header.stored, restartable=unit.restartable) as journal:
                summary = _UnitRun(unit, journal).run()
        path.unlink(missing_ok=True)
        trim_memory()
        return summary


class _UnitRun:
    """The attempts of a unit, with the journal of its steps."""

    def __init__(self, unit: WorkUnit, journal: Journal) -> None:
        """Build the object's scene, or use that of the previous unit, and list the attempts.

        Raises:
            MachineError: If the process died repeatedly in this unit.
        """
        self._unit, self._config, self._journal = unit, unit.config, journal
        self._errors: Counter[str] = Counter()
        header = unit.header
        journal.validate_no_loop(
            f"{header.object_name}, palm poses {header.start} to {header.stop - 1}"
        )
        with self._step("build"):
            self._setup = self._build_setup()
            indices = range(header.start, header.stop)
            self._attempts = list_attempts(self._setup.prepared, indices, self._config)

    def run(self) -> UnitSummary:
        """Run the attempts, and write the shard, either completely or not at all."""
        header = self._unit.header
        records = self._try_all()
        with self._step("measure"):
            trials = trial_rows(self._setup, self._attempts, records)
        looks = self._looks(records)
        if self._config.robustness.repeats:
            trials |= self._repeats(records)

        with self._step("write"):
            shard = Shard(header=header, trials=trials, looks=looks)
            seal = write_shard(self._unit.out, shard)
        depth = looks["image_otm"][:, 3]
        return summary_of(shard, seal, self._setup.sizes, depth, self._config, self._errors)

    @contextmanager
    def _step(self, step: str) -> Iterator[None]:
        """Run a step that is not an attempt, so that a crash in it is not the fault of a grasp.

        Raises:
            MachineError: If an earlier process died in this step.
        """
        name, verdict = self._unit.header.object_name, self._journal.verdict(step)
        if verdict is not None:
            what = _STEPS[step.partition(" ")[0]]
            raise MachineError(
                f"{name}: {what} {verdict.value}; see `drakegrasp doctor`. "
                "The same command tries again"
            )
        with self._journal.step(step, STAGE_SECONDS):
            yield

    def _build_setup(self) -> TrialSetup:
        header = self._unit.header
        try:
            return trial_setup(self._unit.out, header, self._config)
        # A failed assertion within Drake arrives as SystemExit, which would end the worker.
        except SystemExit as error:
            name = header.object_name
            raise DataError(f"{name}: Drake cannot build its scene: {error}") from None

    def _try_all(self) -> list[TrialRecord]:
        """Return the records of the attempts; attempts that geometry decides are not simulated.

        Attempts in which an earlier process died, and that have no verdict yet, run first, so that
        an attempt that crashes is found at once.
        """
        attempts = self._attempts
        # The first call computes the object's distance field.
        with self._step("screen"):
            inject_fault(self._unit.header.object_name, "screen")
            screenings = screen_attempts(self._setup, attempts)
        steps = [f"{ATTEMPT} {row}" for row in range(len(attempts))]
        unresolved = set(self._journal.unresolved)
        records = dict[int, TrialRecord]()
        for row in sorted(range(len(steps)), key=lambda row: steps[row] not in unresolved):
            records[row] = self._try(attempts[row], screenings[row], steps[row])
        ordered = [records[row] for row in range(len(attempts))]
        self._errors.update(record.message for record in ordered if record.message)
        return ordered

    def _try(self, attempt: Attempt, screening: Screening | None, step: str) -> TrialRecord:
        verdict = self._journal.verdict(step)
        if verdict is not None:
            outcome = Outcome.TIMEOUT if verdict is Verdict.HUNG else Outcome.CRASHED
            X_TO = self._setup.prepared.resting_poses[attempt.resting]
            return TrialRecord(outcome=outcome, X_TO=X_TO, X_OG=attempt.X_OG)
        with self._journal.step(step, HANG_FACTOR * self._config.attempt_seconds):
            name = self._unit.header.object_name
            inject_fault(name, attempt.candidate, attempt.standoff_index)
            return try_attempt(self._setup, attempt, screening)

    def _looks(self, records: Sequence[TrialRecord]) -> Table:
        """Return the rows of `/looks`, with the images of both cameras of every success."""
        rows = [i for i, record in enumerate(records) if record.outcome is Outcome.SUCCESS]
        looks = {f.name: f.empty(len(rows), self._setup.sizes) for f in LOOK_FIELDS}
        for k, row in enumerate(rows):
            looks["row"][k] = row
            with self._step(f"look {row}"):
                look = look_at(self._setup, self._attempts[row], records[row].X_TO)
            for name, value in look.items():
                looks[name][k] = value
        return Table(looks)

    def _repeats(self, records: Sequence[TrialRecord]) -> dict[str, AnyArray]:
        """Repeat the samples that are drawn for it; return the columns of ROBUST_FIELDS."""
        columns = {f.name: f.empty(len(records), {}) for f in ROBUST_FIELDS}
        for row, record in enumerate(records):
            drawn = is_drawn(self._attempts[row], self._config.robustness.share)
            if drawn and self._passes_filters(record):
                repeats = self._repeat(row)
                columns["robust_tried"][row] = len(repeats)
                columns["robust_kept"][row] = sum(map(self._passes_filters, repeats))
        # After an inconclusive repeat no scene is cached, so build it again.
        self._setup.renew_scene()
        return columns

    def _repeat(self, row: int) -> list[TrialRecord]:
        """Return the disturbed repeats of an attempt; none if a process died in this step."""
        step, config, prepared = f"repeat {row}", self._config, self._setup.prepared
        attempt = self._attempts[row]
        if self._journal.verdict(step) is not None:
            return []
        limit = HANG_FACTOR * config.robustness.repeats * config.attempt_seconds
        with self._journal.step(step, limit):
            X_TO = prepared.resting_poses[attempt.resting]
            return repeat_disturbed(prepared.model, X_TO, attempt, config)

    def _passes_filters(self, trial: TrialRecord) -> bool:
        """Return whether a trial is a sample by the default filters."""
        rules = self._config.model_copy(update={"filters": REPEAT_FILTERS})
        return judge_sample(self._setup.prepared.model, trial, rules, views=False) is Removal.KEPT


# Units that are done


def find_tasks(out: Path, manifest: Manifest) -> Iterator[tuple[ShardHeader, ...]]:
    """Yield the work units of each object that may have a shard, for `find_units`."""
    try:
        folders = set(os.listdir(out / "shards"))
    except FileNotFoundError:
        return
    for headers in filter(None, manifest.headers_by_object()):
        if shards_folder(out, headers[0].object_name).name in folders:
            yield headers


def find_units(
    out: Path, config: Config, headers: Sequence[ShardHeader]
) -> tuple[list[UnitSummary], list[str]]:
    """Find an object's completed units in a dataset.

    The folder is listed once, and the seals of its shards are verified. A build that continues runs
    this in all its workers.

    Returns:
        The summaries of the work units with a valid shard, and the paths of damaged shards within
        the dataset.
    """
    done, damaged = list[UnitSummary](), list[str]()
    names = set(os.listdir(shards_folder(out, headers[0].object_name)))
    for header in [each for each in headers if each.file_name in names]:
        try:
            done.append(read_summary(out, header, config))
        except DataError:
            damaged.append(str(header.path(out).relative_to(out)))
            continue

        # A process may have died after writing the shard and before removing the journal.
        if header.journal_path(out).name in names:
            header.journal_path(out).unlink(missing_ok=True)
    return done, damaged
