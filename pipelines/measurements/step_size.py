"""Measure how many attempts have the same outcome at two time steps.

The attempts are the first of each object of a dataset whose palm ray meets the object. Prints
JSON: the share with the same outcome, of all attempts and of those that were simulated, and
which outcomes changed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.generation.attempts import list_attempts
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.trial import run_attempt


def outcomes(prepared: PreparedObject, attempts: list[Attempt], config: Config) -> list[Outcome]:
    """Return the outcomes of attempts under a configuration."""
    scene = build_scene(prepared.model, config.physics, load_hand(config.hand_source))
    poses = prepared.resting_poses
    return [run_attempt(scene, poses[a.resting], a, config).outcome for a in attempts]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="directory of a dataset")
    parser.add_argument("--objects", nargs="*", help="names of objects (default: all)")
    parser.add_argument(
        "--attempts", type=int, default=60, help="attempts of each object (default: 60)"
    )
    parser.add_argument(
        "--step", type=float, default=0.001, help="the other time step [s] (default: 0.001)"
    )
    arguments = parser.parse_args(argv)

    # Every step of the other configuration is equally long, in a lift too.
    config = read_manifest(arguments.dataset).config
    other = override_config(
        config, [f"physics.time_step={arguments.step}", "physics.coarse_steps=1"]
    )

    # Pairs of outcomes: with the dataset's step, with the other.
    pairs: Counter[tuple[Outcome, Outcome]] = Counter()
    for entry in read_manifest(arguments.dataset).objects:
        if arguments.objects and entry.name not in arguments.objects:
            continue
        prepared = load_prepared(arguments.dataset, entry.name, config)
        count = range(len(prepared.candidates))
        made = list_attempts(prepared, count, config)
        attempts = [a for a in made if a.ray_hits][: arguments.attempts]
        pairs.update(
            zip(
                outcomes(prepared, attempts, config),
                outcomes(prepared, attempts, other),
                strict=True,
            )
        )

    simulated = {p: n for p, n in pairs.items() if max(o.stage for o in p) > Stage.PLACED}
    result = {
        "steps": [config.physics.time_step, arguments.step],
        "attempts": sum(pairs.values()),
        "alike": sum(n for (a, b), n in pairs.items() if a is b) / max(1, sum(pairs.values())),
        "simulated": sum(simulated.values()),
        "simulated_alike": sum(n for (a, b), n in simulated.items() if a is b)
        / max(1, sum(simulated.values())),
        "changed": {f"{a.label} -> {b.label}": n for (a, b), n in pairs.items() if a is not b},
        "successes": [sum(n for p, n in pairs.items() if p[i] is Outcome.SUCCESS) for i in (0, 1)],
    }

    json.dump(result, sys.stdout, indent=1)
    sys.stdout.write("\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
