"""Our own grasps as files that a protocol of MuJoCo tries: postures, and predictions of contacts.

In: placed grasps, of postures or of contacts. Out: a folder with the hand,
the objects and a file per grasp, as `drakegrasp.exchange.dexgraspbench` writes samples. The hand's
model is the dataset's, in MuJoCo; objects stand as `PlacedObject.X_TO_simulated` says. Contacts
become the posture of the first wrist pose that fits them. A grasp that lacks pregrasp or squeeze
gets those of the export. Objects are cut into convex parts, which takes most of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drakegrasp.exchange.dexgraspbench import OBJECTS, BenchFiles, write_object
from drakegrasp.exchange.export import ClosedGrasp
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.executor import Executor, run_here
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import Posture, joint_order
from drakegrasp.verification.verify import PlacedGrasp, first_fit


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacedPosture:
    """A posture on an object on the table.

    Attributes:
        placed: The object.
        posture: In {O}; why there is none, for a row that is no grasp.
    """

    placed: PlacedObject
    posture: Posture | str


def write_grasps(
    grasps: Sequence[PlacedPosture],
    hand: Hand,
    folder: Path,
    *,
    execute: Executor = run_here,
    keep: Path | None = None,
    report: Report = silent,
) -> tuple[Path, list[Path | str]]:
    """Write grasps, and return the MJCF of the hand, and the file of each or why there is none.

    Args:
        grasps: In the caller's order.
        hand: Their hand.
        folder: To which the paths of objects in the files are relative.
        execute: Cuts and writes the objects.
        keep: Folder that keeps the convex parts of objects for the next call; None keeps none.
        report: Is told how many objects are written.

    Raises:
        OSError: If a folder cannot be written.
    """
    # The hand, and where its spread is among the joints.
    files = BenchFiles(hand, folder)
    spread = joint_order(hand).index(hand.spread.joints[0]) if hand.spread.joints else None

    # Each object once.
    things = (each.placed.model for each in grasps if isinstance(each.posture, Posture))
    models = {model.name: model for model in things}
    report(0, len(models))
    tasks = [(model, folder / OBJECTS / name, keep) for name, model in models.items()]
    for done, _ in enumerate(execute(_write_parts, tasks), start=1):
        report(done, len(models))

    # Each grasp.
    found = list[Path | str]()
    for number, each in enumerate(grasps):
        posture, placed = each.posture, each.placed
        if isinstance(posture, str):
            found.append(posture)
            continue
        grasp = ClosedGrasp(
            trial_id=number,
            split="",
            object_name=placed.model.name,
            X_TO=placed.X_TO_simulated,
            X_TG=placed.X_TO_simulated @ posture.X_OG,
            q=posture.q_grasp,
            spread=0.0 if spread is None else float(posture.q_grasp[spread]),
        )
        path = folder / "grasps" / f"{number}.npy"
        files.write_grasp(path, grasp, pregrasp=posture.q_pregrasp, squeeze=posture.q_squeeze)
        found.append(path)
    return files.hand_path, found


def _write_parts(task: tuple[ObjectModel, Path, Path | None]) -> None:
    """Cut an object into convex parts and write them."""
    from drakegrasp.mjcf.convex_parts import convex_parts, kept_convex_parts

    model, folder, keep = task
    write_object(folder, convex_parts(model) if keep is None else kept_convex_parts(model, keep))


def fitted_postures(
    grasps: Sequence[PlacedGrasp], execute: Executor = run_here
) -> list[PlacedPosture]:
    """Return the posture of each grasp, in the given order; of contacts the first wrist pose."""
    contacts = [(i, g) for i, g in enumerate(grasps) if not g.invalid and g.posture is None]
    fitted = dict(execute(_fit, contacts))
    return [
        PlacedPosture(placed=g.placed, posture=g.invalid or _told(g) or g.posture or fitted[i])
        for i, g in enumerate(grasps)
    ]


def _told(grasp: PlacedGrasp) -> str:
    """Return why a posture cannot be tried: nobody named its resting pose; empty if it can."""
    count = 1 + len(grasp.others)
    return f"resting must be 0 to {count - 1} with a protocol, got none" if count > 1 else ""


def _fit(task: tuple[int, PlacedGrasp]) -> tuple[int, Posture]:
    """Return the number of a grasp of contacts, and the posture of its first wrist pose."""
    number, grasp = task
    fit, hand = first_fit(grasp), load_hand(grasp.config.hand_source)
    named = joint_positions(hand, fit.spread, fit.closing)
    return number, Posture(fit.X_OG, np.array([named[name] for name in joint_order(hand)]))
