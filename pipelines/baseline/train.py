"""Train a network of the baseline on a dataset: postures, a classifier of postures, or contacts.

  python pipelines/baseline/train.py postures OUT/scenes.hdf5 postures.pt
  python pipelines/baseline/train.py classifier OUT/scenes.hdf5 classifier.pt
  python pipelines/baseline/train.py contacts OUT/grasping_oto.hdf5 contacts.pt --heads 5

The checkpoint holds the weights that validated best, all settings, a hash of the dataset's samples
and the versions. The same command gives the same weights on the same machine and versions.
"""

from __future__ import annotations

import argparse
import hashlib
import platform
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from batches import Batch, cloud_batches, image_batches
from fitting import fit
from networks import (
    ContactNetwork,
    GraspClassifier,
    HandCoordinates,
    PostureNetwork,
    PostureSize,
)
from torch import Tensor, nn
from torch.nn import functional

import drakegrasp as dg
from drakegrasp.errors import DataError, DrakegraspError

#: Points of a cloud that the classifier sees: it looks at each cloud once for each grasp.
SEEN = 256


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("data", type=Path, help="scenes.hdf5, or a data file for contacts")
    parser.add_argument("checkpoint", type=Path, help="where to write")
    parser.add_argument("--epochs", type=int, default=60, help="at most  [default: 60]")
    parser.add_argument("--patience", type=int, default=10, help="[default: 10]")
    parser.add_argument("--rate", type=float, default=1e-3, help="learning rate  [default: 0.001]")
    parser.add_argument("--batch", type=int, default=32, help="[default: 32]")
    parser.add_argument("--seed", type=int, default=0, help="[default: 0]")
    parser.add_argument("--heads", type=int, default=5, help="of contacts  [default: 5]")
    arguments = parser.parse_args(argv)
    try:
        history = TASKS[arguments.task](arguments)
    except DrakegraspError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 2
    print(  # noqa: T201
        f"{arguments.checkpoint}: epoch {history['best'] + 1} of {len(history['train'])}, "
        f"{history['seconds'] / 60:.1f} min, {history['loading']:.1%} of it loading"
    )
    return 0


# The tasks


def train_postures(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train the network that proposes postures, on samples."""
    train, valid = _scenes(arguments, negatives="none")
    hand = hand_of(train)
    torch.manual_seed(arguments.seed)
    size = PostureSize(closing=len(hand.directions))
    network = PostureNetwork(size)

    def loss(batch: Batch) -> Tensor:
        # One of the drawn grasps of each view.
        X_TG, q = batch["X_TG"][:, 0], batch["q"][:, 0]
        return network.loss(batch["points"], X_TG[:, :3, 3], X_TG[:, :3, :3], hand.coordinates(q))

    history = _fit(arguments, network, loss, train, valid, cloud_batches)
    _save(arguments, network, history, train, size=asdict(size), hand=hand.as_dict())
    return history


def train_classifier(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train the network that judges postures, on lifts to a verdict, and calibrate it."""
    train, valid = _scenes(arguments, negatives="tested")
    hand = hand_of(train)
    torch.manual_seed(arguments.seed)
    network = GraspClassifier(len(hand.directions))

    def loss(batch: Batch) -> Tensor:
        logits, labels = judged(network, hand, batch)
        return functional.binary_cross_entropy_with_logits(logits, labels)

    history = _fit(arguments, network, loss, train, valid, cloud_batches)
    with torch.no_grad():
        pairs = [judged(network, hand, batch) for batch in _valid_batches(arguments, valid)]
        if pairs:
            logits, labels = (torch.cat(each) for each in zip(*pairs, strict=True))
            network.temperature.copy_(temperature(logits, labels))
    _save(arguments, network, history, train, hand=hand.as_dict())
    return history


def train_contacts(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train the network of the paper's task: contacts from one image."""
    train, valid = (dg.GraspDataset(arguments.data, split=split) for split in ("train", "valid"))
    grasps = torch.from_numpy(train.column("grasps"))
    if not len(grasps):
        raise DataError(f"{arguments.data}: train must have samples, got none")
    torch.manual_seed(arguments.seed)
    scale = grasps.std(0, correction=0).clamp(min=1e-3)
    network = ContactNetwork(grasps.shape[1], arguments.heads, grasps.mean(0), scale)
    network(torch.zeros(1, 4, train.image_size, train.image_size))  # the lazy layer's size

    def loss(batch: Batch) -> Tensor:
        return network.loss(batch["images"], batch["grasps"])

    history = _fit(arguments, network, loss, train, valid, image_batches)
    _save(arguments, network, history, train, heads=arguments.heads)
    return history


TASKS = {
    "postures": train_postures,
    "classifier": train_classifier,
    "contacts": train_contacts,
}


# What they share


def judged(network: GraspClassifier, hand: HandCoordinates, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return logits and labels (n, 2), of held and sample, of all grasps of a batch."""
    grasps = batch["X_TG"].shape[1]
    clouds = batch["points"][:, :SEEN].repeat_interleave(grasps, 0)
    logits = network(
        clouds, batch["X_TG"].flatten(0, 1), hand.coordinates(batch["q"].flatten(0, 1))
    )
    labels = torch.stack([batch["held"], batch["sample"]], -1).flatten(0, 1)
    return logits, labels.float()


def temperature(logits: Tensor, labels: Tensor) -> Tensor:
    """Return the temperatures (2,) that make logits (n, 2) say how often labels (n, 2) are true."""
    tried = torch.logspace(-1, 1, 81)
    losses = torch.stack(
        [
            functional.binary_cross_entropy_with_logits(logits / t, labels, reduction="none").mean(
                0
            )
            for t in tried
        ]
    )
    return tried[losses.argmin(0)]


def hand_of(data: dg.SceneDataset) -> HandCoordinates:
    """Return the coordinates of the hand, from the samples of the training part."""
    grasps = data.tables["grasps"]
    rows = np.flatnonzero(grasps["sample"] & np.isin(grasps["scene"], scenes_of(data)))
    if len(rows) < 2:
        raise DataError(f"{data.path}: train must have two samples or more, got {len(rows)}")
    return HandCoordinates.fit(*(torch.from_numpy(grasps[key][rows]) for key in ("q", "q_open")))


def scenes_of(data: dg.SceneDataset) -> np.ndarray:
    """Return the rows of /scenes that items of a dataset are of."""
    return np.unique(data.tables["views"]["scene"][data.views])


def _scenes(
    arguments: argparse.Namespace, negatives: Any
) -> tuple[dg.SceneDataset, dg.SceneDataset | None]:
    """Return the parts that train and validate; a small dataset may have nothing that validates."""
    options = {"negatives": negatives, "seed": arguments.seed}
    train = dg.SceneDataset(arguments.data, split="train", **options)
    try:
        valid = dg.SceneDataset(arguments.data, split="valid", balance="view", **options)
    except DataError:
        return train, None
    return train, valid


def _fit(
    arguments: argparse.Namespace,
    network: nn.Module,
    loss: Any,
    train: Any,
    valid: Any,
    batches: Any,
) -> dict[str, Any]:
    """Fit a network with the settings of the command line."""
    draw = partial(batches, train, arguments.batch, augment=True, seed=arguments.seed)
    still = partial(_valid_batches, arguments, valid, batches)
    steps = -(-len(train) // arguments.batch)
    return fit(network, loss, draw, still, steps, arguments)


def _valid_batches(
    arguments: argparse.Namespace, valid: Any, batches: Any = cloud_batches
) -> Iterator[Batch]:
    if valid is not None and len(valid):
        yield from batches(valid, arguments.batch, 0, augment=False, seed=arguments.seed)


def _save(
    arguments: argparse.Namespace,
    network: nn.Module,
    history: dict[str, Any],
    data: Any,
    **more: Any,
) -> None:
    """Write the checkpoint, whole or not at all."""
    content = {
        "task": arguments.task,
        "weights": network.state_dict(),
        "settings": {k: v for k, v in vars(arguments).items() if not isinstance(v, Path)},
        "history": history,
        "data": hashlib.sha256(arguments.data.read_bytes()).hexdigest(),
        "versions": {"torch": str(torch.__version__), "python": platform.python_version()},
        **more,
    }
    partial_file = arguments.checkpoint.with_suffix(".part")
    torch.save(content, partial_file)
    partial_file.replace(arguments.checkpoint)


if __name__ == "__main__":
    sys.exit(main())
