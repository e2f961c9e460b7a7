"""Fit the chance that decides which closed hands are lifted, and report how well it orders lifts.

    python pipelines/fit_lift_chance.py TRAIN --test TEST --write FILE

TRAIN and TEST are datasets of one hand and of different objects, in which all closed hands were
lifted, e.g. `build --config fast --set lift.least_chance=0 --set lift.least_depth_variance=0
--candidates 240`. Without `--write` nothing is fitted, and the hand's own weights are evaluated.
The script prints JSON. For both datasets it reports the area under the curve (AUC) of the chance
and of the length of the mean normal alone, the fraction of samples in the better half of the lifts,
and for some minimum chances the fractions of samples and of lifts below them. The chance of each
lift in TRAIN comes from a model that was fitted to other objects.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.stats import rankdata

from drakegrasp.arithmetic import Array
from drakegrasp.config import FilterConfig
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal, first_removal
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.lift_chance import (
    FEATURES,
    GRASP_CONTACTS,
    ClosedGrasp,
    LiftChance,
    features,
    read_lift_chance,
)
from drakegrasp.outcomes import Outcome
from drakegrasp.table import Table

#: Weight of the squares of the standardized weights.
RIDGE = 3.0
#: Parts into which the objects are divided; the chances of a part come from a model of the others.
FOLDS = 7
#: Minimum chances for which fractions are reported.
THRESHOLDS = (0.01, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2)
HEAD = """\
# The chance that a lift by the Barrett Hand gives a sample: bias and weights of a logistic model
# of the features in drakegrasp/hand/lift_chance.py. From {lifts} lifts of {objects} built-in
# objects, {samples} of them samples, by pipelines/fit_lift_chance.py.
"""


@dataclass(frozen=True, kw_only=True)
class Lifts:
    """The lifts of a dataset.

    Attributes:
        features: (n, m), features of the hands when closing ended, in the order of `FEATURES`.
        sample: (n,), whether the filters of the hold keep the lift.
        first: (n,), whether the attempt is of the first round.
        object: (n,), number of the object.
    """

    features: Array
    sample: npt.NDArray[np.bool_]
    first: npt.NDArray[np.bool_]
    object: npt.NDArray[np.int64]

    def part(self, rows: npt.NDArray[np.bool_]) -> Lifts:
        """Return some of the lifts."""
        return Lifts(**{name: values[rows] for name, values in vars(self).items()})


def read_lifts(out: Path) -> Lifts:
    """Return the lifts of a dataset.

    Raises:
        DataError: If the build selected which hands to lift: the lifts that it skipped are missing.
    """
    manifest = read_manifest(out)
    rules = manifest.config.lift
    for name in ("least_chance", "least_depth_variance"):
        if (got := getattr(rules, name)) > 0.0:
            raise DataError(f"{out}: must be built with lift.{name}=0, got {got:g}")
    names = (*(f"closed_{name}" for name in GRASP_CONTACTS), "X_TO", "friction_hand")
    judged = ("outcome", "lifted_other_links", "slip", "turn", "generation", "object")
    with h5py.File(out / TRIALS_FILE) as file:
        trials, objects = file["trials"], file["objects/name"].asstr()[()].tolist()
        rows = np.flatnonzero(np.isfinite(trials["slip"][()]))
        columns = {name: trials[name][()][rows] for name in (*names, *judged)}

    values = np.zeros((len(rows), len(FEATURES)))
    for index, name in enumerate(objects):
        own = columns["object"] == index
        if not own.any():
            continue
        grasp = ClosedGrasp(
            **{each: columns[f"closed_{each}"][own] for each in GRASP_CONTACTS},
            X_TO=unpack_pose(columns["X_TO"][own]),
            p_OOcm=load_prepared(out, name, manifest.config_of(name)).model.p_OOcm,
            friction_hand=columns["friction_hand"][own],
        )
        values[own] = np.stack(list(features(grasp).values()), axis=-1)

    hold = Table(
        other_links=columns["lifted_other_links"], slip=columns["slip"], turn=columns["turn"]
    )
    sample = columns["outcome"] == Outcome.SUCCESS
    sample &= first_removal(hold, FilterConfig()) == Removal.KEPT
    return Lifts(
        features=values,
        sample=sample,
        first=columns["generation"] == 0,
        object=columns["object"].astype(np.int64),
    )


def fit(lifts: Lifts) -> LiftChance:
    """Return the logistic model of lifts, with each number rounded to four digits."""
    centre, scale = lifts.features.mean(axis=0), lifts.features.std(axis=0)
    x = np.column_stack([np.ones(len(lifts.sample)), (lifts.features - centre) / scale])

    def loss(b: Array) -> tuple[float, Array]:
        score, ridge = x @ b, RIDGE * np.append(0.0, b[1:])
        value = np.logaddexp(0.0, score) - lifts.sample * score
        slope = x.T @ (1.0 / (1.0 + np.exp(-score)) - lifts.sample)
        return float(value.sum() + 0.5 * ridge @ b), slope + ridge

    b = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B").x
    numbers = [b[0] - float(b[1:] @ (centre / scale)), *(b[1:] / scale)]
    bias, *weights = (float(f"{number:.4g}") for number in numbers)
    return LiftChance(bias, dict(zip(FEATURES, weights, strict=True)))


def auc(score: Array, sample: npt.NDArray[np.bool_]) -> float:
    """Return the fraction of pairs of a sample and another lift that the score orders correctly."""
    held = int(sample.sum())
    ranks = rankdata(score)[sample].sum() - held * (held + 1) / 2
    return round(float(ranks / (held * (len(sample) - held))), 3)


def chances(lifts: Lifts, model: LiftChance) -> Array:
    """Return the chances (n,) of lifts."""
    values = dict(zip(FEATURES, lifts.features.T, strict=True))
    score = model.bias + sum(weight * values[name] for name, weight in model.weights.items())
    return np.asarray(1.0 / (1.0 + np.exp(-score)))


def held_out(lifts: Lifts) -> Array:
    """Return the chances (n,) of lifts, each from a model that was fitted to other objects."""
    found = np.zeros(len(lifts.sample))
    for fold in range(FOLDS):
        own = lifts.object % FOLDS == fold
        found[own] = chances(lifts.part(own), fit(lifts.part(~own)))
    return found


def describe(lifts: Lifts, chance: Array) -> dict[str, Any]:
    """Return how well chances (n,) order all lifts, and the lifts of the first round."""
    told: dict[str, Any] = {"objects": len(np.unique(lifts.object))}
    normal_sum = lifts.features[:, FEATURES.index("normal_sum")]
    for name, rows in (("all", lifts.first | True), ("first round", lifts.first)):
        sample, own = lifts.sample[rows], chance[rows]
        told[name] = {
            "lifts": len(sample),
            "samples": int(sample.sum()),
            "AUC": auc(own, sample),
            "AUC of -normal_sum": auc(-normal_sum[rows], sample),
            "samples in the better half": round(float((own[sample] >= np.median(own)).mean()), 3),
            "samples and lifts below": {
                str(least): [round(float((part < least).mean()), 3) for part in (own[sample], own)]
                for least in THRESHOLDS
            },
        }
    return told


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("train", type=Path, help="directory of a dataset")
    parser.add_argument("--test", type=Path, help="directory of another dataset")
    parser.add_argument("--write", type=Path, help="file to which the fitted weights are written")
    arguments = parser.parse_args(argv)

    train = read_lifts(arguments.train)
    if arguments.write is None:
        model = read_lift_chance(read_manifest(arguments.train).config.hand_source)
        if model is None:
            parser.error("the hand must have weights, or --write must be given")
    else:
        model = fit(train)
        text = HEAD.format(
            lifts=len(train.sample),
            objects=len(np.unique(train.object)),
            samples=int(train.sample.sum()),
        )
        text += f"bias: {model.bias}\nweights:\n"
        text += "".join(f"  {name}: {weight}\n" for name, weight in model.weights.items())
        arguments.write.write_text(text, encoding="utf-8")

    result = {"train": describe(train, held_out(train))}
    if arguments.test is not None:
        test = read_lifts(arguments.test)
        result["test"] = describe(test, chances(test, model))
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
