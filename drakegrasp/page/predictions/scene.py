"""What the 3D view of a prediction shows: the hand as it was tried, and the dataset's own grasp.

In: a verdict and the row that it is for. Out: plain lists for JSON, as `scene3d` gives them for
attempts, with asked, reached and true contacts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.page.predictions.results import Predictions
from drakegrasp.page.scene3d import HandView, contacts_in_table, make_scene

NO_CONTACTS: list[dict[str, Any]] = []


def prediction_scene(
    predictions: Predictions,
    i: int,
    verdict: Mapping[str, Any],
    row: Mapping[str, Any],
    hand: HandView,
) -> dict[str, Any]:
    """Return the 3D view of a prediction as JSON types.

    Args:
        predictions: All of them.
        i: Number of the prediction.
        verdict: All that its file says.
        row: All columns of its row's trial.
        hand: Of the dataset.
    """
    # Everything is on the object in the resting pose of the row.
    X_TO = unpack_pose(row["X_TO"])
    asked = {"p_OQ": verdict["p_OQ"], "nhat_Q_O": verdict["nhat_Q_O"]}
    marks = [
        *_marks("true", row, "closed", X_TO),
        *_marks("asked", asked, "", X_TO),
        *_marks("reached", verdict, "closed", X_TO),
    ]

    # The hand as far as the trial got, and that of the dataset.
    states = {}
    for name, q, palm in (("closed", "closed_q", "X_OG"), ("lifted", "lifted_q", "X_OG_lifted")):
        links = _hand(hand, X_TO, verdict.get(palm), verdict.get(q))
        if links is not None:
            forces = _marks("force", verdict, name, X_TO, forces=True)
            states[name] = {"links": links, "contacts": [*marks, *forces]}
    own = _hand(hand, X_TO, row["X_OG"], row["closed_q"]) or []
    forces = _marks("force", row, "closed", X_TO, forces=True)
    states["dataset's grasp"] = {"links": own, "contacts": [*marks, *forces]}
    number = int(predictions.objects[i])
    return make_scene(predictions.snapshot, number, X_TO, states, hand)


def _hand(
    hand: HandView, X_TO: Array, X_OG: Array | None, q: Array | None
) -> list[list[float]] | None:
    """Return the poses of the links; None if the trial did not get so far."""
    if X_OG is None or q is None or not (np.isfinite(X_OG).all() and np.isfinite(q).all()):
        return None
    return hand.poses(multiply(X_TO, unpack_pose(X_OG)), q, 0.0)


def _marks(
    kind: str, source: Mapping[str, Any], when: str, X_TO: Array, *, forces: bool = False
) -> list[dict[str, Any]]:
    """Return the contacts of a kind, with their forces or without."""
    prefix = f"{when}_" if when else ""
    values = [source.get(f"{prefix}{name}") for name in ("p_OQ", "nhat_Q_O", "f_Q_O")]
    points, normals, pushes = values
    if points is None or normals is None or (forces and pushes is None):
        return NO_CONTACTS
    pushed = np.zeros_like(points) if pushes is None or not forces else pushes
    return [{"kind": kind, **c} for c in contacts_in_table(points, normals, pushed, X_TO)]
