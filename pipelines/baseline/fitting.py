"""Fit a network.

Input: batches. Output: the weights with the smallest loss in validation, and one printed line per
epoch.
"""

from __future__ import annotations

import argparse
import copy
import math
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Any, TypeVar

import torch
from batches import Batch
from torch import Tensor, nn

T = TypeVar("T")
#: Fraction of the steps over which the learning rate rises; after it the rate falls as a cosine.
WARM = 0.05
#: Weight decay of AdamW, and the maximum norm of a step's gradient.
DECAY, LARGEST_GRADIENT = 1e-2, 5.0


def fit(
    network: nn.Module,
    loss: Callable[[Batch], Tensor],
    train: Callable[[int], Iterator[Batch]],
    valid: Callable[[], Iterator[Batch]],
    steps: int,
    settings: argparse.Namespace,
) -> dict[str, Any]:
    """Fit a network in place, and leave it with the weights that validated best.

    If there is nothing to validate with, the network keeps the last weights.

    Args:
        network: The network; `loss` uses it.
        loss: Function that returns the mean loss of a batch.
        train: Function that returns the batches of an epoch, given its number: the same number
            yields the same batches.
        valid: Function that returns the batches of the validation part, the same each time.
        steps: Number of batches of an epoch.
        settings: Settings of the command line: `epochs` is the maximum number of epochs, `patience`
            the number of epochs without a better validation, `rate` the learning rate, and `task`
            the text that begins each line.

    Returns:
        The losses `train` and `valid` of each epoch, the index of the `best` epoch, the total
        `seconds`, and the fraction of them spent on `loading`.
    """
    optimizer = torch.optim.AdamW(network.parameters(), settings.rate, weight_decay=DECAY)
    total: int = max(steps * settings.epochs, 1)

    def rate(step: int) -> float:
        falling = 0.5 * (1 + math.cos(math.pi * min(step / total, 1.0)))
        return min((step + 1) / max(WARM * total, 1.0), 1.0) * falling

    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, rate)
    best, weights = 0, copy.deepcopy(network.state_dict())
    losses: dict[str, list[float]] = {"train": [], "valid": []}
    start, waited = perf_counter(), 0.0

    for epoch in range(settings.epochs):
        # One pass over the training part.
        network.train()
        values, asked = [], perf_counter()
        for batch in ahead(train(epoch)):
            waited += perf_counter() - asked
            value = loss(batch)
            optimizer.zero_grad()
            value.backward()
            nn.utils.clip_grad_norm_(network.parameters(), LARGEST_GRADIENT)
            optimizer.step()
            scheduler.step()
            values.append(value.item())
            asked = perf_counter()
        losses["train"].append(sum(values) / len(values))

        # The loss on objects that the network did not see.
        losses["valid"].append(mean_loss(network, loss, valid()))
        if not losses["valid"][-1] > min(losses["valid"]):  # or there is nothing to validate with
            best, weights = epoch, copy.deepcopy(network.state_dict())
        seconds, checked = perf_counter() - start, losses["valid"][-1]
        told = "none validates" if math.isnan(checked) else f"valid {checked:.3f}  best {best + 1}"
        print(  # noqa: T201
            f"{settings.task}: epoch {epoch + 1}/{settings.epochs}  "
            f"train {losses['train'][-1]:.3f}  {told}  "
            f"{(epoch + 1) * steps / seconds:.1f} batches/s  "
            f"at most {(settings.epochs - epoch - 1) * seconds / (epoch + 1) / 60:.1f} min left",
            flush=True,
        )
        if epoch - best >= settings.patience:
            break

    network.load_state_dict(weights)
    network.eval()
    return {**losses, "best": best, "seconds": seconds, "loading": waited / seconds}


def ahead(batches: Iterator[T]) -> Iterator[T]:
    """Yield batches in their order; a thread builds the next batch while one is used."""
    with ThreadPoolExecutor(1) as thread:
        following = thread.submit(next, batches, None)
        while (batch := following.result()) is not None:
            following = thread.submit(next, batches, None)
            yield batch


def mean_loss(
    network: nn.Module, loss: Callable[[Batch], Tensor], batches: Iterator[Batch]
) -> float:
    """Return the mean loss of batches, or NaN if there are none."""
    network.eval()
    with torch.no_grad():
        values = [loss(batch).item() for batch in batches]
    return sum(values) / len(values) if values else math.nan
