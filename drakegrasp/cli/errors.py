"""How commands end: every error is one line on standard error and an exit code.

0 done, 1 the work failed, 2 wrong usage, 130 Ctrl-C, 143 SIGTERM.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import click

from drakegrasp.errors import ConfigError, DrakegraspError, GraspError, HandError, MeshError

#: Errors of what was asked for, as against errors of what was done.
WRONG_USAGE = (ConfigError, GraspError, HandError, MeshError)


class Commands(click.Group):
    """Commands in the order of their definition, and errors in one line."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands' names."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that was asked for."""
        with one_line_errors(ctx):
            return super().invoke(ctx)


class OneCommand(click.Command):
    """A script's only command: a build, with errors in one line."""

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Read the command line."""
        try:
            return super().make_context(*args, **kwargs)
        except click.UsageError as error:
            click.echo(f"error: {' '.join(error.format_message().split())}", err=True)
            raise SystemExit(2) from None

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command."""
        with one_line_errors(ctx, builds=True):
            return super().invoke(ctx)


@contextmanager
def one_line_errors(ctx: click.Context, *, builds: bool = False) -> Iterator[None]:
    """Turn errors within the block into one line on standard error and an exit code."""
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    except DrakegraspError as error:
        click.echo(f"error: {' '.join(str(error).split())}", err=True)
        ctx.exit(2 if isinstance(error, WRONG_USAGE) else 1)
    except click.UsageError as error:
        if isinstance(error, click.exceptions.NoArgsIsHelpError):
            raise
        click.echo(f"error: {' '.join(error.format_message().split())}", err=True)
        ctx.exit(2)
    except BrokenPipeError:
        # Whoever reads has what it wanted; at the end Python would complain once more.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        ctx.exit(1)
    except (OSError, RuntimeError) as error:
        if isinstance(error, click.exceptions.Exit | click.Abort):
            raise
        text = str(error).strip() or type(error).__name__
        click.echo(f"error: {text.splitlines()[0]}", err=True)
        ctx.exit(1)
    except KeyboardInterrupt as stop:
        goes_on = builds or ctx.invoked_subcommand == "build"
        click.echo(f"stopped{'; the same command goes on from here' * goes_on}", err=True)
        ctx.exit(143 if isinstance(stop, _Terminated) else 130)
    finally:
        signal.signal(signal.SIGTERM, before)


class _Terminated(KeyboardInterrupt):
    """SIGTERM: what is begun is left as after Ctrl-C."""


def _terminate(number: int, frame: object) -> None:
    raise _Terminated
