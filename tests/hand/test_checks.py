"""Checks of a hand that say how to mend it."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.hands import write_tongs
from helpers.vendors import box, fixed, link

from drakegrasp.hand.checks import check_palm
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.settings import load_config
from drakegrasp.hand_setup import LINES, check_grasp, trial_grasps


def changed_franka(folder: Path, edit: Callable[[dict], None]) -> Hand:
    """Return the parallel gripper with changes of its file."""
    tree = yaml.safe_load((MODELS / "franka_hand.yaml").read_text())
    edit(tree)
    shutil.copy(MODELS / "franka_hand.urdf", folder)
    path = folder / "mine_hand.yaml"
    path.write_text(yaml.safe_dump(tree))
    return load_hand(path)


def test_a_palm_that_cannot_face_a_table_is_found(tmp_path: Path) -> None:
    """A post beside the fingers, which nothing else meets."""
    path = write_tongs(tmp_path)
    model = tmp_path / "tongs.urdf"
    sound = model.read_text()
    assert check_palm(load_hand(path)).ok
    for height, ok in ((0.1, True), (0.3, False)):
        post = link("post", 0.1, box(f"0.02 0.02 {height}", f"0.1 0 {height / 2.0}"))
        model.write_text(sound.replace("</robot>", post + fixed("f", "palm", "post") + "</robot>"))
        found = check_palm(load_hand(path))
        assert found.ok == ok
        assert ok or "the palm must be able to face a table, but the hand reaches 2" in found.text


def test_objects_hang_with_the_line_at_its_angle_and_the_hand_above_the_table() -> None:
    hand = load_hand("franka")
    for line, angle in LINES.items():
        for shape in ("box", "cylinder", "sphere"):
            _, X_TO, pregrasp, _ = next(trial_grasps(hand, shape, line))
            # The fingers slide along y of the object.
            assert np.arcsin(X_TO[2, 1]) == pytest.approx(angle)
            X_TG = X_TO @ pregrasp.X_OG
            assert abs(X_TG[2, 1]) == pytest.approx(np.sin(angle))
            assert X_TG[2, 3] > 0.1


def test_a_ball_is_left_out_if_the_fingers_stand_wider_than_it() -> None:
    found = check_grasp(load_hand("allegro_four"), load_config(), "sphere")
    assert (found.ok, found.text) == (True, "left out: the fingers stand too wide for a ball")


@pytest.mark.sim
@pytest.mark.slow
def test_two_motors_that_push_against_each_other_hold_nothing_along_their_line(
    tmp_path: Path,
) -> None:
    """On a level line friction carries; on an upright one the stronger side gives way."""

    def with_two_motors(tree: dict) -> None:
        tree["drive"] = "torque"
        for finger in tree["fingers"]:
            finger.pop("driven_by", None)
            finger["force_limit"] = 70.0

    hand = changed_franka(tmp_path, with_two_motors)
    level, upright = (
        check_grasp(hand, load_config(), "box", line) for line in ("level", "upright")
    )
    assert level.ok, level.text
    assert not upright.ok, upright.text
    assert "two motors that push against each other do not hold along their line" in upright.text
