"""The commands of drakegrasp, run in the process of a test."""

from __future__ import annotations

import io
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from unittest.mock import patch

from cyclopts.argument import Argument

from drakegrasp.cli.main import app, main


@dataclass(frozen=True, kw_only=True)
class Result:
    """What a command said and did.

    Attributes:
        exit_code: Its exit code.
        stdout, stderr: What it printed.
        exception: What it raised except `SystemExit`; a bug.
    """

    exit_code: int
    stdout: str
    stderr: str
    exception: BaseException | None = None

    @property
    def output(self) -> str:
        """All that was printed."""
        return self.stdout + self.stderr


class Stream(io.TextIOWrapper):
    """A stream in memory, with the bytes of what is printed."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO(), encoding="utf-8", write_through=True)

    def text(self) -> str:
        """All that was printed."""
        return self.buffer.getvalue().decode()  # type: ignore[attr-defined]


def run(*arguments: object, command=main) -> Result:  # type: ignore[no-untyped-def]
    """Return what `drakegrasp ARGUMENTS...`, or another command, says and does."""
    words, out, err = [str(a) for a in arguments], Stream(), Stream()
    code, fault = 0, None
    with (
        redirect_stdout(out),
        redirect_stderr(err),
        patch.object(sys, "argv", ["drakegrasp", *words]),
    ):
        try:
            command(words)
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        except Exception as error:
            code, fault = 1, error
    return Result(exit_code=code, stdout=out.text(), stderr=err.text(), exception=fault)


def arguments_of(*command: str) -> list[Argument]:
    """Return the arguments and options of a command."""
    path = [app]
    for name in command:
        path.append(path[-1][name])
    with app.app_stack(path):
        found = path[-1].assemble_argument_collection()
    return [each for each in found if each.name != "*"]


def error_line(result: Result) -> str:
    """Return the only error that a command printed."""
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, result.stderr
    return lines[0]
