"""`drakegrasp build`, `assemble`, `merge`, `scenes` and `stats`, and what they print."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from drakegrasp.cli.errors import say, say_json
from drakegrasp.cli.help import Command
from drakegrasp.cli.options import (
    FILE,
    PATH,
    build_options,
    chosen_workers,
    connection_options,
    dataset_argument,
    parse_request,
    postprocessing_options,
    scenes_options,
    shared,
)
from drakegrasp.errors import counted

if TYPE_CHECKING:
    from drakegrasp.generation.pipeline import BuildReport
    from drakegrasp.generation.request import BuildRequest
    from drakegrasp.generation.scenes.make import Scenes


@click.command(cls=Command)
@build_options
@connection_options
@click.option(
    "--plan", is_flag=True, help="Only print the hours and bytes that the build would take."
)
@shared("--times")
def build(plan: bool, times: Path | None, **options: Any) -> None:
    """Build a dataset from a directory of meshes.

    The command simulates grasps of every object and writes trials.hdf5,
    grasping_oto.hdf5 and grasping_otm.hdf5 to DIR.
    """
    from drakegrasp.api.building import build_dataset

    workers = chosen_workers(options)
    request = parse_request(options)
    if plan and request.postures is not None:
        raise click.UsageError("--plan must be used without --postures: a row is an attempt")
    if plan:
        print_plan(request, workers["workers"], times)
        return
    report = build_dataset(
        request.objects,
        request.out,
        config=request.config,
        units=request.units,
        manifest=request.manifest,
        only=request.only,
        postures=request.postures,
        **workers,
        show=request.show,
    )
    print_report(report)


@click.command()
@dataset_argument()
@click.option(
    "--reject",
    type=FILE,
    metavar="FILE",
    help="Trials that must not become samples: the reject.json of an inspection, or a text file "
    "with an id per line; # starts a comment.",
)
@postprocessing_options
@shared("--workers")
def assemble(
    out: Path, reject: Path | None, overrides: tuple[str, ...], workers: int | None
) -> None:
    """Filter and split again, without simulating.

    The command writes trials.hdf5 and both data files again from the shards in OUT.
    Entries of reject.json that are not successes are skipped and listed.
    """
    from drakegrasp.dataset.assemble import assemble as assemble_files
    from drakegrasp.dataset.checks.object_files import carried_hand_as_built
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.rejections import read_rejected, unused_rejections
    from drakegrasp.runtime.executor import processes
    from drakegrasp.runtime.progress import progress_bar

    rejected = () if reject is None else read_rejected(reject)
    with processes(workers) as execute, progress_bar("assemble", "tasks") as progress:
        assemble_files(
            out, overrides=overrides, rejected=rejected, execute=execute, progress=progress
        )
        manifest = read_manifest(out)
    if manifest.config.scenes.when == "assembled":
        write_scenes(out, workers=workers)
    print_stats(out)
    for sentence in unused_rejections(out, rejected, manifest.rejected):
        say(sentence)
    for changed in carried_hand_as_built(manifest):
        say(f"{changed}; the card leaves out its drive, load limit and licence")


@click.command()
@dataset_argument()
@scenes_options
@shared("--workers", "--quiet")
def scenes(out: Path, overrides: tuple[str, ...], workers: int | None, quiet: bool) -> None:
    """Render scenes whose cameras know no grasp, to train on.

    The command writes OUT/scenes.hdf5: each object of OUT in each resting pose, seen by sixteen
    cameras (five fixed ones to test), with all hands that closed on it.
    """
    made = write_scenes(out, overrides=overrides, workers=workers, show=not quiet)
    for split, count in made.scenes.items():
        say(f"{split}: {counted(count, 'scene')}, {counted(made.views[split], 'view')}")
    say(f"{counted(made.grasps, 'grasp')} in {made.path}")


def write_scenes(
    out: Path,
    *,
    overrides: Sequence[str] = (),
    workers: int | None = None,
    show: bool = True,
) -> Scenes:
    """Write scenes.hdf5 in processes of this machine."""
    from drakegrasp.generation.scenes.make import make_scenes
    from drakegrasp.runtime.executor import processes
    from drakegrasp.runtime.progress import progress_bar

    with (
        processes(workers) as execute,
        progress_bar("scenes", "objects", show=show) as progress,
    ):
        return make_scenes(out, overrides=overrides, execute=execute, progress=progress)


@click.command()
@click.argument("into", type=PATH, metavar="INTO")
@click.argument("outs", type=PATH, metavar="OUTS...", nargs=-1, required=True)
@postprocessing_options
@shared("--workers")
def merge(
    into: Path, outs: tuple[Path, ...], overrides: tuple[str, ...], workers: int | None
) -> None:
    """Make one dataset of several that were built apart.

    Their objects or their seeds may differ, and nothing else but what --set says for all. INTO
    must be new or empty, and appears when it is complete; OUTS stay as they are.
    """
    from drakegrasp.generation.merge import merge as merge_datasets
    from drakegrasp.runtime.executor import processes
    from drakegrasp.runtime.progress import progress_bar

    with processes(workers) as execute, progress_bar("merge", "tasks") as progress:
        merge_datasets(into, outs, overrides=overrides, execute=execute, progress=progress)
    print_stats(into)


@click.command()
@dataset_argument()
@shared("--json")
def stats(out: Path, as_json: bool) -> None:
    """Count outcomes, how well grasps hold, and samples.

    While a build runs, or after it was stopped, the command counts what is done so far.
    """
    from drakegrasp.dataset.statistics import counts_as_dict

    if as_json:
        say_json(counts_as_dict(out))
    else:
        print_stats(out)


def print_stats(out: Path) -> None:
    """Print the tables of a dataset: outcomes, how well the hand holds, samples by split."""
    from rich.measure import Measurement

    from drakegrasp.cli.tables import (
        WIDTH,
        barren_lines,
        funnel_table,
        hold_table,
        make_console,
        preshape_table,
        split_line,
        split_table,
        unfinished_line,
    )
    from drakegrasp.dataset.card.holding import holding_lines, holding_of
    from drakegrasp.dataset.card.shortfall import split_shortfall
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.paths import BENCHMARK_FILE, BUILTIN_FOLDER, DATA_FILES
    from drakegrasp.dataset.statistics import (
        count_funnel,
        count_splits,
        count_unfinished,
        preshapes_of,
        split_rule_of,
    )
    from drakegrasp.dataset.trials import Trials

    console, unfinished = make_console(), count_unfinished(out)
    funnel = count_funnel(out) if unfinished is None else unfinished.funnel
    table = funnel_table(funnel)
    # Rich would cut numbers in a narrow terminal; the compact table has fewer columns.
    natural = Measurement.get(console, console.options.update(max_width=WIDTH), table).maximum
    if natural > console.width:
        table = funnel_table(funnel, compact=True)
    console.print(table)
    console.print(hold_table(funnel))
    config = read_manifest(out).config
    if preshapes := preshapes_of(funnel, config):
        console.print(preshape_table(preshapes))
    console.print()
    if unfinished is None:
        splits = count_splits(out)
        console.print(split_table(splits))
        rule = split_rule_of(out / DATA_FILES["oto"])
        say(split_line(rule, funnel, splits))
        for line in barren_lines(funnel, config):
            say(line)
        if (holding := holding_of(Trials(out))) is not None:
            for line in holding_lines(holding):
                say(line)
        of_benchmark = (out / BUILTIN_FOLDER / BENCHMARK_FILE).is_file()
        if not of_benchmark and (line := split_shortfall(splits, rule, config.split)):
            say(line)
    else:
        say(f"{out}: {unfinished_line(unfinished)}")


def print_plan(request: BuildRequest, workers: int | None, times: Path | None) -> None:
    """Print how long a requested build is expected to take, and its size."""
    from drakegrasp.generation.estimate import plan_lines, plan_request
    from drakegrasp.generation.stage_times import logged_times, read_times

    logged = logged_times(request.out, request.config)
    measured = logged if times is None else read_times(times)
    say("\n".join(plan_lines(plan_request(request, workers, measured))))


def print_report(report: BuildReport) -> None:
    """Print what a build did, and the paths of its files.

    Raises:
        click.exceptions.Exit: With code 1 if the machine must have spoiled labels; a line on
            standard error has said so.
    """
    print_stats(report.out)
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
        say(str(report.out / name))
    if report.unexplained:
        raise click.exceptions.Exit(1)
