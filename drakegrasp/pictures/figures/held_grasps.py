"""Held grasps as arrays: numbers of all of them, and approaches by object.

In: the attempts of a dataset. Out: arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import norm
from drakegrasp.config import Config
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.figures.approach_map import ObjectApproaches
from drakegrasp.pictures.figures.approach_sphere import approach_directions

#: Columns of the quantities of `HeldGrasps`.
COLUMNS = (
    *("slip", "turn", "closed_f_Q_O", "lifted_f_Q_O", "lifted_penetration", "normal_angle"),
    *("precision", "stable"),
)


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldGrasps:
    """The successes of a dataset, h of them.

    Attributes:
        trial_ids: (h,), rows of `/trials`.
        groups: (h,) bool each, by `held`, `precision` and `stable`.
        quantities: (h,) each, by title with unit.
    """

    trial_ids: npt.NDArray[np.int64]
    groups: dict[str, npt.NDArray[Any]]
    quantities: dict[str, Array]


def read_held(out: Path) -> HeldGrasps:
    """Return the successes of a dataset's first round.

    Raises:
        DataError: If trials.hdf5 is missing or damaged.
    """
    held = Trials(out).where(outcome=Outcome.SUCCESS, refined=False)
    columns = held.columns(COLUMNS)

    degrees = np.rad2deg(1.0)
    closed, lifted = (norm(columns[f"{when}_f_Q_O"]) for when in ("closed", "lifted"))
    angles = np.nan_to_num(columns["normal_angle"])
    return HeldGrasps(
        trial_ids=held.trial_ids,
        groups={
            "held": np.ones(len(held), dtype=np.bool_),
            "precision": columns["precision"],
            "stable": columns["stable"],
        },
        quantities={
            "slip in the hand [mm]": 1e3 * columns["slip"],
            "turn in the hand [°]": degrees * columns["turn"],
            "largest fingertip force after closing [N]": _largest(closed),
            "largest fingertip force after the lift [N]": _largest(lifted),
            "largest penetration after the lift [mm]": 1e3
            * _largest(columns["lifted_penetration"]),
            "largest angle of a contact to the mesh [°]": degrees * _largest(angles),
        },
    )


def _largest(values: npt.NDArray[Any]) -> Array:
    """Return the largest value of each row (n, k)."""
    return np.asarray(values.max(axis=1, initial=0.0))


def read_approaches(out: Path, name: str, config: Config) -> ObjectApproaches:
    """Return from where an object was approached first, in the resting pose that held most.

    Args:
        out: Directory of the dataset.
        name: Of the object.
        config: Of the object, see `Manifest.config_of`.

    Raises:
        DataError: If a file is missing or damaged.
    """
    # The attempts of the object at the pose in which most are held: a picture shows one pose.
    prepared = load_prepared(out, name, config)
    first = Trials(out).where(object_name=name, refined=False)
    resting, held = first["resting"], first["outcome"] == Outcome.SUCCESS
    pose = int(np.bincount(resting[held], minlength=1).argmax())
    own = first[resting == pose].columns(
        ("outcome", "X_OG", "standoff_index", "precision", "stable")
    )
    outcome, packed, standoff, precision, stable = own.values()
    X_OG = unpack_pose(packed)

    # Attempts whose palm ray misses do not approach the object.
    won, approached = outcome == Outcome.SUCCESS, outcome != Outcome.RAY_MISS
    X_TO = prepared.resting_poses[pose]
    directions = approach_directions(X_TO, X_OG)
    reach = np.array(config.candidates.standoffs)[standoff[won]]
    p_OG, z_O = X_OG[won, :3, 3], X_OG[won, :3, 2]
    return ObjectApproaches(
        name=name,
        vertices=prepared.model.visual_vertices,
        faces=prepared.model.visual_faces,
        R_TO=X_TO[:3, :3],
        attempts=len(outcome),
        directions=directions[approached & ~won],
        rays=np.stack([p_OG, p_OG + reach[:, None] * z_O], axis=1),
        successes=directions[won],
        groups=(precision[won].astype(np.int64) + stable[won]),
    )
