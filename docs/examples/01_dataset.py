"""Build a dataset.

Simulate grasps of three built-in objects, count how the attempts ended, and look at the images.

Concepts: object, palm pose, attempt, outcome, sample.
"""

from collections import Counter

import matplotlib.pyplot as plt
import numpy as np

import drakegrasp as dg

OBJECTS = ["4_wineglass_1", "24_carton_1", "33_boot_1"]


def main() -> None:
    """Build the dataset that the other examples read, and draw one sample of each object."""
    # A few palm poses that face the surface are enough for a first look. Each gives three
    # attempts, one per distance between palm and surface.
    config = dg.load_config(
        overrides=["builtin.per_class=1", "candidates.method=normals", "candidates.max=16"]
    )
    # One worker process per core; the same call continues an interrupted build.
    dg.build_dataset("builtin", "example/dataset", config=config, only=OBJECTS, workers=2)

    # Every attempt has a row, whether it succeeded or not.
    outcomes = Counter(dg.Trials("example/dataset")["outcome"].tolist())
    for value, count in outcomes.most_common():
        print(f"{count:4d} {dg.Outcome(value).label}")

    # Successes that pass the filters are samples, each with the images of that grasp.
    samples = {}
    for split in ("train", "valid", "test"):
        for sample in dg.GraspDataset("example/dataset/grasping_otm.hdf5", split=split):
            samples.setdefault(sample.props["object_name"], sample)

    figure, axes = plt.subplots(3, len(samples), figsize=(2.2 * len(samples), 6.8), squeeze=False)
    for column, (name, sample) in zip(axes.T, samples.items(), strict=True):
        colour, depth = np.moveaxis(sample.image[:3], 0, 2), sample.image[3]  # depth in [m]
        column[0].imshow(colour)
        column[1].imshow(np.where(depth < 0.6, depth, np.nan))
        column[2].imshow(sample.mask, cmap="gray")
        column[0].set_title(name)
        for panel in column:
            panel.axis("off")
    figure.tight_layout()
    figure.savefig("example/01_dataset.png")


if __name__ == "__main__":
    main()
