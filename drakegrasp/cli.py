"""The command line: thin, one function per command.

Results go to standard output, progress and errors to standard error. Exit codes: 0 done,
1 the work failed, 2 wrong usage. Heavy imports are within the commands, so that `--help`
answers at once.
"""

from __future__ import annotations

import math
import os
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

from drakegrasp import __version__
from drakegrasp.build_options import (
    BUILTIN,
    build_options,
    manifest_option,
    parse_request,
    set_option,
    times_option,
    units_option,
)
from drakegrasp.commands import Commands

if TYPE_CHECKING:
    from drakegrasp.build import BuildReport
    from drakegrasp.build_options import BuildRequest
    from drakegrasp.verification import Verification

#: Width of tables where standard output is not a terminal [characters]: as wide as they are.
WIDTH = 1000


out_argument = click.argument("out", type=click.Path(path_type=Path), metavar="OUT")
workers_option = click.option(
    "--workers", type=int, help="Processes on this machine.  [one per core]"
)
scheduler_option = click.option(
    "--scheduler", metavar="ADDRESS", help="A running Dask scheduler to use instead."
)
scheduler_file_option = click.option(
    "--scheduler-file",
    type=click.Path(path_type=Path),
    help="Its JSON file, instead of the address.",
)


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="drakegrasp")
def main() -> None:
    """Simulate multi-finger grasps of meshes, with the images of every grasp."""


@main.command()
@click.argument("directory", type=click.Path(path_type=Path), default=Path("."))
def doctor(directory: Path) -> None:
    """Say what this machine lacks, with the line that mends it.

    DIRECTORY is where data would be written.
    """
    from drakegrasp.doctor import diagnose

    findings = diagnose(directory)
    for finding in findings:
        mark = (
            click.style("ok     ", fg="green") if finding.ok else click.style("MISSING", fg="red")
        )
        click.echo(f"{mark}  {finding.name:<18} {finding.what}")
        if not finding.ok:
            click.echo(f"         -> {finding.mend}")
    if not all(finding.ok for finding in findings):
        sys.exit(1)


@main.group()
def objects() -> None:
    """List or export the built-in objects."""


@objects.command("list")
def list_objects() -> None:
    """Print the name and class of every built-in object."""
    from drakegrasp.builtin import BUILTIN_OBJECTS

    for item in BUILTIN_OBJECTS:
        click.echo(f"{item.name:<26} {item.class_name}")


@objects.command("export")
@click.argument("directory", type=click.Path(path_type=Path))
def export_objects(directory: Path) -> None:
    """Write the built-in objects' meshes (.obj, metres) to DIRECTORY."""
    from drakegrasp.builtin import export_builtin

    click.echo(f"{len(export_builtin(directory))} meshes in {directory}")


@main.command()
@click.argument("mesh_dir", type=click.Path(path_type=Path))
@units_option
@manifest_option
def audit(mesh_dir: Path, units: str, manifest: Path | None) -> None:
    """Say mesh by mesh: fit to simulate, mended, or refused, and why.

    A build also drops each object on the table, and refuses one that does not come to rest.
    """
    from drakegrasp.audit import audit as audit_meshes
    from drakegrasp.tables import audit_table

    rows = audit_meshes(mesh_dir, units=units, manifest=manifest)
    _print(audit_table(rows))
    if all(row.status == "refused" for row in rows):
        sys.exit(1)


@main.command()
@build_options
@workers_option
@scheduler_option
@scheduler_file_option
@click.option("--plan", is_flag=True, help="Only print the hours and bytes that it would take.")
@times_option
def build(
    workers: int | None,
    scheduler: str | None,
    scheduler_file: Path | None,
    plan: bool,
    times: Path | None,
    **options: Any,
) -> None:
    """Build the dataset of a directory of meshes."""
    from drakegrasp.cluster import build_dataset

    request = parse_request(**options)
    if plan:
        print_plan(request, workers, times)
        return
    report = build_dataset(
        request.objects,
        request.out,
        config=request.config,
        units=request.units,
        manifest=request.manifest,
        workers=workers,
        scheduler=scheduler,
        scheduler_file=scheduler_file,
        show=request.show,
    )
    print_report(report)


@main.command()
@out_argument
@click.option(
    "--reject",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="File with the ids of trials that are no samples, one per line; # starts a comment.",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Set a value of the filters or the split, e.g. filters.outlier_sigma=3.",
)
def assemble(out: Path, reject: Path | None, overrides: tuple[str, ...]) -> None:
    """Write the three files again from the shards: filters, split, samples."""
    from drakegrasp.assemble import assemble as assemble_files
    from drakegrasp.assemble import read_reject_list
    from drakegrasp.manifest import change_postprocessing
    from drakegrasp.progress import progress_bar

    rejected = () if reject is None else read_reject_list(reject)
    if overrides:
        change_postprocessing(out, overrides)
    with progress_bar("assemble", "shards") as progress:
        assemble_files(out, rejected=rejected, progress=progress)
    _print_stats(out)


@main.command()
@click.argument("path", type=click.Path(path_type=Path), metavar="OUT|FILE")
def check(path: Path) -> None:
    """Check every invariant of a dataset, or of one of its files."""
    from drakegrasp.check import check_dataset
    from drakegrasp.progress import progress_bar

    with progress_bar("check", "steps") as progress:
        violations = check_dataset(path, progress=progress)
    for violation in violations:
        click.echo(str(violation))
    click.echo(f"{path}: {len(violations) or 'no'} broken invariants")
    if violations:
        sys.exit(1)


@main.command()
@out_argument
def stats(out: Path) -> None:
    """Print the funnel by object and the paper's Table III.

    Of a build that still runs, or was stopped: what is done so far.
    """
    _print_stats(out)


@main.command()
@out_argument
@click.option("--trial", required=True, type=int, help="Row of trials.hdf5.")
@click.option(
    "--html",
    type=click.Path(path_type=Path),
    help="File to write that plays the trial in a browser.",
)
def replay(out: Path, trial: int, html: Path | None) -> None:
    """Run a trial again: the same outcome and contacts, or exit code 1."""
    from drakegrasp.replay import record_trial, replay_trial

    again = replay_trial(out, trial)
    click.echo(
        f"trial {trial} of {again.object_name}: was {again.recorded.label}, is {again.found.label}"
    )
    for name, difference in again.differences.items():
        how = "is missing in one" if math.isnan(difference) else f"by up to {difference:.3g}"
        click.echo(f"  {name} differs: {how}")
    for package, change in again.versions.items():
        click.echo(f"  {package}: {change}")
    if html is not None:
        record_trial(out, trial, html)
        click.echo(str(html))
    if not again.same:
        sys.exit(1)


@main.command()
@click.argument("grasps", type=click.Path(path_type=Path), metavar="GRASPS")
@click.option(
    "--object",
    "mesh",
    type=click.Path(path_type=Path),
    metavar="MESH",
    help="The object: a .obj, .stl, .ply or .glb file.",
)
@click.option("--units", help="Unit of length of the mesh: m, cm or mm.  [m]")
@click.option(
    "--dataset",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="In place of --object: a data file, OUT/grasping_oto.hdf5 or _otm; object, its pose and "
    "the camera's come with the row.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Which rows of the dataset, and which group of an HDF5 file of grasps.  [test]",
)
@click.option(
    "--frame",
    type=click.Choice(["object", "camera", "workspace"]),
    help="What the grasps are expressed in.  [object; camera with a dataset]",
)
@click.option(
    "--camera",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="With --object and --frame camera: .npy file with the camera's pose in the table-top "
    "frame, X_TC (4, 4), or one per grasp (n, 4, 4) or (n, 12).",
)
@click.option(
    "--method",
    type=click.Choice(["hand", "forces"]),
    default="hand",
    show_default=True,
    help="Close a simulated hand on the contacts and lift, or lift by forces at the contacts "
    "alone.",
)
@click.option("--hand", metavar="NAME|YAML", help="The hand.  [the configuration's: barrett]")
@click.option(
    "--config",
    metavar="YAML|PRESET",
    help="Configuration: a file, or paper or released.  [the dataset's, else paper]",
)
@set_option
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="NAME",
    help="Write NAME.jsonl and NAME.h5 instead of JSON lines to standard output.",
)
@workers_option
@scheduler_option
@scheduler_file_option
@click.option("--quiet", is_flag=True, help="Show neither progress nor the table.")
def verify(
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    scheduler_file: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Try predicted grasps in the simulator: does each hold its object, and if not, why?

    GRASPS is a .npy array with a row per grasp, a .csv file with a line per grasp, or an HDF5
    file with an array `grasps` at its root or in a group, and maybe `rows` beside it: the rows of
    the dataset that they are for. A grasp is 6 numbers per finger (18 for the Barrett Hand): the
    contact points in metres, then the unit normals out of the object, in the hand file's order
    of fingers.

    If GRASPS is a data file of a dataset, and neither --object nor --dataset is given, its own
    grasps are tried.

    A line of JSON per grasp goes to standard output or NAME.jsonl, a table of the outcomes to
    standard error. Exit code: 0 when every grasp was tried, whatever came of it; 2 for input
    that cannot be used, such as a single grasp that is not on the object.
    """
    from drakegrasp.cluster import run_verification
    from drakegrasp.tables import verdict_table
    from drakegrasp.verification_files import (
        json_lines,
        part_path,
        result_paths,
        write_json_line,
        write_results,
    )
    from drakegrasp.verify_request import VerifyRequest, plan_request
    from drakegrasp.verifying import refuse_off_surface

    tasks = plan_request(VerifyRequest(**options, out=out))
    single = sum(len(task.indices) for task in tasks) == 1

    def print_line(index: int, result: Verification) -> None:
        write_json_line(index, result, sys.stdout)

    def deliver(index: int, result: Verification) -> None:
        if single:
            refuse_off_surface(result)
        write(index, result)

    try:
        with nullcontext(print_line) if out is None else json_lines(out) as write:
            results = run_verification(
                tasks,
                workers=workers,
                scheduler=scheduler,
                scheduler_file=scheduler_file,
                deliver=deliver,
                show=not quiet,
            )
            if out is not None:
                write_results(results, result_paths(out)[1], results[0].config)
    except BaseException:
        if out is not None and part_path(out).exists():
            click.echo(f"{part_path(out)}: the verdicts so far", err=True)
        raise
    for path in () if out is None else result_paths(out):
        click.echo(str(path))
    if not quiet:
        _console(stderr=True).print(verdict_table([result.outcome for result in results]))


@main.command()
@click.option(
    "--objects", default=BUILTIN, show_default=True, metavar="MESH_DIR|builtin", help="Meshes."
)
@click.option("--only", multiple=True, metavar="NAME", help="Those whose names begin so.")
@click.option("--config", "preset", metavar="YAML|PRESET", help="[paper]")
@set_option
@click.option(
    "--candidates",
    type=click.IntRange(min=1),
    default=100,
    show_default=True,
    help="Palm poses per object.",
)
@click.option(
    "--fidelity",
    type=click.IntRange(min=0),
    default=0,
    metavar="N",
    help="Compare the labels of N attempts per object.",
)
@click.option("--peer", is_flag=True, help="Run the same attempts in MuJoCo.")
@click.option(
    "--compare",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    metavar="FILE",
    help="An earlier report; print the ratios to it.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    default=Path("bench.json"),
    show_default=True,
    metavar="FILE",
    help="Where the report goes, as JSON.",
)
@units_option
@manifest_option
@click.option("--quiet", is_flag=True, help="No progress bar.")
def bench(
    objects: str,
    only: tuple[str, ...],
    preset: str | None,
    overrides: tuple[str, ...],
    candidates: int,
    fidelity: int,
    peer: bool,
    compare: Path | None,
    out: Path,
    units: str,
    manifest: Path | None,
    quiet: bool,
) -> None:
    """Measure what attempts cost on this machine, in one process.

    With --fidelity, N random attempts of each object are simulated again without the screen, at
    half the step, with four times the faces and by Drake's other solvers. With --peer (extra
    [peer]), all are simulated plainly in MuJoCo as well.
    """
    import json
    import tempfile

    from drakegrasp import bench as measuring
    from drakegrasp.builtin import export_builtin
    from drakegrasp.config import load_config
    from drakegrasp.meshes import find_meshes
    from drakegrasp.progress import progress_bar
    from drakegrasp.tables import bench_lines, bench_table, fidelity_table

    if peer:
        _need_peer()
    if not os.access(out if out.exists() else out.absolute().parent, os.W_OK):
        raise click.UsageError(f"--out must be a file that can be written, got {out}")
    os.environ.setdefault("LP_NUM_THREADS", "0")  # threads of OpenGL would count as this core's
    config = load_config(preset, [*overrides, f"candidates.max={candidates}"])
    then = None if compare is None else _read_report(compare)
    with tempfile.TemporaryDirectory() as folder:
        if objects == BUILTIN:
            export_builtin(Path(folder))
        meshes = Path(folder) if objects == BUILTIN else Path(objects)
        every = find_meshes(meshes, units=units, manifest=manifest)
        sources = [s for s in every if not only or s.name.startswith(only)]
        if not sources:
            raise click.UsageError(f"--only must name objects of {objects}, got {', '.join(only)}")
        with progress_bar("bench", "attempts", show=not quiet) as progress:
            measured = measuring.measure(
                sources, config, sample=fidelity, peer=peer, progress=progress
            )
            report = measuring.summarize(list(measured), config)
    _print(bench_table(report))
    for line in bench_lines(report):
        click.echo(line)
    if fidelity:
        _print(fidelity_table(report["all"]["fidelity"]))
    if then is not None:
        report["ratio"] = measuring.compare(report, then)
        for key, ratio in report["ratio"].items():
            times = "none to compare with" if ratio is None else f"{ratio:.2f} times that"
            click.echo(f"{key.replace('_', ' ')}: {times} of {compare}")
    out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    click.echo(str(out))


def _need_peer() -> None:
    from importlib.util import find_spec

    for module in ("mujoco", "coacd"):
        if find_spec(module) is None:
            raise click.UsageError(
                f"--peer must find {module}, got none: pip install 'drakegrasp[peer]'"
            )


def _read_report(path: Path) -> dict[str, Any]:
    import json

    try:
        report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        _ = report["all"]["resolved_per_core_second"] + report["all"]["grasps_per_core_hour"]
    except (ValueError, KeyError, TypeError):
        raise click.UsageError(
            f"--compare must be a report of `drakegrasp bench`, got {path}"
        ) from None
    return report


def _console(*, stderr: bool = False) -> Console:
    console = Console(stderr=stderr)
    return console if console.is_terminal else Console(width=WIDTH, stderr=stderr)


def _print(table: Table) -> None:
    _console().print(table)


def _print_stats(out: Path) -> None:
    from drakegrasp.stats import count_funnel, count_splits, count_unfinished
    from drakegrasp.tables import funnel_table, split_table, unfinished_line

    console, unfinished = _console(), count_unfinished(out)
    funnel = count_funnel(out) if unfinished is None else unfinished.funnel
    table = funnel_table(funnel)
    # Numbers are never cut: where the columns do not fit, fewer say the same.
    natural = Measurement.get(console, console.options.update(max_width=WIDTH), table).maximum
    if natural > console.width:
        table = funnel_table(funnel, compact=True)
    console.print(table)
    if unfinished is None:
        console.print(split_table(count_splits(out)))
    else:
        click.echo(f"{out}: {unfinished_line(unfinished)}")


def print_plan(request: BuildRequest, workers: int | None, times: Path | None) -> None:
    """Print what a build that was asked for is expected to take."""
    from drakegrasp.plan import logged_times, plan_lines, plan_request, read_times

    logged = logged_times(request.out, request.config)
    measured = logged if times is None else read_times(times)
    click.echo("\n".join(plan_lines(plan_request(request, workers, measured))))


def print_report(report: BuildReport) -> None:
    """Print what a build did, and where it put it."""
    _print_stats(report.out)
    if report.simulated:
        reused = f" ({report.reused} had been done before)" if report.reused else ""
        click.echo(f"{report.simulated} work units simulated{reused}")
    else:
        click.echo(f"all {report.reused} work units had been done before: nothing was simulated")
    for message, count in report.errors.items():
        click.echo(f"solver error in {count} attempts: {message}")
    for notice in report.notices:
        click.echo(notice)
    for entry in report.refused:
        click.echo(f"refused: {entry['name']}: {entry['reason']}")
    for name in ("grasping_oto.hdf5", "grasping_otm.hdf5", "trials.hdf5"):
        click.echo(str(report.out / name))
