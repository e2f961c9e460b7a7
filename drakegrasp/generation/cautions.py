"""Warnings about a dataset before it is simulated; a warning that does not apply is empty."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from drakegrasp.config import SplitConfig
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.split import may_train
from drakegrasp.errors import listed
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.sources import MeshSource


def nothing_trains(sources: Sequence[MeshSource], split: SplitConfig) -> str:
    """Return why no sample of these meshes can be in the split `train`; empty if one can.

    There is no warning if the configuration has no classes for training, as in a benchmark.
    """
    if split.train_classes == ():
        return ""
    classes = [source.class_name for source in sources]
    if split.by == "object":
        return ""
    counts = Counter(classes)
    if any(may_train(name, count, split) for name, count in counts.items()):
        return ""
    if split.train_classes is not None:
        why = "split.train_classes names none of the classes"
    else:
        why = "every class has one object, which is tested"
    return (
        f"nothing will train: {why}. Split by object (--set split.by=object), give classes more "
        "objects (--per-class for built-in ones; objects.yaml says which meshes are of one class), "
        f"or name the classes to train on, e.g. --set split.train_classes=[{min(counts)}]"
    )


def too_heavy(manifest: Manifest) -> str:
    """Return which objects are heavier than the payload of the hand file; empty if none is."""
    hand = load_hand(manifest.config.hand_source)
    if hand.payload is None:
        return ""
    names = [entry.name for entry in manifest.objects if entry.mass > hand.payload]
    if not names:
        return ""
    return (
        f"heavier than the payload of the hand {hand.name}, {hand.payload:g} kg: {len(names)} of "
        f"{len(manifest.objects)} objects ({listed(names)}); objects.mass makes them lighter"
    )
