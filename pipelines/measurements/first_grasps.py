"""Prints after how many palm poses each object of a directory has a precision grasp.

Usage: python first_grasps.py [--candidates N] [--seed S] [--units UNIT] MESHES [NAME ...]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from drakegrasp.config import Config
from drakegrasp.generation.attempts import TrialSetup, predict_attempts, try_attempt
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import make_attempts
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.verdict import is_precision

#: Palm poses whose attempts geometry judges in one call.
STRIDE = 50


def main() -> None:
    """Print a line per object: palm poses tried, held grasps, whether one is of precision."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("meshes", type=Path, metavar="MESHES")
    parser.add_argument("names", nargs="*", metavar="NAME", help="[default: all]")
    parser.add_argument("--candidates", type=int, default=2000, help="palm poses at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--units", default="m")
    arguments = parser.parse_args()

    config = load_config(overrides=[f"candidates.max={arguments.candidates}"], seed=arguments.seed)
    for source in find_meshes(arguments.meshes, units=arguments.units):
        if not arguments.names or source.name in arguments.names:
            start = time.monotonic()
            tried, held, found = search(source, config)
            what = "precision" if found else "NO PRECISION GRASP"
            sys.stdout.write(
                f"{source.name}: {what} after {tried} palm poses, {held} held, "
                f"{time.monotonic() - start:.0f} s\n"
            )
            sys.stdout.flush()


def search(source: MeshSource, config: Config) -> tuple[int, int, bool]:
    """Return how many palm poses were tried, how many grasps held, and whether one is of precision.

    Args:
        source: The object.
        config: All the rules.
    """
    prepared = prepare(source, config)
    scene = build_scene(prepared.model, config.physics, load_hand(config.hand_source))
    setup = TrialSetup(prepared=prepared, config=config, scene=scene)
    count, held = len(prepared.candidates), 0
    for begin in range(0, count, STRIDE):
        poses = range(begin, min(begin + STRIDE, count))
        attempts = list(
            make_attempts(
                prepared.candidates, poses, config.candidates, name=source.name, seed=config.seed
            )
        )
        for attempt, prediction in zip(attempts, predict_attempts(setup, attempts), strict=True):
            record = try_attempt(setup, attempt, prediction)
            held += record.outcome is Outcome.SUCCESS
            lift = record.lift
            if lift and is_precision(record.outcome.value, lift.contacts.other_links):
                return attempt.candidate + 1, held, True
    return count, held, False


if __name__ == "__main__":
    main()
