"""Recordings of verifications: a trial, or an object that no hand was tried on.

In: a `Verification`. Out: an HTML file, see `pictures.recording`.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydrake.geometry import Meshcat

from drakegrasp.pictures.recording import (
    draw_predicted,
    record_attempt,
    record_html,
    show_object,
)
from drakegrasp.simulation.construction import build_object_scene

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification


def record_verification(verified: Verification, path: Path) -> None:
    """Write a recording of a verification, which is simulated again for it, with its explanation.

    The trial is that of the first wrist pose. A row that is no grasp shows the object at rest.

    Args:
        verified: The verdict.
        path: The HTML file.

    Raises:
        OSError: If the file cannot be written.
    """
    if verified.pregrasp is None:
        _record_object(verified, path)
    else:
        record_attempt(
            verified.placed.model,
            verified.placed.X_TO_simulated,
            verified.pregrasp,
            verified.config,
            path,
            p_OQ=verified.p_OQ,
            nhat_Q_O=verified.nhat_Q_O,
            caption=verified.explain(),
        )


def _record_object(verified: Verification, path: Path) -> None:
    """Write a recording of the object at rest, with the contacts that forces were judged at."""
    placed, config = verified.placed, verified.config

    def run(meshcat: Meshcat) -> None:
        scene = build_object_scene(placed.model, config.physics, meshcat=meshcat)
        show_object(meshcat, scene, placed.X_TO_simulated, config)
        if verified.forces is not None:
            draw_predicted(meshcat, verified.p_OQ, verified.nhat_Q_O)

    record_html(run, path, verified.explain())
