"""Our own grasps as files that a protocol of MuJoCo tries: postures, and predictions of contacts.

In: placed grasps, of postures or of contacts. Out: a folder with the hand,
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

from drakegrasp.exchange.closed_grasps import ClosedGrasp
from drakegrasp.exchange.dexgraspbench import BenchFiles
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.postures.posture import Posture, joint_order
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
    """Yield the posture of each grasp, in the given order; of contacts the first wrist pose."""
    for grasp in grasps:
        if grasp.invalid:
            yield PlacedPosture(placed=grasp.placed, posture=grasp.invalid)
            continue
        if grasp.posture is not None:
            yield PlacedPosture(placed=grasp.placed, posture=grasp.posture)
            continue
        fit, hand = first_fit(grasp), load_hand(grasp.config.hand_source)
        named = joint_positions(hand, fit.spread, fit.closing)
        q = np.array([named[name] for name in joint_order(hand)])
        yield PlacedPosture(placed=grasp.placed, posture=Posture(fit.X_OG, q))
