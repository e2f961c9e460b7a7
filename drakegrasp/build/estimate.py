"""What a build will take: hours, core-hours and bytes, before it is started.

In: the number of objects, the configuration, the number of workers, and how long each stage
takes. Out: the same schedule that `build` would follow, played through without doing the
work. Stages follow one another; within one, the next task goes to the next free worker.
"""

from __future__ import annotations

import heapq
import json
import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import h5py

from drakegrasp.build.request import BUILTIN, BuildRequest
from drakegrasp.config import Config
from drakegrasp.dataset.log import FILE_NAME, read_log
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.objects.builtin.catalog import BUILTIN_OBJECTS
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome

#: Time that the scheduler and the client spend on a task, one after the other [s]; measured
#: with distributed 2026.8 on two cores.
TASK_SECONDS = 0.003
#: One simulation of `certify` [s]: twice the mean of 48 successes on ten G3DB meshes.
CERTIFY_SECONDS = 1.0
#: Objects whose scenes a worker keeps, see `attempts`.
KEPT_OBJECTS = 2
#: Until a worker has imported Drake and takes its first task [s].
START_SECONDS = 5.0
#: Spreads any number of objects evenly over the measured shares, without a random draw.
GOLDEN = 0.6180339887498949


@dataclass(frozen=True, kw_only=True)
class StageTimes:
    """How long the stages take on one core, and what they leave on the disk.

    Attributes:
        prepare: Mending, settling and sampling an object [s].
        scene: Building an object's diagrams and distance field, once per worker that meets it [s].
        attempt: An attempt, on average over all outcomes [s].
        shares: How much longer than that attempts of an object take, from the quickest object
            to the slowest; their mean is 1.
        look: Both images of a success [s].
        assemble: Filters and files, per attempt, on one core [s].
        successes: Share of the attempts that succeed.
        samples: Share of the successes that the filters leave.
        unit_bytes: Of a shard without rows [B].
        attempt_bytes: Of a row of a failed attempt, in its shard and in trials.hdf5 [B].
        success_bytes: What a success adds to its shard [B].
        sample_bytes: Of a row, in grasping_oto.hdf5 and grasping_otm.hdf5 together [B].
        object_bytes: Of an object's own files [B].
        source: Where the figures are from, for the reader.
    """

    prepare: float
    scene: float
    attempt: float
    shares: tuple[float, ...]
    look: float
    assemble: float
    successes: float
    samples: float
    unit_bytes: float
    attempt_bytes: float
    success_bytes: float
    sample_bytes: float
    object_bytes: float
    source: str


#: By the log and the files of thirty G3DB meshes with 300 palm poses each (27,000 attempts, preset
#: `paper`, Drake 1.51.1) on two workers; preparing and assembling by
#: `pipelines/measurements/measure_stages.py`.
MEASURED = StageTimes(
    prepare=3.2,
    scene=0.3,
    attempt=0.011,
    shares=(0.05, 0.23, 0.45, 0.7, 0.93, 1.01, 1.13, 1.36, 1.67, 2.45),
    look=0.029,
    assemble=0.0005,
    successes=0.0087,
    samples=0.88,
    unit_bytes=136e3,
    attempt_bytes=260.0,
    success_bytes=67e3,
    sample_bytes=82e3,
    object_bytes=124e3,
    source="measured on 30 G3DB meshes, preset paper; --times for those of your own",
)


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What a build is expected to take.

    Attributes:
        objects, attempts, units, workers: How many.
        seconds: From start to end [s].
        stages: The same by stage: start, prepare, simulate, assemble [s].
        busy: Share of the workers' time in which they work, until the files are assembled.
        samples: Expected rows of the data files.
        bytes: Expected size of the directory [B].
        source: Where the times are from.
    """

    objects: int
    attempts: int
    units: int
    workers: int
    seconds: float
    stages: dict[str, float]
    busy: float
    samples: int
    bytes: float
    source: str

    @property
    def hours(self) -> float:
        """Hours from start to end."""
        return self.seconds / 3600.0

    @property
    def core_hours(self) -> float:
        """Hours of all workers together, waiting included: what a cluster is asked for."""
        return self.workers * self.hours


def plan_build(objects: int, config: Config, workers: int, times: StageTimes) -> Plan:
    """Return what the build of some objects is expected to take.

    It is what a build from nothing takes if every object has as many candidates as it may
    have, and if no object is cut short by `max_grasps`: never less than what will be done.

    Raises:
        ConfigError: If there is no object or no worker.
    """
    for name, count in (("objects", objects), ("workers", workers)):
        if count < 1:
            raise ConfigError(f"{name} must be at least 1, got {count}")
    prepare = _run([times.prepare] * objects, [0.0] * workers)
    tasks = _units(objects, config, times)
    simulate, work = _run_units(tasks, workers, times.scene)
    attempts = objects * config.candidates.max * len(config.candidates.standoffs)
    stages = {
        "start": START_SECONDS,
        "prepare": prepare,
        "simulate": simulate,
        "assemble": attempts * times.assemble,
    }
    spent = times.prepare * objects + work
    return Plan(
        objects=objects,
        attempts=attempts,
        units=len(tasks),
        workers=workers,
        seconds=sum(stages.values()),
        stages=stages,
        busy=spent / (workers * (prepare + simulate)),
        samples=round(attempts * times.successes * times.samples),
        bytes=_bytes(objects, len(tasks), attempts, times),
        source=times.source,
    )


def plan_request(
    request: BuildRequest, workers: int | None = None, times: StageTimes | None = None
) -> Plan:
    """Return what a build that was asked for is expected to take.

    Args:
        request: What is to be built.
        workers: One per core of this machine if None.
        times: Of the stages; `MEASURED` if None.

    Raises:
        MeshError: If there is no mesh.
        ConfigError: If there is no worker.
    """
    if request.objects == BUILTIN:
        objects = len(BUILTIN_OBJECTS)
    else:
        meshes = find_meshes(request.objects, units=request.units, manifest=request.manifest)
        objects = len(meshes)
    count = len(os.sched_getaffinity(0)) if workers is None else workers
    return plan_build(objects, request.config, count, times or MEASURED)


def read_times(path: Path) -> StageTimes:
    """Return the stage times that `pipelines/measurements/measure_stages.py` printed to a file.

    Raises:
        DataError: If it holds anything else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return StageTimes(**{**content, "shares": tuple(content["shares"])})
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path}: must be the output of pipelines/measurements/measure_stages.py, "
            f"got other ({error})"
        ) from None


def logged_times(out: Path, config: Config) -> StageTimes | None:
    """Return the times of a build's units so far, by its log, or None if none is done.

    What a log does not tell, as the sizes of files, is as in `MEASURED`; its clock is that of
    the wall, so whatever else the machines had to do is in it.

    Args:
        out: Directory of the dataset.
        config: Whose units count.
    """
    seconds: Counter[str] = Counter()
    by_object: dict[str, Counter[str]] = {}
    ours = False
    for event in read_log(out):
        if event["event"] == "started":
            ours = event["config_hash"] == config.simulation_hash()
        # A unit that was found done has no seconds.
        elif ours and event["event"] == "unit done" and event["seconds"]:
            found = by_object.setdefault(event["object"], Counter())
            found.update(attempts=sum(event["outcomes"].values()), seconds=event["seconds"]["try"])
            seconds.update(event["seconds"])
            seconds.update(success=event["outcomes"].get(Outcome.SUCCESS.label, 0))
    attempts = sum(found["attempts"] for found in by_object.values())
    if not attempts:
        return None
    one = seconds["try"] / attempts
    shares = sorted(found["seconds"] / found["attempts"] / one for found in by_object.values())
    look = seconds["look"] / seconds["success"] if seconds["success"] else MEASURED.look
    return replace(
        MEASURED,
        attempt=(seconds["try"] + seconds["write"]) / attempts,
        shares=tuple(shares),
        look=look,
        successes=seconds["success"] / attempts,
        source=f"{attempts:,} attempts of {len(by_object)} objects in {out / FILE_NAME}",
    )


def plan_lines(plan: Plan) -> list[str]:
    """Return a plan as the lines that are printed."""
    stages = ", ".join(f"{name} {_duration(seconds)}" for name, seconds in plan.stages.items())
    return [
        f"from the beginning: {plan.objects:,} objects, {plan.attempts:,} attempts "
        f"in {plan.units:,} work units",
        f"expected {_duration(plan.seconds)} on {plan.workers:,} workers "
        f"({stages}; {100 * plan.busy:.0f}% busy)",
        f"expected {plan.core_hours:,.2f} core-hours",
        f"expected {plan.samples:,} samples, {_size(plan.bytes)} on disk",
        f"times and sizes: {plan.source}",
    ]


def measure_storage(out: Path) -> dict[str, float]:
    """Return the sizes that `StageTimes` has, of a finished dataset [B].

    Raises:
        DataError: If there is none.
    """
    try:
        with h5py.File(out / TRIALS_FILE, "r") as file:
            attempts, successes = len(file["trials/outcome"]), len(file["successes/trial_id"])
            objects = len(file["objects/name"])
        with h5py.File(out / DATA_FILES["oto"], "r") as file:
            samples = sum(len(split["grasps"]) for split in file.values() if "grasps" in split)
        trials = (out / TRIALS_FILE).stat().st_size
        data = sum((out / name).stat().st_size for name in DATA_FILES.values())
    except (OSError, KeyError) as error:
        raise DataError(f"{out}: must be a finished dataset, got none ({error})") from None
    shards = list((out / "shards").rglob("*.h5"))
    rows = sum(_stored_bytes(path, "trials") for path in shards)
    looks = sum(_stored_bytes(path, "looks") for path in shards)
    rest = sum(path.stat().st_size for path in shards) - rows - looks
    kept = sum(path.stat().st_size for path in (out / "objects").iterdir())
    return {
        "unit_bytes": rest / len(shards),
        "attempt_bytes": (trials + rows) / attempts,
        "success_bytes": looks / max(1, successes),
        "sample_bytes": data / max(1, samples),
        "object_bytes": kept / objects,
    }


def _stored_bytes(path: Path, group: str) -> int:
    with h5py.File(path, "r") as file:
        return sum(int(column.id.get_storage_size()) for column in file[group].values())


def _bytes(objects: int, units: int, attempts: int, times: StageTimes) -> float:
    successes = attempts * times.successes
    return (
        objects * times.object_bytes
        + units * times.unit_bytes
        + attempts * times.attempt_bytes
        + successes * (times.success_bytes + times.samples * times.sample_bytes)
    )


def _units(objects: int, config: Config, times: StageTimes) -> list[tuple[int, float]]:
    """Return object and seconds of every work unit, without the building of its scene."""
    step, candidates = config.unit_candidates, config.candidates.max
    look = times.successes * (times.look + _certify_seconds(config))
    units = []
    for i in range(objects):
        share = times.shares[int(i * GOLDEN % 1.0 * len(times.shares))]
        one = len(config.candidates.standoffs) * (times.attempt * share + look)
        units += [(i, one * min(step, candidates - k)) for k in range(0, candidates, step)]
    return units


def _certify_seconds(config: Config) -> float:
    """Return how long certifying a success takes [s]."""
    rules = config.certify
    trials = rules.repeats + rules.friction_steps + 1 if rules.repeats else 0
    return CERTIFY_SECONDS * trials


def _run(tasks: Iterable[float], free: list[float]) -> float:
    """Return when tasks are done that go, in their order, each to the next free worker."""
    heapq.heapify(free)
    for k, seconds in enumerate(tasks):
        start = max(free[0], k * TASK_SECONDS)
        heapq.heapreplace(free, start + seconds)
    return max(free)


def _run_units(units: list[tuple[int, float]], workers: int, scene: float) -> tuple[float, float]:
    """Return when all units are done, and how long all workers together worked on them [s]."""
    free = [(0.0, worker) for worker in range(workers)]
    kept: list[list[int]] = [[] for _ in range(workers)]
    work = 0.0
    for k, (thing, seconds) in enumerate(units):
        at, worker = free[0]
        if thing not in kept[worker]:
            kept[worker] = [*kept[worker], thing][-KEPT_OBJECTS:]
            seconds += scene
        work += seconds
        heapq.heapreplace(free, (max(at, k * TASK_SECONDS) + seconds, worker))
    return max(at for at, _ in free), work


def _duration(seconds: float) -> str:
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:,.1f} {unit}"
    return f"{seconds:.0f} s"


def _size(size: float) -> str:
    for unit, length in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if size >= length:
            return f"{size / length:.1f} {unit}"
    return f"{size / 1e3:.0f} kB"
