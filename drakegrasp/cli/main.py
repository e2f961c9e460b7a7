"""The command line: the group of all commands, and the commands that take few lines.

Results go to standard output, progress and errors to standard error. Exit codes: 0 done,
1 the work failed, 2 wrong usage. Commands import heavy libraries when they run, so that
`--help` answers at once.
"""

from __future__ import annotations

import io
import math
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from drakegrasp import __version__
from drakegrasp.cli.audit import audit
from drakegrasp.cli.bench import bench
from drakegrasp.cli.build import assemble, build, merge, scenes, stats
from drakegrasp.cli.errors import Commands, say, say_finding, say_json
from drakegrasp.cli.export import export
from drakegrasp.cli.hand import hand
from drakegrasp.cli.inspect import figures, inspect_
from drakegrasp.cli.morph import morph
from drakegrasp.cli.options import PATH, chosen_settings, dataset_argument, shared
from drakegrasp.cli.restart import restart_with_utf8
from drakegrasp.cli.score import bench_set, score
from drakegrasp.cli.verify.command import verify
from drakegrasp.errors import counted, printable
from drakegrasp.runtime.allocator import restart_with_jemalloc


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="drakegrasp")
def main() -> None:
    """Simulate multi-finger grasps of object meshes and write datasets of them."""


@click.command()
@click.argument("directory", type=PATH, default=Path("."))
def doctor(directory: Path) -> None:
    """Check that this machine can run drakegrasp.

    The command names what is missing and how to get it. DIRECTORY is where a dataset would be
    written. Exit code 1 if anything is missing.
    """
    from drakegrasp.cli.doctor import diagnose

    # A line per need, and one more with the remedy where it is not met.
    findings = diagnose(directory)
    for finding in findings:
        say_finding(finding.ok, "MISSING", f"{finding.name:<18} {finding.what}")
        if not finding.ok:
            click.echo(f"         -> {finding.remedy}")
    if not all(finding.ok for finding in findings):
        sys.exit(1)


@click.group()
def objects() -> None:
    """List or export the built-in objects, or make morphs of meshes."""


@objects.command("list")
def list_objects() -> None:
    """Print every built-in class, with the parameters that are drawn."""
    from drakegrasp.shapes.catalog import CLASSES

    for item in CLASSES:
        sizes = ", ".join(f"{name} {span}" for name, span in item.parameters.items())
        say(f"{item.number:>2} {item.name:<15} {sizes}")


@objects.command("export")
@click.argument("directory", type=PATH)
@shared("--per-class", "--objects-seed")
def export_objects(directory: Path, **options: Any) -> None:
    """Write the built-in objects' meshes (.obj, metres) to DIRECTORY.

    Equal options write equal bytes on every machine.
    """
    from drakegrasp.generation.request import BUILTIN
    from drakegrasp.hand.settings import load_config
    from drakegrasp.runtime.progress import progress_bar
    from drakegrasp.shapes.catalog import export_builtin

    config = load_config(overrides=chosen_settings({"objects": BUILTIN, **options}))
    with progress_bar("objects", "meshes") as progress:
        paths = export_builtin(directory, config=config.builtin, progress=progress)
    say(f"{counted(len(paths), 'mesh', 'meshes')} in {directory}")


@click.command()
@dataset_argument("path", "OUT|FILE")
@shared("--workers", "--json")
def check(path: Path, workers: int | None, as_json: bool) -> None:
    """Check every invariant of a dataset.

    OUT is a dataset's directory; FILE is one of its three main files. Exit code 1 if an
    invariant is broken.
    """
    from drakegrasp.dataset.checks.run import check_dataset
    from drakegrasp.runtime.executor import processes
    from drakegrasp.runtime.progress import progress_bar

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
@dataset_argument()
@click.option("--trial", required=True, type=int, metavar="ID", help="Row of trials.hdf5.")
@click.option(
    "--html",
    type=PATH,
    metavar="FILE",
    help="Write a recording of the trial that plays in a browser.",
)
def replay(out: Path, trial: int, html: Path | None) -> None:
    """Run a trial again and compare every value.

    Exit code 1 if any value differs from the stored one.
    """
    from drakegrasp.generation.replay import record_trial, replay_trial

    # Whatever differs is printed: values first, then versions, which may explain them.
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


objects.add_command(morph)

# The help lists them in this order.
for _command in (
    *(doctor, objects, audit, hand, build, assemble, merge, scenes, check, stats, inspect_),
    *(figures, replay, verify, score, bench_set, export, bench),
):
    main.add_command(_command)


def run() -> None:
    """Run the program; commands that may simulate in this process have jemalloc for it."""
    restart_with_utf8()
    # A terminal of another encoding shows ? where it has no such character.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    if sys.argv[1:2] in (["bench"], ["verify"], ["score"], ["hand"]):
        restart_with_jemalloc()
    main()
