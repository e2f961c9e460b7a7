"""Measure how often the grasp that `drakegrasp.rank` puts first holds, compared with other choices.

\b
    python pipelines/measurements/grasp_choice.py [--object NAME ...] [--set KEY=VALUE ...]
    python pipelines/measurements/grasp_choice.py --judge barrett-1 --prepared BENCH --lifts 3
    python pipelines/measurements/grasp_choice.py --judge barrett-1 --meshes DIR --units cm
    python pipelines/measurements/grasp_choice.py --prepared BENCH --protocol dexgraspbench

One view of each object is taken from a drawn direction, by rays that meet its mesh, and
`drakegrasp.propose` returns grasps for it. The script tries all of them, each once, on the object
at rest, or with `--lifts` only the first ones of each choice. It prints a line per object, then
JSON: for several choices the fractions of objects that are held, and that are held in a grasp that
would be a sample, each with the 95 % bootstrap interval over the objects, also for the differences;
the area under the ROC curve of the scores within objects; and the CPU milliseconds per view.

Without other options it uses the first built-in objects of 40 classes; the fixed weights of the
score were fitted to second objects of the other 24 classes. `--prepared` uses the objects of a
dataset or a benchmark, each with its own mass and friction, in its first resting pose. With
`--protocol`, the rule of another benchmark decides in MuJoCo, and both numbers are its successes.
With `--results`, the file gets the settings and a line for each object, and the same command
continues; a file of other settings is refused.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
import numpy as np
import numpy.typing as npt

import drakegrasp as dg
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.errors import GraspError, MeshError
from drakegrasp.exchange.dexgraspbench import write_grasps
from drakegrasp.filters import Removal
from drakegrasp.frames import transform_points
from drakegrasp.generation.attempts import judge_sample
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import override_config
from drakegrasp.mesh.cloud import read_cloud
from drakegrasp.mesh.rays import seen_points
from drakegrasp.mesh.surfaces import even_points, on_faces
from drakegrasp.objects.sources import find_meshes
from drakegrasp.protocols.postures import prepare_trials, verify_postures
from drakegrasp.scoring.benchmark import new_classes
from drakegrasp.scoring.judge import ARRAYS, load_judge
from drakegrasp.scoring.ranking import measured
from drakegrasp.seeding import Stream, object_key
from drakegrasp.shapes.catalog import builtin_object, draw_builtin
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.simulation.conditions import usual_materials
from drakegrasp.simulation.placement import PlacedObject

Array = npt.NDArray[np.float64]
#: The camera: distance [m], minimum elevation and range of elevations [degree], half the width of
#: the image at a distance of 1 m [m/m], pixels along an edge.
DISTANCE, ELEVATION, RANGE, HALF, PIXELS = 0.65, 35.0, 30.0, 0.2, 96
#: Number of points on the whole surface.
WHOLE = 4096
#: Classes whose number modulo OF is less than FITTED served to fit the weights.
FITTED, OF = 3, 8
#: Numbers of first grasps of which the best is told.
FIRST = (3, 5, 24)
#: Number of bootstrap resamplings.
DRAWS = 10_000


@click.command(help=__doc__)
@click.option("--object", "names", multiple=True, help="Name of a built-in object.")
@click.option("--prepared", type=click.Path(path_type=Path), help="A dataset or a benchmark.")
@click.option("--meshes", type=click.Path(path_type=Path), help="A folder of meshes.")
@click.option("--units", default="m", help="Unit of the meshes.")
@click.option(
    "--count", type=click.IntRange(min=1), help="Number of objects, evenly spread; all if left out."
)
@click.option("--judge", help="Name or file of a judge, besides the fixed weights.")
@click.option(
    "--lifts",
    type=click.IntRange(min=1),
    help="Number of first grasps to lift, of the judge if there is one; all if left out.",
)
@click.option("--protocol", help="Protocol in MuJoCo that decides in place of the lift.")
@click.option("--friction", default=1.0, help="Factor of the friction of all objects.")
@click.option("--results", type=click.Path(path_type=Path), help="File with a line per object.")
@click.option(
    "--set", "overrides", multiple=True, help="Change one setting of preset fast, KEY=VALUE."
)
def main(
    names: tuple[str, ...],
    prepared: Path | None,
    meshes: Path | None,
    units: str,
    count: int | None,
    judge: str | None,
    lifts: int | None,
    protocol: str | None,
    friction: float,
    results: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Run the script."""
    config = dg.load_config("fast", list(overrides))
    items: Iterator[tuple[str, Callable[[], PlacedObject]]]
    if prepared:
        items = prepared_objects(prepared, overrides)
    elif meshes:
        found_meshes = find_meshes(meshes)
        items = ((m.name, partial(mesh_at_rest, m.path, units, config)) for m in found_meshes)
    else:
        kept = [each for each in draw_builtin() if each.object_class.number % OF >= FITTED]
        names = names or tuple(each.name for each in kept if each.index == 1)
        items = ((name, partial(builtin_at_rest, name, config)) for name in names)
    chosen = list(items)
    if count:
        chosen = [chosen[i] for i in np.linspace(0, len(chosen) - 1, count).round().astype(int)]

    settings = {
        "objects": str(prepared or meshes or "built-in"),
        "units": units,
        "judge": judge and judge_hash(judge),
        "lifts": lifts,
        "protocol": protocol,
        "friction": friction,
        "set": list(overrides),
    }
    found = stored(results, settings) if results else {}
    for name, place in chosen:
        if name in found:
            continue
        try:
            found[name] = measure(name, with_friction(place(), friction), judge, lifts, protocol)
        except (MeshError, GraspError) as error:
            click.echo(f"{name}: {error}", err=True)
            continue
        if results:
            with results.open("a") as file:
                file.write(json.dumps(found[name]) + "\n")
    rows = [found[name] for name, _ in chosen if name in found]
    new = [row for row in rows if name_of_class(row["name"]) in new_classes()]
    click.echo(json.dumps(summary(rows), indent=1))
    if prepared and new:
        click.echo(json.dumps({"new classes": summary(new)}, indent=1))


def judge_hash(source: str) -> str:
    """Return a hash of the numbers of a judge."""
    judge = load_judge(source)
    return hashlib.sha256(b"".join(getattr(judge, name).tobytes() for name in ARRAYS)).hexdigest()


def stored(results: Path, settings: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the stored lines of objects by name; a new file gets the settings as its first line.

    Raises:
        ClickException: If the file has other settings, or none.
    """
    if not results.exists():
        results.write_text(json.dumps({"settings": settings}) + "\n")
    first, *rows = [json.loads(line) for line in results.read_text().splitlines()] or [{}]
    if (other := first.get("settings")) != settings:
        raise click.ClickException(f"{results}: must be of the settings {settings}, got {other}")
    return {row["name"]: row for row in rows}


def with_friction(placed: PlacedObject, factor: float) -> PlacedObject:
    """Return an object whose friction with hand and table is multiplied by a factor."""
    usual = usual_materials(placed.model, placed.config.physics).friction_hand
    return replace(placed, model=replace(placed.model, friction=factor * usual))


def mesh_at_rest(path: Path, units: str, config: dg.Config) -> PlacedObject:
    """Return the object of a mesh file on the table."""
    return dg.place_object(path, units=units, config=config)


def builtin_at_rest(name: str, config: dg.Config) -> PlacedObject:
    """Return a built-in object on the table."""
    return dg.place_object(builtin_object(name).build(), config=config)


def prepared_objects(
    out: Path, overrides: tuple[str, ...]
) -> Iterator[tuple[str, Callable[[], PlacedObject]]]:
    """Yield the names of a dataset's objects, and functions that return them at rest."""
    manifest = read_manifest(out)

    def at_rest(name: str) -> PlacedObject:
        config = manifest.config
        thing = load_prepared(out, name, config)
        changed = override_config(config, list(overrides))
        return PlacedObject(model=thing.model, X_TO=thing.X_TO, config=changed)

    for entry in manifest.objects:
        yield entry.name, partial(at_rest, entry.name)


def name_of_class(name: str) -> str:
    """Return the class of a built-in object."""
    return name.partition("_")[2].rpartition("_")[0]


def measure(
    name: str, placed: PlacedObject, judge: str | None, lifts: int | None, protocol: str | None
) -> dict[str, Any]:
    """Return for each choice of a grasp of an object whether it holds and whether it is a sample.

    Args:
        name: Name of the object.
        placed: The object.
        judge: Name or file of a judge.
        lifts: Number of first grasps to lift; None for all grasps.
        protocol: Name of a protocol in MuJoCo; None for the lift.
    """
    hand = load_hand(placed.config.hand_source)
    triangles, cloud = view_of(name, placed)
    begin = time.process_time()
    grasps = dg.propose(cloud, hand)
    columns = measured(grasps, read_cloud(cloud), hand)
    cpu = time.process_time() - begin
    scores = {"closing": columns["score"]}
    aside = ~np.char.startswith(grasps.said, "from above")
    if judge:
        scores["judge"] = load_judge(judge).chances(columns)[:, 1]
    for key in list(scores):
        scores[f"{key}, from above"] = np.where(aside, -1.0, scores[key])
    if lifts is None:
        faces = np.arange(3 * len(triangles)).reshape(-1, 3)
        whole, _ = on_faces(triangles.reshape(-1, 3), faces, even_points(WHOLE))
        scores["closing, whole surface"] = dg.rank(grasps, whole, hand).score
    orders = {key: np.argsort(-each, kind="stable") for key, each in scores.items()}

    # Try the grasps that a choice needs.
    ends = np.full((len(grasps), 2), np.nan)
    last = list(scores)[1 if judge else 0]
    wanted = {0, *(int(order[0]) for order in orders.values()), *orders[last][:lifts].tolist()}
    rows = list(range(len(grasps))) if lifts is None else sorted(wanted)
    if protocol is None:
        ends[rows] = [tried(placed, grasps, i) for i in rows]
    else:
        ends[rows] = np.array(tried_by(protocol, placed, grasps, rows))[:, None]
    choices = {"plainest": ends[0]}
    for key, order in orders.items():
        choices[key] = ends[order[0]]
        # Where not all are tried, the first ones of other orders are tried only by chance.
        for first in FIRST:
            if lifts is None or (key == last and first <= lifts):
                choices[f"{key}, best of {first}"] = ends[order[:first]].max(axis=0)
        choices[f"{key}, auc"] = np.array([auc(scores[key], end) for end in ends.T])
    choices["random"], choices["oracle"] = ends.mean(axis=0), ends.max(axis=0)
    listed = {key: value.tolist() for key, value in choices.items() if np.isfinite(value).any()}
    told = ", ".join(f"{key} {value[1]:.2f}" for key, value in listed.items())
    click.echo(f"{name}: {len(grasps)} grasps; samples: {told}", err=True)
    best = int(orders[last][0])
    return {
        "name": name,
        "choices": listed,
        "ms": 1e3 * cpu,
        "said": grasps.said[best],
        "friction": usual_materials(placed.model, placed.config.physics).friction_hand,
        "mass": placed.model.mass,
        "score": float(scores[last][best]),
    }


def tried(placed: PlacedObject, grasps: Attempts, i: int) -> list[float]:
    """Return whether a grasp holds, and whether it is a sample."""
    trial = dg.run_trial(placed, grasps.posture(i, placed.X_TO_simulated))
    removal = judge_sample(placed.model, trial, placed.config)
    return [float(trial.outcome == dg.Outcome.SUCCESS), float(removal is Removal.KEPT)]


def tried_by(
    protocol: str, placed: PlacedObject, grasps: Attempts, rows: Sequence[int]
) -> list[bool]:
    """Return whether grasps are successes by a protocol in MuJoCo."""
    hand = load_hand(placed.config.hand_source)
    postures = [(placed, grasps.posture(i, placed.X_TO_simulated)) for i in rows]
    with TemporaryDirectory() as name:
        mjcf, files = write_grasps(postures, hand, Path(name))
        trials = prepare_trials(protocol, mjcf, Path(name))
        return [verdict.success for verdict, _ in verify_postures(files, trials)]


def view_of(name: str, placed: PlacedObject) -> tuple[Array, Array]:
    """Return an object's triangles (n, 3, 3), and the points (m, 3) of its view, in {T} [m]."""
    vertices = transform_points(placed.X_TO_simulated, placed.model.visual_vertices)
    triangles = vertices[placed.model.visual_faces]
    return triangles, seen(triangles, Stream(7, object_key(name)))


def seen(triangles: Array, stream: Stream) -> Array:
    """Return the points (n, 3) in {T} [m] that a camera sees from a drawn direction."""
    drawn = stream.uniform(2)
    azimuth, elevation = 2 * np.pi * drawn[0], math.radians(ELEVATION + RANGE * drawn[1])
    return seen_points(triangles, azimuth, elevation, distance=DISTANCE, half=HALF, pixels=PIXELS)


def auc(score: Array, ends: Array) -> float:
    """Return the area under the ROC curve; NaN if all results are the same or some are unknown."""
    good, bad = score[ends > 0], score[ends == 0]
    if not len(good) or not len(bad) or np.isnan(ends).any():
        return math.nan
    return float(((good[:, None] > bad) + 0.5 * (good[:, None] == bad)).mean())


def summary(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means over objects with their intervals."""
    names = list(dict.fromkeys(key for each in found for key in each["choices"]))
    nothing = [math.nan, math.nan]
    table = np.array([[each["choices"].get(name, nothing) for name in names] for each in found])
    result: dict[str, Any] = {"objects": len(found)}
    for k, end in enumerate(("held", "sample")):
        columns = dict(zip(names, table[:, :, k].T, strict=True))
        for name in ("closing", "closing, from above", "judge", "judge, from above"):
            if name in columns:
                columns[f"{name} minus plainest"] = columns[name] - columns["plainest"]
        if "judge" in columns:
            columns["judge minus closing"] = columns["judge"] - columns["closing"]
        result[end] = {name: interval(values) for name, values in columns.items()}
    result["ms_per_view"] = round(float(np.median([each["ms"] for each in found])))
    return result


def interval(values: Array) -> list[float]:
    """Return the mean and the 95 % interval of values of objects, without unknown values."""
    known = values[np.isfinite(values)]
    if not len(known):
        return [math.nan] * 3
    drawn = np.random.default_rng(0).integers(len(known), size=(DRAWS, len(known)))
    low, high = np.quantile(known[drawn].mean(axis=1), [0.025, 0.975])
    return [round(float(each), 3) for each in (known.mean(), low, high)]


if __name__ == "__main__":
    main()
