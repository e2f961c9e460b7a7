"""A package that adds one extension of each kind.

pyproject.toml in the folder above names them; docs/how-to/extend.md defines what each must be.
"""

import json
import os
from pathlib import Path

import numpy as np

from drakegrasp.cluster.connect import connect
from drakegrasp.cluster.kinds import Local
from drakegrasp.exchange.export import read_closed_grasps
from drakegrasp.filters import Filter, Removal
from drakegrasp.frames import invert_pose, make_pose
from drakegrasp.protocols.protocol import DexGraspBench

#: A hand is the path of its hand file.
HAND = Path(__file__).with_name("jaw_hand.yaml")
#: The text of the exporter in `drakegrasp export --help`.
HELP = "a line of JSON per sample: object, palm pose, joints"

#: A filter decides which rows of a table are removed: here objects that turned in the hand.
CALM = Filter(
    removal=Removal.OWN,
    needs=("turn",),
    refuses=lambda table, limits: ~(table["turn"] <= np.radians(3.0)),
)


class Down:
    """A sampler: palms above the object's centre that look straight down."""

    def __init__(self, model, X_TO, stream, config):
        """Take an object at rest, and the random numbers of the draw."""
        self.far = 2.0 * np.sqrt(np.sum(model.half_extents**2))
        self.up, self.stream = X_TO[2, :3], stream

    def poses(self):
        """Yield poses X_OG (4, 4); +Gz points out of the palm."""
        side = np.cross(self.up, np.eye(3)[np.argmin(np.abs(self.up))])
        side /= np.sqrt(np.sum(side**2))
        while True:
            angle = 2.0 * np.pi * self.stream.uniform(1)[0]
            x = np.cos(angle) * side + np.sin(angle) * np.cross(self.up, side)
            R_OG = np.stack([x, np.cross(-self.up, x), -self.up], axis=1)
            yield make_pose(R_OG, self.far * self.up)


class Slippery(DexGraspBench):
    """A protocol: DexGraspBench with a third of its friction."""

    name, source = "slippery", "docs/examples/plugin"
    friction = (0.2, 0.02)


def write_palms(out, folder, progress):
    """Write the samples of a dataset, and return their number: an exporter."""
    grasps = list(read_closed_grasps(out))
    with (folder / "samples.palms").open("w") as file:
        for grasp in grasps:
            X_OG = invert_pose(grasp.X_TO) @ grasp.X_TG
            row = {"object": grasp.object_name, "X_OG": X_OG.tolist(), "q": grasp.q.tolist()}
            file.write(json.dumps(row) + "\n")
    progress(len(grasps), len(grasps))
    return len(grasps)


def read_palms(path, hand):
    """Return the postures of a file as arguments of `make_attempts`: an importer."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    return {
        "objects": [row["object"] for row in rows],
        "X_FG": [row["X_OG"] for row in rows],
        "q_grasp": [row["q"] for row in rows],
    }


class Half(Local):
    """A kind of cluster: workers on half of the cores of this machine."""

    options = ("memory",)

    def connected(self, out):
        """Return what starts the workers when it is entered."""
        half = max(1, (os.cpu_count() or 1) // 2)
        return connect(half, tls=self.tls, tls_files=self.tls_files, memory=self.memory)
