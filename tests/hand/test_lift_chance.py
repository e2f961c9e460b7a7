"""The chance of a sample: its features on grasps whose values are known, and its file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.hands import write_pincer

from drakegrasp.arithmetic import Array
from drakegrasp.errors import HandError
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.lift_chance import (
    FEATURES,
    GRID,
    ClosedGrasp,
    LiftChance,
    features,
    read_lift_chance,
)

RADIUS, FORCE = 0.03, 4.0


def about_a_cylinder(*angles: float) -> ClosedGrasp:
    """Fingertips around an upright cylinder, at angles [deg], which push along its normals."""
    a = np.deg2rad(angles)
    outward = np.stack([np.cos(a), np.sin(a), 0.0 * a], axis=1)
    return ClosedGrasp(
        touching=np.ones(len(a), dtype=bool),
        p_OQ=RADIUS * outward,
        nhat_Q_O=outward,
        f_Q_O=-FORCE * outward,
        X_TO=np.eye(4),
        p_OOcm=np.array([0.0, 0.0, -0.01]),
        friction_hand=np.array(0.71),
    )


EVEN = about_a_cylinder(0, 120, 240)


def value(grasp: ClosedGrasp, name: str) -> float:
    return float(features(grasp)[name])


def test_fingers_all_around_balance() -> None:
    due = {"least_opposed": -0.5, "evenness": 1.0}
    found = features(EVEN)
    assert tuple(found) == FEATURES
    for name, each in found.items():
        assert each == pytest.approx(due.get(name, 0.0), abs=1e-7), name


def test_fingers_on_one_side_push_the_object_away() -> None:
    grasp = about_a_cylinder(-20, 0, 20)
    mean = (1.0 + 2.0 * np.cos(np.deg2rad(20))) / 3.0
    assert value(grasp, "normal_sum") == pytest.approx(mean)
    assert value(grasp, "least_opposed") == pytest.approx(np.cos(np.deg2rad(20)))
    assert value(grasp, "unbalanced") > 0.5
    assert value(grasp, "root_unbalanced") ** 2 == pytest.approx(value(grasp, "unbalanced"))


def test_friction_lets_fingers_balance_that_do_not_face_each_other() -> None:
    """Two by 150 degrees apart: friction of tan 15 degrees, and more for 70 % of it, will do."""
    grasp = about_a_cylinder(0, 150)
    slippery = replace(grasp, friction_hand=np.array(0.05))
    assert value(grasp, "unbalanced") < 0.5 * value(slippery, "unbalanced")


def test_moment_is_about_the_centre_of_mass() -> None:
    """Only one finger pushes, 1 cm above the centre of mass."""
    f = np.zeros((3, 3))
    f[0] = EVEN.f_Q_O[0]
    grasp = replace(EVEN, f_Q_O=f)
    assert value(grasp, "moment") == pytest.approx(0.01 / RADIUS)
    assert value(grasp, "evenness") == 0.0


def test_across_is_the_horizontal_distance_of_the_centre_of_mass() -> None:
    grasp = replace(EVEN, p_OOcm=np.array([0.003, 0.004, -0.2]))
    assert value(grasp, "across") == pytest.approx(0.005)
    lying = replace(grasp, X_TO=make_pose(rotation_about([1.0, 0.0, 0.0], 0.5 * np.pi), [0, 0, 0]))
    assert value(lying, "across") == pytest.approx(np.hypot(0.003, 0.2))


def test_finger_that_does_not_touch_has_no_say() -> None:
    two = about_a_cylinder(0, 180)
    nothing = np.full((1, 3), np.nan)
    three = replace(
        two,
        touching=np.array([True, True, False]),
        p_OQ=np.concatenate([two.p_OQ, nothing]),
        nhat_Q_O=np.concatenate([two.nhat_Q_O, nothing]),
        f_Q_O=np.concatenate([two.f_Q_O, 0.0 * nothing]),
    )
    for name in ("normal_sum", "evenness", "moment", "across"):
        assert value(three, name) == pytest.approx(value(two, name), abs=1e-12), name


def test_many_grasps_have_the_bits_of_each() -> None:
    known = read_lift_chance("barrett")
    assert known is not None
    each = [about_a_cylinder(0, 110 + k, 230 + 3 * k) for k in range(9)]

    def stacked(name: str) -> Array:
        return np.stack([getattr(grasp, name) for grasp in each])

    names = ("touching", "p_OQ", "nhat_Q_O", "f_Q_O", "X_TO", "friction_hand")
    many = replace(each[0], **{name: stacked(name) for name in names})
    chances = known.of(many)
    assert chances.tolist() == [float(known.of(grasp)) for grasp in each]
    assert np.array_equal(chances / GRID, np.rint(chances / GRID))
    assert len(set(chances.tolist())) == len(each)


def test_chance_is_logistic() -> None:
    model = LiftChance(0.5, {"least_opposed": 2.0, "evenness": -1.0})
    assert float(model.of(EVEN)) == pytest.approx(1.0 / (1.0 + np.exp(1.5)), abs=GRID)


def test_weights_lie_beside_the_hand(tmp_path: Path) -> None:
    assert read_lift_chance("barrett").weights.keys() == set(FEATURES)
    path = write_pincer(tmp_path)
    assert read_lift_chance(path) is None
    path.with_name("pincer_chance.yaml").write_text("bias: 1\nweights: {across: -2}\n")
    assert read_lift_chance(path) == LiftChance(1.0, {"across": -2.0})


NO_NUMBERS = ("bias: 1\nweights:\n", "bias: 1\nweights: [1, 2]\n", "bias: 1\n",
              "bias: many\nweights: {across: 1}\n", "[1]\n", "a: [\n")  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bias: 1\nweights: {colour: 1}\n", "weights must be of .*, got colour"),
        ("bias: 1\nweights: {}\n", "weights must be of .*, got none"),
        (yaml.safe_dump({"bias": 1, "weights": dict.fromkeys(FEATURES, np.nan)}), "must be finite"),
        *((text, "must be YAML with a number bias") for text in NO_NUMBERS),
    ],
)
def test_bad_weights_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "my_hand.yaml"
    path.write_text("version: 1\n")
    (tmp_path / "my_chance.yaml").write_text(text)
    with pytest.raises(HandError, match=message) as caught:
        read_lift_chance(path)
    assert "\n" not in str(caught.value)
