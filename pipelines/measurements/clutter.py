"""How many grasps that geometry calls free are kept and clean among movable neighbours.

    python pipelines/measurements/clutter.py OUT

The script prints a table of the tried grasps of OUT/clutter.hdf5 by surroundings and by number of
objects: free grasps of all, tried ones, and the shares that are kept and clean, with intervals of
95 % from 4,000 resamples of whole scenes; and how the others end.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.paths import CLUTTER_FILE
from drakegrasp.dataset.schema import NO_OBJECT, NOT_TRIED
from drakegrasp.outcomes import Outcome
from drakegrasp.seeding import Stream

#: Number of resamples of the scenes, and the last number of their stream.
RESAMPLES, PLACE = 4000, 62


def interval(good: npt.NDArray[np.int64], tried: npt.NDArray[np.int64]) -> str:
    """Return a share with its interval, from the numbers (n,) of each scene."""
    if not tried.sum():
        return "-"
    stream, n = Stream(0, PLACE), len(tried)
    drawn = stream.integers(n, RESAMPLES * n).reshape(RESAMPLES, n)
    sums = tried[drawn].sum(axis=1)
    shares = good[drawn].sum(axis=1)[sums > 0] / sums[sums > 0]
    low, high = 100.0 * np.quantile(shares, [0.025, 0.975])
    return f"{100.0 * good.sum() / tried.sum():.0f} % ({low:.0f} to {high:.0f})"


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("out", type=Path, help="a dataset with clutter.hdf5")
    options = parser.parse_args(arguments)

    with h5py.File(options.out / CLUTTER_FILE) as file:
        grasps = {
            name: file["grasps"][name][:] for name in ("scene", "free", "outcome", "kept", "clean")
        }
        around = file["scenes/surroundings"].asstr()[:]
        objects = (file["scenes/object"][:] != NO_OBJECT).sum(axis=1)
    tried = grasps["outcome"] != NOT_TRIED
    scenes = len(around)
    kinds = {
        "all": np.ones(len(tried), bool),
        "free": grasps["free"],
        "tried": tried,
        "kept": grasps["kept"],
        "clean": grasps["clean"],
    }
    by_scene = {
        name: np.bincount(grasps["scene"][which], minlength=scenes) for name, which in kinds.items()
    }

    # A line for each group of scenes.
    groups = {name: around == name for name in dict.fromkeys(around)}
    groups |= {f"{count} objects": objects == count for count in sorted(set(objects.tolist()))}
    groups["all"] = np.ones(scenes, dtype=bool)
    lines = [
        "| scenes | number | free grasps | tried | kept | clean |",
        "|---|---|---|---|---|---|",
    ]
    for name, own in groups.items():
        of = {kind: counts[own] for kind, counts in by_scene.items()}
        free = f"{of['free'].sum():,} of {of['all'].sum():,}"
        shares = " | ".join(interval(of[kind], of["tried"]) for kind in ("kept", "clean"))
        lines.append(f"| {name} | {own.sum()} | {free} | {of['tried'].sum()} | {shares} |")
    ends = Counter(Outcome(code).label for code in grasps["outcome"][tried].tolist())
    lines += ["", ", ".join(f"{label} {count}" for label, count in ends.most_common())]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
