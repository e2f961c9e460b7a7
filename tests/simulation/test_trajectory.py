"""The straight path of an object: from rest to rest, within the limits of a lift."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.frames import X_WT, make_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.simulation.lift import LiftPath, lift_path

START, END = np.array([0.1, -0.05, 0.04]), np.array([0.0, 0.0, 0.6])


def path_by(overrides: list[str]) -> LiftPath:
    return lift_path(make_pose(np.eye(3), START), load_config(overrides=overrides))


def test_path_goes_from_rest_to_rest_at_the_target() -> None:
    path = path_by([])
    for time, place in ((0.0, START), (path.duration, END), (path.duration + 1.0, END)):
        p, v, a = path.at(time)
        np.testing.assert_allclose(p - X_WT[:3, 3], place, atol=1e-12)
        np.testing.assert_allclose([v, a], 0.0, atol=1e-12)


def test_velocity_and_acceleration_are_the_paths_derivatives() -> None:
    path, step = path_by([]), 1e-5
    for time in np.linspace(0.1, 0.9, 7) * path.duration:
        before, now, after = (path.at(time + shift) for shift in (-step, 0.0, step))
        assert np.allclose((after[0] - before[0]) / (2.0 * step), now[1], atol=1e-7)
        assert np.allclose((after[1] - before[1]) / (2.0 * step), now[2], atol=1e-7)


@pytest.mark.parametrize("overrides", [[], ["lift.max_speed=5.0"]])
def test_path_keeps_both_limits_and_meets_one(overrides: list[str]) -> None:
    path, lift = path_by(overrides), load_config(overrides=overrides).lift
    states = [path.at(time) for time in np.linspace(0.0, path.duration, 2001)]
    speed = max(np.linalg.norm(v) for _, v, _ in states) / lift.max_speed
    acceleration = max(np.linalg.norm(a) for _, _, a in states) / lift.max_acceleration
    assert max(speed, acceleration) == pytest.approx(1.0, rel=1e-5)
