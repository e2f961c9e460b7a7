"""How long the stages of a build take: measured once, measured by the user, or by the log.

Out: `StageTimes`, from which `drakegrasp.generation.estimate` makes a plan.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from drakegrasp.config import Config, NonNegative, NonNegativeCount
from drakegrasp.dataset.log import FILE_NAME, read_log
from drakegrasp.errors import DataError, counted, one_line
from drakegrasp.foreign_files import read_json
from drakegrasp.outcomes import Outcome


@dataclass(frozen=True, kw_only=True)
class StageTimes:
    """How long the stages take on one core on average, and what they leave on the disk.

    Attributes:
        prepare: Repairing, settling and sampling an object [s].
        scene: Building an object's scene and distance field, on each worker that needs it [s].
        attempt: An attempt, over all outcomes [s].
        look: Both images of a success [s].
        survey: Reading shards before the files are assembled, per attempt [s].
        pack: Packing rows and samples, per attempt [s].
        put: What one process does of assembling, however many workers there are, per attempt [s].
        successes: Share of the attempts that succeed.
        samples: Share of the successes that the filters keep.
        unit_bytes: Of a shard without rows [B].
        attempt_bytes: Of a row of a failed attempt, in its shard and in trials.hdf5 [B].
        success_bytes: What a success adds to its shard [B].
        sample_bytes: Of a row, in grasping_oto.hdf5 and grasping_otm.hdf5 together [B].
        object_bytes: Of an object's own files [B].
        source: Where the figures are from, for the reader.
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


#: By the log and the files of thirty G3DB meshes with 400 palm poses each (34,800 attempts, preset
#: `paper`, Drake 1.51.1, 2026-11-22) on two workers; files by `measure_storage` of
#: `pipelines/measurements/measure_stages.py`. Assembling, and the bytes of a unit, by 1.5 million
#: attempts of `pipelines/measurements/synthetic_dataset.py`.
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
    source="measured on 30 G3DB meshes, preset paper; --times for those of your own",
)


def read_times(path: Path) -> StageTimes:
    """Return the stage times that `pipelines/measurements/measure_stages.py` printed to a file.

    Raises:
        DataError: If it holds anything else.
    """
    try:
        return TypeAdapter(StageTimes).validate_python(read_json(path), strict=False)
    except (OSError, ValueError) as error:
        raise DataError(
            f"{path}: must be the output of pipelines/measurements/measure_stages.py, "
            f"got other ({one_line(error)})"
        ) from None


class _Unit(BaseModel):
    """What the log says of a unit that was simulated."""

    model_config = ConfigDict(strict=True)
    object: str
    outcomes: dict[str, NonNegativeCount]
    seconds: Annotated[dict[str, NonNegative], Field(min_length=1)]


def _unit_of(event: dict[str, Any]) -> _Unit | None:
    """Return a unit of the log; None for one that was done before, and what no build writes."""
    try:
        return _Unit.model_validate(event)
    except ValidationError:
        return None


def logged_times(out: Path, config: Config) -> StageTimes | None:
    """Return the mean times of a build's units so far, by its log, or None if none is done.

    What a log does not tell, e.g. the sizes of files, is as in `MEASURED`. The log has wall-clock
    times: other work of the machines is in them.

    Args:
        out: Directory of the dataset.
        config: Only units of this configuration count.
    """
    # Add up the units of builds with this configuration.
    seconds: Counter[str] = Counter()
    outcomes: Counter[str] = Counter()
    objects = set()
    ours = False
    for event in read_log(out):
        if event["event"] == "started":
            ours = event.get("config_hash") == config.simulation_hash()
        elif ours and event["event"] == "unit done" and (unit := _unit_of(event)) is not None:
            seconds.update(unit.seconds)
            outcomes.update(unit.outcomes)
            objects.add(unit.object)

    # Their means; the log may have none.
    attempts, successes = outcomes.total(), outcomes[Outcome.SUCCESS.label]
    if not attempts:
        return None
    return replace(
        MEASURED,
        attempt=(seconds["try"] + seconds["measure"] + seconds["write"]) / attempts,
        look=seconds["look"] / successes if successes else MEASURED.look,
        successes=successes / attempts,
        source=f"{counted(attempts, 'attempt')} of {counted(len(objects), 'object')} in "
        f"{out / FILE_NAME}",
    )
