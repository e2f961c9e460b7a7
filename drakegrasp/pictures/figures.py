"""All figures of a dataset as files: PNG, SVG, and their numbers as JSON.

Input: the directory of a dataset. Output: a folder of files; the same dataset produces the same
bytes on the same machine.
"""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import matplotlib.style
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from drakegrasp.arithmetic import norm
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import CLUTTER_FILE, DATA_FILES, reach_names
from drakegrasp.dataset.reach import ReachCount, count_reach
from drakegrasp.dataset.reader import GraspDataset, Sample
from drakegrasp.dataset.scenes import SceneDataset, validate_state
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.statistics import ClutterCount, Funnel, count_clutter, count_funnel
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError, counted
from drakegrasp.filters import Removal
from drakegrasp.frames import Array
from drakegrasp.grasp import BANDS
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.charts import draw_counts, draw_distributions, draw_parts
from drakegrasp.pictures.style import (
    INK,
    add_axes,
    beside_instances,
    draw_colour_bar,
    draw_finger_legend,
    draw_sample,
    hide_ticks,
    png_bytes,
    read_far,
    svg_bytes,
    write_beside,
)
from drakegrasp.runtime.files import write_atomic
from drakegrasp.runtime.progress import Report, silent

#: Resolution of the pictures [pixels per inch].
DPI = 150
#: Name of the file of the numbers.
NUMBERS_FILE = "figures.json"
#: Columns from which `Samples` are computed.
COLUMNS = (
    *("slip", "turn", "closed_f_Q_O", "lifted_f_Q_O", "lifted_penetration", "normal_angle"),
    *("precision", "stable"),
)
#: Why a figure of samples is left out.
NO_SAMPLE = "no attempt became a sample"
#: A figure with its numbers.
Drawn: TypeAlias = tuple[Figure, Any]


@dataclass(kw_only=True)
class Written:
    """Summary of the written figures.

    Attributes:
        folder: Folder of the files.
        names: Names of the figures, each of which is a PNG and an SVG.
        left_out: Reason why a figure is missing, by its name.
    """

    folder: Path
    names: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


class Samples(NamedTuple):
    """The n samples of a dataset.

    Attributes:
        trial_ids: (n,), rows of `/trials`.
        groups: (n,) bool each, by `samples`, `precision` and `stable`.
        quantities: (n,) each, by title with unit.
    """

    trial_ids: npt.NDArray[np.int64]
    groups: dict[str, npt.NDArray[Any]]
    quantities: dict[str, Array]


def write_figures(out: Path, folder: Path, *, progress: Report = silent) -> Written:
    """Write the figures of a dataset, each as PNG and SVG, and their numbers.

    A figure for which the dataset has no data is left out.

    Args:
        out: Directory of a dataset.
        folder: Folder to write to; files with the same names are replaced.
        progress: Called after each figure.

    Raises:
        DataError: If the directory is not a dataset.
        OSError: If a file cannot be written.
    """
    samples = read_samples(out)
    read_manifest(out)  # a damaged manifest must raise an error and not just omit some figures
    funnel = count_funnel(out)
    drawings: dict[str, Callable[[], Drawn]] = {
        "sheet": lambda: _sheet(out),
        "outcomes": lambda: _outcomes(funnel),
        "distributions": lambda: _distributions(samples, funnel),
    }
    # Most datasets have no files of arms, and no scenes of several objects.
    if reach_names(out):
        drawings["reach"] = lambda: _reach(count_reach(out))
    if os.path.lexists(out / CLUTTER_FILE):
        drawings["clutter"] = lambda: _clutter(count_clutter(out))
        drawings["scenes"] = lambda: _scenes(out)

    # A figure is drawn if there are data.
    written, numbers = Written(folder=folder), {}
    for done, (name, draw) in enumerate(drawings.items(), start=1):
        try:
            with _plain_style():
                figure, numbers[name] = draw()
                for suffix, content in ((".png", png_bytes), (".svg", svg_bytes)):
                    write_atomic(folder / f"{name}{suffix}", content(figure, dpi=DPI))
            written.names.append(name)
        except DataError as error:
            written.left_out[name] = str(error)
        progress(done, len(drawings))

    # Delete figures of an earlier run that this run did not draw.
    for name in {*drawings, "reach", "clutter", "scenes"}.difference(written.names):
        for suffix in (".png", ".svg"):
            (folder / f"{name}{suffix}").unlink(missing_ok=True)
    text = json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / NUMBERS_FILE, f"{text}\n".encode())
    return written


def read_samples(out: Path) -> Samples:
    """Return the samples of a dataset.

    Raises:
        DataError: If trials.hdf5 is missing or damaged.
    """
    samples = Trials(out).where(kept=True)
    columns = samples.columns(COLUMNS)

    degrees = np.rad2deg(1.0)
    closed, lifted = (norm(columns[f"{when}_f_Q_O"]) for when in ("closed", "lifted"))
    angles = np.nan_to_num(columns["normal_angle"])
    return Samples(
        trial_ids=samples.trial_ids,
        groups={
            "samples": np.ones(len(samples), dtype=np.bool_),
            "precision": columns["precision"],
            "stable": columns["stable"],
        },
        quantities={
            "slip in the hand [mm]": 1e3 * columns["slip"],
            "turn in the hand [°]": degrees * columns["turn"],
            "largest fingertip force after closing [N]": _largest(closed),
            "largest fingertip force after the lift [N]": _largest(lifted),
            "largest penetration after the lift [mm]": 1e3
            * _largest(columns["lifted_penetration"]),
            "largest angle of a contact to the mesh [°]": degrees * _largest(angles),
        },
    )


def _largest(values: npt.NDArray[Any]) -> Array:
    """Return the largest value of each row (n, k)."""
    return np.asarray(values.max(axis=1, initial=0.0))


@contextmanager
def _plain_style() -> Iterator[None]:
    """Draw in matplotlib's default style, whatever the user's is, and without glyph warnings."""
    with matplotlib.style.context("default"), warnings.catch_warnings():
        # A name in another script is drawn as boxes, which is not an error.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        warnings.filterwarnings("ignore", message="Matplotlib currently does not support")
        yield


def _sheet(out: Path) -> Drawn:
    figure, trials = sample_sheet(out / DATA_FILES["oto"])
    return figure, {"trial_ids": trials}


def _told(funnel: Funnel) -> str:
    """Return which rows the charts of samples count."""
    objects = counted(int(np.count_nonzero(funnel.samples)), "object")
    distinct = int(funnel.distinct.sum())
    return f"{counted(int(funnel.samples.sum()), 'sample')} of {objects} ({distinct:,} distinct)"


def _outcomes(funnel: Funnel) -> Drawn:
    # Every attempt is in one bar: the samples, then what prevented one, by frequency.
    removals, outcomes = funnel.removals.sum(axis=0), funnel.outcomes.sum(axis=0)
    lost = {f"removed: {each.label}": int(removals[each]) for each in Removal}
    lost |= {each.label: int(outcomes[each]) for each in Outcome}
    for name in (f"removed: {Removal.KEPT.label}", Outcome.SUCCESS.label):
        del lost[name]
    numbers = {"samples": int(removals[Removal.KEPT])}
    numbers |= {name: n for name, n in sorted(lost.items(), key=lambda each: -each[1]) if n}
    title = f"{counted(int(outcomes.sum()), 'attempt')} of {counted(len(funnel.names), 'object')}"
    return draw_counts(numbers, "attempts", title=title), numbers


def _distributions(samples: Samples, funnel: Funnel) -> Drawn:
    if not len(samples.trial_ids):
        raise DataError(NO_SAMPLE)
    numbers = {
        title: {
            name: {
                "median": round(float(np.median(values[group])), 4),
                "90 %": round(float(np.quantile(values[group], 0.9)), 4),
            }
            for name, group in samples.groups.items()
            if group.any()
        }
        for title, values in samples.quantities.items()
    }
    quantities = list(samples.quantities.items())
    return draw_distributions(quantities, samples.groups, title=_told(funnel)), numbers


def _reach(counts: Sequence[ReachCount]) -> Drawn:
    figure = draw_parts(
        {count.name: (count.reachable, count.asked) for count in counts},
        [f"{low}-{high}°" for low, high in BANDS],
        title="fraction of the samples that an arm reaches",
        what="elevation from which the palm approaches",
    )
    return figure, [count.as_dict() for count in counts]


def _clutter(counts: Sequence[ClutterCount]) -> Drawn:
    def parts(count: ClutterCount) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        ends = np.array([count.free, count.kept, count.clean, count.neighbour_hit])
        return ends, np.array([count.grasps, *[count.tried] * 3])

    figure = draw_parts(
        {count.surroundings: parts(count) for count in counts},
        ["free,\nof all grasps", "kept,\nof tried", "clean,\nof tried", "neighbour hit,\nof tried"],
        title=f"grasps in {counted(sum(count.scenes for count in counts), 'scene')}",
        what="by geometry, and by simulation of free grasps",
    )
    return figure, [asdict(count) for count in counts]


def _scenes(out: Path) -> Drawn:
    """Draw scenes of several objects, evenly spaced: colours beside the masks of the objects."""
    validate_state(out / CLUTTER_FILE, Trials(out))
    data = SceneDataset(out / CLUTTER_FILE, points=None)
    scenes, views = data.tables["scenes"], data.tables["views"]
    count = len(scenes["split"])
    chosen = np.unique(np.linspace(0, count - 1, min(count, SCENES)).round().astype(int))
    across = min(ACROSS, len(chosen))
    wide, high, gap = 3.2, 1.2, 0.25
    lines = -(-len(chosen) // across)
    size = across * (wide + gap) + gap, lines * (high + gap) + gap
    figure = Figure(figsize=size, facecolor="white")
    for place, scene in enumerate(chosen.tolist()):
        line, column = divmod(place, across)
        axes = add_axes(figure, gap + column * (wide + gap), gap + line * (high + gap), wide, high)
        rgb, _, mask = data.stored_images(int(np.argmax(views["scene"] == scene)))
        axes.imshow(beside_instances(rgb, mask), interpolation="nearest")
        hide_ticks(axes)
        write_beside(axes, 0.0, 1.05, f"scene {scene}: {scenes['surroundings'][scene]}", 7.0)
    return figure, {"scenes": chosen.tolist()}


# The sheet of samples.

#: Samples per line of a sheet, and the edge of each of its images [inch].
ACROSS, EDGE = 3, 1.12
#: Number of scenes of several objects on their sheet.
SCENES = 12
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
    figure = Figure(figsize=(width, height), facecolor="white")
    figure.text(margin / width, 0.09 / height, note, fontsize=7.0, color=INK, va="bottom")

    # The samples, all with the same depth scale.
    nearest = min(float(sample.image[3].min()) for sample in samples)
    for i, sample in enumerate(samples):
        line, column = divmod(i, across)
        left = margin + column * (block + between)
        top = head + line * (EDGE + caption) + caption
        axes = [add_axes(figure, left + k * (EDGE + gap), top, EDGE, EDGE) for k in range(3)]
        draw_sample(axes, sample, K, near=nearest, far=far)
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
    # Turn t has the t-th sample of every object that has at least t samples.
    order = sorted(range(len(names)), key=lambda i: (_natural(names[i]), i))
    turns: dict[int, list[int]] = {}
    for _, group in groupby(order, key=names.__getitem__):
        for turn, i in enumerate(group):
            turns.setdefault(turn, []).append(i)

    # Fill the places turn by turn.
    chosen: list[int] = []
    for _, indices in sorted(turns.items()):
        room = min(count - len(chosen), len(indices))
        picks = np.linspace(0, len(indices) - 1, room).round().astype(int)
        chosen += [indices[k] for k in picks]
    # Samples of an object are side by side.
    return sorted(chosen, key=order.index)


def _natural(name: str) -> tuple[int, str]:
    """Return the sorting key of a name: its leading number, then the rest."""
    number, _, rest = name.partition("_")
    return (int(number), rest) if number.isdecimal() else (10**9, name)
