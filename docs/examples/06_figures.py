"""Draw figures of a dataset.

Write all figures that the package knows, then one of your own from the columns of the files.

Concepts: figures, column, slip, contact force.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import drakegrasp as dg
from drakegrasp.pictures.figures import write_figures


def main() -> None:
    """Draw figures of the dataset of 01_dataset.py."""
    # The same as `drakegrasp figures example/dataset`: PNG, SVG, and the numbers in them as JSON.
    written = write_figures(Path("example/dataset"), Path("example/figures"))
    print(", ".join(written.names), "in", written.folder)

    # A column is one array over all samples of a split: how hard the fingers press, and how far
    # the object slips in the hand until the end of the lift.
    figure, axes = plt.subplots(figsize=(5.0, 3.4))
    for split in ("train", "valid", "test"):
        data = dg.GraspDataset("example/dataset/grasping_oto.hdf5", split=split)
        names = sorted(set(data.column("object_props/object_name")))
        f_Q_C = data.column("grasp_props/f_Q_C_lifted")  # (N, 3, 3) [N], a force per fingertip
        slip = data.column("grasp_props/slip")  # (N,) [m]
        force = np.linalg.norm(f_Q_C, axis=2).sum(axis=1)
        axes.plot(force, 1e3 * slip, "o", label=f"{split}: {', '.join(names)}")
    axes.set(xlabel="sum of fingertip forces [N]", ylabel="slip in the hand [mm]", ylim=(0, None))
    axes.legend()
    figure.tight_layout()
    figure.savefig("example/06_figures.png")


if __name__ == "__main__":
    main()
