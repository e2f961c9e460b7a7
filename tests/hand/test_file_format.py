"""The keys of a hand file beyond those of the Barrett Hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.hands import (
    PINCER_SDF,
    SLIDER,
    changed_finger,
    drake_fingertip_poses,
    write_pincer,
    write_slider,
)
from pydrake.multibody.plant import MultibodyPlant

from drakegrasp.errors import HandError
from drakegrasp.hand.description import SLIDE, load_hand
from drakegrasp.hand.kinematics import (
    closing_levers,
    coordinate_limits,
    fingertip_poses,
    joint_positions,
)
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import link_shapes


def test_a_preshape_fixes_joints_at_their_positions(tmp_path: Path) -> None:
    """The right finger stands still, and its joint is none that a coordinate drives."""
    fingers = changed_finger()[:1]
    hand = load_hand(write_pincer(tmp_path, fingers=fingers, preshape={"right_hinge": 0.3}))
    assert hand.locked_joints == ("right_hinge",)
    assert joint_positions(hand, 0.0, [0.5]) == {"left_hinge": 0.5, "right_hinge": 0.3}
    np.testing.assert_array_equal(coordinate_limits(hand), [[0.0, 0.0], [-0.1, 1.0]])
    chain = hand.link_chains["right"]
    assert not chain.gain.any()
    np.testing.assert_array_equal(chain.offset, [0.3])


def test_a_coupling_may_start_at_another_position(tmp_path: Path) -> None:
    """The right hinge, 0..1, stands at 0.8 - 2 c."""
    coupled = [{"joint": "right_hinge", "ratio": -2.0, "offset": 0.8}]
    hand = load_hand(write_pincer(tmp_path, fingers=changed_finger(coupled=coupled)[:1]))
    assert joint_positions(hand, 0.0, [0.1])["right_hinge"] == pytest.approx(0.6)
    np.testing.assert_allclose(coordinate_limits(hand)[1], [-0.1, 0.4])


def test_fingers_slide(tmp_path: Path) -> None:
    hand = load_hand(write_slider(tmp_path))
    np.testing.assert_allclose(hand.closing_speed, [0.1, 0.1])
    np.testing.assert_allclose(hand.closing_unit, [SLIDE, SLIDE])
    assert hand.fingers[0].effort_unit == "N"
    X_GF = fingertip_poses(hand, spread=0.0, closing=[0.01, 0.03])
    np.testing.assert_allclose(X_GF[:, 1, 3], [-0.03, 0.01], atol=1e-12)
    np.testing.assert_allclose(
        X_GF, drake_fingertip_poses(hand, 0.0, np.array([0.01, 0.03])), atol=1e-12
    )
    np.testing.assert_allclose(closing_levers(hand, [0.01, 0.03]), [1.0, 1.0])


def test_motors_and_couplings_of_the_model_are_left_out(tmp_path: Path) -> None:
    """The model couples its fingers and limits their efforts: the hand file alone decides."""
    hand = load_hand(write_slider(tmp_path))
    plant = MultibodyPlant(0.01)
    add_model(plant, hand.model)
    assert (plant.num_actuators(), plant.num_constraints()) == (0, 0)
    text = PINCER_SDF.replace("</limit>", "<effort>3</effort></limit>")
    plant = MultibodyPlant(0.01)
    add_model(plant, load_hand(write_pincer(tmp_path, text)).model)
    assert plant.num_actuators() == 0


def test_a_mesh_that_is_missing_is_named(tmp_path: Path) -> None:
    urdf = SLIDER.replace('<box size="0.02 0.02 0.09"/>', '<mesh filename="gone.obj"/>', 1)
    hand = load_hand(write_slider(tmp_path, urdf))
    with pytest.raises(HandError, match=r"model: .*gone\.obj"):
        link_shapes(hand.model)
