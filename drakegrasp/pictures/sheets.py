"""Overview figures with a grid of samples: of each object, and of training scenes.

Input: a data file or scenes.hdf5. Output: figures. Needs matplotlib, but not Drake.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from drakegrasp.dataset.reader import GraspDataset, Sample
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError, counted
from drakegrasp.frames import Array
from drakegrasp.pictures.style import (
    INK,
    add_axes,
    draw_colour_bar,
    draw_finger_legend,
    draw_sample,
    new_page,
    read_far,
    write_beside,
)

#: Samples per line of a sheet, and the edge of each of its images [inch].
ACROSS, EDGE = 3, 1.12
#: Number of samples on the sheet of a dataset, and the most if it has more objects than that.
PLACES, MOST = 24, 60


def draw_sheet(
    samples: Sequence[Sample],
    K: Array,
    *,
    far: float,
    note: str = "",
) -> Figure:
    """Return the contact sheet of samples as a figure.

    Its axes are colour, depth and mask of each sample in turn, then the colour bar.

    Args:
        samples: Samples to draw, at least one.
        K: (3, 3), camera matrix [px].
        far: Far plane of the camera [m].
        note: Text below all samples.
    """
    # The page: blocks of three images, below a head with legend and colour bar.
    across = min(ACROSS, len(samples))
    lines = -(-len(samples) // across)
    gap, between, caption, margin = 0.035, 0.22, 0.21, 0.16
    # A single sample is too narrow for legend and colour bar side by side.
    head = 0.42 if across > 1 else 0.62
    block = 3 * EDGE + 2 * gap
    width = across * block + (across - 1) * between + 2 * margin
    height = lines * (EDGE + caption) + head + margin + (0.14 if note else 0.0)
    figure = new_page(width, height)
    figure.text(margin / width, 0.09 / height, note, fontsize=7.0, color=INK, va="bottom")

    # The samples, all with the same depth scale.
    nearest = min(float(sample.image[3].min()) for sample in samples)
    for i, sample in enumerate(samples):
        line, column = divmod(i, across)
        left = margin + column * (block + between)
        top = head + line * (EDGE + caption) + caption
        axes = [add_axes(figure, left + k * (EDGE + gap), top, EDGE, EDGE) for k in range(3)]
        draw_sample(axes, sample, K, near=nearest, far=far, scale=0.75)
        name = str(sample.props["object_name"]).replace("_", " ")
        write_beside(axes[0], 0.0, 1.05, name, 7.0)
        trial = f"trial {sample.trial_id}"
        write_beside(axes[2], 1.0, 1.05, trial, 6.0, color="#888888", ha="right")

    # The head.
    bar_width = min(1.6, block / 2.2)
    bar = add_axes(figure, width - margin - bar_width, head - 0.29, bar_width, 0.09)
    draw_colour_bar(figure, bar, nearest, far, size=6.5)
    draw_finger_legend(
        figure, len(samples[0].grasp) // 6, (margin / width, 1.0 - 0.10 / height), 7.0
    )
    return figure


def sample_sheet(path: Path) -> tuple[Figure, list[int]]:
    """Return the sheet of a data file, and the trial id of each of its samples.

    The sheet shows samples of all objects in turn, or of MOST objects, evenly spaced. The same file
    yields the same sheet.

    Args:
        path: A data file.

    Raises:
        DataError: If the file is not a data file or contains no sample.
    """
    # All samples of the file.
    parts = [GraspDataset(path, split=split, fewer_fingers=True) for split in SPLITS]
    places = [(part, row) for part in parts for row in range(len(part))]
    if not places:
        raise DataError(f"{path}: must hold at least one sample to draw, got none")

    # Choose some of them, and draw them.
    names = [str(name) for part in parts for name in part.column("object_props/object_name")]
    objects = len(set(names))
    chosen = spread_over_objects(names, min(max(PLACES, objects), MOST))
    samples: list[Sample] = [places[i][0][places[i][1]] for i in chosen]
    shown = len({names[i] for i in chosen})
    note = f"{len(samples):,} of {counted(len(names), 'sample')}, "
    note += f"{shown:,} of {counted(objects, 'object')} with samples"
    figure = draw_sheet(samples, parts[0].K, far=read_far(path), note=note)
    return figure, [sample.trial_id for sample in samples]


def spread_over_objects(names: Sequence[str], count: int) -> list[int]:
    """Return the indices of at most `count` samples, spread over as many objects as possible.

    Objects are ordered by their numbers. If there are more objects than places, evenly spaced
    objects are taken. The first samples of each object are taken.

    Args:
        names: Name of the object of each sample.
        count: Maximum number of samples to choose.
    """
    # Turn t holds the t-th sample of every object that has at least t samples.
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

    # Samples of an object are side by side.
    place = {i: k for k, i in enumerate(order)}
    return sorted(chosen, key=place.__getitem__)


def _natural(name: str) -> tuple[int, str]:
    """Return the sorting key of a name: its leading number, then the rest."""
    number, _, rest = name.partition("_")
    return (int(number), rest) if number.isdecimal() else (10**9, name)
