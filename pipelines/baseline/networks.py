"""The networks of the baseline: postures from a cloud, verdicts on them, contacts from an image.

They are plain PyTorch and meant to be changed. Poses and points are in metres, angles in radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional


def mlp(*sizes: int) -> nn.Sequential:
    """Return linear layers of the given sizes, with a ReLU between successive layers."""
    layers: list[nn.Module] = []
    for width_in, width_out in pairwise(sizes):
        layers += [nn.Linear(width_in, width_out), nn.ReLU()]
    return nn.Sequential(*layers[:-1])


# The cloud


def farthest_points(points: Tensor, count: int) -> Tensor:
    """Return indices (b, count) of points (b, n, 3), each farthest from the points before it.

    The first index is 0, so the choice needs no random numbers.
    """
    chosen = torch.zeros(len(points), count, dtype=torch.long, device=points.device)
    nearest = torch.full(points.shape[:2], torch.inf, device=points.device)
    for k in range(1, count):
        last = points.gather(1, chosen[:, k - 1, None, None].expand(-1, 1, 3))
        nearest = torch.minimum(nearest, (points - last).square().sum(-1))
        chosen[:, k] = nearest.argmax(1)
    return chosen


class PointEncoder(nn.Module):
    """One level of set abstraction as in PointNet++, and a feature of the whole cloud.

    Source: Qi et al., PointNet++ (NeurIPS 2017).

    Args:
        seeds: Number of points that get a feature.
        neighbours: Number of points that each feature sees.
        width: Length of a feature.
        scale: Length by which coordinates are divided [m].
    """

    def __init__(self, seeds: int, neighbours: int, width: int, scale: float = 0.05) -> None:
        super().__init__()
        self.seeds, self.neighbours, self.scale = seeds, neighbours, scale
        self.local = mlp(3, 32, 64, width)
        self.whole = mlp(width + 3, width, 2 * width)

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return the seeds (b, s, 3) of clouds (b, n, 3), and features (b, s, 3 + 3 width)."""
        chosen = farthest_points(points, self.seeds)
        centres = points.gather(1, chosen[..., None].expand(-1, -1, 3))

        # What each seed sees around it, and what all seeds see together.
        near = torch.cdist(centres, points).topk(self.neighbours, largest=False).indices
        patches = points[torch.arange(len(points))[:, None, None], near] - centres[:, :, None]
        local = self.local(patches / self.scale).amax(2)
        places = centres / self.scale
        whole = self.whole(torch.cat([places, local], -1)).amax(1, keepdim=True)
        return centres, torch.cat([places, local, whole.expand(-1, self.seeds, -1)], -1)


# Postures


@dataclass(frozen=True)
class PostureSize:
    """Sizes of a posture network.

    Attributes:
        closing: Number of coordinates of the closed hand.
        seeds: Number of points of the cloud that propose postures.
        modes: Number of postures that each seed proposes.
        neighbours: Number of points that each seed sees.
        width: Length of a feature.
    """

    closing: int
    seeds: int = 64
    modes: int = 4
    neighbours: int = 16
    width: int = 128


class PostureNetwork(nn.Module):
    """Network that predicts postures from the cloud of one view.

    It is a mixture density with a few modes at each seed.

    A mode has a palm position p_TG relative to its seed, a rotation as two columns that are made
    orthonormal (Zhou et al., CVPR 2019), and coordinates of the closed hand. All modes share three
    learned widths, one for each of the three parts.

    Args:
        size: Sizes of the network.
    """

    def __init__(self, size: PostureSize) -> None:
        super().__init__()
        self.size = size
        self.encoder = PointEncoder(size.seeds, size.neighbours, size.width)
        self.head = mlp(3 + 3 * size.width, 256, 256, size.modes * (10 + size.closing))
        # Widths of position [m], rotation [rad] and coordinates, large before training.
        self.log_width = nn.Parameter(torch.log(torch.tensor([0.05, 0.5, 0.5])))

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the modes of a cloud (b, n, 3) in {T}; there are m = seeds x modes of them.

        Returns:
            Logarithms of the weights (b, m); positions p_TG (b, m, 3) [m]; rotations R_TG
            (b, m, 3, 3); coordinates of the closed hand (b, m, c), of unit variance.
        """
        centres, features = self.encoder(points)
        out = self.head(features).unflatten(-1, (self.size.modes, -1))
        weight = functional.log_softmax(out[..., 0].flatten(1), -1)
        position = centres[:, :, None] + 0.1 * out[..., 1:4]
        rotation = orthonormal(out[..., 4:10].unflatten(-1, (2, 3)))
        return weight, position.flatten(1, 2), rotation.flatten(1, 2), out[..., 10:].flatten(1, 2)

    def loss(self, points: Tensor, p_TG: Tensor, R_TG: Tensor, closing: Tensor) -> Tensor:
        """Return the negative log-likelihood of postures for each cloud, averaged over the batch.

        Args:
            points: (b, n, 3), points in {T}.
            p_TG: (b, g, 3), palm positions.
            R_TG: (b, g, 3, 3), palm rotations.
            closing: (b, g, c), coordinates of the closed hand.
        """
        return -self.log_density(self(points), p_TG, R_TG, closing).mean()

    def log_density(
        self, modes: Sequence[Tensor], p_TG: Tensor, R_TG: Tensor, closing: Tensor
    ) -> Tensor:
        """Return log densities (b, g) of postures, given the modes that `forward` returned."""
        weight, *means = modes
        widths = self.log_width.clamp(min=-4.6)  # 10 mm, 0.6 deg: never a spike
        x, y = (self._in_widths(each, widths) for each in ((p_TG, R_TG, closing), means))
        squares = x.square().sum(-1)[:, :, None] + y.square().sum(-1)[:, None] - 2 * x @ y.mT
        sizes = torch.tensor([3.0, 3.0, self.size.closing], device=p_TG.device)
        density = weight[:, None] - 0.5 * squares - (sizes * widths).sum()
        return torch.as_tensor(density.logsumexp(-1))

    @staticmethod
    def _in_widths(postures: Sequence[Tensor], widths: Tensor) -> Tensor:
        """Return postures as vectors (b, n, 12 + c), scaled so that all widths are 1.

        |R - R'|^2 = 8 sin^2(angle / 2), so half of it is close to the squared angle.
        """
        position, rotation, coordinates = postures
        parts = position, rotation.flatten(-2) / 2**0.5, coordinates
        scaled = [part * (-width).exp() for part, width in zip(parts, widths, strict=True)]
        return torch.cat(scaled, -1)


def orthonormal(columns: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) made of two vectors (..., 2, 3).

    The x axis lies along the first vector, and the y axis in the plane of both.
    """
    x = functional.normalize(columns[..., 0, :], dim=-1)
    y = columns[..., 1, :]
    y = functional.normalize(y - (x * y).sum(-1, keepdim=True) * x, dim=-1)
    return torch.stack([x, y, torch.linalg.cross(x, y)], -1)


# Verdicts


class GraspClassifier(nn.Module):
    """Network that judges whether a posture holds an object, and whether it becomes a sample.

    It is a PointNet on the cloud that the palm sees. The cloud and the table are expressed in the
    palm's frame {G}, so the network need not learn that the verdict is the same if both are turned
    together. `temperature` divides the logits; calibration sets it.

    Source: Qi et al., PointNet (CVPR 2017); Guo et al., On Calibration (ICML 2017).

    Args:
        closing: Number of coordinates of the closed hand.
    """

    def __init__(self, closing: int, width: int = 128) -> None:
        super().__init__()
        self.points = mlp(3, 64, 128, 2 * width)
        self.head = nn.Sequential(nn.Dropout(0.2), mlp(2 * width + 4 + closing, 256, 128, 2))
        self.register_buffer("temperature", torch.ones(2))

    def forward(self, cloud: Tensor, X_TG: Tensor, closing: Tensor) -> Tensor:
        """Return logits (b, 2) of "lifted" and "kept".

        Args:
            cloud: (b, n, 3), points in {T}.
            X_TG: (b, 4, 4), pose of the palm.
            closing: (b, c), coordinates of the closed hand.
        """
        R_TG, p_TG = X_TG[:, :3, :3], X_TG[:, :3, 3]
        cloud_G = (cloud - p_TG[:, None]) @ R_TG
        table = torch.cat([R_TG[:, 2], p_TG[:, 2:] / 0.1], -1)  # normal in {G}; height [0.1 m]
        seen = self.points(cloud_G / 0.1).amax(1)
        return self.head(torch.cat([seen, table, closing], -1)) / self.temperature


# The paper's task


class ContactNetwork(nn.Module):
    """Network that predicts contact points and normals from one RGB-D image, with several heads.

    A single head regresses to the mean of all correct answers. With several heads the best one
    learns from a sample, and the network also predicts how likely each is (Rupprecht et al., ICCV
    2017).

    Args:
        length: Length of a grasp: 6 numbers per finger.
        heads: Number of heads.
        mean, scale: (length,), mean and standard deviation of the grasps of the training part.
    """

    def __init__(self, length: int, heads: int, mean: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.length, self.heads = length, heads
        layers: list[nn.Module] = []
        for width_in, width_out in ((4, 16), (16, 32), (32, 64), (64, 128), (128, 128)):
            layers += [
                nn.Conv2d(width_in, width_out, 3, 2, 1),
                nn.GroupNorm(8, width_out),
                nn.ReLU(),
            ]
        self.image = nn.Sequential(*layers, nn.Flatten(), nn.LazyLinear(256), nn.ReLU())
        self.head = nn.Linear(256, heads * (length + 1))
        self.register_buffer("mean", mean)
        self.register_buffer("scale", scale)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return grasps (b, h, length) for images (b, 4, S, S), and log chances (b, h)."""
        out = self.head(self.image(images)).unflatten(-1, (self.heads, self.length + 1))
        return self.mean + self.scale * out[..., 1:], functional.log_softmax(out[..., 0], -1)

    def loss(self, images: Tensor, grasp: Tensor) -> Tensor:
        """Return the best head's mean error plus the surprise that this head is the best."""
        grasps, chance = self(images)
        error = ((grasps - grasp[:, None]) / self.scale).square().mean(-1)
        best = error.argmin(-1)
        # The other heads learn a little as well, or a head that is never the best would never
        # learn.
        return (0.95 * error.amin(-1) + 0.05 * error.mean(-1)).mean() + 0.1 * functional.nll_loss(
            chance, best
        )


# The hand


@dataclass(frozen=True, eq=False)
class HandCoordinates:
    """A few coordinates of a closed hand of j joints, found in the data.

    Coupled joints move together in every row, so closed hands differ in as many directions as the
    hand has motors. A posture built from these directions satisfies the couplings.

    Attributes:
        mean: (j,), mean positions of the closed joints.
        directions: (c, j), directions: a closed hand is mean + coordinates @ directions.
        open: (j,), joint positions of the open hand; NaN for joints that are set before closing,
            such as the spread.
    """

    mean: Tensor
    directions: Tensor
    open: Tensor

    @classmethod
    def fit(cls, closed: Tensor, opened: Tensor) -> HandCoordinates:
        """Return the coordinates fitted to closed and open hands, (n, j) each [rad or m]."""
        mean = closed.mean(0)
        _, values, rows = torch.linalg.svd(closed - mean, full_matrices=False)
        deviations = values / max(len(closed) - 1, 1) ** 0.5
        kept = deviations > 0.02 * deviations[0]
        still = opened.std(0, correction=0) < 1e-3
        return cls(mean, rows[kept] * deviations[kept, None], opened[0].where(still, torch.nan))

    def coordinates(self, q: Tensor) -> Tensor:
        """Return coordinates (n, c), of unit variance, of joint positions (n, j)."""
        square = self.directions.square().sum(1)
        return (q - self.mean) @ self.directions.T / square

    def closed(self, coordinates: Tensor) -> Tensor:
        """Return the joint positions (n, j) [rad or m] of coordinates (n, c)."""
        return self.mean + coordinates @ self.directions

    def opened(self, q: Tensor) -> Tensor:
        """Return the open hands (n, j) from which hands close to the joint positions (n, j)."""
        return self.open.where(~self.open.isnan(), q)

    def as_dict(self) -> dict[str, Tensor]:
        """Return the values that a checkpoint stores."""
        return asdict(self)
