"""Measure what lifts that end when their sample is lost save, and what they lose.

    python pipelines/measurements/ended_lifts.py MESHES --units cm --candidates 60
    python pipelines/measurements/ended_lifts.py builtin --every 10

Every attempt is simulated with `lift.stop_when=never` and with `lost_sample`, in turns. Prints
JSON: CPU seconds of both, and how the lifts that ended as `moved` end when they go on.
"""

from __future__ import annotations

import argparse
import json
import pickle
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

from drakegrasp.config import BuiltinConfig, Config
from drakegrasp.errors import MeshError
from drakegrasp.filters import first_removal
from drakegrasp.generation.attempts import TrialSetup, list_attempts, predict_attempts
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.shapes.catalog import builtin_sources
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.table import Table


def sources_of(objects: str, units: str, every: int, folder: Path) -> list[MeshSource]:
    """Return every n-th mesh of a directory, or of the built-in objects."""
    if objects == "builtin":
        found = builtin_sources(folder, BuiltinConfig())
    else:
        found = find_meshes(Path(objects), units=units)
    return list(found)[::every]


def try_both(
    source: MeshSource, rules: dict[str, Config]
) -> Iterator[dict[str, tuple[TrialRecord, float]]]:
    """Yield record and CPU time [s] by rule of each attempt that geometry does not decide."""
    config = rules["never"]
    prepared = prepare(source, config)
    attempts = list_attempts(prepared, range(len(prepared.candidates)), config)
    scene = build_scene(prepared.model, config.physics, load_hand(config.hand_source))
    # It is built once, and not at the cost of the first lift.
    if scene.coarse_scene is not None:
        scene.coarse_scene()
    setup = TrialSetup(prepared=prepared, config=config, scene=scene)
    predictions = predict_attempts(setup, attempts)
    turn = 0
    for attempt, prediction in zip(attempts, predictions, strict=True):
        if not attempt.ray_hits or prediction is None or prediction.outcome is not None:
            continue
        turn += 1
        found = {}
        for name in (*rules,)[:: 1 if turn % 2 else -1]:
            start = time.process_time()
            X_TO = prepared.resting_poses[attempt.resting]
            record = run_attempt(scene, X_TO, attempt, rules[name], prediction)
            found[name] = record, time.process_time() - start
        yield found


def is_sample(record: TrialRecord, config: Config) -> bool:
    """Return whether the filters of the hold keep a grasp."""
    if record.outcome is not Outcome.SUCCESS or record.lift is None:
        return False
    lift = record.lift
    hold = Table(other_links=[lift.contacts.other_links], slip=[lift.slip], turn=[lift.turn])
    return bool(first_removal(hold, config.filters)[0] == Removal.KEPT)


@one_thread
def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("objects", help="directory of meshes, or `builtin`")
    parser.add_argument("--units", default="m", help="of the meshes (default: m)")
    parser.add_argument("--every", type=int, default=1, help="take each n-th mesh (default: 1)")
    parser.add_argument("--candidates", type=int, default=60, help="palm poses of each object")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args(argv)

    config = load_config(overrides=[f"candidates.max={arguments.candidates}", *arguments.overrides])
    rules = {
        rule: override_config(config, [f"lift.stop_when={rule}"])
        for rule in ("never", "lost_sample")
    }
    counts: Counter[str] = Counter()
    seconds = {rule: {"all": 0.0, "lifts": 0.0} for rule in rules}
    moved: Counter[str] = Counter()
    lost: list[dict[str, float]] = []
    with TemporaryDirectory() as folder, progress_bar("lifts", "meshes") as report:
        sources = sources_of(arguments.objects, arguments.units, arguments.every, Path(folder))
        for done, source in enumerate(sources, start=1):
            try:
                for found in try_both(source, rules):
                    (whole, _), (ended, _) = found["never"], found["lost_sample"]
                    lifted = whole.lift is not None
                    counts.update(simulated=1, lifts=lifted, held=whole.outcome is Outcome.SUCCESS)
                    for rule, (_, spent) in found.items():
                        seconds[rule]["all"] += spent
                        seconds[rule]["lifts"] += spent * lifted
                    sample = is_sample(whole, config)
                    counts["samples"] += sample
                    if ended.outcome is not Outcome.MOVED:
                        counts["others that differ"] += pickle.dumps(whole) != pickle.dumps(ended)
                        continue
                    moved[whole.outcome.label] += 1
                    if sample and ended.lift is not None and whole.lift is not None:
                        slips = {"slip": ended.lift.slip, "slip of the whole lift": whole.lift.slip}
                        lost.append(slips)
            except MeshError as error:
                sys.stderr.write(f"{source.name}: {error}\n")
            report(done, len(sources))

    saved = {
        part: 1.0 - seconds["lost_sample"][part] / seconds["never"][part]
        for part in ("all", "lifts")
    }
    result = {
        "objects": [source.name for source in sources],
        **counts,
        "CPU seconds": seconds,
        "share saved": saved,
        "moved, by the outcome of the whole lift": moved,
        "samples lost": lost,
    }
    json.dump(result, sys.stdout, indent=1)
    sys.stdout.write("\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
