"""Recordings of verifications: a trial, or a grasp that was not simulated.

In: a `Verification`. Out: an HTML file, see `visualization.recording`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydrake.geometry import Meshcat

from drakegrasp.hand.description import load_hand
from drakegrasp.simulation.construction import build_object_scene, build_scene
from drakegrasp.visualization.recording import (
    draw_predicted,
    record_attempt,
    record_html,
    show_object,
    show_start,
)

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification


def record_verification(verified: Verification, path: Path) -> None:
    """Write a recording of a verification, which is simulated again for it.

    A grasp that was not simulated is shown at rest, with the hand at the palm pose that comes
    closest to the contacts, if there is one.

    Args:
        verified: The verdict.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    if verified.pregrasp is None:
        _record_still(verified, path)
    else:
        record_attempt(
            verified.placed.model,
            verified.placed.X_TO_simulated,
            verified.pregrasp,
            verified.config,
            path,
            p_OQ=verified.p_OQ,
            nhat_Q_O=verified.nhat_Q_O,
        )


def _record_still(verified: Verification, path: Path) -> None:
    """Write a recording of the object, the predicted contacts and the hand of a fit, at rest."""
    model, X_TO = verified.placed.model, verified.placed.X_TO_simulated
    config, fit = verified.config, verified.fit

    def run(meshcat: Meshcat) -> None:
        if fit is None:
            alone = build_object_scene(model, config.physics, meshcat=meshcat)
            show_object(meshcat, alone, X_TO, config)
        else:
            scene = build_scene(model, config.physics, load_hand(config.hand), meshcat=meshcat)
            show_start(meshcat, scene, X_TO, config, fit.X_OG, fit.spread, fit.closing)
        draw_predicted(meshcat, verified.p_OQ, verified.nhat_Q_O)

    record_html(run, path)
