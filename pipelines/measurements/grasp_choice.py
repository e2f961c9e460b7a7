"""Measure how often the grasp that `drakegrasp.rank` puts first is a sample, beside other choices.

\b
    python pipelines/measurements/grasp_choice.py --meshes DIR --units cm --set objects.mass=0.3
    python pipelines/measurements/grasp_choice.py --prepared BENCH
    python pipelines/measurements/grasp_choice.py --prepared BENCH --protocol dexgraspbench

One view of each object is taken from a drawn direction, by rays that meet its mesh and the table,
and `drakegrasp.propose` returns grasps for it. The choices are the first proposal (from above), the
best one by closing, and the best one after lifts of the first K on the object as completed from the
view. The script tries the choices on the object itself, and the first ones by closing for the bound
("oracle"). It prints a line per object, then JSON: for each choice the fractions of objects that
are lifted, and that are a sample, each with the 95 % bootstrap interval over the objects, also for
the differences; the stated chances of the choice, in ten bins; and CPU seconds per view.

Without other options it uses the first built-in object of each class. `--prepared` uses the objects
of a dataset or a benchmark, each with its own mass and friction, in its first resting pose. With
`--protocol`, the rule of another benchmark decides in MuJoCo, and both numbers are its successes.
With `--results`, the file gets a line for each object, and the same command continues.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
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
from drakegrasp.mesh.surfaces import first_hits
from drakegrasp.objects.sources import find_meshes
from drakegrasp.protocols.postures import prepare_trials, verify_postures
from drakegrasp.scoring.ranking import chances
from drakegrasp.seeding import Stream, object_key
from drakegrasp.shapes.catalog import builtin_object, draw_builtin
from drakegrasp.simulation.attempts import GraspTable
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.vision.camera import look_at
from drakegrasp.vision.depth_image import View, cloud_from_depth

Array = npt.NDArray[np.float64]
#: The camera: distance [m], minimum elevation and range of elevations [degree], half the width of
#: the image at a distance of 1 m [m/m], pixels along an edge.
DISTANCE, ELEVATION, RANGE, HALF, PIXELS = 0.65, 35.0, 30.0, 0.2, 96
#: Numbers of first proposals that are tried on the completed object.
SIMULATED = (5, 10)
#: Number of bootstrap resamplings.
DRAWS = 10_000


@click.command(help=__doc__)
@click.option("--prepared", type=click.Path(path_type=Path), help="A dataset or a benchmark.")
@click.option("--meshes", type=click.Path(path_type=Path), help="A folder of meshes.")
@click.option("--units", default="m", help="Unit of the meshes.")
@click.option("--protocol", help="Protocol in MuJoCo that decides in place of the lift.")
@click.option("--results", type=click.Path(path_type=Path), help="File with a line per object.")
@click.option(
    "--set", "overrides", multiple=True, help="Change one setting of preset fast, KEY=VALUE."
)
def main(
    prepared: Path | None,
    meshes: Path | None,
    units: str,
    protocol: str | None,
    results: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Run the script."""
    config = dg.load_config("fast", list(overrides))
    items: Iterator[tuple[str, Callable[[], PlacedObject]]]
    if prepared:
        items = prepared_objects(prepared, overrides)
    elif meshes:
        place = partial(dg.place_object, units=units, config=config)
        items = ((mesh.name, partial(place, mesh.path)) for mesh in find_meshes(meshes))
    else:
        first = (each.name for each in draw_builtin() if each.index == 1)
        items = ((name, partial(builtin_at_rest, name, config)) for name in first)

    rows = [] if results is None or not results.exists() else results.read_text().splitlines()
    found = {row["name"]: row for row in map(json.loads, rows)}
    for name, place_it in items:
        if name in found:
            continue
        try:
            found[name] = measure(name, place_it(), protocol)
        except (MeshError, GraspError) as error:
            click.echo(f"{name}: {error}", err=True)
            continue
        if results:
            with results.open("a") as file:
                file.write(json.dumps(found[name]) + "\n")
    click.echo(json.dumps(summary(list(found.values())), indent=1))


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
        return PlacedObject(model=thing.model, X_TO=thing.resting_poses[0], config=changed)

    for entry in manifest.objects:
        yield entry.name, partial(at_rest, entry.name)


def measure(name: str, placed: PlacedObject, protocol: str | None) -> dict[str, Any]:
    """Return for each choice of a grasp of an object whether it is lifted and a sample.

    Args:
        name: Name of the object.
        placed: The object.
        protocol: Name of a protocol in MuJoCo; None for the lift.
    """
    # The choices, from the view alone.
    view, config = view_of(name, placed), placed.config
    hand = load_hand(config.hand_source)
    begin = time.process_time()
    cloud = cloud_from_depth(view.depth, view.K, view.mask, view.X_TC)
    grasps = dg.propose(cloud, hand)
    proposed = time.process_time()
    ranked = dg.rank(grasps, cloud, hand, simulate=max(SIMULATED), view=view, config=placed.config)
    spent = {"propose": proposed - begin, "rank": time.process_time() - proposed}
    order = np.argsort(-ranked.score, kind="stable")
    choices, chance = {"from above": 0, "closing": int(order[0])}, {}
    for count in SIMULATED:
        share = np.full(len(grasps), np.nan)
        share[order[:count]] = ranked.share[order[:count]]
        stated = chances(ranked.score, share)
        best = int(np.argsort(-stated, kind="stable")[0])
        choices[f"simulate {count}"], chance[f"simulate {count}"] = best, float(stated[best])

    # What they are on the object itself.
    first = order[: max(SIMULATED)].tolist()
    wanted = sorted({*choices.values(), *first})
    if protocol is None:
        ends = {i: tried(placed, grasps, i) for i in wanted}
    else:
        made = tried_by(protocol, placed, grasps, wanted)
        ends = {i: [float(good)] * 2 for i, good in zip(wanted, made, strict=True)}
    listed = {key: ends[i] for key, i in choices.items()}
    listed["oracle"] = np.max([ends[i] for i in first], axis=0).tolist()
    click.echo(f"{name}: {', '.join(f'{k} {v[1]:.0f}' for k, v in listed.items())}", err=True)
    simulated = np.flatnonzero(np.isfinite(ranked.share))
    return {
        "name": name,
        "choices": listed,
        "chance": chance,
        "tried": [[float(ranked.chance[i]), ends[int(i)][1]] for i in simulated],
        "seconds": spent,
        "said": str(grasps.said[choices[f"simulate {max(SIMULATED)}"]]),
    }


def tried(placed: PlacedObject, grasps: GraspTable, i: int) -> list[float]:
    """Return whether a grasp is lifted, and whether it is a sample."""
    trial = dg.run_trial(placed, grasps.posture(i, placed.X_TO_simulated))
    removal = judge_sample(placed.model, trial, placed.config)
    return [float(trial.outcome == dg.Outcome.SUCCESS), float(removal is Removal.KEPT)]


def tried_by(
    protocol: str, placed: PlacedObject, grasps: GraspTable, rows: Sequence[int]
) -> list[bool]:
    """Return whether grasps are successes by a protocol in MuJoCo."""
    hand = load_hand(placed.config.hand_source)
    postures = [(placed, grasps.posture(i, placed.X_TO_simulated)) for i in rows]
    with TemporaryDirectory() as name:
        mjcf, files = write_grasps(postures, hand, Path(name))
        trials = prepare_trials(protocol, mjcf, Path(name))
        return [verdict.success for verdict, _ in verify_postures(files, trials)]


def view_of(name: str, placed: PlacedObject) -> View:
    """Return what a camera sees of an object and of the table, from a drawn direction."""
    vertices = transform_points(placed.X_TO_simulated, placed.model.visual_vertices)
    triangles = vertices[placed.model.visual_faces]
    drawn = Stream(7, object_key(name)).uniform(2)
    azimuth, elevation = 2 * np.pi * drawn[0], math.radians(ELEVATION + RANGE * drawn[1])
    middle = np.array([0.0, 0.0, float(vertices[:, 2].max()) / 2.0])
    X_TC = look_at(middle, DISTANCE, azimuth, math.sin(elevation), 0.0)

    # A ray through each pixel, of length 1 along the camera's z axis.
    focal, centre = (PIXELS - 1) / (2 * HALF), (PIXELS - 1) / 2
    K = np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    v, u = np.mgrid[:PIXELS, :PIXELS].reshape(2, -1)
    rays = np.column_stack([(u - centre) / focal, (v - centre) / focal, np.ones(PIXELS**2)])
    length = np.linalg.norm(rays, axis=1)
    way, eye = rays @ X_TC[:3, :3].T / length[:, None], X_TC[:3, 3]
    met = first_hits(triangles, np.tile(eye, (len(way), 1)), way)
    table = np.where(way[:, 2] < 0.0, -eye[2] / np.minimum(way[:, 2], -1e-9), np.inf)
    depth, mask = np.minimum(met, table) / length, np.isfinite(met)
    shape = PIXELS, PIXELS
    return View(depth=depth.reshape(shape), mask=mask.reshape(shape), K=K, X_TC=X_TC)


def summary(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Return means over objects with their intervals."""
    names = list(found[0]["choices"])
    table = np.array([[each["choices"][name] for name in names] for each in found])
    result: dict[str, Any] = {"objects": len(found)}
    for k, end in enumerate(("lifted", "kept")):
        columns = dict(zip(names, table[:, :, k].T, strict=True))
        differences = {
            f"{name} minus {other}": columns[name] - columns[other]
            for i, name in enumerate(names)
            for other in ("from above", "closing")
            if other in names[:i]
        }
        result[end] = {key: interval(each) for key, each in {**columns, **differences}.items()}
    first = f"simulate {max(SIMULATED)}"
    of_first = [(each["chance"][first], each["choices"][first][1]) for each in found]
    result["stated chances of the first choice"] = bins(of_first)
    result["stated chances of all that were tried"] = bins(
        [tuple(pair) for each in found for pair in each["tried"]]
    )
    result["cpu_seconds"] = {
        key: [
            round(float(q), 2) for q in np.quantile([f["seconds"][key] for f in found], [0.5, 0.9])
        ]
        for key in ("propose", "rank")
    }
    return result


def bins(pairs: Sequence[tuple[float, ...]]) -> list[list[float]]:
    """Return for ten bins of stated chances: count, mean chance, fraction that is a sample."""
    stated, true = np.array(pairs).T
    which = np.minimum((10 * stated).astype(int), 9)
    rows = [(which == k, k) for k in range(10)]
    return [
        [int(own.sum()), round(float(stated[own].mean()), 3), round(float(true[own].mean()), 3)]
        for own, _ in rows
        if own.any()
    ]


def interval(values: Array) -> list[float]:
    """Return the mean and the 95 % interval of values of objects."""
    drawn = np.random.default_rng(0).integers(len(values), size=(DRAWS, len(values)))
    low, high = np.quantile(values[drawn].mean(axis=1), [0.025, 0.975])
    return [round(float(each), 3) for each in (values.mean(), low, high)]


if __name__ == "__main__":
    main()
