"""All figures of a dataset as files: PNG, SVG, and their numbers as JSON.

In: the directory of a dataset. Out: a folder of files; the same dataset gives the same bytes on the
same machine.
"""

from __future__ import annotations

import io
import json
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.figure import Figure

from drakegrasp.dataset.manifest import Manifest, read_manifest
from drakegrasp.dataset.paths import DATA_FILES, SCENES_FILE
from drakegrasp.dataset.statistics import Funnel, count_funnel
from drakegrasp.errors import DataError, MachineError
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.pictures.charts import (
    FAILED,
    GROUPS,
    draw_counts,
    draw_distributions,
    draw_objects,
)
from drakegrasp.pictures.figures.approach_map import approaches_figure
from drakegrasp.pictures.figures.approach_sphere import coverage
from drakegrasp.pictures.figures.class_sheet import class_sheets
from drakegrasp.pictures.figures.held_grasps import HeldGrasps, read_approaches, read_held
from drakegrasp.pictures.figures.palm_poses import caption, palm_poses_figure
from drakegrasp.pictures.figures.phases import phases_figure
from drakegrasp.pictures.figures.samplers import METHODS, compare_samplers, palm_rays
from drakegrasp.pictures.figures.scene_views import scene_views
from drakegrasp.pictures.style import svg_bytes
from drakegrasp.runtime.files import write_atomic
from drakegrasp.runtime.progress import Report, silent

#: Resolution of the pictures [pixels per inch].
DPI = 150
#: Palm rays in the figure of the samplers, per sampler; objects in that of the approaches.
RAYS, OBJECTS = 220, 8
#: The file of the numbers.
NUMBERS_FILE = "figures.json"
#: Colours of the bars of held, precision, stable and samples.
SAMPLES_COLOUR = "#5B6470"


@dataclass(kw_only=True)
class Written:
    """What was written.

    Attributes:
        folder: Where.
        names: Of the figures, each a PNG and an SVG.
        left_out: Why a figure is missing, by its name.
    """

    folder: Path
    names: list[str] = field(default_factory=list)
    left_out: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Dataset:
    """What several figures need of a dataset."""

    out: Path
    manifest: Manifest
    funnel: Funnel
    held: HeldGrasps


#: Figures by name, with their numbers.
_Drawn = tuple[dict[str, Figure], Any]


def write_figures(
    out: Path,
    folder: Path,
    *,
    compare: Path | None = None,
    trial_id: int | None = None,
    progress: Report = silent,
) -> Written:
    """Write the figures of a dataset, each as PNG and SVG, and their numbers.

    A figure that the dataset has nothing for is left out.

    Args:
        out: Directory of a dataset.
        folder: Where to write; files of the same names are replaced.
        compare: A dataset of the same objects by the other sampler of palm poses.
        trial_id: The grasp whose phases are drawn; the first of those that hold best if None.
        progress: Is told of each figure.

    Raises:
        DataError: If the directory holds no dataset, or `compare` or `trial_id` do not fit.
        MachineError: If OpenGL failed and `trial_id` was given.
        OSError: If a file cannot be written.
    """
    held = read_held(out)
    data = _Dataset(out=out, manifest=read_manifest(out), funnel=count_funnel(out), held=held)
    drawings: dict[str, Callable[[], _Drawn]] = {
        "palm_poses": lambda: _palm_poses(data, compare),
        "phases": lambda: _phases(data, trial_id),
        "classes": lambda: _classes(data),
        "outcomes": lambda: _outcomes(data),
        "hold": lambda: _hold(data),
        "objects": lambda: _objects(data),
        "distributions": lambda: _distributions(data),
        "approaches": lambda: _approaches(data),
        "views": lambda: _views(data),
    }
    known = {*drawings}
    if not (out / SCENES_FILE).exists():
        del drawings["views"]  # most datasets have no scenes

    # What was asked for by an option must be drawn; all else as far as there is something.
    asked = {"palm_poses": compare is not None, "phases": trial_id is not None}
    written, numbers = Written(folder=folder), {}
    for i, (name, draw) in enumerate(drawings.items()):
        try:
            with _plain_style():
                figures, numbers[name] = draw()
                for part, figure in figures.items():
                    _write(figure, folder / part)
                    written.names.append(part)
        except (DataError, MachineError) as error:
            if asked.get(name):
                raise
            written.left_out[name] = str(error)
        progress(i + 1, len(drawings))

    # Delete figures of an earlier run that this run did not draw; a sheet of classes has pages.
    names = {*known, *(path.stem for path in folder.glob("classes_[0-9]*.*"))}
    for name in names.difference(written.names):
        for suffix in (".png", ".svg"):
            (folder / f"{name}{suffix}").unlink(missing_ok=True)
    text = json.dumps(numbers, indent=1, ensure_ascii=False, allow_nan=False)
    write_atomic(folder / NUMBERS_FILE, f"{text}\n".encode())
    return written


@contextmanager
def _plain_style() -> Iterator[None]:
    """Draw in matplotlib's own style, whatever the user's is, and without warnings of glyphs."""
    with matplotlib.style.context("default"), warnings.catch_warnings():
        # A name in another script is drawn as boxes; so it is a name, not a fault.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        warnings.filterwarnings("ignore", message="Matplotlib currently does not support")
        yield


def _write(figure: Figure, path: Path) -> None:
    """Write a figure as PNG and SVG; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=DPI, format="png", metadata={"Software": None})
    write_atomic(path.with_name(f"{path.name}.png"), buffer.getvalue())
    write_atomic(path.with_name(f"{path.name}.svg"), svg_bytes(figure, dpi=DPI))


def _palm_poses(data: _Dataset, compare: Path | None) -> _Drawn:
    found = compare_samplers(data.out, compare)
    model, numbers = found.shown.model, found.numbers
    rays, captions = {}, {}
    for method, title in METHODS.items():
        rays[title] = palm_rays(found.candidates[method], found.standoff, RAYS)
        captions[title] = caption(
            numbers["of_object"][method], numbers["of_objects"].get(method), numbers["objects"]
        )
    figure = palm_poses_figure(
        model.visual_vertices,
        model.visual_faces,
        rays,
        R_TO=found.shown.X_TO[:3, :3],
        captions=captions,
        name=model.name,
    )
    return {"palm_poses": figure}, numbers


def _phases(data: _Dataset, trial_id: int | None) -> _Drawn:
    if trial_id is None:
        # The first of the best group that is not empty.
        groups = [data.held.groups[name] for name in ("stable", "precision", "held")]
        best = next((group for group in groups if group.any()), None)
        if best is None:
            raise DataError("no attempt succeeded")
        trial_id = int(data.held.trial_ids[np.argmax(best)])
    return {"phases": phases_figure(data.out, trial_id)}, {"trial_id": trial_id}


def _classes(data: _Dataset) -> _Drawn:
    pages, trials = class_sheets(data.out / DATA_FILES["oto"])
    return {f"classes_{i + 1}": page for i, page in enumerate(pages)}, {"trial_ids": trials}


def _views(data: _Dataset) -> _Drawn:
    figure, drawn = scene_views(data.out / SCENES_FILE)
    return {"views": figure}, drawn


def _outcomes(data: _Dataset) -> _Drawn:
    counts = data.funnel.outcomes.sum(axis=0)
    shown = [o for o in Outcome if counts[o] or o is Outcome.SUCCESS]
    shown.sort(key=lambda o: (o is not Outcome.SUCCESS, -counts[o]))
    numbers = {o.label: int(counts[o]) for o in shown}
    return {"outcomes": draw_counts(numbers, "attempts")}, numbers


def _hold(data: _Dataset) -> _Drawn:
    removals = data.funnel.removals.sum(axis=0)
    numbers = {name: int(group.sum()) for name, group in data.held.groups.items()}
    numbers["samples"] = int(data.funnel.samples.sum())
    if refined := int(data.funnel.refined[:, 2].sum()):
        numbers["of these refined"] = refined
    for removal in Removal:
        if removals[removal] and removal is not Removal.KEPT:
            numbers[f"removed: {removal.label}"] = int(removals[removal])
    colours = [
        *GROUPS.values(),
        SAMPLES_COLOUR,
        *[SAMPLES_COLOUR] * ("of these refined" in numbers),
    ]
    colours += [FAILED] * (len(numbers) - len(colours))
    return {"hold": draw_counts(numbers, "successes", colours=colours)}, numbers


def _objects(data: _Dataset) -> _Drawn:
    funnel = data.funnel
    held = funnel.outcomes[:, Outcome.SUCCESS]
    counts = {"held": held, "precision": funnel.precision, "stable": funnel.stable}
    lists = {name: values.tolist() for name, values in counts.items()}
    attempts, samples = funnel.outcomes.sum(axis=1).tolist(), funnel.samples.tolist()
    numbers = {
        name: {
            "attempts": attempts[i],
            **{group: lists[group][i] for group in lists},
            "samples": samples[i],
        }
        for i, name in enumerate(funnel.names)
    }
    return {"objects": draw_objects(funnel.names, lists)}, numbers


def _distributions(data: _Dataset) -> _Drawn:
    if not len(data.held.trial_ids):
        raise DataError("no attempt succeeded")
    numbers = {}
    for title, values in data.held.quantities.items():
        numbers[title] = {
            name: {
                "median": round(float(np.median(values[group])), 4),
                "90 %": round(float(np.quantile(values[group], 0.9)), 4),
            }
            for name, group in data.held.groups.items()
            if group.any()
        }
    figure = draw_distributions(list(data.held.quantities.items()), data.held.groups)
    return {"distributions": figure}, numbers


def _approaches(data: _Dataset) -> _Drawn:
    # The objects with the most successes.
    held = data.funnel.outcomes[:, Outcome.SUCCESS]
    order = np.argsort(-held, kind="stable")
    shown = [int(i) for i in order[:OBJECTS] if held[i]]
    if not shown:
        raise DataError("no attempt succeeded")
    names, config_of = data.funnel.names, data.manifest.config_of
    items = [read_approaches(data.out, names[i], config_of(names[i])) for i in shown]
    figure = approaches_figure(items, left_out=int(np.count_nonzero(held)) - len(shown))
    numbers = {
        item.name: {
            "attempts": item.attempts,
            "successes": len(item.successes),
            "coverage_of_successes": round(coverage(item.successes), 4),
        }
        for item in items
    }
    return {"approaches": figure}, numbers
