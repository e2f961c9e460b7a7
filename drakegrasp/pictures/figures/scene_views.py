"""Views of scenes that do not know the grasp, with a sample of each scene drawn into them.

In: scenes.hdf5. Out: a sheet, a line per scene. Needs matplotlib, not Drake.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drakegrasp.dataset.scenes.reader import SceneDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.pictures.style import (
    ARROW,
    INK,
    add_axes,
    draw_finger_legend,
    hide_ticks,
    mark_contact,
    shortened,
)
from drakegrasp.vision.camera import project

#: Scenes of a split, views of a scene, and the width of a view [inch].
LINES = {"train": 4, "valid": 1, "test": 2}
ACROSS, WIDE = 4, 1.9
#: Length of the line along +Gz from the palm's origin [m].
PALM = 0.06


def scene_views(path: Path) -> tuple[Figure, list[dict[str, int]]]:
    """Return the sheet, and of each of its views the row of /views and the trial of the sample.

    Scenes are of different objects, evenly over their names. The sample is the first of its scene.

    Raises:
        DataError: If the file is missing or damaged, or has no scene with a sample.
    """
    lines: list[tuple[SceneDataset, npt.NDArray[np.int64]]] = []
    for split in SPLITS:
        data = SceneDataset(path, points=None, split=split, negatives="none", grasps=1)
        if not len(data):
            continue
        scenes = data.tables["views"]["scene"][data.views]
        objects = data.tables["scenes"]["object"][scenes, 0]
        _, first = np.unique(objects, return_index=True)
        picked = np.linspace(0, len(first) - 1, min(LINES[split], len(first))).round().astype(int)
        lines += [(data, data.views[scenes == scenes[i]][:ACROSS]) for i in first[picked]]
    if not lines:
        raise DataError(f"{path}: must have a scene with a sample, got none")

    # The page.
    high, caption, head, margin, gap = 0.75 * WIDE, 0.2, 0.3, 0.12, 0.04
    width = ACROSS * (WIDE + gap) + 2 * margin
    height = len(lines) * (high + caption) + head + margin
    figure, drawn = Figure(figsize=(width, height), facecolor="white"), []
    for line, (data, views) in enumerate(lines):
        top = head + line * (high + caption) + caption
        for column, view in enumerate(views.tolist()):
            axes = add_axes(figure, margin + column * (WIDE + gap), top, WIDE, high)
            trial, name = _draw(axes, data, view)
            drawn.append({"view": view, "trial_id": trial})
            if column == 0:
                text = f"{shortened(name, 30).replace('_', ' ')}, {data.split}, trial {trial}"
                axes.text(0.0, 1.03, text, transform=axes.transAxes, fontsize=7.0, color=INK,
                          parse_math=False)  # fmt: skip
    fingers = lines[0][0].tables["grasps"]["p_TQ"].shape[1]
    draw_finger_legend(figure, fingers, (margin / width, 1.0 - 0.08 / height), 7.0)
    return figure, drawn


def _draw(axes: Axes, data: SceneDataset, view: int) -> tuple[int, str]:
    """Draw a view with the first sample of its scene; return the trial and the object's name."""
    images, grasps = data.images(view), data.grasps_in(view, frame="camera")
    row = int(np.argmax(grasps["sample"]))
    axes.imshow(images["rgb"], interpolation="nearest")
    K, X_CG = images["K"].astype(float), grasps["X_AG"][row].astype(float)
    palm = project(K, np.array([X_CG[:3, 3], X_CG[:3, 3] + PALM * X_CG[:3, 2]]))
    axes.plot(*palm.T, color=INK, linewidth=1.6)
    axes.plot(*palm[0], marker="s", markersize=4.0, color=INK)

    # The contacts, hollow where the file says that the camera does not see them.
    p_CQ, nhat = grasps["p_AQ"][row].astype(float), grasps["nhat_Q_A"][row].astype(float)
    for i in np.flatnonzero(np.isfinite(p_CQ).all(axis=1)).tolist():
        dot, end = project(K, np.array([p_CQ[i], p_CQ[i] + ARROW * nhat[i]]))
        mark_contact(axes, i, dot, end, hidden=not grasps["visible"][row, i], scale=0.8)
    height, width = images["mask"].shape
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    hide_ticks(axes)
    number = int(data.tables["scenes"]["object"][data.tables["views"]["scene"][view], 0])
    return int(grasps["trial_id"][row]), data.names[number]
