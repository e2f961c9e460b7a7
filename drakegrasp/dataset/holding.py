"""How much grasps bear: the share of disturbed lifts that end well, and what tells it beforehand.

In: columns of `/trials` that `simulation.robustness` measured. Out: shares with intervals, and how
well numbers of the first lift rank the grasps. No such number ever fills a column of p_hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from statistics import NormalDist
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, norm
from drakegrasp.dataset.schema import HOLD_FIELDS
from drakegrasp.dataset.suspicion import COLUMNS as SUSPECTED
from drakegrasp.dataset.suspicion import suspicion
from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal

#: Probability that the true share lies in an interval.
CONFIDENCE = 0.95
#: A grasp is robust if at least this share of its repeats are samples.
MUCH = 0.5
#: Columns of `/trials` from which the predictors follow.
COLUMNS = (
    *SUSPECTED,
    *("lifted_nhat_Q_O", "lifted_area", "friction_hand", "chance", "slip_released"),
)


def wilson_interval(
    hits: float, count: float, confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Return the interval of a share, from hits among independent trials (Wilson, 1927).

    Unlike the normal approximation it is right near 0 and 1, where these shares lie.

    Args:
        hits: Number of hits.
        count: Number of trials, positive.
        confidence: Probability that the true share lies within.
    """
    z = NormalDist().inv_cdf(0.5 + confidence / 2.0)
    share, weight = hits / count, z * z / count
    centre = (share + weight / 2.0) / (1.0 + weight)
    half = z * sqrt(share * (1.0 - share) / count + weight / (4.0 * count)) / (1.0 + weight)
    return max(0.0, centre - half), min(1.0, centre + half)


def share_text(hits: int, count: int) -> str:
    """Return k of n with its interval as text."""
    if not count:
        return "nothing conclusive"
    low, high = wilson_interval(hits, count)
    return f"{hits} of {count} ({100 * low:.0f} to {100 * high:.0f} %)"


@dataclass(frozen=True, kw_only=True)
class Bearing:
    """How much the grasps of a group bear.

    Attributes:
        drawn: Number of grasps that were repeated, with a verdict at least once.
        much: Those of which `MUCH` of the repeats or more are samples.
        samples, held: Mean share of the repeats that are samples, and that hold; each grasp counts
            for the inverse of its probability to be drawn.
        low, high: Interval of `samples`: the grasps are independent, not their repeats.
    """

    drawn: int
    much: int
    samples: float
    held: float
    low: float
    high: float


def bearing(columns: Mapping[str, npt.NDArray[Any]]) -> Bearing | None:
    """Return how much grasps bear that were repeated; None if none was.

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
    # Of a weighted mean the grasps count as so many; Wilson's interval of as many lifts is wider
    # than that of shares, never narrower.
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
    """Return what of a lift may predict its p_hold: (n,) each, larger for a larger one.

    Args:
        columns: Rows of `/trials`, by the names of COLUMNS.
    """
    doubts = suspicion(columns)
    forces, normals = columns["lifted_f_Q_O"], columns["lifted_nhat_Q_O"]
    pressed, size = -dot(forces, normals), norm(forces)
    # Of friction's cone: 1 along the normal, 0 at its border. A fingertip that does not touch has
    # none.
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
        "chance before the lift": np.asarray(columns["chance"], dtype=float),
    }


def _least(values: npt.NDArray[Any], there: npt.NDArray[np.bool_]) -> Array:
    """Return the least value (n,) of the fingers (n, k) that are there; NaN if none is."""
    least = np.where(there, values, np.inf).min(axis=1, initial=np.inf)
    return np.where(np.isfinite(least), least, np.nan)


def area_under_roc(scores: Array, positive: npt.NDArray[np.bool_]) -> float:
    """Return how often a positive has a higher score than a negative, ties counting half.

    Args:
        scores: (n,); those that are NaN are left out.
        positive: (n,).

    Returns:
        0.5 for scores that tell nothing; NaN if there are no positives or no negatives.
    """
    good, bad = (np.sort(scores[np.isfinite(scores) & own]) for own in (positive, ~positive))
    if not len(good) or not len(bad):
        return float("nan")
    below, up_to = (np.searchsorted(bad, good, side=side) for side in ("left", "right"))
    return float((below + up_to).mean() / (2 * len(bad)))


@dataclass(frozen=True, kw_only=True)
class Holding:
    """How much the grasps of a dataset bear.

    Attributes:
        groups: `samples`, and `others` that were lifted; those of which none was repeated are left
            out.
        predictor: What ranks the samples best among what is stored of their first lift, and its
            area under the ROC curve for `MUCH`; None if that cannot be told.
    """

    groups: dict[str, Bearing]
    predictor: tuple[str, float] | None


def holding_lines(holding: Holding) -> list[str]:
    """Return how much the grasps of a dataset bear, in sentences without a full stop."""
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
    """Return how much the grasps of a dataset bear; None if none was repeated."""
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
    scores = predictors(trials[repeated].columns(COLUMNS))
    ranked = {name: area_under_roc(values, much) for name, values in scores.items()}
    known = {name: area for name, area in ranked.items() if np.isfinite(area)}
    best = max(known, key=lambda name: known[name]) if known else None
    return Holding(groups=groups, predictor=None if best is None else (best, known[best]))
