"""The commands of drakegrasp, run in the process of a test."""

from __future__ import annotations

from pathlib import Path

from click.testing import CliRunner, Result

from drakegrasp.cli.main import main


def run(*arguments: str | Path | int) -> Result:
    """Return what `drakegrasp ARGUMENTS...` says and does."""
    return CliRunner().invoke(main, [str(a) for a in arguments])


def error_line(result: Result) -> str:
    """Return the only error that a command printed."""
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.stderr
    return lines[0]
