"""Measure what a lift's verdict in MuJoCo depends on: try stored lifts with other settings.

    python pipelines/measurements/peer_settings.py lines.jsonl --dataset OUT --count 100
    python pipelines/measurements/peer_settings.py lines.jsonl

Samples and lost lifts are drawn from random objects of a dataset that have both. Each lift is tried
with torsion radii of 1, 2 and 5 mm, with 10 % less and more friction between object and hand, and
at half the time step. The first call writes a line per lift. The second prints the fractions that
hold with their intervals, and how many verdicts differ from those with the usual settings.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco_baseline
import mujoco_scene
from cross_check import Group, StoredLift, draw_lifts
from mujoco_baseline import MujocoBaseline
from scipy.stats import binomtest

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.mjcf import links
from drakegrasp.mjcf.decomposition import convex_parts
from drakegrasp.outcomes import Outcome
from drakegrasp.seeding import Stream
from drakegrasp.simulation.conditions import usual_conditions

GROUPS: tuple[Group, ...] = ("sample", "lost")
#: Last number of the key of the random stream that draws objects.
PLACE = 25
#: Torsion radius [m], factor of the friction with the hand, and divisor of the time step.
SETTINGS = {
    "usual": (links.TORSION_RADIUS, 1.0, 1),
    "torsion radius 1 mm": (1e-3, 1.0, 1),
    "torsion radius 2 mm": (2e-3, 1.0, 1),
    "torsion radius 5 mm": (5e-3, 1.0, 1),
    "friction -10 %": (links.TORSION_RADIUS, 0.9, 1),
    "friction +10 %": (links.TORSION_RADIUS, 1.1, 1),
    "half the step": (links.TORSION_RADIUS, 1.0, 2),
}


def with_step(stack: ExitStack, finer: int) -> None:
    """Make MuJoCo take time steps that are shorter by a factor, until the stack closes.

    Contacts keep their time constant, and checks keep their period.
    """
    for module in (mujoco_scene, mujoco_baseline):
        stack.enter_context(mock.patch.object(module, "TIME_STEP", links.TIME_STEP / finer))
    for name in ("CLOSING_STRIDE", "LIFTING_STRIDE"):
        stride = finer * getattr(mujoco_baseline, name)
        stack.enter_context(mock.patch.object(mujoco_baseline, name, stride))


def try_object(out: Path, name: str, lifts: Sequence[StoredLift]) -> Iterator[dict[str, Any]]:
    """Yield a line for each lift of an object."""
    config = read_manifest(out).config_of(name)
    prepared = load_prepared(out, name, config)
    usual = usual_conditions(prepared.model, config.physics)
    cut = cache(convex_parts)
    with mock.patch.object(mujoco_scene, "convex_parts", lambda _: cut(prepared.model)):
        peers = {}
        for finer in (1, 2):
            with ExitStack() as stack:
                with_step(stack, finer)
                peers[finer] = MujocoBaseline(prepared.model, prepared.X_TO, config)
    for lift in lifts:
        found = {}
        for setting, (radius, friction, finer) in SETTINGS.items():
            materials = replace(
                lift.materials, friction_hand=friction * lift.materials.friction_hand
            )
            peers[finer].place(prepared.resting_poses[lift.resting])
            conditions = replace(usual, materials=materials)
            with ExitStack() as stack:
                with_step(stack, finer)
                stack.enter_context(mock.patch.object(links, "TORSION_RADIUS", radius))
                trial = peers[finer].run(replace(lift.pregrasp, conditions=conditions))
            found[setting] = trial.outcome.label
        yield {"trial_id": lift.trial_id, "object": name, "group": lift.group, "there": found}


def measure(out: Path, count: int, each: int, lines: Path) -> None:
    """Write a line for each of some samples and lost lifts of a dataset."""
    config, by_object = read_manifest(out).config, dict[str, list[StoredLift]]()
    for lift in draw_lifts(out, 1 << 62):
        by_object.setdefault(lift.object_name, []).append(lift)

    # Objects come in random order, so that partial results are representative.
    names, left = sorted(by_object), dict.fromkeys(GROUPS, count)
    with lines.open("w", encoding="utf-8") as file:
        for i in Stream(config.seed, PLACE).permutation(len(names)).tolist():
            own = [[x for x in by_object[names[i]] if x.group == group] for group in GROUPS]
            if not all(own) or not any(left.values()):
                continue  # cutting an object into convex parts takes longer than a lift
            taken = [pile[: min(each, left[g])] for g, pile in zip(GROUPS, own, strict=True)]
            for group, pile in zip(GROUPS, taken, strict=True):
                left[group] -= len(pile)
            for line in try_object(out, names[i], [*taken[0], *taken[1]]):
                file.write(json.dumps(line) + "\n")
                file.flush()


def summarise(rows: Sequence[dict[str, Any]]) -> Iterator[str]:
    """Yield the table of the results as lines of Markdown."""
    held = Outcome.SUCCESS.label
    for group in GROUPS:
        own = [row["there"] for row in rows if row["group"] == group]
        yield f"\n{len(own)} of {group}\n\n| setting | hold | other verdicts |\n|---|--:|--:|"
        for setting in SETTINGS:
            hits = sum(row[setting] == held for row in own)
            low, high = binomtest(hits, len(own)).proportion_ci(method="wilson")
            others = sum((row[setting] == held) != (row["usual"] == held) for row in own)
            yield f"| {setting} | {hits / len(own):.0%} ({low:.0%} to {high:.0%}) | {others} |"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lines", type=Path, help="file with a line per lift")
    parser.add_argument("--dataset", type=Path, help="measure lifts of this dataset")
    parser.add_argument("--count", type=int, default=100, help="lifts per group (default: 100)")
    parser.add_argument(
        "--each", type=int, default=4, help="lifts per object and group (default: 4)"
    )
    arguments = parser.parse_args(argv)
    if arguments.dataset is not None:
        measure(arguments.dataset, arguments.count, arguments.each, arguments.lines)
    rows = [json.loads(line) for line in arguments.lines.read_text(encoding="utf-8").splitlines()]
    sys.stdout.writelines(f"{line}\n" for line in summarise(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
