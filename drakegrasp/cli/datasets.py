"""The commands that build datasets and count their content: `build`, `stats`, `check` and more."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from drakegrasp.cli.console import Command, progress_bar, say, say_json
from drakegrasp.cli.options import (
    FILE,
    PATH,
    chosen_workers,
    dataset_argument,
    described,
    parse_request,
    shared,
)
from drakegrasp.errors import counted, printable
from drakegrasp.runtime.executor import processes

if TYPE_CHECKING:
    from drakegrasp.generation.pipeline import BuildReport


@click.command(cls=Command)
@described
def build(dry_run: bool = False, part: str | None = None, **options: Any) -> None:
    """Build a dataset from a directory of meshes.

    The command simulates grasps of every object and writes trials.hdf5,
    grasping_oto.hdf5 and grasping_otm.hdf5 to DIR.

    Options:
        BUILD, CONNECTION
        --part I/N: Only run every Nth work unit, starting with the Ith; `merge` joins the datasets
            of all N parts.
        --dry-run: Only print the amount of work that is known before the build.
    """
    from drakegrasp.api.building import build_dataset, known_work

    workers = chosen_workers(options)
    request = parse_request(options)
    if request.read_as and request.postures is None:
        raise click.UsageError(f"--{next(iter(request.read_as))} must be used with --postures")
    if dry_run:
        say("\n".join(known_work(request, part)))
        return
    report = build_dataset(
        request.objects,
        request.out,
        config=request.config,
        units=request.units,
        manifest=request.manifest,
        only=request.only,
        postures=request.postures,
        part=part,
        read_as=request.read_as,
        **workers,
        show=request.show,
    )
    print_report(report)


@click.command("bench-set", cls=Command)
@described
@click.argument("out", type=PATH, metavar="OUT")
def bench_set(
    out: Path,
    only: tuple[str, ...],
    overrides: tuple[str, ...],
    quiet: bool,
    **options: Any,
) -> None:
    """Build the frozen benchmark drakegrasp-bench-1 in OUT.

    The benchmark has 256 built-in objects, each with its own mass and friction, all for testing.
    Their meshes are compared with the published hashes. It takes about an hour on one core. With
    --only or --set the result is a part or a variant of the benchmark, and each card reports this.
    The same command continues an interrupted build.

    Options:
        --only, --set
        CONNECTION, --quiet
    """
    from drakegrasp.api.building import make_benchmark

    report = make_benchmark(
        out,
        only=only,
        overrides=overrides,
        **chosen_workers(options),
        show=not quiet,
    )
    print_report(report)


@click.command()
@described
@dataset_argument()
def assemble(
    out: Path,
    overrides: tuple[str, ...],
    workers: int | None,
    reject: Annotated[Path | None, FILE] = None,
) -> None:
    """Filter and split again, without simulating.

    The command writes trials.hdf5 and both data files again from the shards in OUT.
    Entries of reject.json that are not successes are skipped and listed.

    Options:
        --reject FILE: Trials that must not become samples: the reject.json of an inspection, or a
            text file with one id per line; # starts a comment.
        ASSEMBLED, --workers
    """
    from drakegrasp.cli import tables
    from drakegrasp.dataset.assemble import assemble as assemble_files
    from drakegrasp.dataset.check import check_hand
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.rejections import read_rejected, unused_rejections

    rejected = () if reject is None else read_rejected(reject)
    with progress_bar("assemble", "shards") as progress:
        assemble_files(out, overrides=overrides, rejected=rejected, progress=progress)
        manifest = read_manifest(out)
    if manifest.config.scenes.when == "assembled":
        write_scenes(out, workers=workers)
    tables.print_stats(out)
    for sentence in unused_rejections(out, rejected, manifest.rejected):
        say(sentence)
    for changed in check_hand(manifest):
        say(f"{changed}; the card leaves out its drive, load limit and licence")


@click.command()
@described
@dataset_argument()
def scenes(out: Path, workers: int | None, quiet: bool, overrides: tuple[str, ...] = ()) -> None:
    """Render views of training scenes, independent of grasps.

    The command writes OUT/scenes.hdf5: each object of OUT in each resting pose, seen by sixteen
    cameras (five fixed cameras for testing), with all attempts that closed the hand on it.

    Options:
        --set KEY=VALUE (overrides): Change a key of `scenes`, e.g. scenes.views=8; may be given
            several times.
        --workers, --quiet
    """
    from drakegrasp.dataset.paths import SCENES_FILE

    made = write_scenes(out, overrides=overrides, workers=workers, show=not quiet)
    for split, row in made.items():
        say(f"{split}: {counted(row['scenes'], 'scene')}, {counted(row['views'], 'view')}")
    grasps = sum(row["grasps"] for row in made.values())
    say(f"{counted(grasps, 'grasp')} in {out / SCENES_FILE}")


def write_scenes(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    show: bool = True,
) -> dict[str, dict[str, int]]:
    """Write scenes.hdf5 in processes of this machine."""
    from drakegrasp.generation.scenes import make_scenes

    with (
        processes(workers) as execute,
        progress_bar("scenes", "objects", show=show) as progress,
    ):
        return make_scenes(out, overrides=overrides, execute=execute, progress=progress)


@click.command()
@described
@click.argument("into", type=PATH, metavar="INTO")
@click.argument("outs", type=PATH, metavar="OUTS...", nargs=-1, required=True)
def merge(into: Path, outs: tuple[Path, ...], overrides: tuple[str, ...]) -> None:
    """Merge several datasets that were built separately.

    The datasets may differ only in their objects, their seeds, their parts (`build --part`), and
    the settings that --set changes for all of them. INTO must be new or empty, and appears when it
    is complete; OUTS do not change.

    Options:
        ASSEMBLED
    """
    from drakegrasp.cli import tables
    from drakegrasp.generation.merge import merge as merge_datasets

    with progress_bar("merge", "shards") as progress:
        merge_datasets(into, outs, overrides=overrides, progress=progress)
    tables.print_stats(into)


@click.command()
@dataset_argument()
@shared("--json")
def stats(out: Path, as_json: bool) -> None:
    """Count outcomes, how well grasps hold, and samples.

    While a build runs, or after it was stopped, the command counts the finished work units.
    """
    from drakegrasp.cli import tables
    from drakegrasp.dataset.statistics import counts_as_dict

    if as_json:
        say_json(counts_as_dict(out))
    else:
        tables.print_stats(out)


@click.command()
@dataset_argument("path", "OUT|FILE")
@shared("--workers", "--json")
def check(path: Path, workers: int | None, as_json: bool) -> None:
    """Check every invariant of a dataset.

    OUT is the directory of a dataset; FILE is one of its HDF5 files. The exit code is 1 if an
    invariant is broken.
    """
    from drakegrasp.dataset.check import check_dataset

    with processes(workers) as execute, progress_bar("check", "steps") as progress:
        violations = check_dataset(path, execute=execute, progress=progress)
    if as_json:
        say_json({"path": str(path), "broken": [asdict(violation) for violation in violations]})
    else:
        for violation in violations:
            say(str(violation))
        found = counted(len(violations), "broken invariant")
        say(f"{path}: {found if violations else 'no broken invariants'}")
    if violations:
        sys.exit(1)


@click.command()
@described
@dataset_argument()
def replay(out: Path, *, trial: int, html: Path | None = None) -> None:
    """Run a trial again and compare every value.

    The exit code is 1 if any value differs from the stored one.

    Options:
        --trial ID: Row of trials.hdf5.
        --html FILE: Write a recording of the trial that plays in a browser.
    """
    from drakegrasp.generation.replay import record_trial, replay_trial

    # All differences are printed: values first, then versions, which may explain them.
    again = replay_trial(out, trial)
    say(f"trial {trial} of {again.object_name}: was {again.recorded.label}, is {again.found.label}")
    for other, links in again.meetings.items():
        say(f"  where it starts, {', '.join(map(printable, links))} of the hand meet the {other}")
    for name, difference in again.differences.items():
        how = "is missing in one" if math.isnan(difference) else f"by up to {difference:.3g}"
        say(f"  {name} differs: {how}")
    for package, change in again.versions.items():
        say(f"  {package}: {change}")

    if html is not None:
        record_trial(out, trial, html)
        say(str(html))
    if not again.same:
        sys.exit(1)


def print_report(report: BuildReport) -> None:
    """Print the results of a build, and the paths of its files.

    Raises:
        click.exceptions.Exit: With code 1 if the machine has probably spoiled labels, which a line
            on standard error has reported.
    """
    from drakegrasp.cli import tables

    tables.print_stats(report.out)
    if report.simulated:
        reused = f" ({report.reused} had been done before)" if report.reused else ""
        say(f"{counted(report.simulated, 'work unit')} simulated{reused}")
    else:
        again = "; the files were written again" * report.assembled
        units = counted(report.reused, "work unit")
        say(f"all {units} had been done before: nothing was simulated{again}")
    for message, count in report.errors.items():
        say(f"solver error in {counted(count, 'attempt')}: {message}")
    for notice in report.notices:
        say(notice)
    for entry in report.refused:
        say(f"refused: {entry.name}: {entry.reason}")
    for name in ("grasping_oto.hdf5", "grasping_otm.hdf5", "trials.hdf5"):
        if report.assembly is not None:
            say(str(report.out / name))
    if report.unexplained:
        raise click.exceptions.Exit(1)
