"""The order of the rules for trials.hdf5.

In: an open trials.hdf5 and, if there is one, the dataset around it. Out: its violations, in the
findings of the context.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from functools import partial

import numpy as np

from drakegrasp.dataset.checks import chances as chance_rules
from drakegrasp.dataset.checks import conditions as condition_rules
from drakegrasp.dataset.checks import consistency
from drakegrasp.dataset.checks import trials as trial_rules
from drakegrasp.dataset.checks.context import Context, Dataset, Rows, RowsTask, judge_rows
from drakegrasp.dataset.checks.findings import AnyArray, Findings
from drakegrasp.dataset.checks.open_file import OpenFile, Rule
from drakegrasp.dataset.layout.attributes import ORIGIN, attribute_mistakes
from drakegrasp.errors import HandError
from drakegrasp.hand.files import hand_digest
from drakegrasp.hand.lift_chance import read_lift_chance
from drakegrasp.outcomes import Outcome

#: Trials in a batch: some 10 MB.
TRIAL_ROWS = 8192
#: Trials in a task.
TASK_ROWS = 2 * TRIAL_ROWS


def check_trials_file(trials: OpenFile, context: Context) -> None:
    """Apply every rule to the objects, trials and successes of a file.

    Args:
        trials: The file.
        context: Takes the violations. Its manifest, if it has one, says which objects and
            candidates there are.
    """
    dataset = context.dataset
    if dataset is not None:
        context.add(trials, consistency.same_objects(trials, dataset.manifest))
    if not {"objects", "trials"} <= set(trials.groups):
        return  # a broken layout, which is a finding already; trials need their objects

    # The rows, and then the columns of the successes.
    expected = judge_rows(_tasks(trials, dataset), trials, context)
    if "successes" in trials.groups:
        context.add(trials, consistency.successes(trials, expected))


def _tasks(trials: OpenFile, dataset: Dataset | None) -> Iterator[RowsTask]:
    count, place = trials.count("trials"), trials.place({})
    for start in range(0, count, TASK_ROWS):
        yield RowsTask(
            judge=_judge_trials,
            file=place,
            group="trials",
            start=start,
            stop=min(start + TASK_ROWS, count),
            out=None if dataset is None else dataset.out,
            manifest=None if dataset is None else dataset.manifest,
        )


def _judge_trials(rows: Rows, findings: Findings) -> AnyArray:
    """Apply every rule to rows of /trials; return the ids of the successes among them."""
    trials, dataset = rows.file, rows.dataset

    # The rules whose limits depend on the dataset.
    objects = dataset.manifest.objects if dataset else None
    standoffs = trials.config.candidates.standoffs if trials.config else None
    numbers = partial(
        trial_rules.numbers,
        objects=trials.count("objects"),
        candidates=None if objects is None else [entry.candidates for entry in objects],
        standoffs=None if standoffs is None else len(standoffs),
    )
    wrong = {mistake.key for mistake in attribute_mistakes(trials.file, ORIGIN)}
    named = "fingers" not in wrong and "fingers" in trials.file.attrs
    fingers = json.loads(trials.file.attrs["fingers"]) if named else {}
    last: list[Rule] = [
        partial(
            trial_rules.verdicts,
            required=list(fingers.values()) or [True],
            rules=trials.config.lift if trials.config else None,
        ),
        trial_rules.words,
        trial_rules.contacts,
        trial_rules.poses,
    ]
    sound: list[Rule] = [trial_rules.motion]
    if objects is not None and trials.count("objects") == len(objects):
        poses = [[pose.X_TO for pose in entry.resting] for entry in objects]
        last.append(partial(trial_rules.resting_poses, X_TO=poses))
    if dataset is not None and trials.count("objects") == len(dataset.names):
        last.append(
            partial(
                condition_rules.as_drawn,
                names=dataset.names,
                model=rows.model,
                config=dataset.manifest.config_of,
            )
        )
        # Other files of the hand may have other weights.
        hand = dataset.manifest.config.hand
        with suppress(HandError):
            if hand_digest(hand) == dataset.manifest.versions.get("hand"):
                sound.append(
                    partial(
                        chance_rules.as_computed,
                        required=list(fingers.values()) or [True],
                        names=dataset.names,
                        model=rows.model,
                        chance=read_lift_chance(hand),
                    )
                )

    # Numbers, then stages, which need a legal outcome, then what needs finite values, then what
    # needs sound poses and contacts.
    successes = [np.zeros(0, dtype=np.int64)]
    for whole in trials.batches("trials", rows.start, rows.stop, TRIAL_ROWS, findings):
        successes.append(whole["trial_id"][whole["outcome"] == Outcome.SUCCESS])
        children = trials.config.refine.children if trials.config else None
        batch = trials.judge(
            whole, findings, numbers, partial(trial_rules.lineage, children=children)
        )
        batch = trials.judge(batch, findings, trial_rules.stages)
        batch = trials.judge(batch, findings, *last)
        trials.judge(batch, findings, *sound)
    return np.concatenate(successes)
