"""What the commands print: help, output and errors; and their exit codes.

Every error is one line on standard error and an exit code: 0 done, 1 the work failed, 2 wrong
usage, 130 Ctrl-C, 143 SIGTERM. Printed text has no control characters, whatever names it contains.
Help is plain text in 80 columns: names on the left, texts on the right.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from textwrap import fill, wrap
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from cyclopts import App, CycloptsError, Group, Parameter

from drakegrasp.errors import (
    ConfigError,
    DataError,
    DrakegraspError,
    GraspError,
    HandError,
    MeshError,
    first_line,
    printable,
)

if TYPE_CHECKING:
    from cyclopts.help import HelpEntry, HelpPanel
    from rich.console import Console, ConsoleOptions

    from drakegrasp.runtime.progress import Report

#: Sections of a page, in their order: everyday options come before rare ones.
ARGUMENTS, OPTIONS = Group.create_ordered("Arguments"), Group.create_ordered("Options")
MORE, CLUSTER = Group.create_ordered("More options"), Group.create_ordered("Cluster options")
#: Widths of a page, and of its column of names [characters].
PAGE, NAMES = 80, 26
#: A signal that arrives while a module is imported is sent again after this time [s].
AGAIN_SECONDS = 0.05


class UsageError(DrakegraspError):
    """Options or arguments that do not fit each other."""


#: Errors in the user's input. All other errors are failures of the work.
WRONG_USAGE = (UsageError, ConfigError, GraspError, HandError, MeshError)


def say(text: str, *, err: bool = False) -> None:
    """Print a text; control characters are shown as their codes.

    Args:
        text: One line or more.
        err: Whether to print to standard error.
    """
    stream = sys.stderr if err else sys.stdout
    print("\n".join(map(printable, text.split("\n"))), file=stream, flush=True)


def say_finding(ok: bool, bad: str, text: str) -> None:
    """Print a line that begins with a green `ok`, or with another word in red."""
    word = "ok".ljust(len(bad)) if ok else bad
    if sys.stdout.isatty():
        word = f"\x1b[{32 if ok else 31}m{word}\x1b[0m"
    print(f"{word}  {printable(text)}", flush=True)  # noqa: T201


def say_json(document: Mapping[str, Any], *, indent: int | None = None) -> None:
    """Print a document as strict JSON, on one line if it is not indented."""
    say(json.dumps(document, allow_nan=False, indent=indent))


def progress_bar(title: str, unit: str, *, show: bool = True) -> AbstractContextManager[Report]:
    """Return the progress bar of `runtime.progress`, whose libraries are loaded only now."""
    from drakegrasp.runtime import progress

    return progress.progress_bar(title, unit, show=show)


@contextmanager
def processes(
    workers: int | None, title: str, unit: str, *, show: bool = True
) -> Iterator[dict[str, Any]]:
    """Yield the arguments `execute` and `progress` of a function that works in processes."""
    from drakegrasp.runtime import executor

    with executor.processes(workers) as execute, progress_bar(title, unit, show=show) as progress:
        yield {"execute": execute, "progress": progress}


def same_command(flags: Sequence[str], options: Sequence[str]) -> str:
    """Return the running command without some flags, and without some options with a value."""
    kept, left = ["drakegrasp"], iter(sys.argv[1:])
    for word in left:
        if word in options:
            next(left, None)
        elif word not in flags and word.partition("=")[0] not in options:
            kept.append(word)
    return shlex.join(kept)


def run_command(app: App, words: Sequence[str], *, resumable: bool = False) -> None:
    """Run the command that words name, with errors as one line and an exit code.

    Args:
        app: The commands.
        words: The command line without the name of the program.
        resumable: Whether the same command continues after Ctrl-C.

    Raises:
        SystemExit: If the command fails.
    """
    with one_line_errors(resumable):
        app(words, exit_on_error=False, print_error=False, result_action="return_value")


@contextmanager
def one_line_errors(resumable: bool) -> Iterator[None]:
    """Turn errors within the block into one line on standard error and an exit code."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGTERM, _stop)
    if before[signal.SIGINT] is signal.default_int_handler:  # a shell may have it ignored
        signal.signal(signal.SIGINT, _stop)
    try:
        yield
        sys.stdout.flush()
    except (CycloptsError, DrakegraspError) as error:
        # An error of ours that a validator raises is the cause of one of the library.
        cause = error.__cause__ if isinstance(error.__cause__, DrakegraspError) else error
        code = 2 if isinstance(cause, (CycloptsError, *WRONG_USAGE)) else 1
        _end(f"error: {' '.join(str(cause).split())}", code)
    except BrokenPipeError:
        # The reader needs no more output, and Python must not try to write it again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except (OSError, RuntimeError) as error:
        _end(f"error: {first_line(error)}", 1)
    except MemoryError as error:
        _end(f"error: not enough memory on this machine ({first_line(error)})", 1)
    except KeyboardInterrupt as stop:
        line = "stopped" + "; the same command continues from here" * resumable
        _end(line, 143 if isinstance(stop, _Terminated) else 130)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def wrong_input() -> Iterator[None]:
    """Turn an error of a dataset that the user names as input into wrong usage."""
    try:
        yield
    except DataError as error:
        raise GraspError(str(error)) from None


def _end(line: str, code: int) -> NoReturn:
    say(line, err=True)
    sys.exit(code)


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


# The help of commands.


def new_group(
    name: str, text: str | None, summaries: Mapping[str, str] | None = None, **more: Any
) -> App:
    """Return a group of commands, or a command, with the help and the options of all others.

    Args:
        name: Name of the group.
        text: Its help; None for the docstring of its function.
        summaries: Summaries of commands that are not imported for the help of the group.
        more: Other arguments of `cyclopts.App`.
    """
    return App(
        name=name,
        help=text,
        help_format="plaintext",
        suppress_keyboard_interrupt=False,
        help_formatter=PlainHelp(summaries or {}),
        # Flags have no negative form; of an option that is given twice, the last value counts.
        default_parameter=Parameter(negative=(), negative_iterable=(), allow_repeating=True),
        group_arguments=ARGUMENTS,
        group_parameters=OPTIONS,
        **more,
    )


class PlainHelp:
    """The format of a page of help; its methods are called by cyclopts."""

    def __init__(self, summaries: Mapping[str, str]) -> None:
        self.summaries = summaries

    def __call__(self, console: Console, options: ConsoleOptions, panel: HelpPanel) -> None:
        """Write a section with its names and their texts."""
        rows = [_row(entry, self.summaries) for entry in panel.entries]
        if not rows:
            return
        left = min(max(len(name) for name, _ in rows), NAMES)
        console.file.write(f"\n{panel.title}:\n")
        for name, text in rows:
            # A long name has a line of its own.
            lines = wrap(text, PAGE - left - 4, break_on_hyphens=False)
            first = "" if len(name) > left or not lines else lines.pop(0)
            console.file.write(f"  {name:<{left}}  {first}".rstrip() + "\n")
            console.file.writelines(f"{'':{left + 4}}{line}\n" for line in lines)

    def render_usage(self, console: Console, options: ConsoleOptions, usage: Any) -> None:
        """Write the line of the words that a command takes."""
        text = f"Usage: {str(usage).strip()}"
        console.file.write(fill(text, PAGE, subsequent_indent=" " * 7) + "\n")

    def render_description(self, console: Console, options: ConsoleOptions, text: Any) -> None:
        """Write the text of a command."""
        for paragraph in filter(None, _plain(text).split("\n\n")):
            # The first line of a text has lost its indentation.
            kept = "\n    " in paragraph or paragraph.startswith("    ")
            lines = [f"    {line.strip()}" for line in paragraph.splitlines()]
            filled = "\n".join(lines) if kept else fill(paragraph, PAGE, break_on_hyphens=False)
            console.file.write(f"\n{filled}\n")


def _plain(text: Any) -> str:
    """Return a text of cyclopts without its format; empty if there is none."""
    return str(getattr(text, "primary_renderable", "")).rstrip()


def _row(entry: HelpEntry, summaries: Mapping[str, str]) -> tuple[str, str]:
    """Return the names of an option, an argument or a command, and its text."""
    value = "|".join(entry.choices) if entry.choices else entry.metavar
    names = ", ".join(entry.display_labels)
    name = f"{names} {value}" if value and not entry.positional_label else names
    return name, summaries.get(name) or " ".join(filter(None, _sentences(entry)))


def _sentences(entry: HelpEntry) -> Iterator[str]:
    yield " ".join(_plain(entry.description).split())
    if entry.required and not entry.positional_label:
        yield "[required]"
    if entry.default not in (None, "False", "True", "()"):
        yield f"[default: {entry.default}]"
