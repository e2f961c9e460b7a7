"""Measure how often the grasp that `drakegrasp.rank` puts first holds, compared with other choices.

\b
    python pipelines/measurements/grasp_choice.py [--object NAME ...] [--set KEY=VALUE ...]

One view of each object is taken from a drawn direction, by rays that meet its mesh. All grasps that
`drakegrasp.propose` returns for it are tried, each once, on the object at rest. The script prints a
line per object, then JSON: for several choices the fractions of objects that are held, and that are
held in a stable precision grasp, each with the 95 % bootstrap interval over the objects; the area
under the ROC curve of the score within objects; and the CPU milliseconds per view. Without
`--object` it uses the first built-in objects of 40 classes; the weights of the score were fitted to
second objects of the other 24 classes.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import math
import time
from typing import Any

import click
import numpy as np
import numpy.typing as npt

import drakegrasp as dg
from drakegrasp.frames import transform_points
from drakegrasp.hand.description import load_hand
from drakegrasp.mesh.crossings import first_hits
from drakegrasp.mesh.surfaces import even_points, on_faces
from drakegrasp.seeding import Stream, object_key
from drakegrasp.shapes.catalog import builtin_object, draw_builtin
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.simulation.placement import PlacedObject

Array = npt.NDArray[np.float64]
#: The camera: distance [m], minimum elevation and range of elevations [degree], half the width of
#: the image at a distance of 1 m [m/m], pixels along an edge.
DISTANCE, ELEVATION, RANGE, HALF, PIXELS = 0.65, 35.0, 30.0, 0.2, 96
#: Number of points on the whole surface.
WHOLE = 4096
#: Classes whose number modulo OF is less than FITTED served to fit the weights.
FITTED, OF = 3, 8
#: Number of bootstrap resamplings.
DRAWS = 10_000


@click.command(help=__doc__)
@click.option("--object", "names", multiple=True, help="Name of a built-in object.")
@click.option(
    "--set", "overrides", multiple=True, help="Change one setting of preset fast, KEY=VALUE."
)
def main(names: tuple[str, ...], overrides: tuple[str, ...]) -> None:
    """Run the script."""
    kept = [each for each in draw_builtin() if each.object_class.number % OF >= FITTED]
    names = names or tuple(each.name for each in kept if each.index == 1)
    config = dg.load_config("fast", list(overrides))
    found = [measure(name, config) for name in names]
    click.echo(json.dumps(summary(found), indent=1))


def measure(name: str, config: dg.Config) -> dict[str, Any]:
    """Return for each choice of a grasp of an object whether it holds and whether it is stable."""
    hand = load_hand(config.hand_source)
    placed = dg.place_object(builtin_object(name).build(), config=config)
    triangles = transform_points(placed.X_TO_simulated, placed.model.visual_vertices)[
        placed.model.visual_faces
    ]
    cloud = seen(triangles, name)
    begin = time.process_time()
    grasps = dg.propose(cloud, hand)
    ranking = dg.rank(grasps, cloud, hand)
    cpu = time.process_time() - begin

    # Try all grasps.
    ends = np.array([tried(placed, grasps, i, config) for i in range(len(grasps))])
    faces = np.arange(3 * len(triangles)).reshape(-1, 3)
    whole, _ = on_faces(triangles.reshape(-1, 3), faces, even_points(WHOLE))
    order, known = ranking.order, dg.rank(grasps, whole, hand).order
    choices = {
        "plainest": ends[0],
        "random": ends.mean(axis=0),
        "closing": ends[order[0]],
        "closing, best of 3": ends[order[:3]].max(axis=0),
        "closing, whole surface": ends[known[0]],
        "oracle": ends.max(axis=0),
        "auc": [auc(ranking.score, each) for each in ends.T],
    }
    told = ", ".join(f"{key} {float(value[0]):.2f}" for key, value in choices.items())
    click.echo(f"{name}: {len(grasps)} grasps; held: {told}", err=True)
    return {"choices": choices, "ms": 1e3 * cpu, "score": float(ranking.score[order[0]])}


def tried(placed: PlacedObject, grasps: Attempts, i: int, config: dg.Config) -> list[float]:
    """Return whether a grasp holds, and whether it is stable."""
    trial = dg.run_trial(placed, grasps.posture(i, placed.X_TO_simulated), config)
    return [float(trial.outcome == dg.Outcome.SUCCESS), float(trial.stable)]


def seen(triangles: Array, name: str) -> Array:
    """Return the points (n, 3) in {T} [m] at which rays of a camera first meet triangles."""
    drawn = Stream(7, object_key(name)).uniform(2)
    azimuth, elevation = 2 * np.pi * drawn[0], math.radians(ELEVATION + RANGE * drawn[1])
    target = np.array([0.0, 0.0, triangles[..., 2].max() / 2.0])
    level = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    back = math.cos(elevation) * level + [0.0, 0.0, math.sin(elevation)]
    right = np.array([level[1], -level[0], 0.0])
    u, v = np.meshgrid(*[np.linspace(-HALF, HALF, PIXELS)] * 2)
    rays = u.reshape(-1, 1) * right + v.reshape(-1, 1) * np.cross(-back, right) - back
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    eye = target + DISTANCE * back
    distance = first_hits(triangles, np.tile(eye, (len(rays), 1)), rays)
    hit = np.isfinite(distance)
    return np.asarray(eye + distance[hit, None] * rays[hit])


def auc(score: Array, ends: Array) -> float:
    """Return the area under the ROC curve; NaN if all results are the same."""
    good, bad = score[ends > 0], score[ends == 0]
    if not len(good) or not len(bad):
        return math.nan
    return float(((good[:, None] > bad) + 0.5 * (good[:, None] == bad)).mean())


def summary(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means over objects with their intervals."""
    names = list(found[0]["choices"])
    table = np.array([[each["choices"][name] for name in names] for each in found])
    result: dict[str, Any] = {"objects": len(found)}
    for k, end in enumerate(("held", "stable")):
        columns = dict(zip(names, table[:, :, k].T, strict=True))
        columns["closing above plainest"] = columns["closing"] - columns["plainest"]
        result[end] = {name: interval(values) for name, values in columns.items()}
    result["ms_per_view"] = round(float(np.median([each["ms"] for each in found])))
    return result


def interval(values: Array) -> list[float]:
    """Return the mean and the 95 % interval of values of objects, without unknown values."""
    known = values[np.isfinite(values)]
    drawn = np.random.default_rng(0).integers(len(known), size=(DRAWS, len(known)))
    low, high = np.quantile(known[drawn].mean(axis=1), [0.025, 0.975])
    return [round(float(each), 3) for each in (known.mean(), low, high)]


if __name__ == "__main__":
    main()
