"""Describe how the objects of a directory come to rest, one line per object.

\b
    python pipelines/measurements/resting.py MESHES --units cm

The script prints the number of faces of each collision mesh, how deep the object sinks into the
table, its tilt, the simulated time until it rests, and notes.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from drakegrasp.cli.options import shared
from drakegrasp.errors import MeshError
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import find_meshes
from drakegrasp.simulation.settle import settle


@click.command(help=__doc__)
@click.argument("meshes", type=click.Path(path_type=Path, exists=True))
@shared("--units")
def main(meshes: Path, units: str) -> None:
    """Run the script."""
    config = load_config()
    for source in find_meshes(meshes, units=units):
        try:
            model = prepare_object(source, config.objects)
            resting = settle(model, config)
        except MeshError as error:
            click.echo(f"{source.name}: refused: {error}")
            continue
        click.echo(
            f"{source.name}: {len(model.collision_faces)} faces, {resting.sink * 1e3:.3f} mm deep, "
            f"tilted by {np.degrees(resting.tilt):.1f} degrees, rested after "
            f"{resting.seconds:.2f} s {'; '.join(resting.notes)}"
        )


if __name__ == "__main__":
    main()
