"""All figures of a dataset as files: PNG, SVG, and their numbers as JSON.

Input: the directory of a dataset. Output: a folder of files; the same dataset produces the same
bytes on the same machine.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import matplotlib.style
import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from drakegrasp.arithmetic import norm
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.statistics import Funnel, count_funnel
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError, MachineError
from drakegrasp.filters import Removal
from drakegrasp.frames import Array
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.approaches import approaches_figure, coverage, read_approaches
from drakegrasp.pictures.charts import (
    FAILED,
    GROUPS,
    draw_codes,
    draw_counts,
    draw_distributions,
    draw_objects,
)
from drakegrasp.pictures.rendered import phases_figure
from drakegrasp.pictures.sheets import class_sheets, scene_views
from drakegrasp.pictures.style import png_bytes, svg_bytes
from drakegrasp.runtime.files import write_atomic
from drakegrasp.runtime.progress import Report, silent

#: Resolution of the pictures [pixels per inch].
DPI = 150
#: Number of objects in the figure of the approaches.
OBJECTS = 8
#: Name of the file of the numbers.
NUMBERS_FILE = "figures.json"
#: Colour of the bars of samples.
SAMPLES_COLOUR = "#5B6470"
#: Columns from which the quantities of `HeldGrasps` are computed.
COLUMNS = (
    *("slip", "turn", "closed_f_Q_O", "lifted_f_Q_O", "lifted_penetration", "normal_angle"),
    *("precision", "stable"),
)
#: A figure or the pages of a figure, with its numbers.
Drawn: TypeAlias = tuple[Figure | list[Figure], Any]


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


class HeldGrasps(NamedTuple):
    """The h successes of a dataset.

    Attributes:
        trial_ids: (h,), rows of `/trials`.
        groups: (h,) bool each, by `held`, `precision` and `stable`.
        quantities: (h,) each, by title with unit.
    """

    trial_ids: npt.NDArray[np.int64]
    groups: dict[str, npt.NDArray[Any]]
    quantities: dict[str, Array]


def write_figures(
    out: Path,
    folder: Path,
    *,
    trial_id: int | None = None,
    progress: Report = silent,
) -> Written:
    """Write the figures of a dataset, each as PNG and SVG, and their numbers.

    A figure for which the dataset has no data is left out.

    Args:
        out: Directory of a dataset.
        folder: Folder to write to; files with the same names are replaced.
        trial_id: The grasp whose phases are drawn; the first of those that hold best if None.
        progress: Called after each figure.

    Raises:
        DataError: If the directory is not a dataset, or if `trial_id` does not fit it.
        MachineError: If OpenGL failed and `trial_id` was given.
        OSError: If a file cannot be written.
    """
    held = read_held(out)
    read_manifest(out)  # a damaged manifest must raise an error and not just omit some figures
    funnel = count_funnel(out)
    drawings: dict[str, Callable[[], Drawn]] = {
        "phases": lambda: _phases(out, held, trial_id),
        "classes": lambda: _classes(out),
        "outcomes": lambda: draw_codes(funnel.outcomes.sum(axis=0), Outcome.SUCCESS, "attempts"),
        "hold": lambda: _hold(held, funnel),
        "objects": lambda: _objects(funnel),
        "distributions": lambda: _distributions(held),
        "approaches": lambda: _approaches(out, funnel),
        "views": lambda: scene_views(out / SCENES_FILE),
    }
    known = {*drawings}
    if not (out / SCENES_FILE).exists():
        del drawings["views"]  # most datasets have no scenes

    # The phases of a grasp that was asked for must be drawn; all else only if there are data.
    asked = {"phases": trial_id is not None}
    written, numbers = Written(folder=folder), {}
    for done, (name, draw) in enumerate(drawings.items(), start=1):
        try:
            with _plain_style():
                found, numbers[name] = draw()
                pages = [found] if isinstance(found, Figure) else found
                for i, figure in enumerate(pages, start=1):
                    part = name if found is figure else f"{name}_{i}"
                    for suffix, content in ((".png", png_bytes), (".svg", svg_bytes)):
                        write_atomic(folder / f"{part}{suffix}", content(figure, dpi=DPI))
                    written.names.append(part)
        except (DataError, MachineError) as error:
            if asked.get(name):
                raise
            written.left_out[name] = str(error)
        progress(done, len(drawings))

    # Delete figures of an earlier run that this run did not draw; a sheet of classes has pages.
    names = {*known, *(path.stem for path in folder.glob("classes_[0-9]*.*"))}
    for name in names.difference(written.names):
        for suffix in (".png", ".svg"):
            (folder / f"{name}{suffix}").unlink(missing_ok=True)
    text = json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / NUMBERS_FILE, f"{text}\n".encode())
    return written


def read_held(out: Path) -> HeldGrasps:
    """Return the successes of a dataset.

    Raises:
        DataError: If trials.hdf5 is missing or damaged.
    """
    held = Trials(out).where(outcome=Outcome.SUCCESS)
    columns = held.columns(COLUMNS)

    degrees = np.rad2deg(1.0)
    closed, lifted = (norm(columns[f"{when}_f_Q_O"]) for when in ("closed", "lifted"))
    angles = np.nan_to_num(columns["normal_angle"])
    return HeldGrasps(
        trial_ids=held.trial_ids,
        groups={
            "held": np.ones(len(held), dtype=np.bool_),
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


def _phases(out: Path, held: HeldGrasps, trial_id: int | None) -> Drawn:
    if trial_id is None:
        # The first grasp of the best group that is not empty.
        groups = [held.groups[name] for name in ("stable", "precision", "held")]
        best = next((group for group in groups if group.any()), None)
        if best is None:
            raise DataError("no attempt succeeded")
        trial_id = int(held.trial_ids[np.argmax(best)])
    return phases_figure(out, trial_id), {"trial_id": trial_id}


def _classes(out: Path) -> Drawn:
    pages, trials = class_sheets(out / DATA_FILES["oto"])
    return pages, {"trial_ids": trials}


def _hold(held: HeldGrasps, funnel: Funnel) -> Drawn:
    removals = funnel.removals.sum(axis=0)
    numbers = {name: int(group.sum()) for name, group in held.groups.items()}
    numbers["samples"] = int(funnel.samples.sum())
    colours = [*GROUPS.values(), *[SAMPLES_COLOUR] * (len(numbers) - len(GROUPS))]
    for removal in Removal:
        if removals[removal] and removal is not Removal.KEPT:
            numbers[f"removed: {removal.label}"] = int(removals[removal])
    colours += [FAILED] * (len(numbers) - len(colours))
    return draw_counts(numbers, "successes", colours=colours), numbers


def _objects(funnel: Funnel) -> Drawn:
    groups = {
        "held": funnel.outcomes[:, Outcome.SUCCESS],
        "precision": funnel.precision,
        "stable": funnel.stable,
    }
    counts = {"attempts": funnel.outcomes.sum(axis=1), **groups, "samples": funnel.samples}
    rows = zip(funnel.names, zip(*(v.tolist() for v in counts.values()), strict=True), strict=True)
    numbers = {name: dict(zip(counts, row, strict=True)) for name, row in rows}
    return draw_objects(funnel.names, {name: v.tolist() for name, v in groups.items()}), numbers


def _distributions(held: HeldGrasps) -> Drawn:
    if not len(held.trial_ids):
        raise DataError("no attempt succeeded")
    numbers = {
        title: {
            name: {
                "median": round(float(np.median(values[group])), 4),
                "90 %": round(float(np.quantile(values[group], 0.9)), 4),
            }
            for name, group in held.groups.items()
            if group.any()
        }
        for title, values in held.quantities.items()
    }
    return draw_distributions(list(held.quantities.items()), held.groups), numbers


def _approaches(out: Path, funnel: Funnel) -> Drawn:
    # The objects with the most successes.
    held, names = funnel.outcomes[:, Outcome.SUCCESS], funnel.names
    config_of = read_manifest(out).config_of
    shown = [int(i) for i in np.argsort(-held, kind="stable")[:OBJECTS] if held[i]]
    if not shown:
        raise DataError("no attempt succeeded")
    items = [read_approaches(out, names[i], config_of(names[i])) for i in shown]
    numbers = {
        item.name: {
            "attempts": item.attempts,
            "successes": len(item.successes),
            "coverage_of_successes": round(coverage(item.successes), 4),
        }
        for item in items
    }
    return approaches_figure(items, left_out=int(np.count_nonzero(held)) - len(shown)), numbers
