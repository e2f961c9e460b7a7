"""A trial at its three stages as scenes to render: start, closed, lifted. Nothing is simulated.

In: a dataset's directory and the number of a trial. Out: poses of hand and object from trials.hdf5,
and a scene of Drake's renderer.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.frames import X_WT, Array, rotate_vectors, transform_points, unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.pictures.still_scene import TABLE_SIZE, Poses, StillScene
from drakegrasp.pictures.style import ARROW
from drakegrasp.vision.camera import unproject


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialStages:
    """A trial at its three stages, and the scene to render them in.

    Attributes:
        scene: Of the trial's object and hand.
        place, close, lift: At the start, after closing, after the lift.
        model: The object.
        config: Of the dataset.
        row: Fields of `/trials` by name.
    """

    scene: StillScene
    place: Poses
    close: Poses
    lift: Poses
    model: ObjectModel
    config: Config
    row: Mapping[str, Any]

    def normals(self, when: Literal["closed", "lifted"]) -> dict[str, tuple[Array, Array]]:
        """Return tail and tip (3,) in {W} [m] of the normal at each contact, by Q and finger."""
        X_WO = self.close.X_WO if when == "closed" else self.lift.X_WO
        p_WQ = transform_points(X_WO, self.row[f"{when}_p_OQ"])
        tips = p_WQ + ARROW * rotate_vectors(X_WO, self.row[f"{when}_nhat_Q_O"])
        touching = self.row[f"{when}_touching"]
        return {f"Q{k + 1}": (p_WQ[k], tips[k]) for k in np.flatnonzero(touching)}


def load_trial(out: Path, trial_id: int, *, table_size: float = TABLE_SIZE) -> TrialStages:
    """Return a trial that was lifted, ready to be rendered.

    Args:
        out: Directory of the dataset.
        trial_id: Row of trials.hdf5.
        table_size: Edge of the table [m].

    Raises:
        DataError: If the trial does not exist, or ended before the lift.
    """
    # Read the trial.
    row = Trials(out).trial(trial_id)
    name = row["object_name"]
    config = read_manifest(out).config_of(name)
    outcome = Outcome(int(row["outcome"]))
    if outcome.stage is not Stage.LIFTED:
        raise DataError(f"{out}: trial {trial_id} must have been lifted, got {outcome.label}")

    # Poses of palm and object at the start, and after the lift.
    X_WO = X_WT @ unpack_pose(row["X_TO"])
    X_WG = X_WO @ unpack_pose(row["X_OG"])
    X_WO_lifted = X_WT @ unpack_pose(row["X_TO_lifted"])
    X_WG_lifted = X_WO_lifted @ unpack_pose(row["X_OG_lifted"])

    model = load_prepared(out, name, config).model
    scene = StillScene(load_hand(config.hand_source), model, table_size=table_size)
    return TrialStages(
        scene=scene,
        place=Poses(X_WG=X_WG, q=scene.positions(float(row["spread"])), X_WO=X_WO),
        close=Poses(X_WG=X_WG, q=row["closed_q"], X_WO=X_WO),
        lift=Poses(X_WG=X_WG_lifted, q=row["lifted_q"], X_WO=X_WO_lifted),
        model=model,
        config=config,
        row=row,
    )


def frustum(X_WC: Array, K: Array, size: int, depth: float) -> list[Array]:
    """Return polylines (n, 3) in {W} around a camera's field of view, up to a depth [m]."""
    edge = size - 0.5
    pixels = np.array([[-0.5, -0.5], [edge, -0.5], [edge, edge], [-0.5, edge]])
    corners = transform_points(X_WC, unproject(K, pixels, np.full(4, depth)))
    rays = [np.vstack([X_WC[:3, 3], corner]) for corner in corners]
    return [np.vstack([corners, corners[:1]]), *rays]
