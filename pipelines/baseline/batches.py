"""Batches for the networks: tensors from `dg.SceneDataset` and `dg.GraspDataset`.

A cloud is turned by a random angle about the table's normal, together with its grasps, because the
physics does not depend on the direction of the table's x axis. It is shifted horizontally so that
the mean of the object's points is above the origin; heights stay the same, because the table
matters. Noise of 1 mm is added to the points. Nothing is mirrored, since a hand differs from its
mirror image.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, DataLoader

import drakegrasp as dg

#: Number of points of a cloud that a network sees; all lie on the object.
POINTS = 512
#: Standard deviation of the noise that is added to the points [m].
NOISE = 1e-3

Batch = dict[str, Tensor]


def object_points(points: np.ndarray, on_object: np.ndarray, count: int = POINTS) -> np.ndarray:
    """Return `count` points (count, 3) on the object, of a cloud (n, 3).

    Points are repeated in turn if there are fewer. If no point of the cloud lies on the object,
    points of the whole cloud are returned.
    """
    own = np.flatnonzero(on_object) if on_object.any() else np.arange(len(points))
    return points[own[np.arange(count) % len(own)]]


def cloud_batches(
    data: Sequence[dg.SceneDataset], size: int, epoch: int, *, augment: bool, seed: int
) -> Iterator[Batch]:
    """Yield batches of clouds with grasps, of one epoch; the same arguments yield the same batches.

    Args:
        data: Scenes of one or more files, of the same hand, in the frame "table".
        size: Number of views in a batch.
        epoch: Number of the epoch.
        augment: Whether clouds are turned, noise is added to points, and views come in random
            order.
        seed: Seed of all random draws.

    Yields:
        `points` (b, n, 3) in {T}; `X_TG` (b, g, 4, 4), `q` (b, g, j), `q_open`, and `lifted`,
        `kept`, `tested` (b, g) of the grasps; `shift` (b, 3), the vector subtracted from all
        points.
    """
    for each in data:
        each.epoch = epoch
    views = ConcatDataset(data)
    draw = torch.Generator().manual_seed(1_000_003 * seed + epoch)
    order = torch.randperm(len(views), generator=draw) if augment else torch.arange(len(views))
    for start in range(0, len(order), size):
        items = [views[int(i)] for i in order[start : start + size]]
        batch = {
            "points": _stack([object_points(i["points"], i["on_object"]) for i in items]),
            "X_TG": _stack([i["X_AG"] for i in items]),
            **{k: _stack([i[k] for i in items]) for k in ("q", "q_open", "lifted", "kept")},
            "tested": _stack([i["tested"] for i in items]),
        }
        yield centred(turned(batch, draw) if augment else batch)


def turned(batch: Batch, draw: torch.Generator) -> Batch:
    """Return a batch whose clouds and grasps are turned about Tz, with noise on the points."""
    angle = 2 * torch.pi * torch.rand(len(batch["points"]), generator=draw)
    c, s, o, e = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    R = torch.stack([c, -s, o, s, c, o, o, o, e], -1).view(-1, 3, 3)
    noise = NOISE * torch.randn(batch["points"].shape, generator=draw)
    X_TG = batch["X_TG"].clone()
    X_TG[..., :3, :] = R[:, None] @ X_TG[..., :3, :]
    return {**batch, "points": batch["points"] @ R.mT + noise, "X_TG": X_TG}


def centred(batch: Batch) -> Batch:
    """Return a batch whose clouds are shifted so that their mean is above the origin of {T}."""
    shift = batch["points"].mean(1)
    shift[:, 2] = 0.0
    X_TG = batch["X_TG"].clone()
    X_TG[..., :3, 3] -= shift[:, None]
    return {**batch, "points": batch["points"] - shift[:, None], "X_TG": X_TG, "shift": shift}


def image_batches(
    data: Sequence[dg.GraspDataset], size: int, epoch: int, *, augment: bool, seed: int
) -> Iterator[Batch]:
    """Yield batches of `images` (b, 4, S, S) and their `grasps` (b, 6k).

    The images are in -1..1 except for noise. They are not turned or mirrored, because the camera of
    each image is placed behind the palm of its grasp.
    """
    draw = torch.Generator().manual_seed(1_000_003 * seed + epoch)
    samples = ConcatDataset([each.to_torch(["images", "grasps"]) for each in data])
    loader = DataLoader(samples, batch_size=size, shuffle=augment, generator=draw)
    for batch in loader:
        images = as_input(batch["images"])
        if augment:
            brightness = 0.2 * torch.randn((len(images), 3, 1, 1), generator=draw)
            images[:, :3] += brightness
            images[:, 3] += 0.01 * torch.randn(images[:, 3].shape, generator=draw)
        yield {"images": images, "grasps": batch["grasps"]}


def as_input(images: Tensor) -> Tensor:
    """Return images with colours centred at 0, and depths centred at 0.25 m in units of 0.1 m."""
    depth = ((images[:, 3:] - 0.25) / 0.1).clamp(-3, 3)
    return torch.cat([2 * images[:, :3] - 1, depth], 1)


def _stack(arrays: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.stack(arrays))
