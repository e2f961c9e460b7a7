"""Each number of a protocol, in a grasp in which it alone decides."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.jaws import EDGE, HAND, HERE, box_folder, changed, jaws

from drakegrasp import registry
from drakegrasp.errors import ConfigError
from drakegrasp.exchange.dexgraspbench import write_object
from drakegrasp.protocols.protocol import (
    DexGraspBench,
    DexGraspBenchTabletop,
    DexonomyHard,
    DexonomyHardAsRun,
    PostureVerdict,
    displacement,
    find_protocol,
)
from drakegrasp.protocols.scene import ObjectFolder, ProtocolScene, read_object_folder

Judge = Callable[..., PostureVerdict]


def test_the_box_is_held_by_the_rules_of_dexgraspbench(judge: Judge) -> None:
    verdict = judge()
    assert verdict.success
    assert verdict.push == 5
    assert verdict.moved < 0.02


@pytest.mark.parametrize(
    "numbers",
    [
        {"friction": (0.3, 0.02)},
        {"mass": 0.2},
        {"mass": None, "density": 0.2 / EDGE**3},
        {"acceleration": 20.0},
        {"position_gain": 30.0},
    ],
    ids=lambda numbers: next(reversed(numbers)),
)
def test_a_number_that_makes_the_push_too_strong(judge: Judge, numbers: dict[str, float]) -> None:
    verdict = judge(**numbers)
    assert verdict.reason == "moved"
    assert verdict.push == 2


def test_torsion_holds_a_bar_beside_its_middle(judge: Judge, tmp_path: Path) -> None:
    """1 N at 30 mm turns it; the jaws hold 2 x 1.2 N x 0.02 m."""
    bar = box_folder(tmp_path / "bar", EDGE, 0.16, 0.03)
    aside = jaws(0.01, object_pose=np.array([0.0, 0.03, *HERE[2:]]))
    assert judge(aside, bar).success
    weak = judge(aside, bar, friction=(0.6, 0.002))
    assert weak.reason == "turned"
    assert judge(aside, bar, friction=(0.6, 0.002), max_turned=None, max_moved=1.0).success


def test_distance_that_is_allowed(judge: Judge) -> None:
    """1 N moves jaws of 60 N/m each by 8.3 mm."""
    assert judge(max_moved=0.010).success
    assert judge(max_moved=0.008).reason == "moved"


def test_deep_start_fails_at_once_if_it_is_asked(judge: Judge) -> None:
    assert judge(jaws(-0.009)).success
    deep = judge(jaws(-0.011))
    assert deep.reason == "penetration"
    assert deep.penetration == pytest.approx(0.011, abs=1e-3)
    assert deep.push is None
    assert judge(jaws(-0.011), max_penetration=None).penetration > 0.01
    assert judge(jaws(-0.011), max_penetration=None).reason != "penetration"


def test_hand_that_begins_in_itself_fails(hand: Path, box: ObjectFolder, tmp_path: Path) -> None:
    """Jaws of 10 mm are in the same place, the box is elsewhere."""
    rules = changed(max_penetration=0.005)
    crossed = jaws(-0.025, object_pose=np.array([0.0, 0.0, 1.0, *HERE[3:]]))
    solid = tmp_path / "hand.xml"
    solid.write_text(HAND.replace('<exclude body1="left" body2="right"/>', ""))
    for path, deep in ((hand, False), (solid, True)):
        verdict = rules.run(ProtocolScene(rules, path, box), crossed)
        assert verdict.penetration == 0.0
        assert (verdict.reason == "penetration") == deep


def test_directions_are_tried_in_their_order(judge: Judge) -> None:
    """Along x the jaws hold it; along y at so little friction they do not."""
    found = judge(friction=(0.3, 0.02), directions=((1, 0, 0), (0, 0, 1), (0, 1, 0)))
    assert found.push == 1
    assert judge(friction=(0.3, 0.02), directions=((1, 0, 0), (-1, 0, 0))).success


def test_push_lasts_as_long_as_it_says(judge: Judge) -> None:
    """Nothing holds it: it goes by a t^2 / 2, and is judged after each 0.2 s."""
    away = jaws(
        0.09, grasp=np.array([*HERE, -0.09, -0.09]), squeeze=np.array([*HERE, -0.09, -0.09])
    )
    gone = judge(away, directions=((0, 0, 1),))
    assert gone.moved == pytest.approx(0.5 * 10.0 * 0.2**2, rel=0.05)
    assert judge(away, directions=((0, 0, 1),), push=(1, 10)).moved == pytest.approx(0.008, rel=0.2)
    assert judge(away, directions=((0, 0, 1),), time_step=0.002, push=(1, 50)).moved == (
        pytest.approx(0.05, rel=0.05)
    )


def test_postures_take_0_4_seconds_each(hand: Path, box: ObjectFolder) -> None:
    for protocol, seconds in ((DexGraspBench(), 0.8), (DexonomyHard(), 0.2)):
        scene = ProtocolScene(protocol, hand, box)
        scene.reset(jaws(0.01).pregrasp, np.array(HERE))
        protocol.squeeze(scene, jaws(0.01))
        assert scene._data.time == pytest.approx(seconds)


def test_motors_are_commanded_where_their_own_joints_shall_go(
    box: ObjectFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hand with its motors in another order than its joints, and one that moves half as far."""
    left, right = re.findall(r" *<position .*?/>\n", HAND)
    text = HAND.replace(left + right, right.replace("/>", ' gear="0.5"/>') + left)
    (tmp_path / "hand.xml").write_text(text)
    scene = ProtocolScene(DexGraspBench(), tmp_path / "hand.xml", box)
    start, end = (np.array([*HERE, 0.01 * k, 0.02 * k]) for k in (1, 2))
    scene.reset(start, np.array(HERE))
    np.testing.assert_allclose(scene._data.ctrl, [0.01, 0.01])
    given: list[np.ndarray] = []
    monkeypatch.setattr(scene, "step", lambda _: given.append(scene._data.ctrl.copy()))
    scene.move(start, end, changes=2, steps=1)
    np.testing.assert_allclose(given, [[0.015, 0.015], [0.02, 0.02]])


def test_solver_against_slip_keeps_the_box_from_creeping(judge: Judge) -> None:
    heavy = {"friction": (0.6, 0.02), "directions": ((0, 0, 1),)}
    still = judge(**heavy).moved
    assert judge(**heavy, noslip_iterations=0).moved > 2.0 * still
    assert judge(**heavy, noslip_iterations=0, impratio=1.0).moved > 5.0 * still


def test_model_has_the_numbers_of_contacts_and_joints(hand: Path, box: ObjectFolder) -> None:
    protocol = changed(solref=(0.01, 1.0), joint_margin=0.1, velocity_gain=2.0)
    model = ProtocolScene(protocol, hand, box)._model
    of_hand = model.geom_bodyid != model.body("object").id
    assert (model.geom_solref[of_hand] == [0.01, 1.0]).all()
    assert (model.geom_solimp[of_hand, :3] == [0.5, 0.99, 0.0001]).all()
    assert (model.geom_solref[~of_hand] == [0.02, 1.0]).all()
    assert model.joint("hand-left").margin == 0.1
    assert (model.actuator_biasprm[:, 2] == -2.0).all()
    assert (model.geom_condim == 4).all()


def test_lift_raises_the_box_from_the_table(judge: Judge) -> None:
    """A force of its weight acts from the start; the plane carries it until the jaws do."""
    standing = jaws(0.01, object_pose=np.array([0.0, 0.0, EDGE / 2, *HERE[3:]]))
    up = {
        name: getattr(standing, name) + np.array([0, 0, 0.021, *np.zeros(6)])
        for name in ("pregrasp", "grasp", "squeeze")
    }
    standing = replace(standing, **up)
    lift = {"protocol": DexGraspBenchTabletop}
    held = judge(standing, **lift)
    assert held.success
    assert held.moved < 0.02
    assert judge(standing, **lift, friction=(0.3, 0.02)).moved > 0.05
    assert judge(standing, **lift, lift=0.04, friction=(0.3, 0.02), max_moved=0.05).success


def test_dexonomy_pushes_with_the_weight_and_half_the_friction(judge: Judge) -> None:
    """0.98 N: 2 x 1.2 N x 0.3 are not enough, what the solver does against slip aside."""
    assert judge(protocol=DexonomyHard).reason == "moved"
    assert judge(protocol=DexonomyHardAsRun).reason == "moved"
    assert judge(protocol=DexonomyHard, friction=(0.6, 0.02), impratio=10.0).success


def test_same_scene_gives_the_same_bits_again(hand: Path, box: ObjectFolder) -> None:
    protocol = DexGraspBench()
    scene = ProtocolScene(protocol, hand, box)
    first = protocol.run(scene, jaws(0.01))
    protocol.run(scene, jaws(0.02))
    assert protocol.run(scene, jaws(0.01)) == first


def test_angle_of_a_whole_turn_is_no_return() -> None:
    turned = np.array([*HERE[:3], np.cos(0.1), 0.0, np.sin(0.1), 0.0])
    moved, angle = displacement(np.array(HERE), turned)
    assert (moved, angle) == (0.0, pytest.approx(0.2))
    assert displacement(np.array(HERE), -turned)[1] == pytest.approx(2 * np.pi - 0.2)


@pytest.mark.parametrize("name", registry.names("protocols"))
def test_protocols_have_a_name_a_source_and_words_for_a_paper(name: str) -> None:
    protocol, _ = find_protocol(name)
    assert protocol.name == name
    assert protocol.source
    assert type(protocol).__doc__ and len(type(protocol).__doc__) > 80


def test_a_protocol_of_another_package_is_checked_like_an_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Both(DexGraspBench):
        mass, density = 0.1, 1000.0

    monkeypatch.setattr(registry, "find", lambda *_: Both)
    with pytest.raises(ConfigError, match="mass or density must be None, and only one of them"):
        find_protocol("dexgraspbench")


def test_a_simulation_that_diverges_is_no_success(judge: Judge) -> None:
    verdict = judge(acceleration=1e12)
    assert (verdict.success, verdict.reason) == (False, "diverged")


@pytest.mark.parametrize(("parts", "fits"), [(100, True), (300, False)])
def test_contacts_that_do_not_fit_into_memory_are_no_verdict(
    hand: Path, tmp_path: Path, parts: int, *, fits: bool
) -> None:
    """MuJoCo would leave out all contacts of the step, with a warning: 14 MB are a few hundred."""
    corners = np.asarray(trimesh.creation.box([EDGE] * 3).vertices)
    write_object(tmp_path / "many", [corners] * parts)
    scene = ProtocolScene(DexGraspBench(), hand, read_object_folder(tmp_path / "many", 1.0))
    deep = jaws(-0.02)
    scene.reset(deep.pregrasp, deep.object_pose)
    assert scene.diverged != fits
