"""Load batches for training.

Read images and grasps in random order, and draw the grasps into their images.

Concepts: split, batch, grasp vector, camera frame, camera matrix.
"""

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np

import drakegrasp as dg


def batches(data: dg.GraspDataset, size: int, seed: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield images (n, 4, 128, 128) and grasps (n, 18) in random order.

    With torch, `DataLoader(data.to_torch(["images", "grasps"]), batch_size=size, shuffle=True)`
    does this with as many processes as you like.
    """
    order = np.random.default_rng(seed).permutation(len(data))
    for start in range(0, len(data), size):
        samples = [data[int(row)] for row in order[start : start + size]]
        yield np.stack([s.image for s in samples]), np.stack([s.grasp for s in samples])


def main() -> None:
    """Draw the first batch of the dataset of 01_dataset.py."""
    # Reading needs NumPy and h5py only. The splits share no object here.
    data = dg.GraspDataset("example/dataset/grasping_oto.hdf5", split="train")
    print(len(data), "samples to train on, K =", data.K.round(1).tolist())

    images, grasps = next(batches(data, size=4, seed=0))
    figure, axes = plt.subplots(1, len(images), figsize=(2.6 * len(images), 2.7), squeeze=False)
    for panel, image, grasp in zip(axes[0], images, grasps, strict=True):
        # Three contact points [m] and their normals out of the object, in the camera frame {C}.
        p_CQ, nhat_Q_C = dg.unpack_grasp(grasp)
        panel.imshow(np.moveaxis(image[:3], 0, 2))
        for point, tip, colour in zip(p_CQ, p_CQ + 0.03 * nhat_Q_C, "rbg", strict=True):
            u, v, depth = data.K @ np.column_stack([point, tip])
            panel.plot(u / depth, v / depth, color=colour)
            panel.plot(u[0] / depth[0], v[0] / depth[0], "o", color=colour)
        panel.set(xlim=(0, 127), ylim=(127, 0))
        panel.axis("off")
    figure.tight_layout()
    figure.savefig("example/02_loader.png")


if __name__ == "__main__":
    main()
