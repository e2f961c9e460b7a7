"""Draw the first choices of a judge that end best and worst.

\b
    python pipelines/docs/first_choices.py RESULTS --prepared BENCH --out FOLDER

RESULTS is the file of `pipelines/measurements/grasp_choice.py --judge J --results RESULTS`. Two
sheets come out: the samples, and the grasps that are no sample, both with the largest stated chance
first. Each picture shows the hand as it closed in the lift, or as it started if it did not close.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

import click
import numpy as np

# The camera and the objects have one home.
sys.path.append(str(Path(__file__).parents[1] / "measurements"))
import grasp_choice

import drakegrasp as dg
from drakegrasp.arithmetic import multiply
from drakegrasp.filters import Removal
from drakegrasp.frames import X_WT
from drakegrasp.generation.attempts import judge_sample
from drakegrasp.hand.description import load_hand
from drakegrasp.mesh.cloud import read_cloud
from drakegrasp.pictures.still_scene import Poses, StillScene
from drakegrasp.pictures.style import add_axes, new_page, save_figure, show_image, write_beside
from drakegrasp.scoring.judge import load_judge
from drakegrasp.scoring.ranking import measured
from drakegrasp.simulation.placement import PlacedObject

#: Pictures side by side; edge of a picture and its distance from the next, height of its text, and
#: margin [inch]; resolution [px/inch].
ACROSS, EDGE, GAP, TEXT, MARGIN, DPI = 5, 1.5, 0.08, 0.34, 0.1, 150


@click.command(help=__doc__)
@click.argument("results", type=click.Path(path_type=Path, exists=True))
@click.option("--prepared", type=click.Path(path_type=Path), required=True)
@click.option("--judge", default="barrett-1", help="Name or file of the judge of RESULTS.")
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the sheets.")
@click.option("--count", default=20, help="Number of grasps on a sheet.")
def main(results: Path, prepared: Path, judge: str, out: Path, count: int) -> None:
    """Run the script."""
    _, *rows = [json.loads(line) for line in results.read_text().splitlines()]
    rows.sort(key=lambda row: -row["score"])
    places = dict(grasp_choice.prepared_objects(prepared, ()))
    out.mkdir(parents=True, exist_ok=True)
    for sheet, good in (("best", True), ("worst", False)):
        chosen = [row for row in rows if bool(row["choices"]["judge"][1]) is good][:count]
        drawn = [picture(row["name"], places[row["name"]](), judge) for row in chosen]
        texts = [
            f"{row['name'].replace('_', ' ')}\n{outcome}, {row['score']:.0%}"
            for row, (_, outcome) in zip(chosen, drawn, strict=True)
        ]
        draw([image for image, _ in drawn], texts, out / f"first_choices_{sheet}.png")


def picture(name: str, placed: PlacedObject, judge: str) -> tuple[np.ndarray, str]:
    """Return the picture of the first choice for an object, and its outcome or filter."""
    hand = load_hand(placed.config.hand_source)
    _, cloud = grasp_choice.view_of(name, placed)
    grasps = dg.propose(cloud, hand)
    chances = load_judge(judge).chances(measured(grasps, read_cloud(cloud), hand))[:, 1]
    posture = grasps.posture(int(np.argmax(chances)), placed.X_TO_simulated)
    trial = dg.run_trial(placed, posture)

    assert posture.q_pregrasp is not None  # proposals have one
    scene = StillScene(hand, placed.model)
    poses = Poses(
        X_WG=multiply(X_WT, multiply(trial.X_TO, trial.X_OG)),
        q=posture.q_pregrasp if trial.closed is None else trial.closed.q,
        X_WO=multiply(X_WT, trial.X_TO),
    )
    X_WC = scene.choose_view(scene.outline(poses), fill=1.25)
    removal = judge_sample(placed.model, trial, placed.config)
    end = trial.outcome.label if removal is None else f"held, {removal.label}"
    end = "sample" if removal is Removal.KEPT else end.replace("_", " ")
    click.echo(f"{name}: {end}", err=True)
    return scene.picture(X_WC, 2 * (round(EDGE * DPI),)).image, end


def draw(images: Sequence[np.ndarray], texts: Sequence[str], png: Path) -> None:
    """Write a sheet of pictures with their texts."""
    lines = -(-len(images) // ACROSS)
    width = ACROSS * EDGE + (ACROSS - 1) * GAP + 2 * MARGIN
    figure = new_page(width, lines * (EDGE + TEXT) + 2 * MARGIN)
    for i, (image, text) in enumerate(zip(images, texts, strict=True)):
        line, column = divmod(i, ACROSS)
        left, top = MARGIN + column * (EDGE + GAP), MARGIN + line * (EDGE + TEXT) + TEXT
        axes = add_axes(figure, left, top, EDGE, EDGE)
        show_image(axes, image)
        write_beside(axes, 0.0, 1.02, text, 6.5, va="bottom")
    save_figure(figure, png, dpi=DPI)


if __name__ == "__main__":
    main()
