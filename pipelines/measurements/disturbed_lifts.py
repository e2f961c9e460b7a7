"""Measure how much samples of a dataset bear: each is lifted again with something changed.

    python pipelines/measurements/disturbed_lifts.py lines.jsonl --dataset OUT --count 100
    python pipelines/measurements/disturbed_lifts.py lines.jsonl

Friction and mass are changed by their share, up and down; the palm by 3 mm in a random direction
and 3 degrees about a random axis; `together` changes all three, with random signs. Only `half step`
changes the time step. A lift counts as held, and as a sample by the dataset's filters but for those
of pictures, of outliers, and the user's own. The first call writes a line per sample, the second
prints the shares with their intervals, and how well numbers of the first lift tell the samples of
which half of the lifts `palm` and `together` or more are samples (area under the ROC curve).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.dataset.holding import (
    COLUMNS,
    MUCH,
    area_under_roc,
    predictors,
    wilson_interval,
)
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.generation.attempts import find_attempt
from drakegrasp.generation.columns import judge_sample
from drakegrasp.outcomes import Removal
from drakegrasp.seeding import Stream
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.conditions import usual_conditions
from drakegrasp.simulation.scene_cache import cached_scene
from drakegrasp.simulation.trial import run_attempt

#: Changes of friction and mass as shares, and of the palm.
FRICTION, MASS, SHIFT, TURN = 0.15, 0.20, 3e-3, np.deg2rad(3.0)
#: Lifts of each sample with the palm off, and with all changes.
PALMS, TOGETHER = 2, 4
#: Last number of the place of the streams that are drawn from.
PLACE = 25


def changes(stream: Stream) -> Iterator[tuple[str, float, float, bool]]:
    """Yield the name of each change, the factors of friction and mass, whether the palm is off."""
    yield "as stored", 1.0, 1.0, False
    yield "half step", 1.0, 1.0, False
    for sign in (-1.0, 1.0):
        yield f"friction {sign * FRICTION:+.0%}", 1.0 + sign * FRICTION, 1.0, False
        yield f"mass {sign * MASS:+.0%}", 1.0, 1.0 + sign * MASS, False
    for _ in range(PALMS):
        yield "palm", 1.0, 1.0, True
    for _ in range(TOGETHER):
        friction, mass = (2.0 * stream.integers(2, 2) - 1.0).tolist()
        yield "together", 1.0 + friction * FRICTION, 1.0 + mass * MASS, True


def palm_off(attempt: Attempt, stream: Stream) -> Attempt:
    """Return an attempt with the palm off, in a direction and about an axis that are drawn."""
    shift, axis = (v / np.linalg.norm(v) for v in stream.normal(6).reshape(2, 3))
    X_GH = make_pose(rotation_about(axis, TURN), SHIFT * shift)
    return replace(attempt, X_OG=multiply(attempt.X_OG, X_GH))


def lift_again(out: Path, trials: Trials, trial_id: int, config: Config) -> list[dict[str, Any]]:
    """Return what becomes of a sample with each change."""
    row = trials.trial(trial_id)
    name = row["object_name"]
    candidate, standoff, child = (int(row[k]) for k in ("candidate", "standoff_index", "child"))
    prepared = load_prepared(out, name, config)
    attempt = find_attempt(prepared, candidate, standoff, child, config)
    known = attempt.conditions or usual_conditions(prepared.model, config.physics)
    X_TO = prepared.resting_poses[attempt.resting]
    half = {"time_step": config.physics.time_step / 2.0, "coarse_steps": 1}
    stream, found = Stream(config.seed, trial_id, PLACE), []
    for change, friction, mass, is_off in changes(stream):
        physics = config.physics.model_copy(update=half if change == "half step" else {})
        rules = with_whole_lifts(config).model_copy(update={"physics": physics})
        materials = replace(
            known.materials,
            friction_hand=friction * known.materials.friction_hand,
            mass=mass * known.materials.mass,
        )
        other = replace(attempt, conditions=replace(known, materials=materials))
        scene = cached_scene(prepared.model, physics, config.hand_source, attempt.preshape)
        record = run_attempt(scene, X_TO, palm_off(other, stream) if is_off else other, rules)
        removal = judge_sample(prepared.model, record, rules, views=False)
        found.append(
            {
                "change": change,
                "outcome": record.outcome.label,
                "sample": removal is Removal.KEPT,
                "removal": None if removal is None else removal.label,
            }
        )
    return found


def measure(out: Path, count: int, lines: Path) -> None:
    """Write a line for each of some samples of a dataset, drawn at random."""
    config, trials = read_manifest(out).config, Trials(out).where(sample=True)
    order = Stream(config.seed, PLACE).permutation(len(trials))[:count]
    with lines.open("w", encoding="utf-8") as file:
        for trial_id in trials.trial_ids[order].tolist():
            lifts = lift_again(out, Trials(out), trial_id, config)
            columns = Trials(out)[np.array([trial_id])].columns(COLUMNS)
            told = {key: float(value[0]) for key, value in predictors(columns).items()}
            line = {"trial_id": trial_id, "lifts": lifts, "told": told}
            file.write(json.dumps(line) + "\n")
            file.flush()


def summarise(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the tables of what was measured, as lines of Markdown."""
    yield f"{len(rows)} samples\n\n| change | lifts | held | sample |\n|---|--:|--:|--:|"
    lifts = [lift for row in rows for lift in row["lifts"]]
    failed = ("solver_error", "timeout", "crashed")
    for change in dict.fromkeys(lift["change"] for lift in lifts):
        own = [x for x in lifts if x["change"] == change and x["outcome"] not in failed]
        cells = []
        for hits in (sum(x["outcome"] == "success" for x in own), sum(x["sample"] for x in own)):
            low, high = wilson_interval(hits, len(own))
            cells.append(f"{hits / len(own):.0%} ({low:.0%} to {high:.0%})")
        yield f"| {change} | {len(own)} | {' | '.join(cells)} |"
    noisy = [[x["sample"] for x in r["lifts"] if x["change"] in ("palm", "together")] for r in rows]
    much = np.array([np.mean(own) >= MUCH for own in noisy])
    yield f"\n{much.sum()} of {len(rows)} bear half or more\n\n| number | AUC |\n|---|--:|"
    areas = {
        name: area_under_roc(np.array([row["told"][name] for row in rows]), much)
        for name in rows[0]["told"]
    }
    for name, area in sorted(areas.items(), key=lambda pair: -pair[1]):
        yield f"| {name} | {area:.2f} |"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lines", type=Path, help="file with a line per sample")
    parser.add_argument("--dataset", type=Path, help="measure samples of this dataset")
    parser.add_argument("--count", type=int, default=100, help="how many (default: 100)")
    arguments = parser.parse_args(argv)
    if arguments.dataset is not None:
        measure(arguments.dataset, arguments.count, arguments.lines)
    rows = [json.loads(line) for line in arguments.lines.read_text(encoding="utf-8").splitlines()]
    sys.stdout.writelines(f"{line}\n" for line in summarise(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
