"""The keys of a hand file beyond those of the Barrett Hand, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.hands import (
    PINCER,
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
from drakegrasp.hand.files import MODELS
from drakegrasp.hand.folder import hand_digest
from drakegrasp.hand.kinematics import coordinate_limits, fingertip_poses, joint_positions
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.hand.strength import closing_levers

LEFT = PINCER["fingers"][0]
SLIDING = {
    **{key: value for key, value in LEFT.items() if key != "torque_limit"},
    "force_limit": 5.0,
}
REFUSALS = {
    "two fingers of one name": (
        {"fingers": changed_finger(name="right")},
        r"fingers must have a name each, got right, right",
    ),
    "another version": ({"version": 2}, r"version: must be 1, .* got 2"),
    "no effort": (
        {"fingers": [{k: v for k, v in LEFT.items() if k != "torque_limit"}]},
        r"fingers\.0: torque_limit must be given if .* turns, else force_limit, got none$",
    ),
    "two efforts": (
        {"fingers": changed_finger(force_limit=1.0)},
        r"fingers\.0: torque_limit must be .* got both",
    ),
    "holding force of a turning joint": (
        {"fingers": changed_finger(holding_force=9.0)},
        r"fingers\.0: holding_force must be holding_torque beside torque_limit",
    ),
    "force of a turning joint": (
        {"fingers": [SLIDING, PINCER["fingers"][1]], "closing_speed": 0.1},
        r"fingers\.0\.torque_limit: must be given, as joint 'left_hinge' turns",
    ),
    "speed of no joint": (
        {"closing_speed": 0.1},
        r"closing_speed must be left out: no closing joint slides",
    ),
    "no stand-off": ({"standoffs": []}, r"standoffs: must be a list of at least 1"),
    "stand-offs in millimetres": (
        {"standoffs": [0.03, 44]},
        r"hand\.yaml: standoffs\.1: must be at most 1 m, got 44 m$",
    ),
    "spreads without a spread": (
        {"spreads_deg": [0, 10]},
        r"spreads_deg must be \[0\] without spread\.joints, got \[0\.0, 10\.0\]",
    ),
    "preshape of no joint": (
        {"preshape": {"knee": 0.0}},
        r"preshape\.knee: must be a revolute or prismatic joint of the model",
    ),
    "preshape of a closing joint": (
        {"preshape": {"left_hinge": 0.0}},
        r"fingers\.0\.closing_joint: must be a joint that nothing else drives",
    ),
    "preshape beyond the limits": (
        {"preshape": {"right_hinge": 2.0}, "fingers": changed_finger()[:1]},
        r"preshape\.right_hinge: must be 0\.\.1, the joint's limits, got 2",
    ),
    "no package": (
        {"packages": {"pincer_description": "gone"}},
        r"packages\.pincer_description: must be a folder, got 'gone'",
    ),
    "no payload": ({"payload": 0}, r"payload: must be greater than 0, got 0"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_bad_key_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    changes, message = REFUSALS[case]
    with pytest.raises(HandError, match=message) as info:
        load_hand(write_pincer(tmp_path, **changes))
    assert "\n" not in str(info.value)


def test_the_worlds_joint_is_refused(tmp_path: Path) -> None:
    sdf = PINCER_SDF.replace(
        "<parent>palm</parent><child>mount", "<parent>world</parent><child>mount"
    )
    with pytest.raises(HandError, match=r"joint 'fixed' must join two links of the hand"):
        load_hand(write_pincer(tmp_path, sdf))


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


@pytest.mark.parametrize("named", [True, False])
def test_a_mesh_in_a_package_is_found(tmp_path: Path, named: bool) -> None:
    """By the hand file's `packages`, or by the package.xml above the model."""
    folder = tmp_path / "somewhere" / "meshes"
    folder.mkdir(parents=True)
    mesh = (MODELS / "barrett_distal.obj").read_text()
    (folder / "tip.obj").write_text(mesh)
    (folder.parent / "package.xml").write_text("<package><name> grip </name></package>")
    uri = '<mesh filename="package://grip/meshes/tip.obj"/>'
    urdf = SLIDER.replace('<box size="0.02 0.02 0.09"/>', uri, 1)
    if named:
        path = write_slider(tmp_path, urdf, packages={"grip": "somewhere"})
    else:
        path = write_slider(folder.parent, urdf)
    assert len(link_shapes(load_hand(path))["left"][0]) == 24

    # The mesh is part of the hand.
    before = hand_digest(path)
    (folder / "tip.obj").write_text(mesh + "# changed\n")
    assert hand_digest(path) != before


def test_a_mesh_that_is_missing_is_named(tmp_path: Path) -> None:
    urdf = SLIDER.replace('<box size="0.02 0.02 0.09"/>', '<mesh filename="gone.obj"/>', 1)
    hand = load_hand(write_slider(tmp_path, urdf))
    with pytest.raises(HandError, match=r"model: .*gone\.obj"):
        link_shapes(hand)


def test_a_rated_load_of_the_package_is_of_its_own_hand_file(tmp_path: Path) -> None:
    """Not of a user's hand of the same name, whose file says nothing."""
    assert load_hand("barrett").rated_load == pytest.approx(19.62)
    user = write_pincer(tmp_path).rename(tmp_path / "barrett_hand.yaml")
    assert load_hand(user).rated_load is None
