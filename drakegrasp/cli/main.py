"""The command line: the group of all commands.

Results go to standard output, progress and errors to standard error. Exit codes: 0 done, 1 the work
failed, 2 wrong usage. Commands import heavy libraries only when they run, so that `--help` answers
immediately.
"""

from __future__ import annotations

import io
import sys
from pathlib import Path

import click

from drakegrasp import __version__
from drakegrasp.cli.console import Commands, restart_with_utf8, say_finding
from drakegrasp.cli.datasets import (
    assemble,
    bench_set,
    build,
    check,
    merge,
    replay,
    scenes,
    stats,
)
from drakegrasp.cli.models import audit, hand, objects
from drakegrasp.cli.options import PATH
from drakegrasp.cli.predict import predict
from drakegrasp.cli.predictions import score, verify
from drakegrasp.cli.submit import submit
from drakegrasp.cli.views import export, figures, inspect_


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="drakegrasp")
def main() -> None:
    """Simulate multi-finger grasps of object meshes and write datasets of them."""


@click.command()
@click.argument("directory", type=PATH, default=Path("."))
def doctor(directory: Path) -> None:
    """Check that this machine can run drakegrasp.

    The command reports what is missing and how to install it. DIRECTORY is the directory in which a
    dataset would be written. The exit code is 1 if anything is missing.
    """
    from drakegrasp.cli.doctor import diagnose

    # One line per requirement, and a second line with the remedy if it is not met.
    findings = diagnose(directory)
    for finding in findings:
        say_finding(finding.ok, "MISSING", f"{finding.name:<18} {finding.what}")
        if not finding.ok:
            click.echo(f"         -> {finding.remedy}")
    if not all(finding.ok for finding in findings):
        sys.exit(1)


# The help lists the commands in this order.
for _command in (
    *(doctor, objects, audit, hand, build, submit, assemble, merge, scenes, check, stats, inspect_),
    *(figures, replay, predict, verify, score, bench_set, export),
):
    main.add_command(_command)


def run() -> None:
    """Run the program."""
    # Click drops what is printed to a closed stream, and a file that is opened may get its number.
    if sys.stdout is None:
        sys.exit("error: standard output must be open, got a closed one")
    restart_with_utf8()
    # A terminal with another encoding shows ? for characters that it does not have.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    main()
