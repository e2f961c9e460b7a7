"""Weights of samples that are alike, and how many count in effect."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.dataset.assembly.split import BLOCK, effective_number, weigh_samples
from drakegrasp.frames import make_pose, rotation_about


def pose(shift: float = 0.0, turn_deg: float = 0.0) -> np.ndarray:
    return make_pose(rotation_about([0.0, 0.0, 1.0], np.deg2rad(turn_deg)), [shift, 0.0, 0.1])


@pytest.mark.parametrize(
    ("other", "weight"),
    [
        (pose(), 0.5),
        (pose(shift=0.0099), 0.5),
        (pose(shift=0.0101), 1.0),
        (pose(turn_deg=14.9), 0.5),
        (pose(turn_deg=15.1), 1.0),
        (pose(shift=0.0099, turn_deg=15.1), 1.0),
    ],
)
def test_palms_that_are_near_share_their_weight(other: np.ndarray, weight: float) -> None:
    weights = weigh_samples([[0, 0], [0, 0]], np.array([pose(), other]))
    np.testing.assert_array_equal(weights, [weight, weight])


@pytest.mark.parametrize("other", [[1, 0], [0, 1]])
def test_other_object_or_resting_pose_is_not_alike(other: list[int]) -> None:
    weights = weigh_samples([[0, 0], other], np.array([pose(), pose()]))
    np.testing.assert_array_equal(weights, [1.0, 1.0])


def test_many_samples_are_weighed_in_parts() -> None:
    count = 2 * BLOCK + 3
    weights = weigh_samples([[0, 0]] * count, np.array([pose()] * count))
    np.testing.assert_allclose(weights, 1.0 / count)
    assert effective_number(weights) == pytest.approx(count)


def test_copies_count_once_in_sum_and_less_in_effect() -> None:
    # Three that are alike, and one alone: (1 + 1)^2 / (3 / 9 + 1) = 3.
    weights = weigh_samples([[0, 0]] * 4, np.array([pose()] * 3 + [pose(shift=1.0)]))
    assert weights.sum() == pytest.approx(2.0)
    assert effective_number(weights) == pytest.approx(3.0)


def test_no_sample_has_no_weight() -> None:
    assert weigh_samples(np.zeros((0, 2)), np.zeros((0, 4, 4))).shape == (0,)
    assert effective_number([]) == 0.0
