"""Train a network of the baseline on a dataset: postures, a classifier of postures, or contacts.

  python pipelines/baseline/train.py postures OUT/scenes.hdf5 postures.pt
  python pipelines/baseline/train.py classifier OUT/scenes.hdf5 classifier.pt
  python pipelines/baseline/train.py contacts OUT/grasping_oto.hdf5 contacts.pt --heads 5

Several files of one hand train together, and the first one validates. The checkpoint holds the
weights that validated best, all settings, hashes of the files and the versions. The same command
produces the same weights on the same machine with the same versions.
"""

from __future__ import annotations

import argparse
import contextlib
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

#: Points of a cloud that the classifier sees: it processes each cloud once for each grasp.
SEEN = 128


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task", choices=TASKS)
    parser.add_argument(
        "data", type=Path, nargs="+", help="files scenes.hdf5, or data files for contacts"
    )
    parser.add_argument("checkpoint", type=Path, help="where to write")
    parser.add_argument(
        "--epochs", type=int, default=60, help="maximum number of epochs  [default: 60]"
    )
    parser.add_argument(
        "--patience",
        type=int,
        default=10,
        help="epochs without a better validation before training stops  [default: 10]",
    )
    parser.add_argument("--rate", type=float, default=1e-3, help="learning rate  [default: 0.001]")
    parser.add_argument("--batch", type=int, default=32, help="[default: 32]")
    parser.add_argument("--seed", type=int, default=0, help="[default: 0]")
    parser.add_argument(
        "--objects", type=int, help="number of objects of the first file to train on, drawn by seed"
    )
    parser.add_argument(
        "--without", metavar="CLASS", nargs="+", default=[], help="classes to leave out"
    )
    parser.add_argument(
        "--heads", type=int, default=5, help="heads of the contact network  [default: 5]"
    )
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
    train, valid = _scenes(arguments, "none")
    hand = hand_of(train)
    torch.manual_seed(arguments.seed)
    size = PostureSize(closing=len(hand.directions))
    network = PostureNetwork(size)

    def loss(batch: Batch) -> Tensor:
        X_TG, closing = batch["X_TG"], hand.coordinates(batch["q"])
        return network.loss(batch["points"], X_TG[..., :3, 3], X_TG[..., :3, :3], closing)

    history = _fit(arguments, network, loss, train, valid, cloud_batches)
    _save(arguments, network, history, size=asdict(size), hand=hand.as_dict())
    return history


def train_classifier(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train the network that judges postures, on lifts with a verdict, and calibrate it."""
    # Also lifted grasps that are not samples, or both questions would have the same answers.
    train, valid = _scenes(arguments, "tested", positives="lifted")
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
    _save(arguments, network, history, hand=hand.as_dict())
    return history


def train_contacts(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train the network for the paper's task: contacts from one image."""
    train, valid = (
        [data for path in arguments.data if len(data := dg.GraspDataset(path, split=split))]
        for split in ("train", "valid")
    )
    if not train:
        raise DataError(f"{arguments.data[0]}: train must have samples, got none")
    grasps = torch.from_numpy(np.concatenate([data.column("grasps") for data in train]))
    torch.manual_seed(arguments.seed)
    scale = grasps.std(0, correction=0).clamp(min=1e-3)
    network = ContactNetwork(grasps.shape[1], arguments.heads, grasps.mean(0), scale)
    network(torch.zeros(1, 4, train[0].image_size, train[0].image_size))  # the lazy layer's size

    def loss(batch: Batch) -> Tensor:
        return network.loss(batch["images"], batch["grasps"])

    history = _fit(arguments, network, loss, train, valid, image_batches)
    _save(arguments, network, history, heads=arguments.heads)
    return history


TASKS = {
    "postures": train_postures,
    "classifier": train_classifier,
    "contacts": train_contacts,
}


# What they share


def judged(network: GraspClassifier, hand: HandCoordinates, batch: Batch) -> tuple[Tensor, Tensor]:
    """Return logits and labels (n, 2), for "lifted" and "kept", of all grasps of a batch."""
    grasps = batch["X_TG"].shape[1]
    clouds = batch["points"][:, :SEEN].repeat_interleave(grasps, 0)
    logits = network(
        clouds, batch["X_TG"].flatten(0, 1), hand.coordinates(batch["q"].flatten(0, 1))
    )
    labels = torch.stack([batch["lifted"], batch["kept"]], -1).flatten(0, 1)
    return logits, labels.float()


def temperature(logits: Tensor, labels: Tensor) -> Tensor:
    """Return the temperatures (2,) with which logits (n, 2) best match labels (n, 2)."""
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


def _objects_of(data: dg.SceneDataset) -> list[int]:
    """Return the rows of the objects whose views are items."""
    scenes = data.tables["views"]["scene"][data.views]
    return sorted(set(data.tables["scenes"]["object"][scenes, 0].tolist()))


def hand_of(train: Sequence[dg.SceneDataset]) -> HandCoordinates:
    """Return the hand's coordinates, fitted to the samples that train; print how many these are."""
    found: dict[str, list[np.ndarray]] = {"q": [], "q_open": []}
    for data in train:
        grasps, scenes = data.tables["grasps"], data.tables["views"]["scene"][data.views]
        for name, values in found.items():
            values.append(grasps[name][grasps["kept"] & np.isin(grasps["scene"], scenes)])
    closed, opened = (torch.from_numpy(np.concatenate(found[name])) for name in found)
    if len(closed) < 2:
        raise DataError(f"{train[0].path}: train must have two samples or more, got {len(closed)}")
    objects = sum(len(_objects_of(data)) for data in train)
    print(f"{len(closed)} samples; views of {objects} objects")  # noqa: T201
    return HandCoordinates.fit(closed, opened)


def _scenes(
    arguments: argparse.Namespace, negatives: Any, positives: Any = "kept"
) -> tuple[list[dg.SceneDataset], list[dg.SceneDataset]]:
    """Return the parts that train and the parts that validate.

    Only the first file validates: the grasps that were fed back are of objects that train there. A
    small dataset may have no part that validates.
    """
    options = {"negatives": negatives, "positives": positives, "seed": arguments.seed}
    train = []
    for path in arguments.data:
        names = _names(arguments, path, "train", options)
        if arguments.objects is not None and path == arguments.data[0]:
            draw = torch.Generator().manual_seed(arguments.seed)
            order = torch.randperm(len(names), generator=draw)[: arguments.objects]
            names = [names[i] for i in order.tolist()]
        train.append(dg.SceneDataset(path, split="train", objects=names, **options))
    if len({data.joints for data in train}) > 1:
        raise DataError(f"{arguments.data[-1]}: must be of the same hand as the others")
    valid, path = [], arguments.data[0]
    with contextlib.suppress(DataError):
        names = _names(arguments, path, "valid", options)
        valid.append(dg.SceneDataset(path, split="valid", balance="view", objects=names, **options))
    return train, valid


def _names(arguments: argparse.Namespace, path: Path, split: str, options: Any) -> list[str]:
    """Return the names of the objects that have grasps to draw and whose class is not left out."""
    data = dg.SceneDataset(path, split=split, **options)
    if unknown := sorted(set(arguments.without) - set(data.classes)):
        raise DataError(f"{path}: --without must name classes of it, got {unknown[0]}")
    kept = [k for k in _objects_of(data) if data.classes[k] not in arguments.without]
    return sorted(data.names[k] for k in kept)


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
    steps = -(-sum(map(len, train)) // arguments.batch)
    history = fit(network, loss, draw, still, steps, arguments)
    return history | {"parts": {"train": sum(map(len, train)), "valid": sum(map(len, valid))}}


def _valid_batches(
    arguments: argparse.Namespace, valid: Any, batches: Any = cloud_batches
) -> Iterator[Batch]:
    if valid:
        yield from batches(valid, arguments.batch, 0, augment=False, seed=arguments.seed)


def _save(
    arguments: argparse.Namespace,
    network: nn.Module,
    history: dict[str, Any],
    **more: Any,
) -> None:
    """Write the checkpoint completely or not at all."""
    content = {
        "task": arguments.task,
        "weights": network.state_dict(),
        "settings": {k: v for k, v in vars(arguments).items() if k not in ("data", "checkpoint")},
        "history": history,
        "data": [hashlib.sha256(path.read_bytes()).hexdigest() for path in arguments.data],
        "versions": {"torch": str(torch.__version__), "python": platform.python_version()},
        **more,
    }
    partial_file = arguments.checkpoint.with_suffix(".part")
    torch.save(content, partial_file)
    partial_file.replace(arguments.checkpoint)


if __name__ == "__main__":
    sys.exit(main())
