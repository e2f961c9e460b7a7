"""The order of the rules for trials.hdf5, and of the comparison with the shards.

In: trials.hdf5 and the data files of a dataset, or trials.hdf5 alone. Out: tasks; each judges a
range of the attempts. With the shards of the dataset it compares the attempts, and the samples
among them in the data files, before any other rule.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest

import numpy as np

from drakegrasp.dataset.assembly.decisions import pack_tasks, sample_texts
from drakegrasp.dataset.assembly.pack import TASK_ROWS, PackTask, read_rows
from drakegrasp.dataset.checks import attempts as attempt_rules
from drakegrasp.dataset.checks import trials as trial_rules
from drakegrasp.dataset.checks.assembled import Again, compare_samples, compare_trials
from drakegrasp.dataset.checks.attempts import Dataset
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.rows import CheckedFile, Rule
from drakegrasp.dataset.schema import CAMERAS, SPLITS
from drakegrasp.outcomes import Outcome, Removal

#: Trials in a batch: some 10 MB.
TRIAL_ROWS = 8192


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialsTask:
    """A range of attempts to judge.

    Attributes:
        files: The files, by camera; the trials under "", if they can be read.
        start, stop: Rows of /trials.
        dataset: The dataset around them, if there is one.
        again: Derives the rows again; None where they cannot be compared.
        compared: Cameras of the files that are compared; "" for the trials.
        firsts: Row of the first sample of the range in each split.
    """

    files: Mapping[str, CheckedFile]
    start: int
    stop: int
    dataset: Dataset | None = None
    again: PackTask | None = None
    compared: frozenset[str] = frozenset()
    firsts: Mapping[str, int]

    @property
    def size(self) -> int:
        """Number of rows."""
        return max(self.stop - self.start, 0)

    def judge(self, findings: Findings) -> None:
        """Apply every rule."""
        columns, samples = ({}, {}) if self.again is None else read_rows(self.again)
        if "" in self.files and self.size:
            trials = self.files[""]
            groups = _rules(trials, self.dataset)
            with trials.opened() as file:
                if "" in self.compared and columns:
                    batches = compare_trials(
                        file, trials, columns, self.start, findings, TRIAL_ROWS
                    )
                else:
                    rows = np.arange(self.start, self.stop)
                    batches = trials.batches(file, "trials", rows, TRIAL_ROWS, findings)
                for batch in batches:
                    for rules in groups:
                        batch = trials.judge(batch, findings, *rules)

        if self.dataset is None:
            return
        texts = sample_texts(self.dataset.manifest)
        for camera in (camera for camera in CAMERAS if camera in self.compared):
            for split, own in samples.items():
                if split in self.files[camera].counts:
                    first = self.firsts[split]
                    compare_samples(self.files[camera], camera, split, first, own, texts, findings)


def _rules(trials: CheckedFile, dataset: Dataset | None) -> list[list[Rule]]:
    """Return the rules for a file and the dataset around it, if there is one.

    Each group relies on those before it: the first is for any values, stages need a legal outcome,
    the third is for finite values of known objects, the last for sound poses and contacts.
    """
    # What is known of the objects and the hand.
    config, count = trials.config, trials.counts["objects"]
    objects = dataset.manifest.objects if dataset else None
    fingers = json.loads(trials.attributes.get("fingers", "{}"))
    required = list(fingers.values()) or [True]
    numbers = partial(
        trial_rules.numbers,
        objects=count,
        candidates=None if objects is None else [entry.candidates for entry in objects],
        standoffs=None if config is None else len(config.candidates.standoffs),
        children=None if config is None else config.refine.children,
    )

    # What follows from the dataset needs all of its objects.
    close, lift = (config.close, config.lift) if config else (None, None)
    finite: list[Rule] = [
        partial(trial_rules.verdicts, required=required, rules=lift, close=close),
        trial_rules.contacts,
        trial_rules.poses,
    ]
    sound: list[Rule] = [trial_rules.motion]
    if dataset is not None and count == len(dataset.manifest.objects):
        model, manifest = dataset.loader(), dataset.manifest
        finite += [
            partial(attempt_rules.resting_poses, manifest=manifest),
            partial(attempt_rules.conditions, manifest=manifest, model=model),
        ]
        sound.append(
            partial(attempt_rules.chances, required=required, manifest=manifest, model=model)
        )
    most = None if config is None else config.certify.repeats
    stages: list[Rule] = [
        partial(trial_rules.stages, close=close),
        partial(trial_rules.repeats, most=most),
    ]
    return [[numbers], stages, finite, sound]


def trials_tasks(
    files: Mapping[str, CheckedFile],
    dataset: Dataset | None = None,
    again: Again | None = None,
    compared: frozenset[str] = frozenset(),
) -> Iterator[TrialsTask]:
    """Yield the tasks that judge all attempts, and compare what follows from the shards.

    Args:
        files: As of a task.
        dataset: As of a task.
        again: The dataset assembled again, if its shards are sound.
        compared: As of a task.
    """
    # Trials need their objects: a broken layout is a finding already.
    trials = files.get("")
    sound = trials is not None and {"objects", "trials"} <= set(trials.counts)
    count = trials.counts["trials"] if trials is not None and sound else 0

    # What follows from the shards comes along, range by range.
    packs: Iterable[PackTask] = ()
    if again is not None and compared:
        certified = again.manifest.config.certified
        packs = pack_tasks(again.out, again.shards, again.decisions, certified=certified)
    firsts = dict.fromkeys(SPLITS, 0)
    for start, pack in zip_longest(range(0, count, TASK_ROWS), packs):
        first = pack.start if start is None else start
        yield TrialsTask(
            files={camera: file.for_task() for camera, file in files.items()},
            start=first,
            stop=min(first + TASK_ROWS, count),
            dataset=dataset,
            again=pack,
            compared=compared,
            firsts=dict(firsts),
        )
        for split, ids in {} if pack is None else pack.ids.items():
            firsts[split] += len(ids)


def successes(trials: CheckedFile) -> Iterator[Violation]:
    """Every success is in /successes, in order, with a legal reason of removal and certificate."""
    if not {"trials", "successes"} <= set(trials.counts):
        return
    with trials.opened() as file:
        outcome = file["trials/outcome"]
        blocks = range(0, len(outcome), TASK_ROWS)
        hits = [np.flatnonzero(outcome[a : a + TASK_ROWS] == Outcome.SUCCESS) + a for a in blocks]
        due = np.concatenate([np.zeros(0, dtype=np.int64), *hits])
        batch = trials.read(file, "successes", np.arange(trials.counts["successes"]))

    if not np.array_equal(batch["trial_id"], due):
        different = sorted(set(batch["trial_id"].tolist()) ^ set(due.tolist()))
        got = f"differences at trials {different[:5]}" if different else "another order"
        yield of_file(trials.name, "trial_id must list the successes of /trials", got, "/successes")
    bad = ~np.isin(batch["removal"], [r.value for r in Removal])
    yield from batch.broken(f"removal must be 0..{max(Removal)}", bad, batch["removal"])
    for name, largest in (("certified_share", 1.0), ("certified_friction", np.inf)):
        values = batch[name]
        bad = ~np.isnan(values) & ~((values >= 0.0) & (values <= largest))
        yield from batch.broken(f"{name} must be 0..{largest:g} or NaN", bad, values)
