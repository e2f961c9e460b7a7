"""What commands print: lines without control characters, whatever names are in them."""

from __future__ import annotations

import click

from drakegrasp.errors import printable


def say(text: str, *, err: bool = False) -> None:
    """Print a text; what would steer the terminal is shown as its code.

    Args:
        text: One line or more.
        err: Whether to print to standard error.
    """
    click.echo("\n".join(map(printable, text.split("\n"))), err=err)
