"""The Barrett Hand against its published figures, and any hand against its description.

A configuration is complete when it is loaded: what it leaves open is the hand's own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yaml
from helpers.hands import (
    PINCER,
    PINCER_SDF,
    changed_finger,
    write_pincer,
    write_slider,
    write_tongs,
)
from helpers.tables import table
from pydrake.multibody.plant import MultibodyPlant

from drakegrasp.config import CarriedHand
from drakegrasp.errors import HandError
from drakegrasp.hand.description import SLIDE, Hand, load_hand
from drakegrasp.hand.kinematics import (
    closing_levers,
    coordinate_limits,
    joint_positions,
)
from drakegrasp.hand.parsing import add_model, declared_masses, read_xml
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.hand.shapes import link_shapes

#: Mass [kg] and bounding box of the CAD mesh [m] of each kind of link.
LINKS = {
    "base": (0.60858, (-0.0445, -0.0445, 0.0), (0.0445, 0.0650, 0.0904)),
    "spread": (0.14109, (-0.0123, -0.0123, -0.0389), (0.0650, 0.0123, 0.0150)),
    "proximal": (0.062139, (-0.0125, -0.0125, -0.0105), (0.0794, 0.0150, 0.0105)),
    "distal": (0.04166, (-0.0095, -0.0095, -0.0115), (0.0590, 0.01105, 0.0115)),
}


def link_kind(name: str) -> str:
    return name.rpartition("_")[2]


def test_barrett_has_its_published_figures(hand: Hand) -> None:
    assert [finger.torque_limit for finger in hand.fingers] == [2.0, 2.0, 4.0]
    assert hand.closing_speed == pytest.approx([np.pi / 3] * 3)
    np.testing.assert_allclose(hand.X_BG[:3, 3], [0.0, 0.0, 0.07795])


def test_masses_are_the_published_ones(hand: Hand) -> None:
    masses = declared_masses(read_xml(hand.model.path))
    assert masses == {name: LINKS[link_kind(name)][0] for name in masses}
    assert sum(masses.values()) == pytest.approx(1.2022, abs=1e-4)


def test_collision_shapes_fill_the_cad_bounding_boxes(hand: Hand) -> None:
    shapes = link_shapes(hand.model)
    assert len(shapes) == 9
    for name, parts in shapes.items():
        _, lower, upper = LINKS[link_kind(name)]
        p_L = np.concatenate(parts)
        np.testing.assert_allclose(p_L.min(axis=0), lower, atol=4e-3)
        np.testing.assert_allclose(p_L.max(axis=0), upper, atol=4e-3)


def test_a_hand_of_two_fingers_without_spread_loads(tmp_path: Path) -> None:
    pincer = load_hand(write_pincer(tmp_path))
    assert (pincer.name, pincer.num_fingers) == ("pincer", 2)
    assert pincer.spread.joints == ()
    np.testing.assert_array_equal(coordinate_limits(pincer), [[0, 0], [-0.1, 1], [0, 1]])


@pytest.mark.parametrize(
    ("name", "joints"),
    [
        # Both joints of each finger, without the two of the spread.
        (
            "barrett",
            [f"finger{i}_{part}_joint" for i in (1, 2, 3) for part in ("proximal", "distal")],
        ),
        ("franka", ["left_joint", "right_joint"]),
    ],
)
def test_joints_of_the_fingers_can_have_motors_of_their_own(name: str, joints: list[str]) -> None:
    motors = load_hand(name).own_motors
    assert list(motors) == joints
    fingers = len(load_hand(name).fingers)
    assert list(motors.values()) == sorted([*range(fingers)] * (len(joints) // fingers))


def test_a_hand_whose_files_have_changed_is_another(tmp_path: Path) -> None:
    """Its shapes, too; and the files of a model are also its meshes."""
    path = write_pincer(tmp_path)
    first = load_hand(path)
    assert load_hand(path) is first
    before = link_shapes(first.model)["right"][0]
    write_pincer(tmp_path, sdf=PINCER_SDF.replace("0.02 0.02 0.09", "0.02 0.03 0.09"))
    second = load_hand(path)
    assert second is not first
    assert np.ptp(before, axis=0) == pytest.approx([0.02, 0.02, 0.09])
    assert np.ptp(link_shapes(second.model)["right"][0], axis=0) == pytest.approx(
        [0.02, 0.03, 0.09]
    )

    mesh = "<mesh><uri>bar.obj</uri><drake:declare_convex/></mesh>"
    sdf = PINCER_SDF.replace("<box><size>0.02 0.02 0.09</size></box>", mesh)
    sdf = sdf.replace("<sdf ", '<sdf xmlns:drake="http://drake.mit.edu" ')
    write_pincer(tmp_path, sdf=sdf)
    for edge in (0.02, 0.025):
        trimesh.creation.box([0.02, edge, 0.09]).export(tmp_path / "bar.obj")
        shape = link_shapes(load_hand(path).model)["right"][0]
        assert np.ptp(shape, axis=0) == pytest.approx([0.02, edge, 0.09])


REFUSALS = table("hand_file")


def spoilt(
    left: dict[str, Any] | None = None, replace: tuple[str, str] = ("", ""), **changes: Any
) -> dict[str, Any]:
    """Return what `write_pincer` writes for a case of the table."""
    first, second = PINCER["fingers"]
    first = {k: v for k, v in {**first, **(left or {})}.items() if v is not None}
    fingers = [first, changes.pop("right", second)]
    given = {"fingers": [each for each in fingers if each], "sdf": PINCER_SDF.replace(*replace)}
    return given | changes


@pytest.mark.parametrize("case", REFUSALS)
def test_a_bad_description_is_refused_in_one_line(tmp_path: Path, case: str) -> None:
    path = write_pincer(tmp_path, **spoilt(**REFUSALS[case]["given"]))
    with pytest.raises(HandError, match=REFUSALS[case]["said"]) as info:
        load_hand(path)
    assert "\n" not in str(info.value)
    assert str(tmp_path / "pincer_hand.yaml") in str(info.value)


@pytest.mark.parametrize("key", ["closing_joint", "coupled"])
def test_a_joint_of_another_finger_is_refused(tmp_path: Path, key: str) -> None:
    """Though the finger's other joint is its own."""
    path = write_tongs(tmp_path)
    tree = yaml.safe_load(path.read_text())
    left, right = tree["fingers"]
    left[key], right[key] = right[key], left[key]
    path.write_text(yaml.safe_dump(tree))
    with pytest.raises(
        HandError, match=rf"fingers\.0\.{key}.*: must lie .* 'left_tip', got 'right_.*' of finger"
    ):
        load_hand(path)


@pytest.mark.parametrize("offset", [0.0, 0.8])
def test_a_coupling_that_stops_first_limits_its_finger(tmp_path: Path, offset: float) -> None:
    """The right hinge, 0..1, stands at offset - 2 c, where c is -0.1..1."""
    coupled = [{"joint": "right_hinge", "ratio": -2.0, "offset": offset}]
    hand = load_hand(write_pincer(tmp_path, fingers=changed_finger(coupled=coupled)[:1]))
    assert joint_positions(hand, 0.0, [0.1])["right_hinge"] == pytest.approx(offset - 0.2)
    np.testing.assert_allclose(coordinate_limits(hand)[1], [-0.1, offset / 2.0])


def test_fingers_slide(tmp_path: Path) -> None:
    hand = load_hand(write_slider(tmp_path))
    np.testing.assert_allclose(hand.closing_speed, [0.1, 0.1])
    np.testing.assert_allclose(hand.closing_unit, [SLIDE, SLIDE])
    assert hand.fingers[0].effort_unit == "N"
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


def test_stand_offs_and_spreads_are_the_hands_own_unless_they_are_set(tmp_path: Path) -> None:
    paper = load_config().candidates
    assert paper.standoffs == (0.06, 0.09, 0.12)
    assert paper.spreads_deg == (0.0, 11.25, 22.5)
    gripper = load_config(hand=str(write_pincer(tmp_path))).candidates
    assert (gripper.standoffs, gripper.spreads_deg) == ((0.03, 0.05), (0.0,))
    config = load_config(overrides=["candidates.standoffs=[0.01]"], hand="franka")
    assert config.candidates.standoffs == (0.01,)
    assert config.candidates.spreads_deg == (0.0,)


def test_null_is_that_of_the_hand_that_a_dataset_carries(tmp_path: Path) -> None:
    """Its name says where it lies in the dataset."""
    carried = CarriedHand(path=write_pincer(tmp_path), digest="")
    config = load_config().with_hand("hand/pincer_hand.yaml", carried)
    own = override_config(config, ["candidates.standoffs=null"])
    assert own.candidates.standoffs == (0.03, 0.05)
    assert own.hand_source == carried


def test_another_hand_brings_its_own_unless_they_are_overridden(tmp_path: Path) -> None:
    """Nothing of the first hand's is tried with the second."""
    config, path = load_config(), write_pincer(tmp_path)
    candidates = override_config(config, [f"hand={path}"]).candidates
    assert (candidates.standoffs, candidates.spreads_deg) == ((0.03, 0.05), (0.0,))
    changed = override_config(config, ["candidates.standoffs=[0.01]"], hand=str(path))
    assert changed.candidates.standoffs == (0.01,)
    assert changed.candidates.spreads_deg == (0.0,)


def test_hand_that_is_not_there_is_refused_where_it_is_needed() -> None:
    """A dataset's configuration has the numbers: it is read where the hand is not."""
    with pytest.raises(HandError, match=r"hand must be one of .*barrett.*, got 'no_hand'"):
        load_config(hand="no_hand")
    given = ["candidates.standoffs=[0.01]", "candidates.spreads_deg=[0]"]
    assert load_config(overrides=given, hand="no_hand").hand == "no_hand"
