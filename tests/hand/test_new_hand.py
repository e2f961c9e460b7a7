"""`drakegrasp hand new`: what is guessed of a hand, and what overrides it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from helpers.commands import run
from helpers.golden import Golden, points, rounded
from helpers.machine import needs_egl
from helpers.vendors import JAWS, JAWS_MJCF, MITTEN, box, joint, link, write_model

from drakegrasp.errors import HandError
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.draft.fingers import Answers
from drakegrasp.hand.draft.vendor import THIN, Shape
from drakegrasp.hand.file_format import MODELS, DrivenBy
from drakegrasp.hand.finger_sweep import pad_points_at
from drakegrasp.hand.kinematics import closed_positions
from drakegrasp.hand_setup import NewHand, draft_hand


def draft(folder: Path, text: str, name: str = "hand.urdf", **answers: object) -> NewHand:
    path = write_model(folder / "vendor", text, name)
    return draft_hand(path, folder / "out", answers=Answers(**answers))  # type: ignore[arg-type]


def pads(hand: Hand, share: float) -> np.ndarray:
    """Return the pad points (k, 3) in {G} when the hand has closed by a share."""
    return pad_points_at(hand, share * closed_positions(hand))


def test_a_hand_of_four_fingers_grasps_with_three(tmp_path: Path) -> None:
    ring = MITTEN[MITTEN.index('<link name="index') : MITTEN.index('<link name="middle')]
    ring = ring.replace("index", "ring").replace("0 0.022 0", "0 0 0")
    hand = load_hand(draft(tmp_path, MITTEN.replace("</robot>", ring + "</robot>")).path)
    assert len(hand.fingers) == 3 and hand.fingers[-1].name == "thumb_far"


def test_a_mesh_without_thickness_gets_some_on_both_sides() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0], [0.02, 0.06, 0.0], [0.0, 0.06, 0.0]])
    hull = Shape(vertices=corners, faces=np.array([[0, 1, 2], [0, 2, 3]])).hull()
    assert hull.vertices is not None
    half = THIN / 2.0
    np.testing.assert_allclose(hull.vertices.min(axis=0), [-half] * 3)
    np.testing.assert_allclose(hull.vertices.max(axis=0), [0.02 + half, 0.06 + half, half])


BAR = link("bar", 0.01, box("0.01 0.01 0.02", "0 0 0.01"))


def test_bars_of_a_linkage_are_no_fingers(tmp_path: Path) -> None:
    """A bar of the jaws' motor, which reaches less far than they do."""
    bar = BAR + joint("bar_slide", "prismatic", "body", "bar", "0.02 0 0", "0 1 0", "0 0.05 60",
                      '<mimic joint="left_slide"/>')  # fmt: skip
    hand = load_hand(draft(tmp_path, JAWS.replace("</robot>", bar + "</robot>")).path)
    assert set(hand.fingertip_links) == {"left_jaw", "right_jaw"}
    assert any(c.joint == "bar_slide" for finger in hand.fingers for c in finger.coupled)


def test_a_bar_may_be_the_joint_that_leads(tmp_path: Path) -> None:
    """As in grippers whose fingers follow a knuckle beside them."""
    bar = BAR + joint("knuckle", "prismatic", "body", "bar", "0.02 0 0", "0 1 0", "0 0.05 60")
    text = JAWS.replace('"left_slide"/>', '"knuckle"/>').replace("</robot>", bar + "</robot>")
    slide = text.index("</joint>", text.index('name="left_slide"'))
    hand = load_hand(draft(tmp_path, text[:slide] + '<mimic joint="knuckle"/>' + text[slide:]).path)
    driver, driven = hand.fingers
    assert (driver.force_limit, driven.driven_by) == (120.0, DrivenBy(finger=driver.name))
    assert any(c.joint == "knuckle" for finger in hand.fingers for c in finger.coupled)


def test_an_effort_is_that_of_the_weakest_joint(tmp_path: Path) -> None:
    """A thumb whose last joint has a tenth of the torque presses less."""
    strong = '<axis xyz="0 -1 0"/><limit lower="0" upper="1.2" effort="1.0"'
    weak = MITTEN.replace(strong, strong.replace("1.0", "0.1"))
    assert weak != MITTEN
    limits = []
    for n, text in enumerate((MITTEN, weak)):
        hand = load_hand(draft(tmp_path / str(n), text).path)
        limits.append(hand.fingers[-1].torque_limit)
    assert limits[1] < 0.5 * limits[0]


def test_the_hand_of_the_package_is_drafted_from_its_model(tmp_path: Path) -> None:
    """From SDFormat, with meshes; joints that spread fingers keep a position."""
    drafted = draft_hand(MODELS / "barrett_hand.sdf", tmp_path / "out", answers=Answers(effort=2.0))
    assert [finding.text for finding in drafted.findings if not finding.ok] == []
    hand, own = load_hand(drafted.path), load_hand("barrett")
    assert set(hand.preshape) == set(own.spread.joints)
    assert {f.closing_joint for f in hand.fingers} == {f.closing_joint for f in own.fingers}
    assert {f.fingertip for f in hand.fingers} == set(own.fingertip_links)
    np.testing.assert_allclose(hand.X_BG[:3, 2], own.X_BG[:3, 2], atol=0.02)
    np.testing.assert_allclose(hand.X_BG[2, 3], own.X_BG[2, 3], atol=0.005)


def test_the_folder_is_complete_by_itself(tmp_path: Path) -> None:
    """With the vendor's licence."""
    vendor = tmp_path / "vendor"
    write_model(vendor, "MIT", "LICENSE.txt")
    drafted = draft(tmp_path, MITTEN)
    shutil.rmtree(vendor)
    moved = tmp_path / "moved"
    drafted.path.parent.rename(moved)
    assert load_hand(moved / drafted.path.name).num_fingers == 3
    assert (moved / "LICENSE.txt").read_text() == "MIT"


def test_answers_override_guesses(tmp_path: Path) -> None:
    drafted = draft(tmp_path, MITTEN, palm="palm", fingers=("index_far", "thumb_far"), effort=0.5)
    tree = yaml.safe_load(drafted.path.read_text())
    assert {finger["fingertip"] for finger in tree["fingers"]} == {"index_far", "thumb_far"}
    limits = [finger["torque_limit"] for finger in tree["fingers"]]
    whole = yaml.safe_load(draft(tmp_path / "whole", MITTEN).path.read_text())
    assert max(limits) <= 0.5 * 1.6
    assert "middle_1" in tree["preshape"]
    assert "middle_1" not in whole.get("preshape", {})


@pytest.mark.parametrize(
    ("text", "answers", "message"),
    [
        (JAWS, {"palm": "wrist"}, r"--palm must be one of body, .* got 'wrist'"),
        (JAWS, {"fingers": ("left_jaw", "thumb")}, r"--fingers must be of .* got 'thumb'"),
        # Fingers that close side by side: the message says what may be answered.
        (
            MITTEN,
            {"fingers": ("index_far", "middle_far")},
            r"close against each other: .* --fingers LINK,LINK",
        ),
        # An effort that no motor has is named with its source.
        (
            JAWS,
            {"effort": 2000.0},
            r"^--effort must be 0\.5\.\.1000 N for joint 'left_slide', got 2000$",
        ),
        (
            JAWS.replace('effort="60"', 'effort="2000"'),
            {},
            r"joint 'left_slide' must be .* got 2000 in the model",
        ),
    ],
)
def test_what_cannot_be_a_hand_is_refused(
    tmp_path: Path, text: str, answers: dict[str, object], message: str
) -> None:
    with pytest.raises(HandError, match=message):
        draft(tmp_path, text, **answers)
    assert not (tmp_path / "out").exists()


def test_a_folder_with_files_is_not_written_over(tmp_path: Path) -> None:
    write_model(tmp_path / "out", "mine", "notes.txt")
    with pytest.raises(HandError, match="--out must be a new or empty folder"):
        draft(tmp_path, JAWS)
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"


@pytest.mark.sim
@pytest.mark.slow
@needs_egl
def test_a_drafted_gripper_passes_every_check(tmp_path: Path) -> None:
    """Two commands, and no answer."""
    path, out = write_model(tmp_path, JAWS, "jaws.urdf"), tmp_path / "out"
    result = run("hand", "new", str(path), "--out", str(out))
    assert result.exit_code == 0, result.output
    assert (out / "jaws_hand.png").read_bytes().startswith(b"\x89PNG")
    result = run("hand", "check", str(out / "jaws_hand.yaml"))
    assert result.exit_code == 0, result.output


@pytest.mark.parametrize(
    ("name", "text", "suffix"),
    [("jaws", JAWS, "urdf"), ("jaws_mjcf", JAWS_MJCF, "xml"), ("mitten", MITTEN, "urdf")],
)
def test_draft(tmp_path: Path, golden: Golden, name: str, text: str, suffix: str) -> None:
    """The hand file with its comments, the model, the meshes, notes and findings."""
    model = write_model(tmp_path / "vendor", text, f"{name}.{suffix}")
    drafted = draft_hand(model, tmp_path / "out")
    lines = [*drafted.notes, *(f"{f.ok} {f.name}: {f.text}" for f in drafted.findings)]
    for path in sorted(drafted.path.parent.rglob("*")):
        if path.suffix in (".yaml", ".urdf"):
            lines += [f"== {path.name}", path.read_text(encoding="utf-8")]
        elif path.suffix == ".obj":
            lines.append(f"{path.name} {points(trimesh.load_mesh(path, process=False).bounds)}")
    golden(f"drafts/{name}", rounded("\n".join(lines).replace(str(tmp_path), "FOLDER")))
