"""A judge: the chances that a grasp holds, learned from lifts of proposals for other objects.

Input: what `ranking` measures while the hand closes on a cloud. Output: two calibrated chances of
each proposal, that the hand holds the object and that the grasp would be a sample of a dataset. A
judge is a logistic regression in one NumPy file, and belongs to one hand.
`pipelines/baseline/train_judge.py` makes such a file.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import Array, dot, multiply, norm
from drakegrasp.errors import GraspError, HandError, listed, one_line
from drakegrasp.foreign_files import is_name, parse_json, read_npz
from drakegrasp.hand.description import Hand
from drakegrasp.hand.finger_sweep import closing_path, pad_points_at
from drakegrasp.mesh.cloud import smallest_rectangle

#: The answers of a judge: the hand holds the object; and it is a sample, by the usual filters.
HEADS = ("held", "sample")
#: Columns of a closing that have a value for each finger; a judge uses the smallest, the mean and
#: the largest.
BY_FINGER = ("gaps", "pushes", "closed", "heights", "touch")
#: The other columns of a closing.
OF_HAND = (
    *("clearance", "table", "gap", "push", "opposition", "arm", "robust", "free", "above", "width"),
    "score",
)
#: Steps of closing at which the fingerprint of a hand has its pad points, and its decimals.
STEPS, DECIMALS = 5, 6
#: Standardised features are cut to this.
FARTHEST = 4.0
#: Maximum size of the arrays of a file [bytes], a thousand times that of the package's judge.
MOST_BYTES = 16_000_000
#: Names of the arrays of a file.
ARRAYS = ("mean", "scale", "weights", "offset")


@dataclass(frozen=True, kw_only=True, eq=False)
class Judge:
    """A logistic regression with f features for each of `HEADS`, read by `load_judge`.

    Attributes:
        name: Name of the judge.
        about: What the file states: hand, features, command, hash of the data, versions, scores.
        mean: (f,), mean of each feature.
        scale: (f,), standard deviation of each feature.
        weights: (f, 2), of the standardised features.
        offset: (2,), added to the weighted sums.
    """

    name: str
    about: dict[str, Any]
    mean: Array
    scale: Array
    weights: Array
    offset: Array

    def chances(self, features: Mapping[str, Array]) -> Array:
        """Return the chances (n, 2) of `HEADS` for features (n,) by their names.

        Raises:
            GraspError: If the judge uses a feature that is not among them.
        """
        if unknown := [name for name in self.about["features"] if name not in features]:
            raise GraspError(
                f"judge {self.name} must use features of this version, got {listed(unknown)}"
            )
        values = np.column_stack([features[name] for name in self.about["features"]])
        logits = self.logits(values)
        return np.asarray(1.0 / (1.0 + np.exp(-logits)))

    def logits(self, values: Array) -> Array:
        """Return the logits (n, 2) of the chances for features (n, f) in the judge's order."""
        x = np.clip((values - self.mean) / self.scale, -FARTHEST, FARTHEST)
        return multiply(x, self.weights) + self.offset

    def refuse_other_hand(self, hand: Hand) -> None:
        """Reject a hand for which the judge was not trained.

        Raises:
            HandError: If it is another hand.
        """
        if self.about["fingerprint"] != fingerprint(hand):
            raise HandError(
                f"hand must be {self.about['hand']} for the judge {self.name}, as it was trained, "
                f"got {'a changed ' if hand.name == self.about['hand'] else ''}{hand.name}"
            )


def judge_names() -> list[str]:
    """Return the names of the judges of the package."""
    files = resources.files("drakegrasp.scoring").iterdir()
    return sorted(f.name.removesuffix(".npz") for f in files if f.name.endswith(".npz"))


def load_judge(source: str | Path | Judge) -> Judge:
    """Return a judge of the package by its name, or the judge of a file.

    Raises:
        GraspError: If there is no such judge, or the file is not a judge.
    """
    if isinstance(source, Judge):
        return source
    if not isinstance(source, str | Path):
        raise GraspError(f"judge must be a name or a file, got {type(source).__name__}")
    path = Path(source)
    if str(source) in judge_names():
        path = Path(str(resources.files("drakegrasp.scoring").joinpath(f"{source}.npz")))
    elif not path.is_file():
        raise GraspError(
            f"judge must be one of {', '.join(judge_names())}, or a file, got {str(source)!r}"
        )

    # Read the file, and look for faults.
    try:
        file = read_npz(path, MOST_BYTES)
        about = parse_json(str(file["about"]))
        arrays = {name: file[name].astype(float, casting="same_kind") for name in ARRAYS}
        fault = _fault(about, arrays)
    except Exception as error:  # a damaged file raises all kinds
        fault = one_line(error)
    if fault:
        raise GraspError(f"{path}: must be the file of a judge (.npz), got another: {fault}")
    return Judge(name=about["name"], about=about, **arrays)


def _fault(about: Any, arrays: Mapping[str, Array]) -> str:
    """Return what is wrong with the content of a file; empty if nothing is."""
    for key in ("name", "hand", "fingerprint"):
        if not (isinstance(value := about.get(key), str) and is_name(value)):
            return f"its {key} is {repr(value)[:40]}"
    features = about.get("features")
    if not (isinstance(features, list) and all(isinstance(name, str) for name in features)):
        return "its features must be a list of names"
    count, heads = len(features), len(HEADS)
    shapes = {"mean": (count,), "scale": (count,), "weights": (count, heads), "offset": (heads,)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape or not np.isfinite(arrays[name]).all():
            return f"its {name} must be finite numbers of shape {shape}"
    return "" if (arrays["scale"] > 0.0).all() else "its scale must be positive"


def features_of(
    found: Mapping[str, Array], points: Array, X_TG: Array, spread: float
) -> dict[str, Array]:
    """Return the features (n,) from which a judge takes its own, by their names.

    Args:
        found: Columns (s, n, m, ...) of n closings on s solids, with m moves of each; the first is
            no move.
        points: (p, 3), the cloud in {T} [m].
        X_TG: (n, 4, 4), the palm poses.
        spread: Spread [rad].
    """
    top = float(points[:, 2].max())
    columns: dict[str, Array] = {}
    for name in OF_HAND:
        columns[name] = np.asarray(found[name], dtype=float)
    for name in BY_FINGER:
        values = np.asarray(found[name], dtype=float)
        columns[f"{name}, least"], columns[f"{name}, most"] = values.min(-1), values.max(-1)
        columns[f"{name}, mean"] = values.mean(-1)
    features: dict[str, Array] = {}
    for name, values in columns.items():
        features[name] = values.mean(axis=(0, 2))
        features[f"{name}, lowest"] = values.min(axis=(0, 2))
        features[f"{name}, highest"] = values.max(axis=(0, 2))
        features[f"{name}, hull"] = values[0].mean(axis=1) - features[name]

    # The palm, relative to what is seen.
    count = len(X_TG)
    axes, middle, half = smallest_rectangle(points)
    R, p = X_TG[:, :3, :3], X_TG[:, :3, 3]
    centre = np.array([*middle, top / 2.0])
    seen = np.einsum("npa,nab->npb", points[None] - p[:, None], R)
    aside = dot((centre - p)[:, None], R)
    along = np.abs(np.einsum("na,ka->nk", R[:, :2, 1], axes))
    features |= {
        "down": -R[:, 2, 2],
        "closes upwards": np.abs(R[:, 2, 1]),
        "closes along": along[:, 0],
        "closes across": along[:, 1],
        "palm height": p[:, 2],
        "palm over top": p[:, 2] - top,
        "distance": norm(centre - p),
        "aside x": np.abs(aside[:, 0]),
        "aside y": np.abs(aside[:, 1]),
        "ahead": aside[:, 2],
        "front": seen[:, :, 2].min(axis=1),
        **{f"extent {k}": np.ptp(seen[:, :, k], axis=1) for k in range(3)},
        "spread": np.full(count, spread),
        "top": np.full(count, top),
        "long": np.full(count, half[0]),
        "short": np.full(count, half[1]),
    }
    return features


def fingerprint(hand: Hand) -> str:
    """Return a hash (16 hex digits) of a hand's fingers and preshapes.

    It includes everything that the hand file says of the fingers, and how the pads move while the
    hand closes.
    """
    paths = [pad_points_at(hand, closing) for closing in closing_path(hand, STEPS)]
    rounded = np.round(np.array(paths), DECIMALS) + 0.0
    described = [*map(asdict, hand.fingers), hand.spread.joints, hand.preshape_names]
    text = json.dumps(described, sort_keys=True, default=vars).encode()
    return hashlib.sha256(text + rounded.tobytes()).hexdigest()[:16]
