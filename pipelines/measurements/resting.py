"""Prints how the objects of a directory come to rest: `python resting.py MESHES [UNITS]`."""

from __future__ import annotations

import sys

import numpy as np

from drakegrasp.errors import MeshError
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import prepare_object
from drakegrasp.objects.sources import find_meshes
from drakegrasp.simulation.settle import settle


def main(meshes: str, units: str) -> None:
    """Print a line per object: faces of its collision mesh, sink, tilt, simulated time, notes."""
    config = load_config()
    for source in find_meshes(meshes, units=units):
        try:
            model = prepare_object(source, config.objects)
            resting = settle(model, config)
        except MeshError as error:
            sys.stdout.write(f"{source.name}: refused: {error}\n")
            continue
        sys.stdout.write(
            f"{source.name}: {len(model.collision_faces)} faces, {resting.sink * 1e3:.3f} mm deep, "
            f"tilted by {np.degrees(resting.tilt):.1f} degrees, rested after "
            f"{resting.seconds:.2f} s {'; '.join(resting.notes)}\n"
        )


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else "m")
