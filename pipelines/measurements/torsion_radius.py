"""Measure the torsion radius of the contact patches of fingertips in a dataset.

    python pipelines/measurements/torsion_radius.py OUT --every 2

A patch under the normal force f resists twisting with a torque of at most mu f r, where its torsion
radius r is the mean distance of its pressure from the centre of pressure. For a disc of radius R, r
is 2/3 R under uniform pressure, and 8/15 R if the pressure falls to zero at the rim as a
paraboloid. Held trials are simulated again. Each patch is that of a fingertip after closing, or at
the end of the lift.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np

import drakegrasp as dg
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation import contacts


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="directory of a dataset")
    parser.add_argument("--every", type=int, default=1, help="each n-th held trial (default: 1)")
    arguments = parser.parse_args(argv)
    with h5py.File(arguments.dataset / TRIALS_FILE) as file:
        held = np.flatnonzero(file["trials/outcome"][()] == Outcome.SUCCESS)[:: arguments.every]

    # Record the faces of each patch while the simulation reads them.
    read, patches = contacts._read_faces, []

    def note(surface: Any, object_is_M: bool) -> Any:
        patches.append(faces := read(surface, object_is_M))
        return faces

    with mock.patch.object(contacts, "_read_faces", note):
        for trial in held.tolist():
            dg.replay_trial(arguments.dataset, trial)

    # Torsion radius, and radius of a disc of the same area.
    radii, discs = [], []
    for areas, centres, _, pressures, _ in patches:
        weights = areas * pressures
        if weights.sum() > 0.0:
            centre = np.average(centres, axis=0, weights=weights)
            distances = np.linalg.norm(centres - centre, axis=1)
            radii.append(np.average(distances, weights=weights))
            discs.append(np.sqrt(areas.sum() / np.pi))
    low, middle, high = np.percentile(radii, [25, 50, 75]) * 1e3
    sys.stdout.write(
        f"{len(radii)} patches of {len(held)} trials: torsion radius {middle:.2f} mm (half of them "
        f"{low:.2f} to {high:.2f}), {np.median(np.divide(radii, discs)):.3f} of the radius of a "
        f"disc of their area ({np.median(discs) * 1e3:.2f} mm)\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
