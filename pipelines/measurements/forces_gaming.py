"""Try to deceive the method `forces` with false predictions, made of a dataset's own grasps.

\b
    python pipelines/measurements/forces_gaming.py OUT --number 24 > forces_gaming.json

OUT is an assembled dataset. The script takes samples of as many objects as possible, and falsifies
each in several ways: normals along the forces of the simulation, or along forces that balance the
load at the dataset's friction, points in the air or inside the object, mirrored or permuted
contacts, and so on. It judges whether the false and the original grasps hold at each friction
coefficient. `gained` counts false grasps that hold although the original grasp does not. The script
prints JSON.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.trials import Trials
from drakegrasp.hand.settings import override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.lift import lift_path
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.verification.forces import (
    MAX_DISTANCE,
    ForceProgram,
    ForceVerdict,
    GraspContacts,
    hardest_forces,
    judge_forces,
)

#: Friction coefficients that are tried.
FRICTIONS = (0.05, 0.71)
#: Distances of points above and below the surface, along it, and between contacts on one side [m].
OFF, SLID, APART = 0.009, 0.02, 0.02
#: Number of predictions near a grasp, of which the best counts, and their deviations [m, rad].
DRAWS, STRAY, TILT = 30, 0.005, np.deg2rad(40.0)

Array = npt.NDArray[np.float64]
Contacts = tuple[Array, Array]


@dataclass(frozen=True, kw_only=True, eq=False)
class Grasp:
    """A sample in {O}: points, normals and forces (k, 3) [m, -, N] on an object at rest."""

    placed: PlacedObject
    p: Array
    n: Array
    f: Array
    config: Config
    rng: np.random.Generator

    @property
    def model(self) -> ObjectModel:
        """The object."""
        return self.placed.model


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--number", type=int, default=24, show_default=True, help="Grasps of each kind.")
def main(out: Path, number: int) -> None:
    """Run the script."""
    grasps = some_grasps(out, number)
    figures: dict[str, Any] = {
        "grasps": len(grasps),
        "objects": len({grasp.model.name for grasp in grasps}),
    }
    for friction in FRICTIONS:
        honest = [judge(grasp, friction, (grasp.p, grasp.n)) for grasp in grasps]
        figures[f"friction {friction}"] = {"as they are": summary(honest, honest)} | {
            name: summary([judge(g, friction, spoil(g)) for g in grasps], honest)
            for name, spoil in SPOILT.items()
        }
        figures[f"friction {friction}"]["best of near ones"] = summary(
            [best_of_draws(grasp, friction) for grasp in grasps], honest
        )
    click.echo(json.dumps(figures, indent=1))


def some_grasps(out: Path, number: int) -> list[Grasp]:
    """Return samples of a dataset, taken from each object in turn."""
    # The first sample of each object comes first, then the second, and so on.
    samples = Trials(out).where(sample=True)
    names = samples.objects["name"][samples["object"]]
    turn = np.array([int((names[:i] == name).sum()) for i, name in enumerate(names)])
    chosen = np.argsort(turn, kind="stable")[:number]
    contacts = samples.contacts(frame="object")

    config = read_manifest(out).config
    objects = {name: load_prepared(out, name, config) for name in set(names[chosen])}
    return [
        Grasp(
            placed=PlacedObject(
                model=objects[names[i]].model,
                X_TO=objects[names[i]].resting_poses[samples["resting"][i]],
                config=config,
            ),
            p=contacts.points[i],
            n=contacts.normals[i],
            f=contacts.forces[i],
            config=config,
            rng=np.random.default_rng(int(i)),
        )
        for i in chosen
    ]


def judge(grasp: Grasp, friction: float, contacts: Contacts) -> ForceVerdict:
    """Return the verdict of the method `forces` on contacts on the object of a grasp."""
    p, n = contacts
    return judge_forces(
        grasp.model,
        grasp.placed.X_TO_simulated,
        p,
        n / np.linalg.norm(n, axis=1, keepdims=True),
        override_config(grasp.config, [f"physics.friction_hand={friction}"]),
    )


def summary(verdicts: list[ForceVerdict], honest: list[ForceVerdict]) -> dict[str, Any]:
    """Return how many grasps hold, how many only as false ones, and why the others fail."""
    patches = [v.on_surface and v.patches.share <= 1.0 for v in verdicts]
    return {
        "held": sum(v.held for v in verdicts),
        "gained": sum(v.held and not h.held for v, h in zip(verdicts, honest, strict=True)),
        "held at patches": sum(patches),
        "off the surface": sum(not v.on_surface for v in verdicts),
        "by": dict(Counter(_cause(v) for v in verdicts if not v.held)),
    }


def _cause(verdict: ForceVerdict) -> str:
    """Return why a grasp fails, in two words."""
    if not verdict.on_surface:
        far = verdict.contacts.distance > MAX_DISTANCE
        return "point off" if far.any() else "normal off"
    return "no forces" if np.isinf(verdict.planned_share) else "too weak"


# Ways to falsify a grasp


def along_stored_forces(grasp: Grasp) -> Contacts:
    """Normals opposite to the forces with which the simulated fingertips press."""
    return grasp.p, -grasp.f


def along_balancing_forces(grasp: Grasp) -> Contacts:
    """Normals opposite to forces that support the load at the dataset's own friction."""
    contacts = GraspContacts(grasp.p, grasp.n, grasp.model.p_OOcm, 20.0)
    wrenches = lift_path(grasp.placed.X_TO_simulated, grasp.config).wrenches(grasp.model)
    forces = hardest_forces(ForceProgram(contacts, grasp.config.physics.friction_hand), wrenches)
    return grasp.p, np.where(np.isfinite(forces.f_Q_O), -forces.f_Q_O, grasp.n)


def mirrored(grasp: Grasp) -> Contacts:
    """The contacts mirrored at the plane x = 0 of the object's frame."""
    return grasp.p * [-1.0, 1.0, 1.0], grasp.n * [-1.0, 1.0, 1.0]


def slid(grasp: Grasp) -> Contacts:
    """Each contact moved along the surface, with its original normal."""
    away = np.cross(grasp.n, grasp.rng.normal(size=grasp.n.shape))
    away *= SLID / np.linalg.norm(away, axis=1, keepdims=True)
    points, _, _ = grasp.model.collision.nearest.on_surface(grasp.p + away)
    return np.asarray(points), grasp.n


def on_one_side(grasp: Grasp) -> Contacts:
    """All contacts beside the first one, with the surface's normals there."""
    _, _, (_, along, across) = np.linalg.svd(grasp.n[:1])
    beside = grasp.p[0] + APART * np.array([0.0 * along, along, across])[: len(grasp.p)]
    points, _, faces = grasp.model.collision.nearest.on_surface(beside)
    return np.asarray(points), np.asarray(grasp.model.collision.face_normals[faces])


SPOILT: dict[str, Callable[[Grasp], Contacts]] = {
    "normals along the stored forces": along_stored_forces,
    "normals along balancing forces": along_balancing_forces,
    "9 mm in the air": lambda g: (g.p + OFF * g.n, g.n),
    "9 mm inside": lambda g: (g.p - OFF * g.n, g.n),
    "9 mm in the air, along balancing forces": lambda g: (
        g.p + OFF * g.n,
        along_balancing_forces(g)[1],
    ),
    "mirrored": mirrored,
    "slid by 20 mm": slid,
    "on one side": on_one_side,
    "fingers permuted": lambda g: (np.roll(g.p, 1, axis=0), np.roll(g.n, 1, axis=0)),
    "normals reversed": lambda g: (g.p, -g.n),
}


def best_of_draws(grasp: Grasp, friction: float) -> ForceVerdict:
    """Return the best verdict of predictions near a grasp: the gain from choosing among them."""
    rng = np.random.default_rng(1)
    verdicts = []
    for _ in range(DRAWS):
        p = grasp.p + rng.uniform(-STRAY, STRAY, grasp.p.shape) / np.sqrt(3.0)
        n = grasp.n + np.tan(TILT) * rng.uniform(-1.0, 1.0, grasp.n.shape) / np.sqrt(3.0)
        verdicts.append(judge(grasp, friction, (p, n)))
        if verdicts[-1].held:
            break
    return min(verdicts, key=lambda v: (not v.on_surface, v.planned_share))


if __name__ == "__main__":
    main()
