"""Make a dataset of any size out of a small one, to measure what size costs.

\b
    python pipelines/measurements/synthetic_dataset.py SMALL OUT --objects 500

Each object is one of SMALL under a new name, with 10,000 palm poses: those of SMALL again and
again, in another order each time. Shards are written as a build writes them; the first copies of an
object are made from rows, the others from its shards. The files are not
assembled: the next command is `drakegrasp assemble OUT`. `drakegrasp check OUT` finds nothing.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import click
import h5py
import numpy as np

from drakegrasp.config import override_config
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, read_manifest, write_manifest
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared, save_prepared
from drakegrasp.dataset.shards import Shard, ShardHeader, read_shard, write_shard
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import seal
from drakegrasp.runtime.progress import progress_bar


@click.command(help=__doc__)
@click.argument("small", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("out", type=click.Path(path_type=Path))
@click.option("--objects", type=int, default=50, show_default=True, help="Number of objects.")
@click.option(
    "--different", type=int, default=25, show_default=True, help="Of these made from rows."
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

    # Objects whose attempts are complete in SMALL, evenly over its classes.
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
                write_from_rows(out, headers, small, source, entry, i)
            else:
                copy_shards(out, headers, names[i % len(entries)])
            progress(i + 1, objects)
    write_manifest(replace(manifest, objects=tuple(made)), out)


def repeated(prepared: PreparedObject, name: str, count: int) -> PreparedObject:
    """Return an object under another name, with its palm poses in turn up to a number."""
    candidates = prepared.candidates
    rows = np.arange(count) % len(candidates)
    return replace(
        prepared,
        model=replace(prepared.model, name=name),
        candidates=replace(
            candidates, X_OG=candidates.X_OG[rows], distance=candidates.distance[rows]
        ),
    )


def write_from_rows(
    out: Path,
    headers: list[ShardHeader],
    small: Path,
    source: Manifest,
    entry: ObjectEntry,
    seed: int,
) -> None:
    """Write the shards of an object from rows of another one, drawn without return in turn."""
    own = [header for header in source.headers() if header.object_name == entry.name]
    shards = [read_shard(header.path(small), header) for header in own]
    trials = joined([dict(shard.trials) for shard in shards])
    looks = joined([dict(shard.looks) for shard in shards])
    look_of = {
        int(row): k for k, row in enumerate(np.flatnonzero(trials["outcome"] == Outcome.SUCCESS))
    }

    # Another order in each round: a column must not compress because it repeats itself.
    standoffs = len(trials["outcome"]) // entry.candidates
    order = drawn(entry.candidates, np.random.default_rng(seed))
    for header in headers:
        poses = np.array([next(order) for _ in range(header.stop - header.start)])
        rows = (poses[:, None] * standoffs + np.arange(standoffs)).ravel()
        columns = {name: values[rows] for name, values in trials.items()}
        columns["candidate"] = np.repeat(
            np.arange(header.start, header.stop, dtype=np.int32), standoffs
        )
        hits = np.flatnonzero(columns["outcome"] == Outcome.SUCCESS)
        places = [look_of[int(row)] for row in rows[hits]]
        seen = {name: values[places] for name, values in looks.items()}
        seen["row"] = hits.astype(np.int32)
        write_shard(out, Shard(header=header, trials=columns, looks=seen))


def drawn(count: int, generator: np.random.Generator) -> Iterator[int]:
    """Yield the numbers below a count without end, in another order each round."""
    while True:
        yield from generator.permutation(count).tolist()


def joined(parts: list[dict[str, AnyArray]]) -> dict[str, AnyArray]:
    """Return the columns of several tables as those of one."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def copy_shards(out: Path, headers: list[ShardHeader], of: str) -> None:
    """Copy the shards of an object for another one."""
    for header in headers:
        path = header.path(out)
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(replace(header, object_name=of).path(out), path)
        with h5py.File(path, "r+") as file:
            file.attrs.update(asdict(header))
        seal(path)


if __name__ == "__main__":
    main()
