"""Measures the cost of attempts on this machine, stage by stage, in this process alone.

Input: meshes and a configuration. Output: plain data for a JSON file. Costs are seconds of CPU time
of this process, so that other work on the machine disturbs them as little as possible. Rates leave
out the cost of preparing an object, because a dataset pays it once; `with_preparing` includes it.
"""

from __future__ import annotations

import platform
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import installed_versions
from drakegrasp.dataset.prepared_objects import PreparedObject
from drakegrasp.errors import DataError
from drakegrasp.generation.attempts import (
    TrialSetup,
    list_attempts,
    look_at,
    predict_attempts,
    try_attempt,
)
from drakegrasp.generation.prepare import prepare
from drakegrasp.objects.sources import MeshSource
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.allocator import allocator
from drakegrasp.runtime.environment import one_thread, timed
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.scene_cache import cached_scene
from drakegrasp.simulation.trial import TrialRecord

#: Attempts between two reports of progress.
STRIDE = 50
#: Multiples of the measured palm poses for which rates with preparing are given.
MULTIPLES = (1, 10)
#: Other work on the machine disturbs CPU time less than the wall clock.
_cpu_timed = partial(timed, clock=time.process_time)


def measure(
    sources: Sequence[MeshSource],
    config: Config,
    *,
    mujoco: bool = False,
    progress: Report = silent,
) -> Iterator[dict[str, Any]]:
    """Yield the measurements of each object, see `docs/results/speed.md`.

    Args:
        sources: The meshes.
        config: The configuration to run; `candidates.max` determines the number of attempts.
        mujoco: Whether to also run all attempts in MuJoCo; needs the extra `[peer]`.
        progress: Called with the number of finished attempts and the estimated total.

    Raises:
        MeshError: If a mesh cannot be prepared.
    """
    counter = _Counter(progress, len(sources), 2 if mujoco else 1)
    for source in sources:
        yield _measure_object(source, config, mujoco, counter)


class _Counter:
    """Counts attempts for the progress bar; estimates the total from the objects so far."""

    def __init__(self, progress: Report, objects: int, runs: int) -> None:
        self._progress, self._objects, self._runs = progress, objects, runs
        self._done = self._begun = self._known = self._grasps = 0

    def begin(self, attempts: int) -> None:
        """Add the attempts of the next object."""
        self._begun += 1
        self._known += self._runs * attempts

    def add(self, outcome: Outcome) -> None:
        """Count an attempt."""
        self._done += 1
        self._grasps += outcome is Outcome.SUCCESS
        if self._done % STRIDE == 0 or self._done == self._known:
            total = self._known * self._objects // self._begun
            self._progress(self._done, total, grasps=self._grasps)


def summarize(objects: Sequence[dict[str, Any]], config: Config) -> dict[str, Any]:
    """Return the whole report: machine, versions, each object, and the sum of all objects."""
    total = {"objects": len(objects), **_sum_rates(objects)}
    if any("peer" in report for report in objects):
        total["peer"] = _sum_baseline([report["peer"] for report in objects])

    return {
        "all": total,
        "objects": list(objects),
        "peak_memory": _peak_memory(),
        "cpu": _cpu(),
        "allocator": allocator(),
        "versions": installed_versions(config),
        "config": config.to_dict(),
    }


def compare(now: dict[str, Any], then: dict[str, Any]) -> dict[str, float | None]:
    """Return the ratio of each rate to that of an earlier report; None if that was zero.

    Raises:
        DataError: If the reports differ in objects, or in the attempts of an object.
    """
    attempts = [{o["name"]: o["attempts"] for o in report["objects"]} for report in (now, then)]
    different = sorted(name for name, _ in attempts[0].items() ^ attempts[1].items())
    if different:
        raise DataError(
            f"reports must be of the same attempts to be compared, got others of {different[0]}"
        )
    keys = ("resolved_per_core_second", "grasps_per_core_hour")
    return {key: now["all"][key] / old if (old := then["all"][key]) else None for key in keys}


@one_thread
def _measure_object(
    source: MeshSource, config: Config, mujoco: bool, counter: _Counter
) -> dict[str, Any]:
    """Return the measurements of one object."""
    # Prepare the object and list its attempts, as a build does.
    seconds: dict[str, float] = {}
    with _cpu_timed(seconds, "prepare"):
        prepared = prepare(source, config)
    attempts = list_attempts(prepared, range(len(prepared.candidates)), config)
    counter.begin(len(attempts))

    # Build what all attempts share, and screen the attempts by geometry.
    with _cpu_timed(seconds, "scene"):
        scene = cached_scene(prepared.model, config.physics, config.hand_source)
        bench = TrialSetup(prepared=prepared, config=config, scene=scene)
    with _cpu_timed(seconds, "field"):
        _ = prepared.model.field
    with _cpu_timed(seconds, "screen"):
        predictions = predict_attempts(bench, attempts)

    # Simulate the remaining attempts, and render the successes.
    records: list[TrialRecord] = []
    for attempt, prediction in zip(attempts, predictions, strict=True):
        with _cpu_timed(seconds, "try"):
            records.append(try_attempt(bench, attempt, prediction))
        counter.add(records[-1].outcome)
    with _cpu_timed(seconds, "look"):
        for attempt, record in zip(attempts, records, strict=True):
            if record.outcome is Outcome.SUCCESS:
                look_at(bench, attempt, record.X_TO)

    report = {
        "name": source.name,
        "faces": len(prepared.model.collision_faces),
        "candidates": len(prepared.candidates),
        **_rates(Counter(record.outcome.label for record in records), seconds),
        "peak_memory": _peak_memory(),
    }

    # Run the same attempts in MuJoCo.
    if mujoco:
        baseline = _run_baseline(prepared, attempts, config, counter)
        theirs = baseline["grasps_per_core_hour"]
        ratio = report["grasps_per_core_hour"] / theirs if theirs else None
        report["peer"] = {**baseline, "ratio": ratio}
    return report


def _rates(outcomes: Counter[str], seconds: Mapping[str, float]) -> dict[str, Any]:
    attempts, held = sum(outcomes.values()), outcomes[Outcome.SUCCESS.label]
    spent = sum(s for stage, s in seconds.items() if stage != "prepare")
    # Ten times as many attempts cost ten times as much: docs/results/speed.md.
    prepared = {n: 3600.0 * held / (spent + seconds["prepare"] / n) for n in MULTIPLES}
    return {
        "attempts": attempts,
        "outcomes": dict(outcomes),
        "seconds": dict(seconds),
        "resolved_per_core_second": attempts / spent,
        "grasps_per_core_hour": 3600.0 * held / spent,
        "with_preparing": {str(n): rate for n, rate in prepared.items()},
    }


def _sum_rates(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    outcomes: Counter[str] = Counter()
    seconds: Counter[str] = Counter()
    for report in reports:
        outcomes.update(report["outcomes"])
        seconds.update(report["seconds"])
    return _rates(outcomes, seconds)


def _run_baseline(
    prepared: PreparedObject, attempts: Sequence[Attempt], config: Config, counter: _Counter
) -> dict[str, Any]:
    """Return the outcomes and costs of the same attempts in MuJoCo.

    Cutting the object into convex parts counts as preparation.
    """
    from drakegrasp.bench.mujoco_baseline import MujocoBaseline

    seconds: dict[str, float] = {}
    with _cpu_timed(seconds, "prepare"):
        baseline = MujocoBaseline(prepared.model, prepared.X_TO, config)
    outcomes: Counter[str] = Counter()
    for attempt in attempts:
        baseline.place(prepared.resting_poses[attempt.resting])
        with _cpu_timed(seconds, "try"):
            outcome = baseline.run(attempt).outcome
        outcomes[outcome.label] += 1
        counter.add(outcome)
    return {"parts": baseline.parts, **_rates(outcomes, seconds)}


def _sum_baseline(reports: Sequence[dict[str, Any]]) -> dict[str, Any]:
    ratios = [report["ratio"] for report in reports if report["ratio"] is not None]
    middle = median(ratios) if ratios else None
    return {**_sum_rates(reports), "median_ratio": middle, "ratios": len(ratios)}


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
