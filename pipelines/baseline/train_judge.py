"""Make a judge for `drakegrasp.rank(..., judge=...)`: lift proposals, and learn what holds.

\b
    python pipelines/baseline/train_judge.py DATA JUDGE.npz

First the data: built-in objects of another seed than the benchmark's and without its new classes,
each with its own sizes, mass, friction and resting pose, and one view of it. Of the grasps that
`drakegrasp.propose` returns for the view, some are drawn and lifted. DATA gets a file for each
object, and the settings; after an interruption, the same command continues, and DATA of other
settings is refused. Hand and seed are constants of this script, and the camera is that of
`pipelines/measurements/grasp_choice.py`. Then a logistic regression learns the outcomes from the
features of `drakegrasp.rank`. Its chances are calibrated on classes that another regression did not
see. The same command writes the same bytes on the same machine.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import os
import sys

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import hashlib
import io
import json
import multiprocessing
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

# The camera and the ROC curve have one home.
sys.path.append(str(Path(__file__).parents[1] / "measurements"))
import grasp_choice

import drakegrasp as dg
from drakegrasp.errors import MeshError
from drakegrasp.filters import Removal
from drakegrasp.frames import transform_points
from drakegrasp.generation.attempts import judge_sample
from drakegrasp.hand.description import load_hand
from drakegrasp.mesh.cloud import read_cloud
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import write_atomic
from drakegrasp.scoring.benchmark import FRICTIONS, MASSES, new_classes
from drakegrasp.scoring.judge import ARRAYS, FARTHEST, HEADS, Judge, fingerprint
from drakegrasp.scoring.ranking import measured
from drakegrasp.seeding import Stream, object_key
from drakegrasp.shapes.catalog import CLASSES, LICENCE, BuiltinObject
from drakegrasp.simulation.attempts import make_attempts
from drakegrasp.simulation.placement import PlacedObject, place_object
from drakegrasp.simulation.posture import start_of
from drakegrasp.simulation.scene_cache import cached_scene
from drakegrasp.simulation.settle import settle
from drakegrasp.simulation.trial import run_attempt

Array = npt.NDArray[np.float64]
#: Seed of the objects and of all other draws of the data.
SEED = 4801
#: The hand of the judge: an argument of `load_hand`.
HAND = "barrett"
#: Usual numbers of objects of each class, and of lifts of each object.
PER_CLASS, LIFTS = 5, 18
#: Penalty of the weights' squares, steps of the search, and folds of the classes.
DECAY, STEPS, FOLDS = 0.01, {"maxiter": 300}, 6
#: What the options of the command may be.
POSITIVE = click.IntRange(min=1)


def draw(name: str, *place: int) -> Stream:
    """Return the stream of an object's draws for a purpose."""
    return Stream(SEED, object_key(name), *place)


def placed_object(item: BuiltinObject) -> PlacedObject:
    """Return an object at rest, with drawn mass and friction: upright, or as it fell."""
    u = draw(item.name, 1).uniform(3)
    friction = FRICTIONS[int(u[1] * len(FRICTIONS))]
    values = {
        "hand": HAND,
        "objects.mass": MASSES[int(u[0] * len(MASSES))],
        "physics.friction_hand": friction,
        "physics.friction_table": friction,
        "lift.stop_when": "never",
    }
    config = dg.load_config("fast", [f"{key}={value}" for key, value in values.items()])
    placed = place_object(item.build(), config=config, X_TO=None)
    if u[2] < 0.5:
        return placed
    quaternion = draw(item.name, 2).normal(4)
    quaternion /= np.linalg.norm(quaternion)
    try:
        fallen = settle(placed.model, config, rotation(quaternion))
    except MeshError:
        return placed
    return PlacedObject(model=placed.model, X_TO=fallen.X_TO, config=config)


def rotation(quaternion: Array) -> Array:
    """Return the rotation matrix of a unit quaternion w, x, y, z."""
    w, v = quaternion[0], quaternion[1:]
    K = np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
    return np.asarray(np.eye(3) + 2.0 * w * K + 2.0 * K @ K)


def tried(placed: PlacedObject, posture: dg.Posture) -> list[bool]:
    """Return whether a grasp holds and is a sample, and whether the hand scraped the table."""
    config = placed.config
    start = start_of(posture, load_hand(config.hand_source))
    scene = cached_scene(placed.model, config.physics, config.hand_source, start.preshape)
    trial = run_attempt(scene, placed.X_TO_simulated, start, config)
    # A hand that only scraped the table while it closed is lifted all the same.
    scraped = (
        trial.outcome is Outcome.TABLE_CONTACT
        and trial.lift is None
        and trial.closed is not None
        and not trial.closed.contacts.hand_on_table
    )
    if scraped:
        close = config.close.model_copy(update={"scrape_depth": None})
        rules = config.model_copy(update={"close": close})
        trial = run_attempt(scene, placed.X_TO_simulated, start, rules)
    removal = judge_sample(placed.model, trial, config)
    return [trial.outcome is Outcome.SUCCESS, removal is Removal.KEPT, scraped]


def make_data(item: BuiltinObject, folder: Path, lifts: int) -> str:
    """Write the file of an object, unless it exists, and return a line about it."""
    path = folder / f"{item.name}.npz"
    if path.exists():
        return ""
    try:
        placed = placed_object(item)
    except MeshError as error:
        return f"{item.name}: {error}"
    model, hand = placed.model, load_hand(placed.config.hand_source)
    triangles = transform_points(placed.X_TO_simulated, model.visual_vertices)[model.visual_faces]
    cloud = grasp_choice.seen(triangles, draw(item.name, 3))
    try:
        grasps = dg.propose(cloud, hand)
    except dg.GraspError as error:
        return f"{item.name}: {error}"

    # Lift the plainest grasp, and others at random.
    drawn = draw(item.name, 4).permutation(len(grasps)).tolist()
    chosen = [0, *(i for i in drawn if i)][:lifts]
    ends = [tried(placed, grasps.posture(i, placed.X_TO_simulated)) for i in chosen]
    kept = grasps.at(chosen)
    arrays = {
        "cloud": cloud.astype(np.float32),
        "X_TG": kept.X_FG,
        "q_grasp": kept.q_grasp,
        "q_pregrasp": kept.q_pregrasp,
        "said": kept.said,
        "ends": np.array(ends),
    }
    if any(kept.preshape):
        arrays["preshape"] = np.array(kept.preshape)
    write_atomic(path, packed(arrays))
    counts = np.sum(ends, axis=0)
    return f"{item.name}: {len(ends)} of {len(grasps)} grasps; held, sample, scraped: {counts}"


def claim(folder: Path, lifts: int) -> None:
    """Write the settings of a new folder of data.

    Raises:
        ClickException: If the folder has data of other settings.
    """
    camera = ("DISTANCE", "ELEVATION", "RANGE", "HALF", "PIXELS")
    settings = {
        "hand": HAND,
        "fingerprint": fingerprint(load_hand(HAND)),
        "seed": SEED,
        "lifts": lifts,
        "camera": {name: getattr(grasp_choice, name) for name in camera},
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "settings.json"
    if not any(folder.iterdir()):
        write_atomic(path, json.dumps(settings, indent=1).encode())
    other = json.loads(path.read_text()) if path.exists() else None
    if other != settings:
        raise click.ClickException(f"{folder}: must have data of {settings}, got {other}")


def packed(arrays: dict[str, Any]) -> bytes:
    """Return an NPZ file of arrays, with the same bytes every time."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            one = io.BytesIO()
            np.save(one, np.asarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), one.getvalue())
    return content.getvalue()


def objects(per_class: int) -> list[BuiltinObject]:
    """Return the objects, first one of each class, without the new classes of the benchmark."""
    known = [each for each in CLASSES if each.name not in new_classes()]
    return [
        BuiltinObject(object_class=each, index=index, seed=SEED)
        for index in range(1, per_class + 1)
        for each in known
    ]


# Learning


def read_data(folder: Path, chosen: list[BuiltinObject]) -> dict[str, Any]:
    """Return features, outcomes and objects of all lifts, and a hash of the files."""
    hand, digest, rows = load_hand(HAND), hashlib.sha256(), list[dict[str, Array]]()
    ends, owner = list[Array](), list[Array]()
    for number, item in enumerate(chosen):
        path = folder / f"{item.name}.npz"
        if not path.exists():
            continue
        digest.update(path.read_bytes())
        with np.load(path) as file:
            cloud, X_TG, q = file["cloud"].astype(float), file["X_TG"], file["q_pregrasp"]
            grasps = make_attempts(
                hand,
                [item.name] * len(X_TG),
                X_TG,
                file["q_grasp"],
                q_pregrasp=q,
                frame="table",
                preshape=file["preshape"].tolist() if "preshape" in file else None,
            )
            ends.append(file["ends"])
        found = measured(grasps, read_cloud(cloud), hand)
        rows.append({name: values for name, values in found.items() if values.ndim == 1})
        owner.append(np.full(len(X_TG), number))
    if not rows:
        raise click.ClickException(f"{folder}: must have files of objects, got none")
    names = list(rows[0])
    return {
        "names": names,
        "features": np.column_stack([np.concatenate([r[name] for r in rows]) for name in names]),
        "ends": np.concatenate(ends),
        "object": np.concatenate(owner),
        "sha256": digest.hexdigest(),
    }


def fit(x: Array, y: Array) -> Judge:
    """Return a logistic regression for features (n, f) and outcomes (n, 2), not calibrated."""
    (n, f), mean, scale = x.shape, x.mean(axis=0), np.maximum(x.std(axis=0), 1e-6)
    z = np.clip((x - mean) / scale, -FARTHEST, FARTHEST)

    def loss(w: Array, end: Array) -> tuple[float, Array]:
        logit = z @ w[:-1] + w[-1]
        value = np.logaddexp(0.0, logit) - end * logit
        back = (1.0 / (1.0 + np.exp(-logit)) - end) / n
        penalty = 0.5 * DECAY * float(w[:-1] @ w[:-1])
        return float(value.mean()) + penalty, np.append(z.T @ back + DECAY * w[:-1], back.sum())

    found = [minimize(loss, np.zeros(f + 1), args=(end,), jac=True, options=STEPS).x for end in y.T]
    w = np.array(found).T
    return Judge(name="", about={}, mean=mean, scale=scale, weights=w[:-1], offset=w[-1])


def calibrated(logits: Array, y: Array) -> tuple[Array, Array]:
    """Return slope and shift (2,) with which logits (n, 2) fit outcomes best (Platt 1999)."""

    def loss(w: Array, logit: Array, end: Array) -> float:
        value = w[0] * logit + w[1]
        return float((np.logaddexp(0.0, value) - end * value).mean())

    pairs = [minimize(loss, [1.0, 0.0], args=pair).x for pair in zip(logits.T, y.T, strict=True)]
    slope, shift = np.array(pairs).T
    return slope, shift


def crossed(x: Array, y: Array, groups: npt.NDArray[np.int64]) -> Array:
    """Return logits (n, 2) of regressions that did not see the row's class."""
    logits, folds = np.zeros(y.shape), np.unique(groups, return_inverse=True)[1] % FOLDS
    for fold in range(FOLDS):
        held = folds == fold
        if held.any() and not held.all():
            logits[held] = fit(x[~held], y[~held]).logits(x[held])
    return logits


def auc(score: Array, ends: Array, owner: Array) -> float:
    """Return the mean over objects of the area under the ROC curve."""
    rows = [owner == one for one in np.unique(owner)]
    return float(np.nanmean([grasp_choice.auc(score[own], ends[own]) for own in rows]))


def first(score: Array, ends: Array, owner: Array) -> float:
    """Return the fraction of objects whose first grasp by a score is good."""
    rows = [np.flatnonzero(owner == one) for one in np.unique(owner)]
    return float(np.mean([ends[own[np.argmax(score[own])]] for own in rows]))


def learn(folder: Path, chosen: list[BuiltinObject], name: str, options: str = "") -> bytes:
    """Return the file of a judge, and print how well it judges objects of unseen classes.

    Args:
        folder: The data.
        chosen: The objects.
        name: Name of the judge.
        options: Options of the command that are not the usual ones.
    """
    data = read_data(folder, chosen)
    x, y, owner = data["features"], data["ends"][:, :2].astype(float), data["object"]
    number = np.array([item.object_class.number for item in chosen])
    logits = crossed(x, y, number[owner])
    slope, shift = calibrated(logits, y)
    judge = fit(x, y)
    judge = replace(judge, weights=judge.weights * slope, offset=judge.offset * slope + shift)
    sample, plain = logits[:, 1], -np.arange(len(owner), dtype=float)
    formula = x[:, data["names"].index("score")]
    choices = {"plainest": plain, "closing": formula, "judge": sample, "oracle": y[:, 1]}
    about = {
        "name": name,
        "hand": HAND,
        "fingerprint": fingerprint(load_hand(HAND)),
        "features": data["names"],
        "objects": len(np.unique(owner)),
        "lifts": len(owner),
        "data_sha256": data["sha256"],
        "seed": SEED,
        "unseen classes": {
            **{f"{key}, sample": round(first(s, y[:, 1], owner), 3) for key, s in choices.items()},
            **{
                f"AUC {head}": round(auc(logits[:, k], y[:, k], owner), 3)
                for k, head in enumerate(HEADS)
            },
        },
        "command": f"python pipelines/baseline/train_judge.py DATA {name}.npz{options}",
        "licence": LICENCE,
        "versions": {"drakegrasp": dg.__version__, "numpy": np.__version__},
    }
    click.echo(json.dumps(about["unseen classes"], indent=1))
    arrays = {key: getattr(judge, key).astype(np.float32) for key in ARRAYS}
    return packed({"about": json.dumps(about), **arrays})


@click.command(help=__doc__)
@click.argument("data", type=click.Path(path_type=Path))
@click.argument("judge", type=click.Path(path_type=Path))
@click.option("--per-class", default=PER_CLASS, type=POSITIVE, help="Objects of each class.")
@click.option("--lifts", default=LIFTS, type=POSITIVE, help="Lifts of each object.")
@click.option("--workers", default=1, type=POSITIVE, help="Processes that lift.")
def main(data: Path, judge: Path, per_class: int, lifts: int, workers: int) -> None:
    """Run the script."""
    claim(data, lifts)
    chosen = objects(per_class)
    with multiprocessing.get_context("spawn").Pool(workers) as pool:
        work = partial(make_data, folder=data, lifts=lifts)
        for done, line in enumerate(pool.imap(work, chosen), start=1):
            if line:
                click.echo(f"{done}/{len(chosen)} {line}", err=True)
    options = f" --per-class {per_class}" if per_class != PER_CLASS else ""
    options += f" --lifts {lifts}" if lifts != LIFTS else ""
    write_atomic(judge, learn(data, chosen, judge.stem, options))
    click.echo(f"wrote {judge}")


if __name__ == "__main__":
    main()
