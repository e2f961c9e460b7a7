"""Estimates the hours, core-hours and bytes of a build before it is started.

Input: the number of objects, the configuration, the number of workers, and the mean time of each
stage. Output: for each stage, the number of tasks of the busiest worker times the mean time of a
task.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from drakegrasp.config import Config, NonNegative, NonNegativeCount
from drakegrasp.dataset.assembly.pack import TASK_ROWS
from drakegrasp.dataset.lock import LOG_FILE, read_log
from drakegrasp.errors import ConfigError, DataError, counted, one_line
from drakegrasp.foreign_files import read_json
from drakegrasp.generation.request import BUILTIN, BuildRequest, refuse_unknown
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import available_cores
from drakegrasp.shapes.catalog import draw_builtin

#: Time of the scheduler and the client for one task [s], which limits the rate of tasks; measured
#: with distributed 2026.8 on two cores.
TASK_SECONDS = 0.003
#: One simulation of `certify` [s]: twice the mean of 48 successes on ten G3DB meshes.
CERTIFY_SECONDS = 1.0
#: Time until a worker has imported Drake and takes its first task [s].
START_SECONDS = 5.0


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The expected size and duration of a build.

    Attributes:
        objects: Number of objects.
        attempts: Number of attempts.
        units: Number of work units.
        workers: Number of workers.
        stages: Wall-clock time of each stage: start, prepare, simulate, assemble [s].
        samples: Expected number of rows of the data files.
        bytes: Expected size of the directory [B].
        source: Source of the times.
    """

    objects: int
    attempts: int
    units: int
    workers: int
    stages: dict[str, float]
    samples: int
    bytes: float
    source: str

    @property
    def seconds(self) -> float:
        """Wall-clock time from start to end [s]."""
        return sum(self.stages.values())

    @property
    def hours(self) -> float:
        """Hours from start to end."""
        return self.seconds / 3600.0

    @property
    def core_hours(self) -> float:
        """Total worker-hours, including idle time, as requested from a cluster."""
        return self.workers * self.hours


#: Maximum number of workers and of objects, larger than in any build.
MOST_WORKERS = 1_000_000


def plan_build(objects: int, config: Config, workers: int, times: StageTimes) -> Plan:
    """Return the expected size and duration of building objects from the beginning.

    The work is never more than estimated: each object is assumed to have the largest number of
    candidates, and `max_grasps` to stop no object early.

    Raises:
        ConfigError: If there is no object or no worker.
    """
    for name, count in (("objects", objects), ("workers", workers)):
        if count < 1:
            raise ConfigError(f"{name} must be at least 1, got {count}")
        if count > MOST_WORKERS:
            raise ConfigError(f"{name} must be at most {MOST_WORKERS:,}, got {count}")

    # The amount of work.
    ranges = tuple(config.unit_ranges(config.candidates.max))
    units = objects * len(ranges)
    standoffs = len(config.candidates.standoffs)
    attempts = objects * config.candidates.max * standoffs
    successes = attempts * times.successes
    samples = successes * times.samples

    # The mean attempt, and the scenes: all workers that share an object's units build its scene.
    attempt = times.attempt + times.successes * (times.look + _certify_seconds(config))
    scenes = objects * min(workers, len(ranges))
    longest = standoffs * max(map(len, ranges)) * attempt

    # Assembling has one task per object, and then one task per block of rows. Meanwhile one process
    # writes the packed rows to the files.
    survey = _shared(objects, workers, attempts / objects * times.survey)
    pack = _shared(math.ceil(attempts / TASK_ROWS), workers, TASK_ROWS * times.pack)

    return Plan(
        objects=objects,
        attempts=attempts,
        units=units,
        workers=workers,
        stages={
            "start": START_SECONDS,
            "prepare": _shared(objects, workers, times.prepare),
            "simulate": max(_shared(units, workers, attempts / units * attempt), longest)
            + math.ceil(scenes / workers) * times.scene,
            "assemble": survey + max(pack, attempts * times.put),
        },
        samples=round(samples),
        bytes=(
            objects * times.object_bytes
            + units * times.unit_bytes
            + attempts * times.attempt_bytes
            + successes * times.success_bytes
            + samples * times.sample_bytes
        ),
        source=times.source,
    )


def plan_request(
    request: BuildRequest, workers: int | None = None, times: StageTimes | None = None
) -> Plan:
    """Return the expected size and duration of a requested build.

    Args:
        request: The requested build.
        workers: Number of workers; one per core of this machine if None.
        times: Times of the stages; if None, those measured with a similar configuration.

    Raises:
        MeshError: If there is no mesh, or `only` has a name that no object has.
        ConfigError: If the number of workers is less than 1.
    """
    if request.objects == BUILTIN:
        names = [each.name for each in draw_builtin(request.config.builtin)]
    else:
        meshes = find_meshes(request.objects, units=request.units, manifest=request.manifest)
        names = [mesh.name for mesh in meshes]
    refuse_unknown(request.only, names)
    objects = len(set(request.only or names))
    count = available_cores() if workers is None else workers
    return plan_build(objects, request.config, count, times or measured_times(request.config))


def plan_lines(plan: Plan) -> list[str]:
    """Return the lines that are printed for a plan."""
    stages = ", ".join(f"{name} {_duration(seconds)}" for name, seconds in plan.stages.items())
    return [
        f"from the beginning: {counted(plan.objects, 'object')}, "
        f"{counted(plan.attempts, 'attempt')} in {counted(plan.units, 'work unit')}",
        f"expected {_duration(plan.seconds)} on {counted(plan.workers, 'worker')} ({stages})",
        f"expected {plan.core_hours:,.2f} core-hours",
        f"expected {counted(plan.samples, 'sample')}, {_size(plan.bytes)} on disk",
        f"times and sizes: {plan.source}",
    ]


def _shared(tasks: int, workers: int, seconds: float) -> float:
    """Return the time of workers for tasks of equal length [s]; Dask limits the rate of tasks."""
    return max(math.ceil(tasks / workers) * seconds, tasks * TASK_SECONDS)


def _certify_seconds(config: Config) -> float:
    """Return the mean time of certifying per success [s]; other lifts are not counted."""
    rules = config.certify
    simulations = rules.repeats + rules.friction_steps + 1 if config.certified else 0
    return CERTIFY_SECONDS * rules.share * simulations


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


@dataclass(frozen=True, kw_only=True)
class StageTimes:
    """Mean times of the stages on one core, and sizes of their files.

    Attributes:
        prepare: Time for repairing, settling and sampling an object [s].
        scene: Time for building an object's scene and distance field, on each worker that needs
            them [s].
        attempt: Mean time of an attempt over all outcomes [s].
        look: Time for both images of a success [s].
        survey: Time for reading shards before the files are assembled, per attempt [s].
        pack: Time for packing rows and samples, per attempt [s].
        put: Time for the part of assembling that always runs in one process, per attempt [s].
        successes: Fraction of the attempts that succeed.
        samples: Fraction of the successes that the filters keep.
        unit_bytes: Size of a shard without rows [B].
        attempt_bytes: Size of a failed attempt's row, in its shard and in trials.hdf5 [B].
        success_bytes: Size that a success adds to its shard [B].
        sample_bytes: Size of a row in grasping_oto.hdf5 and grasping_otm.hdf5 together [B].
        object_bytes: Size of the files of an object [B].
        source: Source of the figures, for the reader.
    """

    prepare: NonNegative
    scene: NonNegative
    attempt: NonNegative
    look: NonNegative
    survey: NonNegative
    pack: NonNegative
    put: NonNegative
    successes: NonNegative
    samples: NonNegative
    unit_bytes: NonNegative
    attempt_bytes: NonNegative
    success_bytes: NonNegative
    sample_bytes: NonNegative
    object_bytes: NonNegative
    source: str


#: Measured with the log and the files of thirty G3DB meshes with 400 palm poses each (34,800
#: attempts, preset `paper`, Drake 1.51.1, 2026-11-22) on two workers. The sizes of files were
#: measured by `measure_storage` of `pipelines/measurements/measure_stages.py`. Assembling and the
#: bytes of a unit were measured with 1.5 million attempts of
#: `pipelines/measurements/synthetic_dataset.py`.
MEASURED = StageTimes(
    prepare=3.2,
    scene=0.4,
    attempt=0.018,
    look=0.039,
    survey=14e-6,
    pack=21e-6,
    put=2.0e-6,
    successes=0.0101,
    samples=0.43,
    unit_bytes=27e3,
    attempt_bytes=278.0,
    success_bytes=66e3,
    sample_bytes=71e3,
    object_bytes=215e3,
    source="measured on 30 G3DB meshes with the preset paper; --times FILE uses your own",
)


#: Measured with four built-in objects with 24 palm poses each (288 attempts, with refined palm
#: poses about their samples; 26 samples; 51 s on one core; preset `fast`, 2026-11-27). All other
#: values are those of `MEASURED`.
FAST = replace(
    MEASURED,
    attempt=0.064,
    successes=0.17,
    samples=0.30,
    source="measured on 4 built-in objects with the preset fast; --times FILE uses your own",
)


def measured_times(config: Config) -> StageTimes:
    """Return the times that were measured with a preset similar to a configuration."""
    return FAST if "above" in config.candidates.method else MEASURED


def read_times(path: Path) -> StageTimes:
    """Return the stage times that `pipelines/measurements/measure_stages.py` printed to a file.

    Raises:
        DataError: If the file holds anything else.
    """
    try:
        return TypeAdapter(StageTimes).validate_python(read_json(path), strict=False)
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path}: must be the output of pipelines/measurements/measure_stages.py, "
            f"got other ({one_line(error)})"
        ) from None


class _Unit(BaseModel):
    """The log's entry of a simulated unit."""

    model_config = ConfigDict(strict=True)
    object: str
    outcomes: dict[str, NonNegativeCount]
    seconds: Annotated[dict[str, NonNegative], Field(min_length=1)]


def _unit_of(event: dict[str, Any]) -> _Unit | None:
    """Return a simulated unit of the log; None for a reused unit and for an invalid entry."""
    try:
        return _Unit.model_validate(event)
    except ValidationError:
        return None


def logged_times(out: Path, config: Config) -> StageTimes | None:
    """Return the mean times of the units in a build's log, or None if the log has no attempts.

    Values that a log does not state, e.g. the sizes of files, are those of `measured_times`. The
    log has wall-clock times, so other load of the machines increases them.

    Args:
        out: Directory of the dataset.
        config: Only units of this configuration count.
    """
    # Add up the units of builds with this configuration.
    seconds: Counter[str] = Counter()
    outcomes: Counter[str] = Counter()
    objects, base = set(), measured_times(config)
    ours = False
    for event in read_log(out):
        if event["event"] == "started":
            ours = event.get("config_hash") == config.simulation_hash()
        elif ours and event["event"] == "unit done" and (unit := _unit_of(event)) is not None:
            seconds.update(unit.seconds)
            outcomes.update(unit.outcomes)
            objects.add(unit.object)

    # Compute their means; the log may have no attempts.
    attempts, successes = outcomes.total(), outcomes[Outcome.SUCCESS.label]
    if not attempts:
        return None
    return replace(
        base,
        attempt=(seconds["try"] + seconds["measure"] + seconds["write"]) / attempts,
        look=seconds["look"] / successes if successes else base.look,
        successes=successes / attempts,
        source=f"{counted(attempts, 'attempt')} of {counted(len(objects), 'object')} in "
        f"{out / LOG_FILE}",
    )
