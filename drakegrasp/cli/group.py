"""The group that every command belongs to."""

from __future__ import annotations

import click

from drakegrasp import __version__
from drakegrasp.cli.errors import Commands


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="drakegrasp")
def main() -> None:
    """Simulate multi-finger grasps of object meshes and write datasets of them."""
