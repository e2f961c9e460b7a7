"""Draw the surest predictions for views of scenes: those that are samples, and those that are not.

  python pipelines/baseline/gallery.py predicted.h5 OUT/scenes.hdf5 card gallery.png

`card` is the folder of `drakegrasp score`. Its verdicts are used, and predictions without a verdict
there are tried now. The upper pictures show the predictions with the largest confidence that became
samples. The lower ones show those that did not: there the network is wrong although it is sure.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import drakegrasp as dg
from drakegrasp.dataset.scenes import SceneRows
from drakegrasp.errors import DrakegraspError
from drakegrasp.frames import invert_pose
from drakegrasp.pictures.style import add_axes, hide_ticks, save_figure, shortened
from drakegrasp.scoring.measures import Judged
from drakegrasp.scoring.run import VERDICTS
from drakegrasp.vision.camera import project

#: Pictures side by side, lines of each kind, the width of a picture and of the gap [inch].
ACROSS, LINES, WIDE, GAP = 6, 2, 1.5, 0.05
#: Length of the line from the palm's origin along +z, and of those to both sides along x [m].
AHEAD, ASIDE = 0.08, 0.04
#: Colours of predictions that are samples, and of the others.
COLOURS = ("#1a7f37", "#c2410c")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("predictions", type=Path, help="postures that predict.py has written")
    parser.add_argument("data", type=Path, help="scenes.hdf5")
    parser.add_argument("card", type=Path, help="folder of the score")
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args(argv)
    try:
        figure = gallery(arguments.predictions, arguments.data, arguments.card)
    except DrakegraspError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 2
    save_figure(figure, arguments.picture, dpi=150)
    return 0


def gallery(predictions: Path, data: Path, card: Path) -> Figure:
    """Return pictures of the surest predictions that are samples, and below them of the others.

    Raises:
        DataError, GraspError, UsageError: As `drakegrasp score` raises them.
    """
    views = dg.SceneDataset(
        data, points=None, split="test", negatives="none", balance="view", grasps=1
    )
    judged = judge(predictions, data, card)
    with h5py.File(predictions) as file:
        row_of, X_OG, confidence = (file[key][:] for key in ("row", "X_FG", "confidence"))

    # The first choice for each view, in the order of confidence.
    ranked, verdicts = judged.ranked[0], judged.verdicts[0]
    order = np.argsort(-np.asarray(ranked.confidence), kind="stable")
    first = [i for i in order.tolist() if ranked.rank[i] == 0]

    line = 0.75 * WIDE + 0.34
    figure = Figure(figsize=(ACROSS * (WIDE + GAP) + 0.2, 2 * LINES * line + 0.1))
    for kind, good in enumerate((True, False)):
        places = [i for i in first if verdicts[i].counted == good][: ACROSS * LINES]
        for number, i in enumerate(places):
            down, across = divmod(number, ACROSS)
            top = (kind * LINES + down) * line + 0.3
            axes = add_axes(figure, 0.1 + across * (WIDE + GAP), top, WIDE, 0.75 * WIDE)
            # The surest prediction for a row comes first in the file.
            row = int(ranked.of_row[i])
            item, place = views[row], int(np.flatnonzero(row_of == row)[0])
            draw(axes, item, X_OG[place], COLOURS[kind])
            outcome = "a sample" if good else verdicts[i].outcome.replace("_", " ")
            name = shortened(views.names[int(item["object"])], 18).replace("_", " ")
            said = f"{name}\n{'held, no sample' if outcome == 'success' else outcome}"
            axes.set_title(f"{said}, {confidence[place]:.2f}", fontsize=6.5, color=COLOURS[kind])
    return figure


def judge(predictions: Path, data: Path, card: Path) -> Judged:
    """Return the predictions with their verdicts, read from the score's folder if it has them."""
    # Scoring writes a card, and must not replace the folder's card, which has reference rows.
    with tempfile.TemporaryDirectory() as folder:
        if (card / VERDICTS).is_file():
            shutil.copy(card / VERDICTS, folder)
        rows = SceneRows(data, split="test")
        return dg.score(predictions, rows, references=(), per_object=1, out=folder, show=True).sets[
            0
        ]


def draw(axes: Axes, item: dict[str, np.ndarray], X_OG: np.ndarray, colour: str) -> None:
    """Draw the centre of a view with a palm: a line along its +z, and lines to both sides."""
    X_CG = invert_pose(item["X_TC"].astype(float)) @ item["X_AO"].astype(float) @ X_OG
    axes.imshow(item["rgb"], interpolation="nearest")
    axes.set_facecolor(item["rgb"][0, 0] / 255.0)
    origin, x, z = X_CG[:3, 3], X_CG[:3, 0], X_CG[:3, 2]
    for ends in ((origin, origin + AHEAD * z), (origin - ASIDE * x, origin + ASIDE * x)):
        axes.plot(*project(item["K"].astype(float), np.array(ends)).T, color=colour, linewidth=2)
    # The part of the image around the object.
    height, width = item["mask"].shape
    v, u = np.nonzero(item["mask"])
    centre = np.array([u.mean(), v.mean()]) if len(u) else np.array([width, height]) / 2
    (left, upper), half = centre, np.array([width, height]) / 4
    axes.set(xlim=(left - half[0], left + half[0]), ylim=(upper + half[1], upper - half[1]))
    hide_ticks(axes)


if __name__ == "__main__":
    sys.exit(main())
