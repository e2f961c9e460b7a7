"""Simulate the lifts of a dataset again with other settings, and compare the verdicts.

    python pipelines/measurements/lifts_again.py OUT --set physics.coarse_steps=1 --every 4

Prints JSON: how many lifts end with the same outcome, how many are held and stable then and now,
and by how much closing joints opened between the end of closing and the end of the lift. A joint
that opened is tried once more with a drive of unlimited strength: if it stays closed there, the
load was beyond the drive's strength. Trials with such joints are listed, with both angles.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.generation.attempts import find_attempt
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.progress import Report, progress_bar
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.simulation.verdict import is_stable

#: A closing joint that opens by more than this has opened [rad].
OPENED = np.deg2rad(0.1)
#: No load opens a drive of this strength [N m].
UNLIMITED = 1e6


def opening(hand: Hand, record: TrialRecord) -> float:
    """Return by how much the closing joint opened that opened most, after closing [rad]."""
    if record.lift is None or record.closed is None:
        return 0.0
    joints = [hand.joint_names.index(finger.closing_joint) for finger in hand.fingers]
    return float((record.closed.q - record.lift.q)[joints].max())


def lift_again(
    dataset: Path, rows: npt.NDArray[np.int64], other: Config, report: Report
) -> Iterator[tuple[TrialRecord, float, float]]:
    """Yield, lift by lift, the record and how far a joint opened, also with a strong drive [rad].

    Args:
        dataset: Directory of the dataset.
        rows: Rows of `/trials` in `trials.hdf5`, in order.
        other: The configuration of the simulations.
        report: Is told the progress.
    """
    # The dataset's own configuration made the attempts, friction and mass are those asked for.
    # One hand has a drive that nothing opens.
    config = read_manifest(dataset).config
    asked = {"physics": other.physics, "randomize": other.randomize}
    rules = config.model_copy(update=asked)
    hand = load_hand(other.hand_source)
    fingers = tuple(replace(finger, holding_torque=UNLIMITED) for finger in hand.fingers)
    strong = replace(hand, fingers=fingers)
    with h5py.File(dataset / TRIALS_FILE) as file:
        keys = ("object", "candidate", "standoff_index", "child")
        place = {key: file["trials"][key][()][rows] for key in keys}
        names = file["objects/name"].asstr()[()]

    for index in np.unique(place["object"]):
        # The scenes of one object.
        prepared = load_prepared(dataset, names[index], config)
        scene, unlimited = (
            build_scene(prepared.model, other.physics, each) for each in (hand, strong)
        )

        # Its lifts again.
        for i in np.flatnonzero(place["object"] == index):
            candidate, standoff, child = (int(place[key][i]) for key in keys[1:])
            attempt = find_attempt(prepared, candidate, standoff, child, rules)
            X_TO = prepared.resting_poses[attempt.resting]
            record = run_attempt(scene, X_TO, attempt, other)
            angle = strong_angle = opening(hand, record)
            if angle > OPENED:
                again = run_attempt(unlimited, X_TO, attempt, other)
                strong_angle = opening(hand, again)
            report(int(i) + 1, len(rows))
            yield record, angle, strong_angle


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="directory of a dataset")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    parser.add_argument("--every", type=int, default=1, help="each n-th lift (default: 1)")
    arguments = parser.parse_args(argv)

    # Each n-th of the attempts that were lifted; what they were then.
    with h5py.File(arguments.dataset / TRIALS_FILE) as file:
        trials = file["trials"]
        rows = np.flatnonzero(np.isfinite(trials["slip"][()]))[:: arguments.every]
        outcomes, links, slip, turn = (
            trials[key][()][rows] for key in ("outcome", "lifted_other_links", "slip", "turn")
        )
    stable = is_stable(outcomes, links, slip, turn)

    # Simulate them again.
    everything = ["lift.least_chance=0", *arguments.settings]
    other = override_config(read_manifest(arguments.dataset).config, everything)
    with progress_bar("Lifts", "lift") as report:
        again = list(lift_again(arguments.dataset, rows, other, report))

    # What they are now. A lift that has no measurements is not stable.
    now = np.array([record.outcome for record, *_ in again])
    stable_now = [
        record.lift is not None
        and bool(
            is_stable(
                record.outcome, record.lift.contacts.other_links, record.lift.slip, record.lift.turn
            )
        )
        for record, *_ in again
    ]
    changed = Counter(
        f"{Outcome(then).label} -> {record.outcome.label}"
        for then, (record, *_) in zip(outcomes, again, strict=True)
        if then != record.outcome
    )
    opened = np.array([angles for _, *angles in again])
    held, held_now = outcomes == Outcome.SUCCESS, now == Outcome.SUCCESS
    result = {
        "settings": arguments.settings,
        "lifts": len(rows),
        "alike": float(np.mean(outcomes == now)),
        "changed": dict(changed),
        "held": [int(held.sum()), int(held_now.sum()), int((held & held_now).sum())],
        "stable": [int(stable.sum()), int(np.sum(stable_now)), int((stable & stable_now).sum())],
        "opening_deg": {
            name: round(float(np.rad2deg(np.quantile(opened[:, 0], q))), 4)
            for name, q in (("median", 0.5), ("99 %", 0.99), ("largest", 1.0))
        },
        "opened": int(np.sum(opened[:, 0] > OPENED)),
        "opened_trials": {
            int(row): [
                Outcome(then).label,
                *(round(float(each), 3) for each in np.rad2deg([angle, strong_angle])),
            ]
            for row, then, (angle, strong_angle) in zip(rows, outcomes, opened, strict=True)
            if angle > OPENED
        },
        "opened_with_a_strong_drive": int(np.sum(opened[:, 1] > OPENED)),
        "opening_with_a_strong_drive_deg": float(np.rad2deg(opened[:, 1].max())),
    }
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
