"""Output, errors, exit codes and help of the commands.

Every error is one line on standard error and an exit code: 0 done, 1 the work failed, 2 wrong
usage, 130 Ctrl-C, 143 SIGTERM. Printed text has no control characters, whatever names it contains.
In help output, common options come first, and rare options follow under a separate heading.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from difflib import get_close_matches
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

import click

from drakegrasp.errors import (
    ConfigError,
    DrakegraspError,
    GraspError,
    HandError,
    MeshError,
    first_line,
    printable,
)

if TYPE_CHECKING:
    from drakegrasp.runtime.progress import Report

_UTF8, _STREAMS = "PYTHONUTF8", "PYTHONIOENCODING"
#: A signal that arrives while a module is imported is sent again after this time [s].
AGAIN_SECONDS = 0.05
#: Minimum similarity of a known option to an unknown one to be proposed [ratio of `difflib`].
ALIKE = 0.75
#: Errors in the user's input. All other errors are failures of the work.
WRONG_USAGE = (ConfigError, GraspError, HandError, MeshError)


def say_finding(ok: bool, bad: str, text: str) -> None:
    """Print a line that begins with a green `ok`, or with another word in red."""
    word = click.style("ok".ljust(len(bad)), fg="green") if ok else click.style(bad, fg="red")
    click.echo(f"{word}  {printable(text)}")


def say(text: str, *, err: bool = False) -> None:
    """Print a text; control characters are shown as their codes.

    Args:
        text: One line or more.
        err: Whether to print to standard error.
    """
    click.echo("\n".join(map(printable, text.split("\n"))), err=err)


def say_json(document: Mapping[str, Any]) -> None:
    """Print a document as strict JSON on one line."""
    click.echo(json.dumps(document, allow_nan=False))


def progress_bar(title: str, unit: str, *, show: bool = True) -> AbstractContextManager[Report]:
    """Return the progress bar of `runtime.progress`, whose libraries are loaded only now."""
    from drakegrasp.runtime import progress

    return progress.progress_bar(title, unit, show=show)


class Command(click.Command):
    """A command whose help has a section for each heading of its options."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options; called by click."""
        sections: dict[str, list[tuple[str, str]]] = {"Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None and not isinstance(parameter, click.Argument):
                heading = getattr(parameter, "heading", "Options")
                sections.setdefault(heading, []).append(record)
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)


class OneCommand(Command):
    """The only command of a script, with errors on one line; also the base of `Commands`."""

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Read the command line; for a group, the options before the name of the command."""
        with one_line_errors():
            return super().make_context(*args, **kwargs)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the requested command."""
        of_group = isinstance(self, click.Group)
        with one_line_errors(lambda: not of_group or ctx.invoked_subcommand == "build"):
            return super().invoke(ctx)


class Commands(OneCommand, click.Group):
    """Commands in the order of their definition, with errors on one line."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands' names."""
        return list(self.commands)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options and the commands; called by click."""
        click.Group.format_options(self, ctx, formatter)


@contextmanager
def one_line_errors(resumable: Callable[[], bool] = lambda: False) -> Iterator[None]:
    """Turn errors within the block into one line on standard error and an exit code.

    Args:
        resumable: Function that tells whether the same command continues after Ctrl-C.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGTERM, _stop)
    if before[signal.SIGINT] is signal.default_int_handler:  # a shell may have it ignored
        signal.signal(signal.SIGINT, _stop)
    try:
        yield
    except click.exceptions.NoArgsIsHelpError:
        raise
    except click.UsageError as error:
        if isinstance(error, click.NoSuchOption):
            # Click also compares the dashes, so any two short names are similar.
            names = {each.lstrip("-"): each for each in error.possibilities or ()}
            near = get_close_matches(error.option_name.lstrip("-"), names, cutoff=ALIKE)
            error = click.NoSuchOption(error.option_name, possibilities=[names[n] for n in near])
        _end(f"error: {_one_line(error.format_message())}", 2)
    except DrakegraspError as error:
        code = 2 if isinstance(error, WRONG_USAGE) else 1
        _end(f"error: {_one_line(str(error))}", code)
    except (click.Abort, click.exceptions.Exit, BrokenPipeError):
        # Click handles these; a reader that closes the pipe needs no more output.
        raise
    except (OSError, RuntimeError) as error:
        text = str(error).strip() or type(error).__name__
        _end(f"error: {text.splitlines()[0]}", 1)
    except MemoryError as error:
        _end(f"error: not enough memory on this machine ({first_line(error)})", 1)
    except KeyboardInterrupt as stop:
        line = "stopped" + "; the same command continues from here" * resumable()
        _end(line, 143 if isinstance(stop, _Terminated) else 130)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(line: str, code: int) -> NoReturn:
    """Print a line and have click end the program; click's own errors take four lines."""
    say(line, err=True)
    raise click.exceptions.Exit(code)


def _one_line(text: str) -> str:
    return " ".join(text.split())


class _Terminated(KeyboardInterrupt):
    """SIGTERM, which is handled like Ctrl-C: the command cleans up before it ends."""


def _stop(number: int, frame: FrameType | None) -> None:
    """Stop the running command, but not during the import of a module.

    A library may swallow the exception while it is imported, as trimesh does; the command would
    continue with a partly imported library. So the signal is sent again a moment later.
    """
    if _is_importing(frame):
        again = threading.Timer(AGAIN_SECONDS, os.kill, (os.getpid(), number))
        again.daemon = True
        again.start()
        return
    raise _Terminated if number == signal.SIGTERM else KeyboardInterrupt


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def restart_with_utf8() -> None:
    """Start this program again in Python's UTF-8 mode if the locale has another encoding.

    Under such a locale Drake cannot be imported, and files with names that the locale cannot encode
    cannot be opened. The streams keep the encoding of the terminal.
    """
    if sys.getfilesystemencoding() == "utf-8" or os.environ.get(_UTF8) == "1":
        return
    terminal = getattr(sys.stdout, "encoding", None) or "utf-8"
    environment = {_STREAMS: f"{terminal}:replace", **os.environ, _UTF8: "1"}
    os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)
