"""Our own grasps as files that a protocol of MuJoCo tries: postures, and predictions of contacts.

In: postures on objects that are placed, or placed grasps of contacts. Out: a folder with the hand,
the objects and a file per grasp, as `drakegrasp.exchange.dexgraspbench` writes samples. The hand's
model is the dataset's, in MuJoCo; objects stand as `PlacedObject.X_TO_simulated` says. Contacts
become the posture of the first wrist pose that fits them. A grasp that lacks pregrasp or squeeze
gets those of the export.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.errors import GraspError, listed
from drakegrasp.exchange.closed_grasps import ClosedGrasp
from drakegrasp.exchange.dexgraspbench import BenchFiles
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.postures.posture import Posture, joint_order
from drakegrasp.simulation.postures.table import PostureTable, given_candidates
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
    grasps: Sequence[PlacedPosture], hand: Hand, folder: Path
) -> tuple[Path, list[Path | str]]:
    """Write grasps, and return the MJCF of the hand, and the file of each or why there is none.

    Args:
        grasps: In the caller's order.
        hand: Their hand.
        folder: To which the paths of objects in the files are relative.
    """
    # The hand, and where its spread is among the joints.
    files, written = BenchFiles(hand, folder), set[str]()
    spread = joint_order(hand).index(hand.spread.joints[0]) if hand.spread.joints else None

    # Each grasp, and its object before the first.
    found = list[Path | str]()
    for number, each in enumerate(grasps):
        posture, placed = each.posture, each.placed
        if isinstance(posture, str):
            found.append(posture)
            continue
        if placed.model.name not in written:
            files.write_object(placed.model)
            written.add(placed.model.name)
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


def fitted_postures(grasps: Sequence[PlacedGrasp]) -> Iterator[PlacedPosture]:
    """Yield the first wrist pose of each grasp of contacts, in the given order."""
    for grasp in grasps:
        if grasp.invalid:
            yield PlacedPosture(placed=grasp.placed, posture=grasp.invalid)
            continue
        fit, hand = first_fit(grasp), load_hand(grasp.config.hand_source)
        named = joint_positions(hand, fit.spread, fit.closing)
        q = np.array([named[name] for name in joint_order(hand)])
        yield PlacedPosture(placed=grasp.placed, posture=Posture(fit.X_OG, q))


def postures_on_dataset(table: PostureTable, out: Path) -> list[PlacedPosture]:
    """Return the postures of a table on the objects of a dataset.

    Raises:
        GraspError: If an object, a resting pose or a scale is none of the dataset's, or the
            postures are in the frames of mesh files.
        DataError: If the dataset cannot be used.
    """
    manifest = read_manifest(out)
    known = [entry.name for entry in manifest.objects]
    found: dict[int, PlacedPosture] = {}
    for name in dict.fromkeys(table.objects):
        if name not in known:
            raise GraspError(f"object must be one of {listed(known)}, got {name!r}")
        config = manifest.config_of(name)
        prepared = load_prepared(out, name, config)
        things = [
            PlacedObject(model=prepared.model, X_TO=X_TO, config=config)
            for X_TO in prepared.resting_poses
        ]
        found |= _on_object(table.of_object(name), things, config)
    return [found[row] for row in sorted(found)]


def postures_on_object(table: PostureTable, placed: PlacedObject) -> list[PlacedPosture]:
    """Return the postures of a table on one object, whatever they call it."""
    found = dict[int, PlacedPosture]()
    for name in dict.fromkeys(table.objects):
        found |= _on_object(table.of_object(name), [placed], placed.config)
    return [found[row] for row in sorted(found)]


def _on_object(
    table: PostureTable, things: Sequence[PlacedObject], config: Config
) -> dict[int, PlacedPosture]:
    """Return the postures of an object's rows, by row."""
    if table.frame == "mesh":
        raise GraspError("frame must be object, table, camera or world for a protocol, got mesh")
    rules = config.candidates.model_copy(update={"max": len(table)})
    X_TO = np.array([placed.X_TO for placed in things])
    found = given_candidates(
        things[0].model, X_TO, table, np.eye(4), config.model_copy(update={"candidates": rules})
    )
    return {
        int(table.row[i]): PlacedPosture(
            placed=things[table.resting[i]],
            posture=Posture(
                found.X_OG[i],
                table.q_grasp[i],
                _given(table.q_pregrasp[i]),
                _given(table.q_squeeze[i]),
            ),
        )
        for i in range(len(table))
    }


def _given(q: Array) -> Array | None:
    return None if np.isnan(q).any() else q
