"""Throughput of this machine: what attempts cost, stage by stage, in this process alone.

In: meshes and a configuration. Out: plain data for a JSON file. Costs are seconds of a core
(CPU time of this process), so that other work on the machine disturbs them as little as
possible; preparing an object is told apart, because a dataset does it once.
"""

from __future__ import annotations

import platform
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import trimesh

from drakegrasp.build.attempts import Workbench, predict_all, try_on
from drakegrasp.build.prepare import prepare
from drakegrasp.build.work_unit import look_at_successes
from drakegrasp.config import Config, override_config
from drakegrasp.dataset.manifest import installed_versions
from drakegrasp.dataset.prepared_objects import PreparedObject
from drakegrasp.errors import DataError
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.sources import MeshSource
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.runtime.blas import one_thread
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.seeding import Stream
from drakegrasp.simulation.candidates import Attempt, make_attempts
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.screen import Prediction
from drakegrasp.simulation.trial import TrialRecord

#: Attempts from one report of progress to the next.
STRIDE = 50


@dataclass(frozen=True)
class Variant:
    """Another way to simulate an attempt, by which labels are judged.

    Attributes:
        overrides: Of the configuration; `{half}` stands for half of its time step.
        fine: Whether each face of the object is cut into four, so that edges are half as long.
    """

    overrides: tuple[str, ...] = ()
    fine: bool = False


VARIANTS = {
    "screen_off": Variant(("screen.mode=off",)),
    "half_step": Variant(("physics.time_step={half}", "physics.calm_steps=1")),
    "calm_off": Variant(("physics.calm_steps=1",)),
    "double_resolution": Variant(fine=True),
    "similar": Variant(("physics.solver=similar",)),
    "sap": Variant(("physics.solver=sap",)),
}


def measure(
    sources: Sequence[MeshSource],
    config: Config,
    *,
    sample: int = 0,
    peer: bool = False,
    progress: Report = silent,
) -> Iterator[dict[str, Any]]:
    """Yield what was measured on each object, see `docs/benchmarks.md`.

    Args:
        sources: The meshes.
        config: What to run; `candidates.max` says how much.
        sample: Attempts per object that are run again in other ways for `fidelity`, drawn
            with the seed from those whose palm ray meets the object.
        peer: Whether to run all attempts in MuJoCo as well; needs the extra `[peer]`.
        progress: Called with the attempts that are done, as far as objects are known.

    Raises:
        MeshError: If a mesh cannot be prepared.
    """
    counter = _Counter(progress, len(sources), (2 if peer else 1), sample)
    for source in sources:
        yield _measure_object(source, config, sample, peer, counter)


class _Counter:
    """Counts attempts for the progress; objects to come count as those before did."""

    def __init__(self, progress: Report, objects: int, runs: int, sample: int) -> None:
        self._progress, self._objects, self._runs, self._sample = progress, objects, runs, sample
        self._done = self._begun = self._known = self._grasps = 0

    def begin(self, attempts: int, hits: int) -> None:
        """Add the attempts of the next object."""
        self._begun += 1
        self._known += self._runs * attempts + len(VARIANTS) * min(self._sample, hits)

    def add(self, outcome: Outcome) -> None:
        """Count an attempt."""
        self._done += 1
        self._grasps += outcome is Outcome.SUCCESS
        if self._done % STRIDE == 0 or self._done == self._known:
            total = self._known * self._objects // self._begun
            self._progress(self._done, total, grasps=self._grasps)


def summarize(objects: Sequence[dict[str, Any]], config: Config) -> dict[str, Any]:
    """Return the whole report: machine, versions, each object and all together."""
    outcomes: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    for found in objects:
        outcomes.update(found["outcomes"])
        seconds.update(found["seconds"])
    total = {"objects": len(objects), **_rates(outcomes, seconds)}
    if any("fidelity" in found for found in objects):
        total["fidelity"] = _add_fidelity([found["fidelity"] for found in objects])
    if any("peer" in found for found in objects):
        total["peer"] = _add_peer([found["peer"] for found in objects])
    return {
        "all": total,
        "objects": list(objects),
        "peak_memory": _peak_memory(),
        "cpu": _cpu(),
        "versions": installed_versions(config),
        "config": config.to_dict(),
    }


def compare(now: dict[str, Any], then: dict[str, Any]) -> dict[str, float | None]:
    """Return the ratio of each rate to that of an earlier report; None where that was zero.

    Raises:
        DataError: If the reports are not of as many attempts at the same objects.
    """
    tried = [{o["name"]: o["attempts"] for o in report["objects"]} for report in (now, then)]
    odd = sorted(name for name, _ in tried[0].items() ^ tried[1].items())
    if odd:
        raise DataError(
            f"reports must be of the same attempts to be compared, got other ones of {odd[0]}"
        )
    keys = ("resolved_per_core_second", "grasps_per_core_hour")
    return {key: now["all"][key] / old if (old := then["all"][key]) else None for key in keys}


@one_thread
def _measure_object(
    source: MeshSource, config: Config, sample: int, peer: bool, counter: _Counter
) -> dict[str, Any]:
    seconds: dict[str, float] = {}
    with _timed(seconds, "prepare"):
        prepared = prepare(source, config)
    attempts = _attempts(prepared, config)
    hits = [row for row, attempt in enumerate(attempts) if attempt.ray_hits]
    counter.begin(len(attempts), len(hits))
    with _timed(seconds, "scene"):
        scene = build_scene(prepared.model, config.physics, load_hand(config.hand))
        bench = Workbench(prepared=prepared, config=config, scene=scene)
    with _timed(seconds, "field"):
        _ = prepared.model.field
    with _timed(seconds, "screen"):
        predictions = predict_all(bench, attempts)
    records: list[TrialRecord] = []
    for attempt, prediction in zip(attempts, predictions, strict=True):
        with _timed(seconds, "try"):
            records.append(try_on(bench, attempt, prediction))
        counter.add(records[-1].outcome)
    with _timed(seconds, "look"):
        look_at_successes(bench, records)
    found = {
        "name": source.name,
        "faces": len(prepared.model.collision_faces),
        "candidates": len(prepared.candidates),
        **_rates(Counter(record.outcome.label for record in records), seconds),
        "peak_memory": _peak_memory(),
    }
    if peer:
        found["peer"] = _run_peer(prepared, attempts, config, counter)
        ours, theirs = found["grasps_per_core_hour"], found["peer"]["grasps_per_core_hour"]
        found["peer"]["ratio"] = ours / theirs if theirs else None
    if sample:
        rows = [hits[k] for k in Stream(config.seed).permutation(len(hits))[:sample]]
        found["fidelity"] = {
            name: _compare_labels(bench, attempts, records, predictions, rows, variant, counter)
            for name, variant in VARIANTS.items()
        }
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


def _run_peer(
    prepared: PreparedObject, attempts: Sequence[Attempt], config: Config, counter: _Counter
) -> dict[str, Any]:
    """Return what MuJoCo makes of the same attempts; cutting the object into parts is prepared."""
    from drakegrasp.bench.mujoco_baseline import Peer

    seconds: dict[str, float] = {}
    with _timed(seconds, "prepare"):
        peer = Peer(prepared.model, prepared.X_TO, config)
    outcomes: Counter[str] = Counter()
    for attempt in attempts:
        with _timed(seconds, "try"):
            outcome = peer.run(attempt)
        outcomes[outcome.label] += 1
        counter.add(outcome)
    return {"parts": peer.parts, **_rates(outcomes, seconds)}


def _add_peer(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    outcomes: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    for each in found:
        outcomes.update(each["outcomes"])
        seconds.update(each["seconds"])
    ratios = [each["ratio"] for each in found if each["ratio"] is not None]
    middle = median(ratios) if ratios else None
    return {**_rates(outcomes, seconds), "median_ratio": middle, "ratios": len(ratios)}


def _compare_labels(
    bench: Workbench,
    attempts: Sequence[Attempt],
    records: Sequence[TrialRecord],
    predictions: Sequence[Prediction | None],
    rows: Sequence[int],
    variant: Variant,
    counter: _Counter,
) -> dict[str, int]:
    """Return counts for one variant over some of an object's attempts."""
    half = bench.config.physics.time_step / 2.0
    other = override_config(bench.config, [t.format(half=half) for t in variant.overrides])
    some = [attempts[row] for row in rows]
    # What geometry says is asked of the same surface, however fine its faces are.
    seen = predict_all(replace(bench, config=other), some)
    prepared = bench.prepared
    if variant.fine:
        prepared = replace(prepared, model=_finer(prepared.model))
    scene = build_scene(prepared.model, other.physics, load_hand(other.hand))
    bench = Workbench(prepared=prepared, config=other, scene=scene)
    pairs, decided = [], []
    for row, attempt, prediction in zip(rows, some, seen, strict=True):
        outcome = try_on(bench, attempt, prediction).outcome
        counter.add(outcome)
        pairs.append((records[row].outcome, outcome))
        said = predictions[row]
        decided.append(said is not None and said.outcome is not None)
    return _count(pairs, decided)


def _finer(model: ObjectModel) -> ObjectModel:
    """Return an object whose collision surface is the same in four times as many faces."""
    vertices, faces = trimesh.remesh.subdivide(model.collision_vertices, model.collision_faces)
    return replace(model, collision_vertices=vertices, collision_faces=faces.astype(np.int32))


def _count(pairs: Sequence[tuple[Outcome, Outcome]], decided: Sequence[bool]) -> dict[str, int]:
    """Return counts of pairs of verdicts: as measured, where geometry decided, and otherwise."""
    success = Outcome.SUCCESS
    # What geometry said instead of the simulation is no other label.
    alike = {Outcome.SCREENED: Outcome.MISSING_FINGERTIP}
    flips = [(a, b) for a, b in pairs if alike.get(a, a) is not alike.get(b, b)]
    both = list(zip(pairs, decided, strict=True))
    return {
        "attempts": len(pairs),
        "flips": len(flips),
        "simulated": sum(a.stage > Stage.PLACED for a, _ in pairs),
        "successes": sum(a is success for a, _ in pairs),
        "successes_other": sum(b is success for _, b in pairs),
        "success_flips": sum(success in pair for pair in flips),
        "decided": sum(decided),
        "successes_lost_by_screen": sum(sure and b is success for (_, b), sure in both),
    }


def _add_fidelity(found: Sequence[dict[str, dict[str, int]]]) -> dict[str, dict[str, Any]]:
    added: dict[str, dict[str, Any]] = {}
    for name in VARIANTS:
        counts: Counter[str] = Counter()
        for each in found:
            counts.update(each[name])
        flips = counts["flips"]
        added[name] = {
            **counts,
            "flip_share": flips / max(1, counts["attempts"]),
            "flip_share_of_simulated": flips / max(1, counts["simulated"]),
        }
    off = added["screen_off"]
    lost, successes = off["successes_lost_by_screen"], off["successes_other"]
    off["recall"] = 1.0 - lost / successes if successes else None
    off["precision"] = 1.0 - lost / off["decided"] if off["decided"] else None
    return added


def _peak_memory() -> int:
    # Linux counts in KiB, macOS in bytes.
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


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
