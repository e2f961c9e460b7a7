"""Trial grasps: how far what is pinched slips, by hand and drive."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from helpers.golden import Golden, points, short
from helpers.hands import SLIDER, write_slider
from helpers.tiers import in_second_tier

from drakegrasp.hand.description import load_hand
from drakegrasp.hand.finger_sweep import find_opposition, find_pinch, reach
from drakegrasp.hand.settings import load_config
from drakegrasp.hand_setup import GRASPS, check_grasp, trial_grasps
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.scene import hand_positions
from drakegrasp.simulation.trial import TrialRecord, run_attempt


def test_a_pinch_is_where_the_pads_leave_its_width(tmp_path) -> None:
    """Fingers slide along y from 40 mm to the middle; pads end 110 mm above the palm link."""
    hand = load_hand(write_slider(tmp_path))
    axis, group = find_opposition(hand)
    np.testing.assert_allclose(axis, [0.0, 1.0, 0.0], atol=1e-9)
    assert group.tolist() == [True, False]
    pinch = find_pinch(hand, 0.05)
    assert pinch is not None
    np.testing.assert_allclose(pinch.closing, 0.015, atol=0.002)
    assert pinch.width == pytest.approx(0.05, abs=0.004)
    assert pinch.tilt < np.deg2rad(3.0)
    assert pinch.p_GM[1] == pytest.approx(0.0, abs=1e-3)
    assert find_pinch(hand, 0.1) is None
    assert reach(hand, np.array([0.0, 0.0, 1.0])) == pytest.approx(0.1, abs=1e-9)


@pytest.mark.parametrize("turned", [0.0, 0.02, -0.02])
def test_fingers_around_a_centre_close_against_the_last_one(tmp_path, turned: float) -> None:
    """Three sliding fingers at 120 degrees, two of them mounted a little beside [rad]."""
    palm, _, left = SLIDER.partition('<link name="left">')
    link = left.partition("</link>")[0]
    parts, fingers = [palm], []
    for name, yaw in (
        ("a", turned - np.pi / 6.0),
        ("b", turned + 7.0 * np.pi / 6.0),
        ("c", np.pi / 2.0),
    ):
        x, y = 0.04 * np.cos(yaw), 0.04 * np.sin(yaw)
        parts.append(
            f'<link name="{name}">{link}</link>'
            f'<joint name="{name}_slide" type="prismatic"><parent link="palm"/>'
            f'<child link="{name}"/><origin xyz="{x} {y} 0.01" rpy="0 0 {yaw + np.pi / 2.0}"/>'
            '<axis xyz="0 1 0"/><limit lower="0" upper="0.04" effort="20" velocity="1"/></joint>'
        )
        finger = {"name": name, "fingertip": name, "closing_joint": f"{name}_slide"}
        fingers.append({**finger, "force_limit": 20.0, "pad_point": [0.0, 0.0, 0.09]})
    hand = load_hand(write_slider(tmp_path, "".join([*parts, "</robot>"]), fingers=fingers))
    axis, group = find_opposition(hand)
    np.testing.assert_allclose(axis, [0.0, 1.0, 0.0], atol=1e-9)
    assert group.tolist() == [True, True, False]


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("name", ["allegro", "franka", in_second_tier("leap")])
@pytest.mark.parametrize("drive", ["worm", in_second_tier("locked")])
def test_a_pinched_box_slips_by_less_than_a_millimetre(name: str, drive: str) -> None:
    """Within the payload; joints of the preshape keep their positions."""
    hand, config = load_hand(name), load_config(overrides=[f"lift.drive={drive}"])
    model, X_TO, pregrasp, _ = next(trial_grasps(hand, "box"))
    assert model.mass <= hand.payload
    scene = build_scene(model, config.physics, hand)
    record = run_attempt(scene, X_TO, pregrasp, config)
    assert record.outcome is Outcome.SUCCESS
    assert record.closed.contacts.touching.all()
    assert record.lift.slip < 1e-3
    assert record.lift.turn < np.deg2rad(1.0)
    q = dict(zip(hand.joint_names, hand_positions(scene), strict=True))
    for joint, position in hand.preshape.items():
        assert q[joint] == position


@pytest.mark.sim
@pytest.mark.slow
def test_slip_of_fingers_that_are_pushed_open_is_told() -> None:
    finding = check_grasp(load_hand("allegro"), load_config(overrides=["lift.drive=torque"]), "box")
    assert finding.ok
    locked, own = finding.text.split(" with fingers that are locked, ")
    assert "slips by 0.1" in locked
    assert own.startswith("and slips by 6.")
    assert own.endswith("with fingers that motors of its own strength keep closed")


def test_trial_grasps_are_lifted_to_their_end(monkeypatch) -> None:
    """The one with locked fingers and the one with its own."""
    configs = []

    def hold(scene, X_TO, attempt, config):
        configs.append(config)
        still = SimpleNamespace(slip=0.0, turn=0.0)
        return TrialRecord(outcome=Outcome.SUCCESS, X_TO=X_TO, X_OG=attempt.X_OG, lift=still)

    module = "drakegrasp.hand_setup"
    monkeypatch.setattr(f"{module}.build_scene", lambda *_: None)
    monkeypatch.setattr(f"{module}.run_attempt", hold)
    config = load_config(overrides=["lift.drive=torque", "lift.stop_when=lost_sample"])
    assert check_grasp(load_hand("allegro"), config, "box").ok
    assert [each.lift.drive for each in configs] == ["locked", "torque"]
    assert {each.lift.stop_when for each in configs} == {"never"}


@pytest.mark.parametrize("name", ["barrett", "franka"])
def test_trial_grasps_of_a_hand(name: str, golden: Golden) -> None:
    """The objects, how they hang, and where the hand starts."""
    hand, lines = load_hand(name), []
    for shape, line in GRASPS:
        for model, X_TO, start, width in trial_grasps(hand, shape, line):
            size = points([model.half_extents])
            lines.append(f"{shape} {line} {short(width)} m, {short(model.mass)} kg {size}")
            lines += [points(X[:3]) for X in (X_TO, start.X_OG)]
            lines.append(f"{short(start.spread)} {points([start.closing])}")
    golden(f"grasps/{name}", "\n".join(lines))
