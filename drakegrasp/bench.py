"""Throughput of this machine: what attempts cost, stage by stage, in this process alone.

In: meshes and a configuration. Out: plain data for a JSON file. Costs are seconds of a core
(CPU time of this process), so that other work on the machine disturbs them as little as
possible; preparing an object is told apart, because a dataset does it once.
"""

from __future__ import annotations

import platform
import resource
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.candidates import Attempt, make_attempts
from drakegrasp.config import Config, override_config
from drakegrasp.construction import build_scene
from drakegrasp.hand import load_hand
from drakegrasp.manifest import installed_versions
from drakegrasp.meshes import MeshSource
from drakegrasp.outcomes import Outcome
from drakegrasp.prepared import PreparedObject, prepare
from drakegrasp.trial import TrialRecord
from drakegrasp.units import Workbench, look_at_successes, predict_all, try_on

#: Other ways to simulate an attempt, by which labels are judged.
VARIANTS = {
    "screen_off": ["screen.mode=off"],
    "half_step": ["physics.time_step={half}"],
    "similar": ["physics.solver=similar"],
    "sap": ["physics.solver=sap"],
}


def measure(
    sources: Iterable[MeshSource], config: Config, *, sample: int = 0
) -> Iterator[dict[str, Any]]:
    """Yield what was measured on each object, see `docs/performance.md`.

    Args:
        sources: The meshes.
        config: What to run; `candidates.max` says how much.
        sample: Attempts per object that are run again in other ways for `fidelity`, drawn
            with the seed from those whose palm ray meets the object.

    Raises:
        MeshError: If a mesh cannot be prepared.
    """
    for source in sources:
        yield _measure_object(source, config, sample)


def summarize(objects: Sequence[dict[str, Any]], config: Config) -> dict[str, Any]:
    """Return the whole report: machine, versions, each object and all together."""
    outcomes: Counter[str] = Counter()
    seconds: dict[str, float] = {}
    for found in objects:
        outcomes.update(found["outcomes"])
        for stage, spent in found["seconds"].items():
            seconds[stage] = seconds.get(stage, 0.0) + spent
    total = {"objects": len(objects), **_rates(outcomes, seconds)}
    if any("fidelity" in found for found in objects):
        total["fidelity"] = _add_fidelity([found["fidelity"] for found in objects])
    return {
        "all": total,
        "objects": list(objects),
        "peak_memory": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "cpu": _cpu(),
        "versions": installed_versions(config),
        "config": config.to_dict(),
    }


def compare(now: dict[str, Any], then: dict[str, Any]) -> dict[str, float]:
    """Return the ratio of each rate to that of an earlier report, over the same attempts."""
    keys = ("resolved_per_core_second", "grasps_per_core_hour")
    return {key: now["all"][key] / then["all"][key] for key in keys if then["all"][key]}


def _measure_object(source: MeshSource, config: Config, sample: int) -> dict[str, Any]:
    seconds: dict[str, float] = {}
    with _timed(seconds, "prepare"):
        prepared = prepare(source, config)
    with _timed(seconds, "scene"):
        scene = build_scene(prepared.model, config.physics, load_hand(config.hand))
        bench = Workbench(prepared=prepared, config=config, scene=scene)
    with _timed(seconds, "field"):
        _ = prepared.model.field
    attempts = _attempts(prepared, config)
    with _timed(seconds, "screen"):
        predictions = predict_all(bench, attempts)
    records: list[TrialRecord] = []
    for attempt, prediction in zip(attempts, predictions, strict=True):
        with _timed(seconds, "try"):
            records.append(try_on(bench, attempt, prediction))
    with _timed(seconds, "look"):
        look_at_successes(bench, records)
    outcomes = Counter(record.outcome.label for record in records)
    found = {
        "name": source.name,
        "faces": len(prepared.model.collision_faces),
        "candidates": len(prepared.candidates),
        **_rates(outcomes, seconds),
    }
    if sample:
        found["fidelity"] = _fidelity(prepared, attempts, records, config, sample)
    return found


def _attempts(prepared: PreparedObject, config: Config) -> list[Attempt]:
    every = range(len(prepared.candidates))
    name, rules = prepared.model.name, config.candidates
    return list(make_attempts(prepared.candidates, every, rules, name=name, seed=config.seed))


def _rates(outcomes: Counter[str], seconds: Mapping[str, float]) -> dict[str, Any]:
    attempts = sum(outcomes.values())
    spent = sum(s for stage, s in seconds.items() if stage != "prepare")
    return {
        "attempts": attempts,
        "outcomes": dict(outcomes),
        "seconds": dict(seconds),
        "resolved_per_core_second": attempts / spent,
        "grasps_per_core_hour": 3600.0 * outcomes[Outcome.SUCCESS.label] / spent,
    }


def _fidelity(
    prepared: PreparedObject,
    attempts: Sequence[Attempt],
    records: Sequence[TrialRecord],
    config: Config,
    sample: int,
) -> dict[str, dict[str, int]]:
    """Return counts for each variant over a random sample of an object's attempts."""
    hits = [row for row, attempt in enumerate(attempts) if attempt.ray_hits]
    rng = np.random.default_rng(config.seed)
    rows = rng.permutation(hits)[:sample].tolist()
    half = config.physics.time_step / 2.0
    found = {}
    for name, overrides in VARIANTS.items():
        other = override_config(config, [text.format(half=half) for text in overrides])
        scene = build_scene(prepared.model, other.physics, load_hand(other.hand))
        bench = Workbench(prepared=prepared, config=other, scene=scene)
        pairs = [(records[row].outcome, try_on(bench, attempts[row]).outcome) for row in rows]
        found[name] = _count(pairs)
    return found


def _count(pairs: Sequence[tuple[Outcome, Outcome]]) -> dict[str, int]:
    success = Outcome.SUCCESS
    decided = (Outcome.SCREENED, Outcome.START_COLLISION)
    # What geometry said instead of the simulation is no other label.
    alike = {Outcome.SCREENED: Outcome.MISSING_FINGERTIP}
    return {
        "attempts": len(pairs),
        "flips": sum(alike.get(a, a) is not alike.get(b, b) for a, b in pairs),
        "simulated": sum(a not in decided for a, _ in pairs),
        "successes": sum(a is success for a, _ in pairs),
        "successes_other": sum(b is success for _, b in pairs),
        "decided": sum(a in decided for a, _ in pairs),
        "successes_lost_by_screen": sum(a in decided and b is success for a, b in pairs),
    }


def _add_fidelity(found: Sequence[dict[str, dict[str, int]]]) -> dict[str, dict[str, Any]]:
    added: dict[str, dict[str, Any]] = {}
    for name in VARIANTS:
        counts: Counter[str] = Counter()
        for each in found:
            counts.update(each[name])
        added[name] = {**counts, "flip_share": counts["flips"] / max(1, counts["attempts"])}
    off = added["screen_off"]
    lost, successes = off["successes_lost_by_screen"], off["successes_other"]
    off["recall"] = 1.0 - lost / successes if successes else None
    off["precision"] = 1.0 - lost / off["decided"] if off["decided"] else None
    return added


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if "model name" in line)
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.process_time()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.process_time() - start
