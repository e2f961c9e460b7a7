"""Anomaly is of its own columns."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from drakegrasp.dataset.quality import CAP, COLUMNS, PARTS, anomaly
from drakegrasp.frames import GRAVITY, make_pose, pack_pose, rotation_about
from drakegrasp.outcomes import Outcome

#: Three unit normals that add up to nothing.
BALANCED = np.array([[1.0, 0.0, 0.0], [-0.5, np.sqrt(0.75), 0.0], [-0.5, -np.sqrt(0.75), 0.0]])
SCALES = {part.name: part.scale for part in PARTS}


def firm(count: int = 2, mass: float = 1.0) -> dict[str, npt.NDArray[Any]]:
    """Columns of grasps of which no part is anomalous; the lifted object is turned."""
    R_TO = rotation_about([0.0, 0.0, 1.0], 0.3) @ rotation_about([1.0, 0.0, 0.0], 2.0)
    pull_T = np.array([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0], [0.0, 0.0, mass * GRAVITY]])
    rows: dict[str, Any] = {
        "outcome": np.uint8(Outcome.SUCCESS),
        "unused": np.uint32(0),
        "closed_touching": np.ones(3, dtype=bool),
        "closed_penetration": np.zeros(3),
        "lifted_penetration": np.zeros(3),
        "normal_angle": np.zeros(3),
        "surface_distance": np.zeros(3),
        "slip": 0.0,
        "turn": 0.0,
        "lifted_other_links": np.uint8(0),
        "lifted_f_Q_O": pull_T @ R_TO,
        "X_TO_lifted": pack_pose(make_pose(R_TO, [0.0, 0.1, 0.5])),
        "closed_nhat_Q_O": BALANCED,
        "time_close": 0.8,
        "time_lift": 2.0,
        "mass": mass,
    }
    return {name: np.array([value] * count) for name, value in rows.items()}


def test_scales_are_those_of_the_docs() -> None:
    """See docs/reference/outcomes.md."""
    assert {name: round(scale, 9) for name, scale in SCALES.items()} == {
        "penetration": 4e-3,
        "normal_angle": round(np.pi / 6.0, 9),
        "surface_distance": 2e-3,
        "slip": 0.01,
        "turn": round(np.pi / 18.0, 9),
        "other_links": 1.0,
        "imbalance": 0.05,
        "normal_sum": 0.54,
    }


def test_a_firm_grasp_is_not_anomalous() -> None:
    found = anomaly(firm())
    assert set(COLUMNS) == set(firm())
    np.testing.assert_allclose(found.score, 0.0, atol=1e-12)
    assert list(found.values) == list(found.shares) or set(found.values) == set(found.shares)


@pytest.mark.parametrize(
    ("part", "column", "value"),
    [
        ("penetration", "closed_penetration", [0.0, 2e-3, 0.0]),
        ("penetration", "lifted_penetration", [0.0, 0.0, 2e-3]),
        ("normal_angle", "normal_angle", [0.0, 0.25, 0.1]),
        ("surface_distance", "surface_distance", [1e-3, 0.0, 0.0]),
        ("slip", "slip", 4e-3),
        ("turn", "turn", 0.1),
        ("other_links", "lifted_other_links", 1),
        ("normal_sum", "closed_nhat_Q_O", np.array([[0.0, 0.0, 1.0], [1, 0, 0], [-1, 0, 0]])),
    ],
)
def test_each_part_is_of_its_own_column(part: str, column: str, value: Any) -> None:
    columns = firm()
    columns[column][1] = value
    found = anomaly(columns)
    expected = 1.0 / 3.0 if part == "normal_sum" else np.max(value)
    assert found.values[part][1] == pytest.approx(expected)
    assert found.score[1] == pytest.approx(expected / SCALES[part])
    assert found.score[0] == pytest.approx(0.0, abs=1e-12)
    for name in set(SCALES) - {part}:
        assert found.shares[name][1] == pytest.approx(0.0, abs=1e-12)


def test_forces_must_carry_the_weight_upwards() -> None:
    """Without forces the whole weight is unexplained; sideways 1 N of 2 kg is 1/19.62 of it."""
    columns = firm(3, mass=2.0)
    columns["lifted_f_Q_O"][1] = 0.0
    R_TO = columns["X_TO_lifted"][2].reshape(3, 4)[:, :3]
    columns["lifted_f_Q_O"][2, 0] += R_TO.T @ [0.0, 1.0, 0.0]
    found = anomaly(columns).values["imbalance"]
    np.testing.assert_allclose(found, [0.0, 1.0, 1.0 / 19.62], atol=1e-12)


def test_parts_add_up_in_squares_and_are_capped() -> None:
    columns = firm(2)
    columns["slip"][:] = [0.010, 1.0]
    columns["lifted_other_links"][:] = [2, 0]
    np.testing.assert_allclose(anomaly(columns).score, [np.sqrt(5.0), CAP])


def test_an_attempt_is_judged_by_the_stages_that_it_reached() -> None:
    columns = firm(3)
    columns["outcome"][:] = [Outcome.RAY_MISS, Outcome.MISSING_FINGERTIP, Outcome.SUCCESS]
    columns["time_close"][0] = columns["time_lift"][0] = columns["time_lift"][1] = np.nan
    columns["closed_penetration"][:] = 1e-3
    columns["closed_nhat_Q_O"][1, 2] = np.nan  # the finger that does not touch
    found = anomaly(columns)
    assert np.isnan(found.score).tolist() == [True, False, False]
    assert np.isnan(found.values["slip"]).tolist() == [True, True, False]
    assert found.values["penetration"][1] == 1e-3
    assert found.values["normal_sum"][1] == pytest.approx(1.0 / 3.0)


def test_a_success_without_a_normal_is_most_anomalous_by_it() -> None:
    columns = firm(2)
    columns["closed_nhat_Q_O"][1, 0] = np.nan
    columns["normal_angle"][1, 0] = np.nan
    found = anomaly(columns)
    assert found.shares["normal_sum"][1] == found.shares["normal_angle"][1] == CAP
    assert found.score[1] == pytest.approx(np.sqrt(2.0) * CAP)


def test_a_fingertip_that_does_not_touch_counts_unless_the_preshape_leaves_it_out() -> None:
    """It has no contact to doubt. The other two oppose each other, and then push the same way."""
    columns, x = firm(3), [1.0, 0.0, 0.0]
    columns["closed_touching"][:, 2] = False
    for name in ("normal_angle", "surface_distance"):
        columns[name][:, 2] = np.nan
    columns["closed_nhat_Q_O"][:] = [x, x, [np.nan] * 3]
    columns["closed_nhat_Q_O"][0, 1] *= -1.0
    columns["unused"][2] = 0b100
    found = anomaly(columns)
    np.testing.assert_allclose(found.values["normal_sum"], [0.0, 2.0 / 3.0, 1.0], atol=1e-12)
    assert found.score[0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("fingers", [2, 3, 4])
def test_sum_of_normals_is_per_finger_of_the_hand(fingers: int) -> None:
    """All point the same way: the sum is as long as there are fingers, whatever their number."""
    columns = {
        name: np.repeat(values[:, :1], fingers, axis=1)
        if values.ndim > 1 and values.shape[1] == 3
        else values
        for name, values in firm().items()
    }
    assert anomaly(columns).values["normal_sum"] == pytest.approx(1.0)
