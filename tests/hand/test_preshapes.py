"""Preshapes of a hand, and fingers that the motor of another finger drives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.hands import SLIDER, copy_model, slider_fingers, write_slider
from helpers.successes import good, judge

from drakegrasp.config import FilterConfig
from drakegrasp.errors import HandError
from drakegrasp.exchange.dexgraspbench import grasp_dictionary
from drakegrasp.exchange.export import ClosedGrasp
from drakegrasp.exchange.isaac_grasp import grasp_entry
from drakegrasp.filters import Removal
from drakegrasp.frames import make_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.checks import check_couplings
from drakegrasp.hand.description import Hand, load_hand, load_plain_hand
from drakegrasp.hand.kinematics import (
    closed_positions,
    coordinate_limits,
    fingertip_forces,
    joint_positions,
    open_together,
)
from drakegrasp.pictures.still_scene import StillScene
from drakegrasp.simulation.posture import Posture, start_of
from drakegrasp.verification.wrist_solver import fit_wrist, make_postures

PINCH = {
    "name": "pinch",
    "fingers": ["index", "thumb"],
    "joints": {"middle_mcp_joint": -0.19, "middle_pip_joint": 0.0, "ring_roll_joint": 0.1},
}
ALL = {"name": "all", "fingers": ["index", "middle", "ring", "thumb"]}
REFUSALS = {
    "no such finger": ([{**PINCH, "fingers": ["index", "little"]}],
                       r"preshapes.0.fingers must be of index, middle, ring, thumb, got 'little'"),
    "one name twice": ([PINCH, PINCH], "preshapes must have a name each, got pinch, pinch"),
    "a joint that closes": (
        [ALL, {**PINCH, "joints": {"index_mcp_joint": 0.3}}],
        r"preshapes.1: fingers.0.closing_joint: must be a joint that nothing else drives"),
    "a joint beyond its limits": (
        [{**PINCH, "joints": {"ring_mcp_joint": 3.0}}],
        r"preshapes.0: preshape.ring_mcp_joint: must be -0.196..1.61, .* got 3"),
    "a joint of another hand": (
        [{**PINCH, "joints": {"little_joint": 0.0}}],
        r"preshapes.0: preshape.little_joint: must be a revolute or prismatic joint"),
}  # fmt: skip


def allegro(folder: Path, *preshapes: dict, name: str = "allegro_four") -> Hand:
    """Return a hand of the package with preshapes."""
    tree = copy_model(folder, name) | {"preshapes": list(preshapes)}
    path = folder / "shaped_hand.yaml"
    path.write_text(yaml.safe_dump(tree))
    return load_hand(path)


@pytest.mark.parametrize("case", REFUSALS)
def test_a_preshape_that_a_hand_cannot_have_is_refused(tmp_path: Path, case: str) -> None:
    preshapes, message = REFUSALS[case]
    with pytest.raises(HandError, match=message):
        allegro(tmp_path, *preshapes)


def test_fingers_that_a_preshape_leaves_out_keep_their_joints(tmp_path: Path) -> None:
    """As the preshape says, else as in the open hand; the common preshape holds as well."""
    hand = allegro(tmp_path, ALL, PINCH)
    pinch = hand.at(1)
    assert [finger.name for finger in pinch.fingers] == ["index", "thumb"]
    assert (hand.unused_in(0), hand.unused_in(1), hand.unused_in(None)) == (0, 0b0110, 0)
    q = joint_positions(pinch, 0.0, [0.5, 0.4])
    assert (q["index_mcp_joint"], q["thumb_mcp_joint"]) == (0.5, 0.4)
    assert (q["middle_mcp_joint"], q["middle_pip_joint"], q["ring_roll_joint"]) == (-0.19, 0.0, 0.1)
    assert (q["ring_mcp_joint"], q["ring_pip_joint"]) == (0.0, 0.2)
    assert q["thumb_opposition_joint"] == 1.396
    assert hand.at(0).num_fingers == hand.at(None).num_fingers == 4


def test_a_preshape_includes_the_finger_whose_motor_drives_its_own(tmp_path: Path) -> None:
    half = {"name": "half", "fingers": ["right"]}
    with pytest.raises(HandError, match=r"preshapes.0.fingers must include 'left', whose motor"):
        allegro(tmp_path, half, name="franka")


def test_filters_do_not_miss_what_a_preshape_leaves_out() -> None:
    """A NaN of another finger is off the surface; outliers are sought among the same fingers."""
    grasps = good(40)
    unused = np.zeros((40, 3), dtype=bool)
    unused[20:, 1] = True
    lacking = np.tile(np.repeat(unused, 3, axis=1), 2)
    grasp, held = grasps.grasp_T.copy(), grasps.lifted_O.copy()
    grasp[lacking] = held[lacking] = np.nan
    grasp[3, 4] = np.nan
    grasp[6, 4] = grasp[30, 0] = 50.0
    shaped = grasps.with_columns(grasp_T=grasp, lifted_O=held, unused=unused)
    removal = judge(shaped, FilterConfig())
    assert np.flatnonzero(removal).tolist() == [3, 6, 30]
    assert removal[3] == Removal.OFF_SURFACE
    assert removal[6] == removal[30] == Removal.OUTLIER


def test_what_knows_one_preshape_refuses_several(tmp_path: Path) -> None:
    allegro(tmp_path, PINCH)
    with pytest.raises(HandError, match="hand must be one without preshapes for MuJoCo, got "):
        load_plain_hand(tmp_path / "shaped_hand.yaml", "MuJoCo")
    assert load_plain_hand("allegro", "MuJoCo") is load_hand("allegro")


def test_exports_leave_the_fingers_that_a_grasp_does_not_use_where_they_are(tmp_path: Path) -> None:
    """Neither before the grasp nor in the squeeze; joints of the preshape keep its positions."""
    hand = allegro(tmp_path, ALL, PINCH)
    posed = StillScene(hand)
    q = joint_positions(hand.at(1), 0.0, [0.5, 0.4])
    grasp = ClosedGrasp(
        trial_id=0,
        split="train",
        object_name="ball",
        X_TO=np.eye(4),
        X_TG=np.eye(4),
        q=np.array([q[name] for name in posed.joints]),
        spread=0.0,
        unused=hand.unused_in(1),
    )
    moving = {
        "index_mcp_joint", "index_pip_joint", "index_dip_joint",
        "thumb_mcp_joint", "thumb_ip_joint",
    }  # fmt: skip

    entry = grasp_entry(hand, grasp)
    before, closed = entry["pregrasp_cspace_position"], entry["cspace_position"]
    assert {name for name in closed if before[name] != closed[name]} == moving

    stages = grasp_dictionary(hand, posed, posed.joints, grasp)
    for stage in ("pregrasp_qpos", "squeeze_qpos"):
        differs = stages[stage][7:] != stages["grasp_qpos"][7:]
        assert {n for n, d in zip(posed.joints, differs, strict=True) if d} == moving


def test_bits_say_which_fingers_are_left_out() -> None:
    left_out = [[False, False, False], [True, False, False], [False, True, True]]
    np.testing.assert_array_equal(unused_fingers([0, 1, 6], 3), left_out)


OWN, DRIVEN = slider_fingers(60.0, finger="left")
MOTOR_REFUSALS = {
    "no such finger": (
        [OWN, {**DRIVEN, "driven_by": {"finger": "middle"}}],
        r"fingers.1.driven_by.finger must be .* motor of its own \(left\), got 'middle'"),
    "each drives the other": (
        [{**DRIVEN, "name": "left", "driven_by": {"finger": "right"}}, DRIVEN],
        r"fingers.0.driven_by.finger must be .* \(there is none\), got 'right'"),
    "a motor of its own as well": (
        [OWN, {**DRIVEN, "force_limit": 3.0}],
        "fingers.1.force_limit must be left out with driven_by: the motor is that of finger"),
    "a rotor of its own": ([OWN, {**DRIVEN, "rotor_inertia": 1e-6}],
                           "fingers.1.rotor_inertia must be left out"),
    "it opens while the other closes": (
        [OWN, {**DRIVEN, "driven_by": {"finger": "left", "ratio": -1.0}}],
        "fingers.1.driven_by.ratio: .*greater than 0"),
}  # fmt: skip


def shared(tmp_path: Path, ratio: float = 1.0, **changes: object) -> Hand:
    fingers = slider_fingers(60.0, finger="left", ratio=ratio)
    return load_hand(write_slider(tmp_path, fingers=fingers, **changes))


@pytest.mark.parametrize("case", MOTOR_REFUSALS)
def test_a_finger_is_driven_by_one_motor(tmp_path: Path, case: str) -> None:
    fingers, message = MOTOR_REFUSALS[case]
    with pytest.raises(HandError, match=message):
        load_hand(write_slider(tmp_path, fingers=fingers))


def test_a_finger_that_turns_is_not_driven_by_one_that_slides(tmp_path: Path) -> None:
    turning = SLIDER.replace(
        'name="right_slide" type="prismatic"', 'name="right_slide" type="revolute"'
    )
    message = (
        r"fingers.1.driven_by: must be a finger whose closing joint turns, as 'right_slide', "
        "got 'left'"
    )
    with pytest.raises(HandError, match=message):
        shared(tmp_path, urdf=turning)


def test_hand_check_asks_for_the_motor_that_the_model_shares(tmp_path: Path) -> None:
    """Its fingers mimic each other in the URDF."""
    finding = check_couplings(load_hand(write_slider(tmp_path)))
    assert "'right_slide' must be coupled to 'left_slide' by 1 and 0" in finding.text
    assert check_couplings(shared(tmp_path)).ok


def test_fingers_of_one_motor_close_in_step(tmp_path: Path) -> None:
    """The model lets each slide by 40 mm: the one that closes twice as far is at its end first."""
    hand = shared(tmp_path, ratio=2.0)
    np.testing.assert_allclose(coordinate_limits(hand)[1:], [[0.0, 0.02], [0.0, 0.04]])
    np.testing.assert_allclose(closed_positions(hand), [0.02, 0.04])
    np.testing.assert_allclose(hand.closing_speed, [0.1, 0.2])
    np.testing.assert_allclose(open_together(hand, [0.015, 0.02]), [0.01, 0.02])
    np.testing.assert_allclose(open_together(hand, [0.005, 0.02]), [0.005, 0.01])


def test_one_motor_presses_with_both_fingers(tmp_path: Path) -> None:
    """120 N at a motor that moves each finger by as much are 60 N each, by 1 and 2 they are 40."""
    assert fingertip_forces(shared(tmp_path), "torque") == pytest.approx([60.0, 60.0])
    assert fingertip_forces(shared(tmp_path, ratio=2.0), "torque") == pytest.approx([40.0, 40.0])
    assert fingertip_forces(load_hand("franka"), "worm") == pytest.approx([35.0, 35.0])


@pytest.mark.parametrize(("q", "own_motors"), [((0.02, 0.02), False), ((0.02, 0.03), True)])
def test_a_posture_that_the_motor_cannot_reach_gets_motors_of_its_own(
    tmp_path: Path, q: tuple[float, float], own_motors: bool
) -> None:
    start = start_of(Posture(np.eye(4), np.array(q)), shared(tmp_path))
    assert start.own_motors == own_motors
    assert start.closing is None or np.ptp(start.closing) == 0.0


def test_a_wrist_brings_both_fingers_to_their_points(tmp_path: Path) -> None:
    """The contacts are 3 mm off the middle: the palm moves, not one of the fingers."""
    hand = shared(tmp_path)
    assert make_postures(hand).coordinates.shape[1] == 2
    p_OQ, outward = np.array([[0.0, -0.017, 0.3], [0.0, 0.023, 0.3]]), np.eye(3)[[1, 1]]
    outward[0] *= -1.0
    best = fit_wrist(hand, p_OQ, outward, make_pose(np.eye(3), [0.0, 0.0, 0.5]))[0]
    assert best.closing[0] == best.closing[1] == pytest.approx(0.02, abs=1e-3)
    assert best.residual.max() < 5e-4
