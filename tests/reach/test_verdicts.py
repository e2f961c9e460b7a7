"""What an arm can do about grasps that a network predicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.arms import write_arm

import drakegrasp as dg

GRASP = [-0.025, 0.03, -0.009, 0.025, 0.03, -0.009, 0, -0.03, -0.009, 0, 1, 0, 0, 1, 0, 0, -1, 0]


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_arm(tmp_path_factory.mktemp("arm"))


@pytest.mark.sim
def test_a_verdict_tells_whether_the_arm_reaches_the_grasp(six: Path) -> None:
    box = trimesh.creation.box([0.06, 0.06, 0.06])
    near, far = (dg.load_arm(six, (x, 0.0, 0.0, 0.0)) for x in (-0.5, -2.0))
    verdict = dg.verify_grasp(GRASP, box, arm=near)
    assert verdict.reach is not None
    assert verdict.reach.reachable
    assert "The arm reaches it, with a clearance of " in verdict.explain()
    other = verdict.reached_by(far)
    assert other.reach is not None
    assert other.reach.outcome == "out_of_reach"
    assert "The arm does not reach it: the palm pose is out of its reach." in other.explain()

    # Where the object is moved to, the arm must reach.
    X_TO = verdict.placed.X_TO.copy()
    X_TO[0, 3] = -1.5
    moved = dg.verify_grasp(GRASP, dg.place_object(box, X_TO=X_TO), arm=far)
    assert moved.reach is not None
    assert moved.reach.reachable
    assert moved.held == verdict.held
    assert dg.verify_grasp(np.full(18, np.nan), box, arm=near).reach is None
