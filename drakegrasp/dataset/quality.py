"""Quality of grasps: how implausible they look.

Input: columns of trials.hdf5. Output: an anomaly score with its parts.

The anomaly score tells which grasps a person should look at first. By itself it removes
nothing; a limit in the configuration (`filters.max_anomaly`) can. Each part is a quantity that is
small for a firm grasp, divided by the value above which this part alone is reason enough to look,
see `PARTS`:

* `normal_angle`, `surface_distance`: a patch on both sides of an edge has a mean normal and a
  centre that no surface has.
* `imbalance`: after the lift, the fingertips' forces and the weight should cancel. The rest is
  supported by something else, or accelerates the object.
* `normal_sum`: length of the sum of the unit normals after closing. Normals of opposed fingers
  cancel; if all fingers push in the same direction, the object escapes. On 1,023 lifts of 29
  objects it separates failed lifts from others with an area under the ROC curve of 0.83.

Epsilon, the Ferrari-Canny measure, is not a part: as a threshold it would remove half of the true
grasps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply, norm
from drakegrasp.dataset.schema import TRIAL_FIELDS, Shown
from drakegrasp.frames import GRAVITY, unpack_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.outcomes import Outcome, Stage

#: Largest value of a part: one extreme number must not hide the others.
CAP = 3.0


@dataclass(frozen=True)
class Part:
    """One reason to doubt a grasp.

    Attributes:
        name: Name of the part.
        scale: Value from which on the part alone is reason enough to look; our own choices, see
            below.
        shown: How people read the part.
        meaning: Description of the part, in words.
        stage: First stage at which the part has a value.
    """

    name: str
    scale: float
    shown: Shown
    meaning: str
    stage: Stage = Stage.TRIED


def _shown(name: str) -> Shown:
    """Return how people read a field of `/trials`."""
    (shown,) = (field.shown for field in TRIAL_FIELDS if field.name == name)
    assert shown is not None
    return shown


#: The scales are the limits of `filters` in the preset `paper`, if it has a limit. The others are
#: values that 5 % of the stable grasps on 29 objects exceed (penetration; the sum of normals: 1.6
#: for three fingers), or that none of them exceeds (imbalance).
# fmt: off
PARTS = (
    Part("penetration", 4e-3, Shown("penetration", "mm"),
         "largest depth of the object in a fingertip", Stage.CLOSED),
    Part("slip", 0.010, _shown("slip"), "motion of the object in the hand during the lift"),
    Part("turn", float(np.deg2rad(10.0)), _shown("turn"),
         "rotation of the object in the hand during the lift"),
    Part("normal_angle", float(np.deg2rad(30.0)), _shown("normal_angle"),
         "largest angle of a contact's normal from the mesh's"),
    Part("surface_distance", 2e-3, _shown("surface_distance"),
         "largest distance of a contact's centre from the mesh: contact on an edge"),
    Part("other_links", 1.0, Shown("other links", digits=0),
         "other links that touch the object after the lift"),
    Part("imbalance", 0.05, Shown("force imbalance", digits=3),
         "fingertips' forces and weight after the lift, as a share of the weight"),
    Part("normal_sum", 0.54, Shown("sum of normals", digits=2),
         "length of the sum of the contact normals after closing, per finger that grasps",
         Stage.CLOSED),
)
# fmt: on

#: Columns of `/trials` that `anomaly` reads.
COLUMNS = (
    "outcome",
    "unused",
    "closed_touching",
    "closed_penetration",
    "lifted_penetration",
    "normal_angle",
    "surface_distance",
    "slip",
    "turn",
    "lifted_other_links",
    "lifted_f_Q_O",
    "X_TO_lifted",
    "closed_nhat_Q_O",
    "time_close",
    "time_lift",
    "mass",
)


@dataclass(frozen=True, kw_only=True, eq=False)
class Anomaly:
    """How implausible n attempts look.

    Attributes:
        score: (n,), root of the sum of the squared parts; NaN if nothing was simulated.
        values: For each name of PARTS the measured quantity (n,) in its unit; NaN if the attempt
            ended before it could be measured, or if a contact has no normal.
        shares: For each name of PARTS the value divided by the scale of the part (n,), at most CAP;
            NaN if the attempt ended before the value could be measured.
    """

    score: Array
    values: Mapping[str, Array]
    shares: Mapping[str, Array]


def anomaly(columns: Mapping[str, npt.NDArray[Any]]) -> Anomaly:
    """Return how implausible attempts look, and why.

    An attempt that ended before the lift is judged by the parts that it has. A contact without a
    normal (its patches face each other) counts with the largest part, CAP; a fingertip that does
    not touch has no contact.

    Args:
        columns: Rows of `/trials` by the names of COLUMNS.
    """
    # How far each attempt got: each time has a value from its stage on.
    closed, tried = np.isfinite(columns["time_close"]), np.isfinite(columns["time_lift"])
    reached = {Stage.CLOSED: closed, Stage.TRIED: closed & tried}

    # The value of each part, and the value divided by its scale.
    values = _values(columns)
    shares = {}
    for part in PARTS:
        there = reached[part.stage]
        values[part.name] = np.where(there, values[part.name], np.nan)
        share = np.minimum(np.nan_to_num(values[part.name], nan=np.inf) / part.scale, CAP)
        shares[part.name] = np.where(there, share, np.nan)

    # The sum is over the parts that an attempt has.
    squares = np.nan_to_num(np.stack([shares[part.name] for part in PARTS], axis=-1))
    score = np.where(closed, norm(squares), np.nan)
    return Anomaly(score=score, values=values, shares=shares)


def _values(columns: Mapping[str, npt.NDArray[Any]]) -> dict[str, Array]:
    """Return the values (n,) of all parts, whatever the stage of the attempts."""
    # The largest depth of both instants; a finger that does not touch has none.
    depths = np.stack([columns["closed_penetration"], columns["lifted_penetration"]])
    depths = np.nan_to_num(depths).max(axis=(0, -1), initial=0.0)

    # Forces of the fingertips and the weight in {T}, whose z axis is vertical.
    R_TO = unpack_pose(columns["X_TO_lifted"])[:, :3, :3]
    f_O = np.nan_to_num(columns["lifted_f_Q_O"]).sum(axis=1)
    weight = np.asarray(columns["mass"], dtype=float) * GRAVITY
    rest_T = multiply(R_TO, f_O[..., None])[..., 0]
    rest_T[:, 2] -= weight

    # A finger that does not touch has no contact; in a failed attempt a normal may be missing.
    touching = np.asarray(columns["closed_touching"], dtype=bool)
    fits = {
        name: np.where(touching, columns[name], 0.0).max(axis=1, initial=0.0)
        for name in ("normal_angle", "surface_distance")
    }
    judged = (columns["outcome"] == Outcome.SUCCESS)[:, None] & touching
    normals = np.asarray(columns["closed_nhat_Q_O"], dtype=float)
    normals = np.where(judged[..., None], normals, np.nan_to_num(normals))

    used = (~unused_fingers(columns["unused"], normals.shape[1])).sum(axis=1)

    return {
        "penetration": depths,
        **fits,
        "slip": np.asarray(columns["slip"], dtype=float),
        "turn": np.asarray(columns["turn"], dtype=float),
        "other_links": np.asarray(columns["lifted_other_links"], dtype=float),
        "imbalance": norm(rest_T) / weight,
        "normal_sum": norm(normals.sum(axis=1)) / used,
    }
