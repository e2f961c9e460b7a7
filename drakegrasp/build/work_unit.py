"""Work units: a range of one object's candidates, tried one after the other, to one shard.

A work unit is plain data, so it can cross a process border. What a shard holds depends on its
header and the configuration alone: not on who runs it, nor on what ran before, nor on how
often its process died on the way (see `drakegrasp.runtime.journal`).
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.build.attempts import Workbench, predict_all, try_on, workbench
from drakegrasp.build.columns import array_sizes, look_values, trial_rows
from drakegrasp.config import Config, parse_config
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.prepared_objects import PreparedObject
from drakegrasp.dataset.schema import LOOK_FIELDS
from drakegrasp.dataset.shards import Shard, ShardHeader, read_outcomes, write_shard
from drakegrasp.errors import DataError, MachineError
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.blas import one_thread
from drakegrasp.runtime.environment import trim_memory
from drakegrasp.runtime.fault_injection import inject_fault
from drakegrasp.runtime.files import disk_full_named
from drakegrasp.runtime.journal import (
    ATTEMPT,
    GIVE_UP_DEATHS,
    NO_JOURNAL,
    Journal,
    Verdict,
    open_journal,
)
from drakegrasp.simulation.candidates import Attempt, make_attempts
from drakegrasp.simulation.robustness import UNKNOWN, Certificate, certify
from drakegrasp.simulation.screen import Prediction
from drakegrasp.simulation.trial import TrialRecord

#: An attempt that is that many times over its wall-clock limit will never look at the clock.
HANG_FACTOR = 1.5
#: Wall clock after which anything else that a unit does hangs [s].
STAGE_SECONDS = 600.0
#: What else a unit does, by the name of its step.
_STAGES = {"build": "building its scene", "look": "its images", "write": "writing its shard"}
#: How many attempts' time a certificate may take before it hangs.
CERTIFY_FACTOR = 2.0


@dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """What one task does: plain data.

    Attributes:
        out: Directory of the dataset, seen by every worker.
        header: Object and range of candidates.
        config: `Config.to_dict()`.
        expendable: Whether the process that runs it is started again when it dies. Then a
            crash or a hang costs the guilty attempt; else it is the caller's to see.
    """

    out: str
    header: ShardHeader
    config: dict[str, Any]
    expendable: bool = False


@dataclass(frozen=True, kw_only=True)
class UnitSummary:
    """What comes back from a unit; the data itself went into its shard.

    Attributes:
        header: Of the unit.
        outcomes: Number of attempts by outcome.
        seconds: Wall clock by stage (`build`, `try`, `look`, `certify` if there are repeats,
            `write`) [s]; for logs only.
        errors: Number of solver errors by their message.
    """

    header: ShardHeader
    outcomes: dict[Outcome, int]
    seconds: dict[str, float]
    errors: dict[str, int]


#: Two threads in one scene would give each other's results: only one unit runs at a time.
_one_unit = threading.Lock()


@one_thread
def run_unit(unit: WorkUnit) -> UnitSummary:
    """Try all attempts of a unit, look at the successes, and write the shard.

    Raises:
        DataError: If the object's files are damaged, or Drake cannot build its scene.
        BlankImageError: If OpenGL gives nothing.
        DiskFullError: If there is no room for the shard.
        MachineError: If something other than an attempt kills the process again and again.
    """
    out, header = Path(unit.out), unit.header
    with _one_unit, disk_full_named(out):
        outcomes = _outcomes_there(out, header)
        if outcomes is not None:  # its process died between the shard and the answer
            summary = UnitSummary(header=header, outcomes=outcomes, seconds={}, errors={})
        elif unit.expendable:
            with open_journal(header.journal_path(out), asdict(header)) as journal:
                summary = _run_unit(unit, journal)
        else:
            summary = _run_unit(unit, NO_JOURNAL)
        header.journal_path(out).unlink(missing_ok=True)
        trim_memory()
        return summary


def find_outcomes(out: Path, header: ShardHeader) -> dict[Outcome, int] | None:
    """Return the number of attempts by outcome of a unit that is done, or None if it is not.

    Raises:
        DataError: If its shard is there, but damaged or of something else.
    """
    path = header.path(out)
    return count_outcomes(read_outcomes(path, header)) if path.exists() else None


def _outcomes_there(out: Path, header: ShardHeader) -> dict[Outcome, int] | None:
    try:
        return find_outcomes(out, header)
    except DataError:
        return None


def _run_unit(unit: WorkUnit, journal: Journal) -> UnitSummary:
    config, out, header = parse_config(unit.config), Path(unit.out), unit.header
    _refuse_futile(journal, header)
    seconds: dict[str, float] = {}
    with _stage(journal, "build", header, seconds):
        bench = _workbench(out, header, config)
        attempts = unit_attempts(bench.prepared, header, config)
    with _timed(seconds, "try"):
        records = _try_all(bench, attempts, journal)
    with _timed(seconds, "look"):
        looks = look_at_successes(bench, records, journal)
    if config.certify.repeats:
        with _timed(seconds, "certify"):
            _certify_all(bench, attempts, looks, journal)
    with _stage(journal, "write", header, seconds):
        shard = Shard(header=header, trials=trial_rows(bench, attempts, records), looks=looks)
        write_shard(out, shard)
    return UnitSummary(
        header=header,
        outcomes=count_outcomes(shard.trials["outcome"]),
        seconds=seconds,
        errors=dict(Counter(record.message for record in records if record.message)),
    )


def _workbench(out: Path, header: ShardHeader, config: Config) -> Workbench:
    try:
        return workbench(out, header, config)
    # A failed assertion within Drake arrives as SystemExit, which would end the worker.
    except SystemExit as error:
        raise DataError(
            f"{header.object_name}: Drake must be able to build its scene, got: {error}"
        ) from None


def _try_all(bench: Workbench, attempts: Sequence[Attempt], journal: Journal) -> list[TrialRecord]:
    """Return the records of attempts in their order; those under suspicion run first."""
    steps = [f"{ATTEMPT} {row}" for row in range(len(attempts))]
    suspects = set(journal.suspects)
    order = sorted(range(len(attempts)), key=lambda row: steps[row] not in suspects)
    predictions = predict_all(bench, attempts)
    records = {
        row: _try_step(bench, attempts[row], journal, steps[row], predictions[row]) for row in order
    }
    return [records[row] for row in range(len(attempts))]


def _try_step(
    bench: Workbench,
    attempt: Attempt,
    journal: Journal,
    step: str,
    prediction: Prediction | None,
) -> TrialRecord:
    verdict = journal.verdict(step)
    if verdict is not None:
        outcome = Outcome.TIMEOUT if verdict is Verdict.HUNG else Outcome.CRASHED
        return TrialRecord(outcome=outcome, X_TO=bench.prepared.X_TO, X_OG=attempt.X_OG)
    with journal.step(step, HANG_FACTOR * bench.config.attempt_seconds):
        inject_fault(bench.prepared.model.name, attempt.candidate, attempt.standoff_index)
        return try_on(bench, attempt, prediction)


def _refuse_futile(journal: Journal, header: ShardHeader) -> None:
    if journal.is_futile:
        raise MachineError(
            f"{header.object_name}, palm poses {header.start} to {header.stop - 1}: the worker "
            f"must stay alive for one work unit, got {GIVE_UP_DEATHS} deaths in a row; is there "
            "enough memory? The same command goes on from here"
        )


def _refuse_guilty(journal: Journal, step: str, name: str) -> None:
    """Refuse a step that is no attempt and ended its process: that is not the grasp's fault."""
    verdict = journal.verdict(step)
    if verdict is not None:
        what = _STAGES[step.partition(" ")[0]]
        raise MachineError(
            f"{name}: {what} must not end the process, got one that {verdict.value}; see "
            "`drakegrasp doctor`. The same command tries again"
        )


@contextmanager
def _stage(
    journal: Journal, step: str, header: ShardHeader, seconds: dict[str, float]
) -> Iterator[None]:
    _refuse_guilty(journal, step, header.object_name)
    with _timed(seconds, step), journal.step(step, STAGE_SECONDS):
        yield


def unit_attempts(
    prepared: PreparedObject, header: ShardHeader, config: Config
) -> Sequence[Attempt]:
    """Return the attempts of a unit in the order of its rows."""
    return list(
        make_attempts(
            prepared.candidates,
            range(header.start, header.stop),
            config.candidates,
            name=prepared.model.name,
            seed=config.seed,
        )
    )


def count_outcomes(outcomes: AnyArray) -> dict[Outcome, int]:
    """Return the number of attempts by outcome, of a column of outcomes."""
    values, counts = np.unique(outcomes, return_counts=True)
    return {Outcome(int(v)): int(n) for v, n in zip(values, counts, strict=True)}


def look_at_successes(
    bench: Workbench, records: Sequence[TrialRecord], journal: Journal = NO_JOURNAL
) -> dict[str, AnyArray]:
    """Return the columns of `/looks`: both images of every success."""
    rows = [i for i, record in enumerate(records) if record.outcome is Outcome.SUCCESS]
    columns = {f.name: f.empty(len(rows), array_sizes(bench)) for f in LOOK_FIELDS}
    for k, row in enumerate(rows):
        step = f"look {row}"
        _refuse_guilty(journal, step, bench.prepared.model.name)
        columns["row"][k] = row
        with journal.step(step, STAGE_SECONDS):
            for name, value in look_values(bench, records[row]).items():
                columns[name][k] = value
    return columns


def _certify_all(
    bench: Workbench,
    attempts: Sequence[Attempt],
    looks: dict[str, AnyArray],
    journal: Journal,
) -> None:
    """Fill in how robust each success is."""
    for k, row in enumerate(looks["row"].tolist()):
        found = _certify_step(bench, attempts[row], journal, f"certify {row}")
        looks["certified_share"][k] = found.share
        looks["certified_friction"][k] = found.friction


def _certify_step(bench: Workbench, attempt: Attempt, journal: Journal, step: str) -> Certificate:
    if journal.verdict(step) is not None:  # it ended its process: the grasp itself held
        return UNKNOWN
    rules, config = bench.config.certify, bench.config
    trials = rules.repeats + rules.friction_steps + 1
    with journal.step(step, CERTIFY_FACTOR * trials * config.attempt_seconds):
        return certify(bench.prepared.model, bench.prepared.X_TO, attempt, config)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
