"""Quality of grasps: how implausible they look, and how much disturbance they tolerate.

Input: columns of trials.hdf5. Output: a score of suspicion with its parts; for lifts that were
repeated with disturbances (`simulation.robustness`), the fractions of repeats that end well, with
intervals, and how well numbers of the first lift rank the grasps. Such a number never fills a
column of p_hold.

The score of suspicion tells which grasps a person should look at first. By itself it removes
nothing; a limit in the configuration (`filters.max_suspicion`) can. Each part is a quantity that is
small for a firm grasp, divided by the value above which this part alone is reason enough to look,
see `PARTS`:

* `normal_angle`, `surface_distance`: a patch on both sides of an edge has a mean normal and a
  centre that no surface has.
* `imbalance`: after the lift, the fingertips' forces and the weight should cancel. The rest is
  supported by something else, or accelerates the object.
* `normal_sum`: length of the sum of the unit normals after closing. Normals of opposed fingers
  cancel; if all fingers push in the same direction, the object escapes. On 1,023 lifts of 29
  objects it separates failed lifts from held ones with an area under the ROC curve of 0.83.

Epsilon, the Ferrari-Canny measure, is not a part: as a threshold it would remove half of the true
grasps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, multiply, norm
from drakegrasp.dataset.schema import HOLD_FIELDS, TRIAL_FIELDS, Shown
from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.outcomes import Outcome, Stage

#: Drake's gravity [m/s^2], as in `simulation.settle`, which loads Drake.
GRAVITY = 9.81
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
    stage: Stage = Stage.LIFTED


def _shown(name: str) -> Shown:
    """Return how people read a field of `/trials`."""
    (shown,) = (field.shown for field in TRIAL_FIELDS if field.name == name)
    assert shown is not None
    return shown


#: The scales are the limits of `filters` in the preset `paper`, if it has a limit. The others are
#: values that 5 % of the stable grasps on 29 objects exceed (penetration; the sum of normals: 1.6
#: for three fingers), or that none of them exceeds (imbalance).
PARTS = (
    Part(
        "penetration",
        4e-3,
        Shown("penetration", "mm"),
        "largest depth of the object in a fingertip",
        Stage.CLOSED,
    ),
    Part("slip", 0.010, _shown("slip"), "motion of the object in the hand during the lift"),
    Part(
        "turn",
        float(np.deg2rad(10.0)),
        _shown("turn"),
        "rotation of the object in the hand during the lift",
    ),
    Part(
        "normal_angle",
        float(np.deg2rad(30.0)),
        _shown("normal_angle"),
        "largest angle of a contact's normal from the mesh's",
    ),
    Part(
        "surface_distance",
        2e-3,
        _shown("surface_distance"),
        "largest distance of a contact's centre from the mesh: contact on an edge",
    ),
    Part(
        "other_links",
        1.0,
        Shown("other links", digits=0),
        "other links that touch the object after the lift",
    ),
    Part(
        "imbalance",
        0.05,
        Shown("force imbalance", digits=3),
        "fingertips' forces and weight after the lift, as a share of the weight",
    ),
    Part(
        "normal_sum",
        0.54,
        Shown("sum of normals", digits=2),
        "length of the sum of the contact normals after closing, per finger that grasps",
        Stage.CLOSED,
    ),
)

#: Columns of `/trials` that `suspicion` reads.
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
class Suspicion:
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


def suspicion(columns: Mapping[str, npt.NDArray[Any]]) -> Suspicion:
    """Return how implausible attempts look, and why.

    An attempt that ended before the lift is judged by the parts that it has. A contact without a
    normal (its patches face each other) counts with the largest part, CAP; a fingertip that does
    not touch has no contact.

    Args:
        columns: Rows of `/trials` by the names of COLUMNS.
    """
    # How far each attempt got: each time has a value from its stage on.
    closed, lifted = np.isfinite(columns["time_close"]), np.isfinite(columns["time_lift"])
    reached = {Stage.CLOSED: closed, Stage.LIFTED: closed & lifted}

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
    return Suspicion(score=score, values=values, shares=shares)


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


#: Probability that the true fraction is in an interval.
CONFIDENCE = 0.95
#: A grasp is robust if at least this fraction of its repeats are samples.
MUCH = 0.5
#: Columns of `/trials` from which the predictors follow.
PREDICTED_BY = (
    *COLUMNS,
    *("lifted_nhat_Q_O", "lifted_area", "friction_hand", "slip_released"),
)


def wilson_interval(
    hits: float, count: float, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the interval of a fraction, from hits among independent trials (Wilson, 1927).

    Unlike the normal approximation it is valid near 0 and 1, where these fractions are.

    Args:
        hits: Number of hits.
        count: Number of trials, positive.
        confidence: Probability that the true fraction is in the interval.
    """
    z = NormalDist().inv_cdf(0.5 + confidence / 2.0)
    share, weight = hits / count, z * z / count
    centre = (share + weight / 2.0) / (1.0 + weight)
    half = z * sqrt(share * (1.0 - share) / count + weight / (4.0 * count)) / (1.0 + weight)
    return max(0.0, centre - half), min(1.0, centre + half)


def share_text(hits: int, count: int) -> str:
    """Return the text "k of n" with the interval of the fraction."""
    if not count:
        return "nothing conclusive"
    low, high = wilson_interval(hits, count)
    return f"{hits} of {count} ({100 * low:.0f} to {100 * high:.0f} %)"


@dataclass(frozen=True, kw_only=True)
class Bearing:
    """How much disturbance the grasps of a group tolerate.

    Attributes:
        drawn: Number of grasps that were repeated, with at least one verdict.
        much: Number of these of whose repeats at least the fraction `MUCH` are samples.
        samples, held: Mean fractions of the repeats that are samples, and that hold; each grasp has
            the inverse of its probability to be drawn as weight.
        low, high: Interval of `samples`; the grasps are independent, their repeats are not.
    """

    drawn: int
    much: int
    samples: float
    held: float
    low: float
    high: float


def bearing(columns: Mapping[str, npt.NDArray[Any]]) -> Bearing | None:
    """Return how much disturbance the repeated grasps tolerate; None if none was repeated.

    Args:
        columns: Rows of `/trials`, by the names of HOLD_FIELDS.
    """
    repeats = columns["p_hold_repeats"].astype(float)
    there = repeats > 0
    if not there.any():
        return None
    share, held = (columns[f"p_hold_{k}"][there] / repeats[there] for k in ("samples", "held"))
    weight = 1.0 / columns["p_hold_probability"][there]
    weight = weight / weight.sum()
    mean = float(weight @ share)
    # The effective number of grasps of a weighted mean. Wilson's interval for as many lifts is
    # never narrower than that of the mean of fractions.
    effective = 1.0 / float(weight @ weight)
    low, high = wilson_interval(mean * effective, effective)
    return Bearing(
        drawn=int(there.sum()),
        much=int((share >= MUCH).sum()),
        samples=mean,
        held=float(weight @ held),
        low=low,
        high=high,
    )


def predictors(columns: Mapping[str, npt.NDArray[Any]]) -> dict[str, Array]:
    """Return numbers of a lift that may predict its p_hold: (n,) each, larger for a larger one.

    Args:
        columns: Rows of `/trials`, by the names of PREDICTED_BY.
    """
    doubts = suspicion(columns)
    forces, normals = columns["lifted_f_Q_O"], columns["lifted_nhat_Q_O"]
    pressed, size = -dot(forces, normals), norm(forces)
    # Margin to the friction cone: 1 for a force along the normal, 0 at the cone's border; undefined
    # for a fingertip that does not touch.
    across = np.sqrt(np.maximum(size**2 - pressed**2, 0.0))
    with np.errstate(invalid="ignore", divide="ignore"):
        margin = 1.0 - across / (columns["friction_hand"][:, None] * pressed)
    touching = size > 0.0
    return {
        "least margin to the friction cone": _least(margin, touching),
        "least force of a fingertip": _least(size, touching),
        "least area of a contact": _least(columns["lifted_area"], touching),
        "slip": -doubts.values["slip"],
        "slip before the wrist moves": -np.asarray(columns["slip_released"], dtype=float),
        "turn": -doubts.values["turn"],
        "sum of normals": -doubts.values["normal_sum"],
        "normal angle": -doubts.values["normal_angle"],
        "suspicion": -doubts.score,
    }


def _least(values: npt.NDArray[Any], there: npt.NDArray[np.bool_]) -> Array:
    """Return the smallest value (n,) of the fingers (n, k) in `there`; NaN if there is none."""
    least = np.where(there, values, np.inf).min(axis=1, initial=np.inf)
    return np.where(np.isfinite(least), least, np.nan)


def area_under_roc(scores: Array, positive: npt.NDArray[np.bool_]) -> float:
    """Return how often a positive has a higher score than a negative, ties counting half.

    Args:
        scores: (n,); NaN values are left out.
        positive: (n,), which scores belong to positives.

    Returns:
        0.5 for scores without information; NaN if there are no positives or no negatives.
    """
    good, bad = (np.sort(scores[np.isfinite(scores) & own]) for own in (positive, ~positive))
    if not len(good) or not len(bad):
        return float("nan")
    below, up_to = (np.searchsorted(bad, good, side=side) for side in ("left", "right"))
    return float((below + up_to).mean() / (2 * len(bad)))


@dataclass(frozen=True, kw_only=True)
class Holding:
    """How much disturbance the grasps of a dataset tolerate.

    Attributes:
        groups: `samples`, and `others` that were lifted; a group without repeated grasps is left
            out.
        predictor: Stored number of the first lift that ranks the samples best, and its area under
            the ROC curve for `MUCH`; None if it cannot be computed.
    """

    groups: dict[str, Bearing]
    predictor: tuple[str, float] | None


def holding_lines(holding: Holding) -> list[str]:
    """Return how much disturbance the grasps tolerate, in sentences without a full stop."""
    lines = [
        f"p_hold of {name}: {100 * each.samples:.0f} % of the disturbed repeats would be samples "
        f"({100 * each.low:.0f} to {100 * each.high:.0f} %), {100 * each.held:.0f} % hold; "
        f"half or more of their repeats would be samples of {each.much:,} of {each.drawn:,}"
        for name, each in holding.groups.items()
    ]
    if holding.predictor is not None:
        name, area = holding.predictor
        lines.append(
            f"of what is stored of the first lift, {name} ranks these samples best (AUC {area:.2f})"
        )
    return lines


def holding_of(trials: Trials) -> Holding | None:
    """Return how much disturbance the grasps of a dataset tolerate; None if none was repeated."""
    names = [*(field.name for field in HOLD_FIELDS), "removal"]
    blocks = list(trials.blocks(names))
    columns = {name: np.concatenate([block[name] for block in blocks]) for name in names}
    sample = columns["removal"] == Removal.KEPT
    found = {
        name: bearing({key: values[own] for key, values in columns.items()})
        for name, own in (("samples", sample), ("others", ~sample))
    }
    groups = {name: each for name, each in found.items() if each is not None}
    if not groups:
        return None
    repeated = sample & (columns["p_hold_repeats"] > 0)
    much = (columns["p_hold_samples"] >= MUCH * columns["p_hold_repeats"])[repeated]
    scores = predictors(trials[repeated].columns(PREDICTED_BY))
    ranked = {name: area_under_roc(values, much) for name, values in scores.items()}
    known = {name: area for name, area in ranked.items() if np.isfinite(area)}
    best = max(known, key=lambda name: known[name]) if known else None
    return Holding(groups=groups, predictor=None if best is None else (best, known[best]))
