"""The sampler `above`: palms that look down on an object, along its axes."""

import numpy as np
import pytest
from helpers.objects import box_model

from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.settings import load_config
from drakegrasp.simulation.above import ACROSS, ALONG, TILT, YAW
from drakegrasp.simulation.candidates import sample_candidates

#: A bar that lies at 30 degrees to the table's axes, seven times as long as wide.
SIZE, TURN = np.array([0.14, 0.02, 0.03]), np.deg2rad(30.0)


@pytest.fixture
def drawn(tmp_path):
    """Return 600 palms over the bar, in {T}, and the middle of the bar there."""
    bar = box_model(tmp_path, SIZE)
    X_TO = make_pose(rotation_about(np.array([0.0, 0.0, 1.0]), TURN), [0.2, -0.1, SIZE[2] / 2])
    config = load_config().candidates.model_copy(update={"method": "above", "max": 600})
    candidates = sample_candidates(bar, X_TO, config, 0)
    assert len(candidates) == 600
    return X_TO @ candidates.X_OG, X_TO[:3, 3], candidates


def test_palms_look_down_at_the_bar_from_beyond_it(drawn) -> None:
    X_TG, middle, candidates = drawn
    z = X_TG[:, :3, 2]
    tilt = np.rad2deg(np.arccos(-z[:, 2]))
    assert TILT[0] - 1e-9 <= tilt.min() < 12.0 and 34.0 < tilt.max() <= TILT[1] + 1e-9
    # Uniform over the zone: half of it lies above its middle height.
    middle_height = np.cos(np.deg2rad(TILT)).mean()
    assert np.mean(-z[:, 2] > middle_height) == pytest.approx(0.5, abs=0.08)
    assert (np.linalg.norm(X_TG[:, :3, 3] - middle, axis=1) > np.linalg.norm(SIZE) / 2).all()
    assert np.isfinite(candidates.distance).all()
    np.testing.assert_allclose(np.linalg.det(X_TG[:, :3, :3]), 1.0, atol=1e-12)


def test_palms_aim_along_the_major_axis_and_turn_by_quarters(drawn) -> None:
    X_TG, middle, _ = drawn
    p, z = X_TG[:, :3, 3], X_TG[:, :3, 2]
    at = p - (p[:, 2:] - middle[2]) / z[:, 2:] * z - middle
    along, across = np.array([np.cos(TURN), np.sin(TURN)]), np.array([-np.sin(TURN), np.cos(TURN)])
    for direction, share, size in ((along, ALONG, SIZE[0]), (across, ACROSS, SIZE[1])):
        reach = np.abs(at[:, :2] @ direction).max()
        assert reach == pytest.approx(share * size / 2, rel=0.05)

    # Gx, seen from above, is within YAW of one of four directions, and a tilt adds little.
    x = X_TG[:, :2, 0]
    angle = np.rad2deg(np.arctan2(x @ across, x @ along))
    quarter = np.round(angle / 90.0)
    assert np.abs(angle - 90.0 * quarter).max() < YAW + 12.0
    assert (np.bincount(quarter.astype(int) % 4, minlength=4) > 100).all()
