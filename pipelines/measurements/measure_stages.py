"""Measure the seconds and bytes of every stage of a build on some meshes.

\b
    python pipelines/measurements/measure_stages.py MESH_DIR OUT --candidates 20 > times.json
    drakegrasp build --objects MESH_DIR ... --plan --times times.json

The script builds a small dataset in this process alone, so that no other worker disturbs the times.
The defaults of `drakegrasp.generation.estimate` were measured with it.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
import h5py

from drakegrasp.cli.options import shared
from drakegrasp.dataset.assembly.pack import pack_rows
from drakegrasp.dataset.assembly.survey import survey_object
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.statistics import count_splits
from drakegrasp.errors import DataError
from drakegrasp.generation.estimate import StageTimes
from drakegrasp.generation.pipeline import build
from drakegrasp.generation.prepare import prepare_one
from drakegrasp.generation.work_unit import UnitSummary
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome


class Clock:
    """An executor that stores the time and the result of every task."""

    def __init__(self) -> None:
        self.prepare: list[float] = []
        self.units: list[UnitSummary] = []
        self.assembling: defaultdict[str, float] = defaultdict(float)
        self.last = 0.0

    def __call__(self, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        """Yield function(item) of every item, in order."""
        for item in items:
            start = time.perf_counter()
            result = function(item)
            end = time.perf_counter()
            if function is prepare_one:
                self.prepare.append(end - start)
            elif isinstance(result, UnitSummary):
                self.units.append(result)
                self.last = end
            else:
                self.assembling[function.__name__] += end - start
            yield result


@click.command(help=__doc__)
@click.argument("meshes", type=click.Path(path_type=Path, exists=True))
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--config", "config_name", metavar="YAML|PRESET", help="Configuration.  [default: paper]"
)
@shared("--set")
@click.option(
    "--candidates", type=int, default=20, show_default=True, help="Palm poses per object."
)
@shared("--units", "--manifest")
def main(
    meshes: Path,
    out: Path,
    config_name: str | None,
    overrides: tuple[str, ...],
    candidates: int,
    units: str,
    manifest: Path | None,
) -> None:
    """Run the script."""
    sources = find_meshes(meshes, units=units, manifest=manifest)
    config = load_config(config_name, [*overrides, f"candidates.max={candidates}"])
    clock, begin, begin_cpu = Clock(), time.perf_counter(), time.process_time()
    build(sources, out, config, clock, show=False)
    end = time.perf_counter()

    # Wall-clock time includes waiting for other processes; CPU time counts only this process.
    core = (time.process_time() - begin_cpu) / (end - begin)
    times = stage_times(clock, core, assembled=end - clock.last, out=out)
    click.echo(json.dumps(asdict(times), indent=1))


def stage_times(clock: Clock, core: float, *, assembled: float, out: Path) -> StageTimes:
    """Return the seconds of each stage of a build.

    Args:
        clock: Wall-clock times of the tasks.
        core: CPU time of this process per wall-clock time.
        assembled: Time from the last unit to the end [s].
        out: Directory of the dataset.
    """
    # Sum over all units.
    outcomes: Counter[Outcome] = Counter()
    seconds: Counter[str] = Counter()
    for unit in clock.units:
        outcomes.update(unit.outcomes)
        seconds.update({stage: core * spent for stage, spent in unit.seconds.items()})

    attempts, successes = sum(outcomes.values()), outcomes[Outcome.SUCCESS]
    samples = sum(split.samples for split in count_splits(out))
    objects = len(read_manifest(out).objects)

    return StageTimes(
        prepare=core * sum(clock.prepare) / len(clock.prepare),
        scene=seconds["build"] / objects,
        attempt=(seconds["try"] + seconds["measure"] + seconds["write"]) / attempts,
        look=seconds["look"] / max(1, successes),
        survey=core * clock.assembling[survey_object.__name__] / attempts,
        pack=core * clock.assembling[pack_rows.__name__] / attempts,
        put=core * (assembled - sum(clock.assembling.values())) / attempts,
        successes=successes / attempts,
        samples=samples / max(1, successes),
        **measure_storage(out),
        source=f"measured on {objects} objects, {attempts} attempts",
    )


def measure_storage(out: Path) -> dict[str, float]:
    """Return the sizes in `StageTimes` for a finished dataset [B].

    Raises:
        DataError: If there is no finished dataset.
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


if __name__ == "__main__":
    main()
