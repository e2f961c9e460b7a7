"""The contact sheet of a data file: a page of its samples. Needs matplotlib, not Drake.

In: a data file. Out: a PNG file.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from drakegrasp.dataset.reader import GraspDataset, Sample
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.frames import Array
from drakegrasp.pictures.style import (
    INK,
    add_axes,
    draw_colour_bar,
    draw_finger_legend,
    draw_sample,
    read_far,
    save_figure,
)

#: Samples per line of a contact sheet, and the edge of each of its images [inch].
ACROSS, EDGE = 3, 1.12


def contact_sheet(path: Path, png: Path, *, rows: int = 8, split: str | None = None) -> int:
    """Draw samples of a data file: colour, depth and mask of each, with its contacts.

    The sheet shows as many different objects as it can. The same file gives the same sheet.

    Args:
        path: `grasping_oto.hdf5` or `grasping_otm.hdf5`.
        png: The file to write.
        rows: Most lines of samples.
        split: The split to draw from; all of them if None.

    Returns:
        The number of samples drawn.

    Raises:
        DataError: If the file is not a data file or holds no sample.
    """
    # All samples of the file.
    splits = SPLITS if split is None else (split,)
    parts = [GraspDataset(path, split=each, fewer_fingers=True) for each in splits]
    places = [(part, row) for part in parts for row in range(len(part))]
    if not places:
        raise DataError(f"{path}: must hold at least one sample to draw, got none")

    # Choose some of them, and draw.
    names = [str(name) for part in parts for name in part.column("object_props/object_name")]
    chosen = spread_over_objects(names, rows * ACROSS)
    samples = [places[i][0][places[i][1]] for i in chosen]
    figure = draw_sheet(samples, parts[0].K, far=read_far(path))
    save_figure(figure, png, dpi=130)
    return len(samples)


def spread_over_objects(names: Sequence[str], count: int) -> list[int]:
    """Return the indices of at most `count` samples, spread over as many objects as possible.

    Objects are in the order of their numbers. If there are more objects than places, evenly
    spaced ones are taken. Of each object the first samples are taken.

    Args:
        names: Name of the object of each sample.
        count: Most samples to choose.
    """
    # Turn t holds the t-th sample of every object that has so many.
    order = sorted(range(len(names)), key=lambda i: (_natural(names[i]), i))
    turns: list[list[int]] = []
    for _, group in groupby(order, key=lambda i: names[i]):
        for turn, i in enumerate(group):
            if turn == len(turns):
                turns.append([])
            turns[turn].append(i)

    # Fill the places turn by turn.
    chosen: list[int] = []
    for turn_indices in turns:
        room = min(count - len(chosen), len(turn_indices))
        picks = np.linspace(0, len(turn_indices) - 1, room).round().astype(int)
        chosen += [turn_indices[k] for k in picks]

    # Samples of an object stand side by side.
    place = {i: k for k, i in enumerate(order)}
    return sorted(chosen, key=place.__getitem__)


def draw_sheet(
    samples: Sequence[Sample], K: Array, *, far: float, titles: Sequence[str] | None = None
) -> Figure:
    """Return the contact sheet of samples as a figure.

    Its axes are colour, depth and mask of each sample in turn, then the colour bar.

    Args:
        samples: What to draw, at least one.
        K: (3, 3), camera matrix [px].
        far: Far plane of the camera [m].
        titles: Text above each sample; the name of its object if None.
    """
    # The page: blocks of three images, below a head with legend and colour bar.
    across = min(ACROSS, len(samples))
    lines = -(-len(samples) // across)
    gap, between, caption, margin = 0.035, 0.22, 0.21, 0.16
    # A single sample is too narrow for legend and colour bar side by side.
    head = 0.42 if across > 1 else 0.62
    block = 3 * EDGE + 2 * gap
    width = across * block + (across - 1) * between + 2 * margin
    height = lines * (EDGE + caption) + head + margin
    figure = Figure(figsize=(width, height), facecolor="white")

    # The samples, all with the same scale of depths.
    nearest = min(float(sample.image[3].min()) for sample in samples)
    for i, sample in enumerate(samples):
        line, column = divmod(i, across)
        left = margin + column * (block + between)
        top = head + line * (EDGE + caption) + caption
        axes = [add_axes(figure, left + k * (EDGE + gap), top, EDGE, EDGE) for k in range(3)]
        draw_sample(axes, sample, K, near=nearest, far=far, scale=0.75)
        title = str(sample.props["object_name"]) if titles is None else titles[i]
        axes[0].text(
            0.0, 1.05, title.replace("_", " "), transform=axes[0].transAxes, fontsize=7.0,
            color=INK, parse_math=False,
        )  # fmt: skip
        axes[2].text(
            1.0, 1.05, f"trial {sample.trial_id}", transform=axes[2].transAxes,
            fontsize=6.0, color="#888888", ha="right",
        )  # fmt: skip

    # The head.
    bar_width = min(1.6, block / 2.2)
    bar = add_axes(figure, width - margin - bar_width, head - 0.29, bar_width, 0.09)
    draw_colour_bar(figure, bar, nearest, far, size=6.5)
    draw_finger_legend(
        figure, len(samples[0].grasp) // 6, (margin / width, 1.0 - 0.10 / height), 7.0
    )
    return figure


def _natural(name: str) -> tuple[int, str]:
    """Return the sorting key of a name: its leading number, then the rest."""
    number, _, rest = name.partition("_")
    return (int(number), rest) if number.isdecimal() else (10**9, name)
