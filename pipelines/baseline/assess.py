"""Measure how well the classifier judges grasps of objects that it never saw.

  python pipelines/baseline/assess.py classifier.pt OUT/scenes.hdf5 reliability.png

The script judges each grasp whose lift has a verdict once, from one view of its scene. It
prints JSON with the AUC and its interval over objects, the Brier score and the reliability curve,
and draws this curve.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from batches import centred, object_points
from matplotlib.figure import Figure
from networks import GraspClassifier, HandCoordinates
from predict import load
from scipy.stats import rankdata
from train import judged

import drakegrasp as dg
from drakegrasp.errors import DrakegraspError

#: The two questions that the classifier answers.
LABELS = ("lifted", "kept")
#: Bins of the reliability curve; all hold equally many grasps.
BINS = 10
#: Number of times that the objects are resampled for an interval.
RESAMPLES = 2000


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("data", type=Path, help="scenes.hdf5")
    parser.add_argument("picture", type=Path, help="the reliability curve to write, e.g. a PNG")
    parser.add_argument("--split", default="test", help="[default: test]")
    arguments = parser.parse_args(argv)
    try:
        chances, labels, objects = judge(arguments.checkpoint, arguments.data, arguments.split)
    except DrakegraspError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 2

    found = {
        name: assessment(chances[:, k], labels[:, k], objects) for k, name in enumerate(LABELS)
    }
    picture(found).savefig(arguments.picture, dpi=150)
    about = {"split": arguments.split, "grasps": len(labels), "objects": len(np.unique(objects))}
    print(json.dumps(about | found, indent=1))  # noqa: T201
    return 0


def judge(checkpoint: Path, path: Path, split: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return chances and labels (n, 2) of a split's tested grasps, and their objects (n,)."""
    said = load(checkpoint, "classifier")
    network, hand = (
        GraspClassifier(len(said["hand"]["directions"])),
        HandCoordinates(**said["hand"]),
    )
    network.load_state_dict(said["weights"])
    network.eval()

    # The first view of each scene; `grasps_in` returns all grasps, and only the tested ones count.
    data = dg.SceneDataset(
        path, split=split, negatives="tested", positives="lifted", balance="view"
    )
    scenes = data.tables["views"]["scene"][data.views]
    chances, labels, objects = [], [], []
    for index in np.unique(scenes, return_index=True)[1].tolist():
        item, grasps = data[index], data.grasps_in(int(data.views[index]))
        tested = grasps["tested"]
        batch = {"points": object_points(item["points"], item["on_object"])[None]}
        batch |= {k: grasps[k][tested][None] for k in ("q", *LABELS)}
        batch["X_TG"] = grasps["X_AG"][tested][None].astype(np.float32)
        tensors = {k: torch.from_numpy(np.ascontiguousarray(v)) for k, v in batch.items()}
        with torch.no_grad():
            logits, answers = judged(network, hand, centred(tensors))
        chances.append(logits.sigmoid().numpy())
        labels.append(answers.numpy() > 0.5)
        objects.append(np.full(len(answers), int(item["object"])))
    return np.concatenate(chances), np.concatenate(labels), np.concatenate(objects)


def assessment(chance: np.ndarray, label: np.ndarray, objects: np.ndarray) -> dict[str, Any]:
    """Return how well chances (n,) predict labels (n,) of grasps of some objects (n,).

    The interval contains the central 95 % of the AUCs of objects drawn with replacement.
    """
    draw, rows = np.random.default_rng(0), [np.flatnonzero(objects == k) for k in set(objects)]
    drawn = []
    for _ in range(RESAMPLES):
        some = np.concatenate([rows[k] for k in draw.integers(len(rows), size=len(rows))])
        drawn.append(auc(chance[some], label[some]))
    bins = np.array_split(np.argsort(chance, kind="stable"), min(BINS, len(chance)))
    low, high = np.nanpercentile(drawn, [2.5, 97.5])
    return {
        "share": round(float(label.mean()), 4),
        "auc": [round(float(value), 4) for value in (auc(chance, label), low, high)],
        "brier": round(float(np.square(chance - label).mean()), 4),
        "curve": [
            {"said": round(float(chance[b].mean()), 4), "true": round(float(label[b].mean()), 4),
             "grasps": len(b)}
            for b in bins
        ],
    }  # fmt: skip


def auc(chance: np.ndarray, label: np.ndarray) -> float:
    """Return how often, of a true and a false row, the true one has the larger chance.

    The result is NaN if all rows are true or all are false.
    """
    true = int(label.sum())
    if not 0 < true < len(label):
        return float("nan")
    ranks = rankdata(chance)[label].sum()
    return float((ranks - true * (true + 1) / 2) / (true * (len(label) - true)))


def picture(found: dict[str, Any]) -> Figure:
    """Return the reliability curves: how often each stated chance comes true."""
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2, sharey=True), LABELS, strict=True):
        curve, (value, low, high) = found[name]["curve"], found[name]["auc"]
        axes.plot([0, 1], [0, 1], color="#999999", linewidth=1, zorder=1)
        axes.plot([b["said"] for b in curve], [b["true"] for b in curve], "o-", color="#2a6fb0")
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xlabel="chance that the network states")
        axes.set_title(f"{name}: AUC {value:.2f} ({low:.2f} to {high:.2f})", fontsize=10)
    figure.axes[0].set_ylabel("share for which it is true")
    return figure


if __name__ == "__main__":
    sys.exit(main())
