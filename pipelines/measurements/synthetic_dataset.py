"""Create a dataset of any size from a small one, to measure how costs grow with size.

\b
    python pipelines/measurements/synthetic_dataset.py SMALL OUT --objects 500

Each object is an object of SMALL under a new name, with 10,000 palm poses. These repeat the palm
poses of SMALL, in another order each time, with the colour of the new name. Shards are written as a
build writes them. The first copy of an object is made from rows, and the other copies from the
shards of the first. The files are not assembled: the next command is `drakegrasp assemble OUT`.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, read_manifest, write_manifest
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared, save_prepared
from drakegrasp.dataset.shards import Shard, ShardHeader, read_shard, write_shard
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.simulation.conditions import draw_conditions

#: Columns of attempts, and of looks at successes.
Rows = tuple[dict[str, AnyArray], dict[str, AnyArray]]


@click.command(help=__doc__)
@click.argument("small", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--objects", type=int, default=50, show_default=True, help="Number of objects.")
@click.option(
    "--different", type=int, default=25, show_default=True, help="Objects that are made from rows."
)
@click.option(
    "--candidates", type=int, default=10_000, show_default=True, help="Palm poses per object."
)
@click.option("--unit", type=int, help="Palm poses in a work unit.  [default: as in a build]")
def main(
    small: Path, out: Path, objects: int, different: int, candidates: int, unit: int | None
) -> None:
    """Run the script."""
    source = read_manifest(small)
    overrides = [f"candidates.max={candidates}", f"unit_candidates={unit or 'null'}"]
    config = override_config(source.config, overrides)

    # Objects of SMALL, taken evenly from its classes.
    entries = source.objects[:: max(1, len(source.objects) // different)][:different]
    names = [f"{i:05d}_{entries[i % len(entries)].name}" for i in range(objects)]
    manifest = replace(source, config=config, objects=(), refused=(), rejected=())
    made: list[ObjectEntry] = []
    with progress_bar("make", "objects") as progress:
        for i, name in enumerate(names):
            entry = entries[i % len(entries)]
            prepared = repeated(load_prepared(small, entry.name, source.config), name, candidates)
            save_prepared(prepared, out, config)
            made.append(prepared.entry())
            headers = list(replace(manifest, objects=(made[-1],)).headers())
            if i < len(entries):
                rows, drawn_rows = load_rows(small, source, entry), drawn(entry.candidates, i)
                shards = (shard_of_rows(header, rows, drawn_rows) for header in headers)
            else:
                first = names[i % len(entries)]
                shards = (copy_of_shard(out, header, first) for header in headers)
            looks = draw_conditions(prepared.model, config, 0, 0).values()
            for shard in shards:
                write_shard(out, with_colour(shard, looks["object_colour"]))
            progress(i + 1, objects)
    write_manifest(replace(manifest, objects=tuple(made)), out)


def repeated(prepared: PreparedObject, name: str, count: int) -> PreparedObject:
    """Return an object under another name, whose palm poses are repeated up to a number."""
    candidates = prepared.candidates
    rows = np.arange(count) % len(candidates)
    columns = ("X_OG", "distance", "resting", "source")
    return replace(
        prepared,
        model=replace(prepared.model, name=name),
        candidates=replace(candidates, **{key: getattr(candidates, key)[rows] for key in columns}),
    )


def load_rows(small: Path, source: Manifest, entry: ObjectEntry) -> Rows:
    """Return the columns of all attempts of an object, and those of its looks."""
    own = [header for header in source.headers() if header.object_name == entry.name]
    shards = [read_shard(header.path(small), header) for header in own]
    return joined([dict(shard.trials) for shard in shards]), joined(
        [dict(shard.looks) for shard in shards]
    )


def shard_of_rows(header: ShardHeader, rows: Rows, order: Iterator[int]) -> Shard:
    """Return a shard with rows of another object; the order in each round is random."""
    trials, looks = rows
    success = np.flatnonzero(trials["outcome"] == Outcome.SUCCESS)
    look_of = {int(row): k for k, row in enumerate(success)}

    # Each round has another order, so that a column does not compress well by repeating itself.
    standoffs = int(trials["standoff_index"].max()) + 1
    poses = np.array([next(order) for _ in range(header.stop - header.start)])
    chosen = (poses[:, None] * standoffs + np.arange(standoffs)).ravel()
    columns = {name: values[chosen] for name, values in trials.items()}
    columns["candidate"] = np.repeat(
        np.arange(header.start, header.stop, dtype=np.int32), standoffs
    )
    hits = np.flatnonzero(columns["outcome"] == Outcome.SUCCESS)
    places = [look_of[int(row)] for row in chosen[hits]]
    seen = {name: values[places] for name, values in looks.items()}
    seen["row"] = hits.astype(np.int32)
    return Shard(header=header, trials=columns, looks=seen)


def drawn(count: int, seed: int) -> Iterator[int]:
    """Yield the numbers below `count` endlessly, in another order each round."""
    generator = np.random.default_rng(seed)
    while True:
        yield from generator.permutation(count).tolist()


def copy_of_shard(out: Path, header: ShardHeader, first: str) -> Shard:
    """Return the shard of the first copy of an object, with the header of another copy."""
    own = replace(header, object_name=first)
    return replace(read_shard(own.path(out)), header=header)


def with_colour(shard: Shard, colour: AnyArray) -> Shard:
    """Return a shard whose object has the given colour (3,)."""
    column = np.array(shard.trials["object_colour"])
    column[:] = colour
    return replace(shard, trials={**shard.trials, "object_colour": column})


def joined(parts: list[dict[str, AnyArray]]) -> dict[str, AnyArray]:
    """Return the concatenated columns of several tables."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


if __name__ == "__main__":
    main()
