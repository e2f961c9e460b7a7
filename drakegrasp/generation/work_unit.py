"""Work units: one object's attempts at a range of its candidates, from trials to a shard.

Palm poses about those of grasps that hold are tried in the unit of these grasps: no unit waits for
another.

A work unit is plain data, so it can be sent to another process. Its header and the configuration
alone decide what its shard holds: not who runs it, nor what ran before, nor how often its process
died (see `drakegrasp.runtime.journal`).
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drakegrasp.config import Config, FilterConfig
from drakegrasp.dataset.assembly.survey import count_samples, successes_of
from drakegrasp.dataset.filtering import judge_successes
from drakegrasp.dataset.schema import HOLD_FIELDS
from drakegrasp.dataset.shards import Shard, ShardHeader, read_trials, write_shard
from drakegrasp.errors import DataError, MachineError
from drakegrasp.filters import Removal
from drakegrasp.generation.attempts import (
    TrialSetup,
    lift_scraped,
    list_attempts,
    list_children,
    measure_contacts,
    predict_attempts,
    render_views,
    trial_setup,
    try_attempt,
)
from drakegrasp.generation.columns import empty_looks, fill_look, judge_sample, trial_rows
from drakegrasp.generation.counts import has_target
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread, timed, trim_memory
from drakegrasp.runtime.files import disk_full_named
from drakegrasp.runtime.journal import (
    ATTEMPT,
    GIVE_UP_DEATHS,
    NO_JOURNAL,
    Journal,
    Verdict,
    inject_fault,
    open_journal,
)
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.robustness import Certificate, certify, is_drawn
from drakegrasp.simulation.scene_cache import cached_scene
from drakegrasp.simulation.screen import Prediction
from drakegrasp.simulation.trial import TrialRecord, has_only_scraped
from drakegrasp.table import AnyArray, Table

#: An attempt that takes this many times its limit of computing time hangs: it never looks at it.
HANG_FACTOR = 1.5
#: Computing time after which any other step of a unit hangs [s].
STAGE_SECONDS = 600.0
#: A certificate hangs when it takes this many times the limit of all its simulations.
CERTIFY_FACTOR = 2.0
#: What a parent of refined palm poses and a sample that is repeated pass: all default filters but
#: that of outliers, which looks at all grasps of an object.
PARENT_FILTERS = FilterConfig(outlier_sigma=0.0)
#: What each step of a unit that is no attempt does, for error messages.
_STEPS = {
    "build": "building its scene",
    "predict": "predicting its attempts",
    "look": "rendering its images",
    "measure": "measuring its contacts",
    "write": "writing its shard",
}


@dataclass(frozen=True, kw_only=True)
class WorkUnit:
    """What one task does: plain data.

    Attributes:
        out: Directory of the dataset, visible to every worker.
        header: Object and range of candidates.
        config: All the rules.
        refined: Whether palm poses about those of samples are tried, if the configuration has any.
        likely_tested: Whether its samples may test or validate, see `certify.share_tested`.
        restartable: Whether the process that runs it is started again when it dies. If so, a
            crash or a hang costs only the attempt; if not, it propagates to the caller.
    """

    out: Path
    header: ShardHeader
    config: Config
    refined: bool = True
    likely_tested: bool = False
    restartable: bool = False


@dataclass(frozen=True, kw_only=True)
class UnitSummary:
    """What a unit returns; its data are in its shard.

    Attributes:
        header: Of the unit.
        outcomes: Number of attempts by outcome.
        seconds: Wall clock by stage (`build`, `try`, `measure`, `look`, `certify` if there are
            repeats, `write`) [s]; for logs only. Empty if the shard was there already.
        errors: Number of solver errors by their message.
        samples: Number of samples, see `count_samples`; None if there is no target of them.
    """

    header: ShardHeader
    outcomes: dict[Outcome, int]
    seconds: dict[str, float]
    errors: dict[str, int]
    samples: int | None = None


#: Two threads in one scene would mix up their results: only one unit runs at a time.
_one_unit = threading.Lock()


@one_thread
def run_unit(unit: WorkUnit) -> UnitSummary:
    """Run all attempts of a unit, render its successes, certify lifts, and write its shard.

    A unit whose shard is complete is not run again.

    Raises:
        DataError: If the object's files are damaged, or Drake cannot build its scene.
        BlankImageError: If OpenGL renders blank images.
        DiskFullError: If there is no room for the shard.
        MachineError: If something other than an attempt kills the process again and again.
    """
    out, header = unit.out, unit.header
    with _one_unit, disk_full_named(out):
        outcomes = _outcomes_there(out, header)
        if outcomes is not None:
            # A process died after it wrote the shard and before it answered.
            summary = UnitSummary(header=header, outcomes=outcomes, seconds={}, errors={})
        elif unit.restartable:
            with open_journal(header.journal_path(out), header.stored) as journal:
                summary = _run_experiment(unit, journal)
        else:
            summary = _run_experiment(unit, NO_JOURNAL)
        header.journal_path(out).unlink(missing_ok=True)
        trim_memory()
        if not has_target(unit.config):
            return summary
        return replace(summary, samples=count_samples(out, header, unit.config))


def _run_experiment(unit: WorkUnit, journal: Journal) -> UnitSummary:
    """Tell the whole experiment: set up, run round after round, write."""
    config, out, header = unit.config, unit.out, unit.header
    seconds: dict[str, float] = {}
    _refuse_crash_loop(journal, header)

    # Build the object's scene, or take the one of the unit before, and list the attempts.
    with _stage(journal, "build", header.object_name, seconds):
        setup = _build_setup(out, header, config)
        attempts = list_attempts(setup.prepared, range(header.start, header.stop), config)

    # Run the attempts, then those about the samples among them, and so on.
    rounds = list[_Round]()
    refines = unit.refined and config.refine.children > 0
    while attempts:
        first = sum(len(done.attempts) for done in rounds)
        has_children = refines and len(rounds) < config.refine.generations
        done = _run_round(setup, attempts, first, journal, seconds, has_children=has_children)
        rounds.append(done)
        if config.certified:
            with timed(seconds, "certify"):
                _certify_lifts(setup, done, first, journal, likely_tested=unit.likely_tested)
        attempts = []
        if has_children:
            with timed(seconds, "try"):
                attempts = _children(setup, done)

    # Write the shard: all of it or nothing.
    with _stage(journal, "write", header.object_name, seconds):
        trials = _joined([done.trials for done in rounds])
        looks = _joined([done.looks for done in rounds])
        write_shard(out, Shard(header=header, trials=trials, looks=looks))

    messages = [record.message for done in rounds for record in done.records if record.message]
    return UnitSummary(
        header=header,
        outcomes=count_outcomes(trials["outcome"]),
        seconds=seconds,
        errors=dict(Counter(messages)),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Round:
    """Attempts of a unit, their records, and their columns of `/trials` and `/looks`.

    In the rows `scraping` are hands that would be samples if they had not scraped the table.
    """

    attempts: Sequence[Attempt]
    records: Sequence[TrialRecord]
    scraping: Sequence[int]
    trials: dict[str, AnyArray]
    looks: dict[str, AnyArray]


def _run_round(
    setup: TrialSetup,
    attempts: Sequence[Attempt],
    first: int,
    journal: Journal,
    seconds: dict[str, float],
    *,
    has_children: bool,
) -> _Round:
    """Try attempts, the first of which is in row `first` of the unit; measure, render."""
    # Try each attempt: what geometry already decides is not simulated.
    with timed(seconds, "try"):
        predictions = _predict_all(setup, attempts, journal)
        records, scraping = _try_all(
            setup, attempts, predictions, journal, first, has_children=has_children
        )

    # Measure how the contacts of each lift lie on the object's true surface.
    with _stage(journal, "measure", setup.prepared.model.name, seconds):
        fits = [measure_contacts(setup, record) for record in records]

    # Render both cameras' images of each success.
    with timed(seconds, "look"):
        looks = render_successes(setup, attempts, records, journal, first)

    trials = trial_rows(setup, attempts, records, fits)
    return _Round(attempts=attempts, records=records, scraping=scraping, trials=trials, looks=looks)


def _children(setup: TrialSetup, done: _Round) -> list[Attempt]:
    """Return attempts about each of a round that is a sample by the default filters.

    Or would be one if it did not scrape the table: most palm poses about such a one do not.
    """
    return [
        child
        for row in sorted({*_samples(setup, done), *done.scraping})
        for child in list_children(setup.prepared, done.attempts[row], setup.config)
    ]


def _samples(setup: TrialSetup, done: _Round) -> list[int]:
    """Return the rows of a round that are samples by the default filters."""
    rows = np.flatnonzero(done.trials["outcome"] == Outcome.SUCCESS)
    trials = {name: values[rows] for name, values in done.trials.items()}
    depths = done.looks["image_otm"][:, 3]
    found = Table({**trials, **done.looks}, depth_otm=depths)
    successes = successes_of(found, setup.config.camera)
    removal = judge_successes(successes, PARENT_FILTERS)
    return rows[removal == Removal.KEPT].tolist()


def _joined(parts: Sequence[dict[str, AnyArray]]) -> dict[str, AnyArray]:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def find_outcomes(out: Path, header: ShardHeader) -> dict[Outcome, int] | None:
    """Return the number of attempts by outcome of a unit that is done, or None if it is not.

    Raises:
        DataError: If its shard is damaged or of something else.
    """
    path = header.path(out)
    if not path.exists():
        return None
    return count_outcomes(read_trials(path, header, ("outcome",))["outcome"])


def count_outcomes(outcomes: AnyArray) -> dict[Outcome, int]:
    """Return the number of attempts by outcome, given a column of outcomes (n,)."""
    values, counts = np.unique(outcomes, return_counts=True)
    return {Outcome(int(v)): int(n) for v, n in zip(values, counts, strict=True)}


def render_successes(
    setup: TrialSetup,
    attempts: Sequence[Attempt],
    records: Sequence[TrialRecord],
    journal: Journal = NO_JOURNAL,
    first: int = 0,
) -> dict[str, AnyArray]:
    """Return the columns of `/looks`: both images of every success.

    The first attempt is in row `first` of the unit.

    Raises:
        BlankImageError: If OpenGL renders blank images.
        MachineError: If rendering ended the process before.
    """
    rows = [i for i, record in enumerate(records) if record.outcome is Outcome.SUCCESS]
    looks = empty_looks(setup, len(rows))
    for k, row in enumerate(rows):
        step = f"look {first + row}"
        _refuse_failing(journal, step, setup.prepared.model.name)
        looks["row"][k] = first + row
        with journal.step(step, STAGE_SECONDS):
            fill_look(looks, k, render_views(setup, attempts[row], records[row]))
    return looks


def _outcomes_there(out: Path, header: ShardHeader) -> dict[Outcome, int] | None:
    """Return the outcomes of a complete shard; None if it is missing or damaged."""
    try:
        return find_outcomes(out, header)
    except DataError:
        return None


def _build_setup(out: Path, header: ShardHeader, config: Config) -> TrialSetup:
    try:
        return trial_setup(out, header, config)
    # A failed assertion within Drake arrives as SystemExit, which would end the worker.
    except SystemExit as error:
        raise DataError(f"{header.object_name}: Drake cannot build its scene: {error}") from None


def _predict_all(
    setup: TrialSetup, attempts: Sequence[Attempt], journal: Journal
) -> list[Prediction | None]:
    """Return what geometry says of attempts; the first time it measures the object's distances.

    Raises:
        MachineError: If this ended the process before.
    """
    _refuse_failing(journal, "predict", setup.prepared.model.name)
    with journal.step("predict", STAGE_SECONDS):
        inject_fault(setup.prepared.model.name, "predict")
        return list(predict_attempts(setup, attempts))


def _try_all(
    setup: TrialSetup,
    attempts: Sequence[Attempt],
    predictions: Sequence[Prediction | None],
    journal: Journal,
    first: int,
    *,
    has_children: bool,
) -> tuple[list[TrialRecord], list[int]]:
    """Return the records of attempts in their order, and the rows of `_Round.scraping`.

    The first attempt is in row `first` of the unit. Attempts in which an earlier process died, and
    that are not yet judged, run first: then a failing one is found at once. Hands that scrape are
    lifted at once, while they are still closed, where a round has children.
    """
    steps = [f"{ATTEMPT} {first + row}" for row in range(len(attempts))]
    unresolved = set(journal.unresolved)
    order = sorted(range(len(attempts)), key=lambda row: steps[row] not in unresolved)
    records, scraping = dict[int, TrialRecord](), list[int]()
    for row in order:
        attempt = attempts[row]
        records[row] = _try_step(setup, attempt, predictions[row], journal, steps[row])
        if has_children and _only_scrapes(
            setup, attempt, records[row], journal, f"lift {first + row}"
        ):
            scraping.append(row)
    return [records[row] for row in range(len(attempts))], scraping


def _try_step(
    setup: TrialSetup,
    attempt: Attempt,
    prediction: Prediction | None,
    journal: Journal,
    step: str,
) -> TrialRecord:
    verdict = journal.verdict(step)
    if verdict is not None:
        outcome = Outcome.TIMEOUT if verdict is Verdict.HUNG else Outcome.CRASHED
        X_TO = setup.prepared.resting_poses[attempt.resting]
        return TrialRecord(outcome=outcome, X_TO=X_TO, X_OG=attempt.X_OG)
    with journal.step(step, HANG_FACTOR * setup.config.attempt_seconds):
        inject_fault(setup.prepared.model.name, attempt.candidate, attempt.standoff_index)
        return try_attempt(setup, attempt, prediction)


def _only_scrapes(
    setup: TrialSetup, attempt: Attempt, record: TrialRecord, journal: Journal, step: str
) -> bool:
    """Return whether a trial shows no sample only because the hand scraped the table.

    Whether it would be one is seen by lifting it. If that ended its process, it costs the children.
    """
    if not has_only_scraped(record) or journal.verdict(step) is not None:
        return False
    rules = setup.config.model_copy(update={"filters": PARENT_FILTERS})
    with journal.step(step, HANG_FACTOR * rules.attempt_seconds):
        lifted = lift_scraped(setup, attempt, record)
    return judge_sample(setup.prepared.model, lifted, rules) is Removal.KEPT


def _certify_lifts(
    setup: TrialSetup, done: _Round, first: int, journal: Journal, *, likely_tested: bool
) -> None:
    """Add to a round how much its lifts bear that are drawn for it.

    Args:
        setup: Of the unit.
        done: The round.
        first: Row of its first attempt in the unit.
        journal: Of the unit.
        likely_tested: Of the unit.
    """
    rules, trials, samples = setup.config.certify, done.trials, set(_samples(setup, done))
    of_samples = max(rules.share or 0.0, rules.share_tested if likely_tested else 0.0)
    trials |= {field.name: field.empty(len(done.attempts), {}) for field in HOLD_FIELDS}
    look_of = {row - first: k for k, row in enumerate(done.looks["row"].tolist())}
    for row in np.flatnonzero(np.isfinite(trials["time_lift"])).tolist():
        probability = of_samples if row in samples else rules.share_others
        if not is_drawn(done.attempts[row], probability):
            continue
        held = row in look_of
        step = f"certify {first + row}"
        found = _certify_step(setup, done.attempts[row], journal, step, held=held)
        trials["p_hold_probability"][row] = probability
        for name in ("repeats", "held", "samples", "half_step"):
            trials[f"p_hold_{name}"][row] = getattr(found, name)
        if held:
            done.looks["certified_friction"][look_of[row]] = found.friction
    # A scene in which Drake failed was forgotten.
    setup.scene = cached_scene(setup.prepared.model, setup.config.physics, setup.config.hand_source)


def _certify_step(
    setup: TrialSetup, attempt: Attempt, journal: Journal, step: str, *, held: bool
) -> Certificate:
    # A certificate that ended its process costs the certificate: the lift itself has its verdict.
    if journal.verdict(step) is not None:
        return Certificate()
    model, config = setup.prepared.model, setup.config
    rules = config.model_copy(update={"filters": PARENT_FILTERS})
    simulations = config.certify.repeats + config.certify.friction_steps + 1
    with journal.step(step, CERTIFY_FACTOR * simulations * config.attempt_seconds):
        return certify(
            model,
            setup.prepared.resting_poses[attempt.resting],
            attempt,
            config,
            lambda trial: judge_sample(model, trial, rules, views=False) is Removal.KEPT,
            held=held,
        )


@contextmanager
def _stage(journal: Journal, step: str, name: str, seconds: dict[str, float]) -> Iterator[None]:
    """Run and time a stage that is one step of the journal.

    Raises:
        MachineError: If the stage ended the process before.
    """
    _refuse_failing(journal, step, name)
    with timed(seconds, step), journal.step(step, STAGE_SECONDS):
        yield


def _refuse_crash_loop(journal: Journal, header: ShardHeader) -> None:
    if journal.in_crash_loop:
        raise MachineError(
            f"{header.object_name}, palm poses {header.start} to {header.stop - 1}: the worker "
            f"died {GIVE_UP_DEATHS} times in a row in this work unit; is there enough memory? "
            "The same command goes on from here"
        )


def _refuse_failing(journal: Journal, step: str, name: str) -> None:
    """Refuse a step that is no attempt and ended its process: that is not the grasp's fault."""
    verdict = journal.verdict(step)
    if verdict is not None:
        what = _STEPS[step.partition(" ")[0]]
        raise MachineError(
            f"{name}: {what} {verdict.value}; see `drakegrasp doctor`. The same command tries again"
        )
