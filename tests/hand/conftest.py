"""Checks of hands simulate no grasps, but in tests that are marked."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def no_simulation(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """Files and geometry decide."""
    if "sim" not in request.keywords:
        monkeypatch.setattr("drakegrasp.hand_setup.GRASPS", ())
