"""Sound hands pass; a spoilt copy of one fails with a message that names what is wrong.

The hand of docs/how-to/add-a-hand.md is complete, and does what the page says.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from helpers.commands import run
from helpers.golden import Golden, points, short
from helpers.hands import PAGE as PATH
from helpers.hands import copy_model, write_tongs
from helpers.machine import needs_egl
from helpers.tables import table
from helpers.tiers import in_second_tier
from helpers.vendors import box, fixed, link

from drakegrasp.hand.checks import Finding
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.file_format import MODELS, Coupling, Finger, HandFile, Palm, Spread, hand_names
from drakegrasp.hand.settings import load_config
from drakegrasp.hand_setup import GRASPS, check_grasp, check_hand, trial_grasps
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.verification.wrist_problem import hand_constants


def copied(folder: Path, name: str) -> Path:
    """Copy the files of a hand, or write those of the tutorial's; return its hand file."""
    if name == "tongs":
        return write_tongs(folder)
    copy_model(folder, name)
    shutil.copy(MODELS / f"{name}_hand.yaml", folder)
    return folder / f"{name}_hand.yaml"


def change(path: Path, suffix: str, old: str, new: str) -> None:
    """Change a text in a hand file, or in its model."""
    models = path.parent.glob(f"{path.stem.removesuffix('_hand')}*{suffix}")
    file = path if suffix == ".yaml" else next(models)
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))


FAULTS = table("spoilt_hands")
PALM_SHAPE, SPREAD_AXIS = (
    FAULTS[case]["old"]
    for case in ("palm without a shape", "spread joints that the model turns against each other")
)
MIMIC = "<mimic joint='{}'><multiplier>{}</multiplier></mimic>"
POST = (
    link("post", 0.1, box("0.02 0.02 {0}", "0.1 0 {1}")) + fixed("f", "palm", "post") + "</robot>"
)


def refuse(path: Path, check: str, message: str) -> None:
    """Check that one check of a hand fails, with a message of a line."""
    findings = check_hand(path)
    (failed,) = (finding for finding in findings if not finding.ok)
    assert failed.name == check
    assert re.search(message, failed.text), failed.text
    assert "\n" not in failed.text


@pytest.mark.parametrize("fault", FAULTS)
def test_a_spoilt_hand_fails_with_a_message_that_names_the_fault(
    tmp_path: Path, fault: str
) -> None:
    """No other check fails, and none of these needs a simulation to be seen."""
    case = FAULTS[fault]
    path = copied(tmp_path, case["hand"])
    change(path, case["file"], case["old"], case["new"])
    refuse(path, case["check"], case["said"])


def test_a_mirrored_order_of_fingers_is_refused(tmp_path: Path) -> None:
    path = copied(tmp_path, "barrett")
    head, first, second, rest = re.split(r"(?=  - name: )", path.read_text(), maxsplit=3)
    path.write_text(head + second + first + rest)
    message = r"fingers must run counter-clockwise about \+Gz \(F2, F3, F1\), got F2, F1, F3"
    refuse(path, "finger order", message)


#: A link that is fixed to the palm, below or above it in the model, with a shape or without.
FIXED = """  <link name="{0}"><inertial><mass value="0.1"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="{3}"/><geometry><box size="0.06 0.14 0.03"/></geometry></collision>
  </link>
  <joint name="{0}_fixed" type="fixed"><parent link="{1}"/><child link="{2}"/></joint>
</robot>"""
SHELL = FIXED.format("shell", "palm", "shell", "0 0 -0.015")
MOUNT = FIXED.format("mount", "mount", "palm", "0 0.05 0.015")
RING = "<child>ring_roll</child>\n      <axis>\n"
#: What a sound hand may have: the hand, and what is replaced in its model by what.
SOUND = {
    "shape of the palm on a link that is fixed to it": (
        "tongs", ".urdf", {PALM_SHAPE: "", "</robot>": SHELL}
    ),
    "post beside the fingers": ("tongs", ".urdf", {"</robot>": POST.format(0.1, 0.05)}),
    "link above the palm, among the fingers": ("tongs", ".urdf", {"</robot>": MOUNT}),
    "spread joints that the model turns together": (
        "barrett", ".sdf", {SPREAD_AXIS: SPREAD_AXIS + MIMIC.format("finger1_spread_joint", 1.0)}
    ),
    "joints of the preshape that the model ties": (
        "allegro", ".sdf", {RING: RING + MIMIC.format("middle_roll_joint", 1.0)}
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", SOUND)
def test_a_sound_hand_passes_whatever_else_its_model_has(tmp_path: Path, case: str) -> None:
    name, suffix, changes = SOUND[case]
    path = copied(tmp_path, name)
    for old, new in changes.items():
        change(path, suffix, old, new)
    assert [finding.text for finding in check_hand(path) if not finding.ok] == []
    # What is checked can be used: the palm has the corners of one box, or also of the post.
    corners = 16 if "post" in case else 8
    assert len(hand_constants(load_hand(path)).palm) == corners or name != "tongs"


def test_the_hand_of_the_example_plugin_passes() -> None:
    """Its pads have no region, so they are the whole surface of the fingertips."""
    path = Path(__file__).parents[2] / "docs/examples/plugin/example_plugin/jaw_hand.yaml"
    assert [finding.text for finding in check_hand(path) if not finding.ok] == []


@pytest.mark.parametrize("name", ["allegro", "barrett", "franka"])
def test_findings_of_a_hand_of_the_package(name: str, golden: Golden) -> None:
    findings = check_hand(name)
    golden(f"hands/{name}", "\n".join(f"{f.ok} {f.name}: {f.text}" for f in findings))


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name if name == "franka" else in_second_tier(name) for name in hand_names()]
)
def test_every_hand_of_the_package_passes(name: str) -> None:
    reported: list[Finding] = []
    findings = check_hand(name, report=reported.append)
    assert [finding.text for finding in findings if not finding.ok] == []
    assert reported == findings
    assert [finding.name for finding in findings[-2:]] == ["cylinder, level", "sphere, level"]


def test_a_ball_is_left_out_if_the_fingers_stand_wider_than_it() -> None:
    found = check_grasp(load_hand("allegro_four"), load_config(), "sphere")
    assert (found.ok, found.text) == (True, "left out: the fingers stand too wide for a ball")


@pytest.mark.sim
@pytest.mark.slow
def test_two_motors_that_push_against_each_other_hold_nothing_along_their_line(
    tmp_path: Path,
) -> None:
    """On a level line friction carries; on an upright one the stronger side gives way."""
    tree = copy_model(tmp_path, "franka") | {"drive": "torque"}
    for finger in tree["fingers"]:
        finger.pop("driven_by", None)
        finger["force_limit"] = 70.0
    path = tmp_path / "mine_hand.yaml"
    path.write_text(yaml.safe_dump(tree))
    hand = load_hand(path)
    level, upright = (
        check_grasp(hand, load_config(), "box", line) for line in ("level", "upright")
    )
    assert level.ok, level.text
    assert not upright.ok, upright.text
    assert "two motors that push against each other do not hold along their line" in upright.text


@pytest.mark.sim
@pytest.mark.slow
def test_slip_of_fingers_that_are_pushed_open_is_told() -> None:
    finding = check_grasp(load_hand("allegro"), load_config(overrides=["lift.drive=torque"]), "box")
    assert finding.ok
    locked, own = finding.text.split(" with fingers that are locked, ")
    assert "slips by 0.1" in locked
    assert own.startswith("and slips by 6.")
    assert own.endswith("with fingers that motors of its own strength keep closed")


@pytest.mark.parametrize(
    ("outcome", "turn_deg", "ok"),
    [
        (Outcome.SUCCESS, 9.0, True),
        (Outcome.SUCCESS, 11.0, False),
        (Outcome.DROPPED, 9.0, False),
    ],
)
def test_trial_grasps_are_lifted_to_their_end(monkeypatch, outcome, turn_deg, ok) -> None:
    """The one with locked fingers and the one with its own; a sample may turn by 10 degrees."""
    configs = []

    def hold(scene, X_TO, attempt, config):
        configs.append(config)
        still = SimpleNamespace(slip=0.0, turn=np.deg2rad(turn_deg))
        return TrialRecord(outcome=outcome, X_TO=X_TO, X_OG=attempt.X_OG, lift=still)

    module = "drakegrasp.hand_setup"
    monkeypatch.setattr(f"{module}.build_scene", lambda *_: None)
    monkeypatch.setattr(f"{module}.run_attempt", hold)
    config = load_config(overrides=["lift.drive=torque", "lift.stop_when=lost_sample"])
    assert check_grasp(load_hand("allegro"), config, "box").ok == ok
    assert [each.lift.drive for each in configs][:2] == ["locked", "torque" if ok else "locked"]
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


PAGE = PATH.read_text()


@pytest.fixture
def tongs(tmp_path: Path) -> Path:
    """The files of the page."""
    return write_tongs(tmp_path)


@pytest.mark.sim
@pytest.mark.slow
@needs_egl
def test_the_tutorial_hand_passes_every_check_of_the_page(tongs: Path) -> None:
    picture = tongs.parent / "tongs.png"
    result = run("hand", "check", str(tongs), "--picture", str(picture))
    assert result.exit_code == 0, result.output
    lines = [line.split(None, 1)[1] for line in result.output.splitlines()[:-1]]
    assert lines[0] == "files                2 fingers, 4 joints, 5 shapes in tongs.urdf"
    table = PAGE[PAGE.index("| check | what") : PAGE.index("The picture shows the hand")]
    names = re.findall(r"^\| ([a-z].*?) \|", table, re.MULTILINE)[1:]
    assert [re.split(r"  +", line)[0] for line in lines] == [*names[:-1], *map(", ".join, GRASPS)]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_fault_ends_the_command_with_one(tongs: Path) -> None:
    tongs.write_text(tongs.read_text().replace("left_tip ", "left_nail "))
    result = run("hand", "check", str(tongs))
    assert result.exit_code == 1
    assert result.output.startswith("FAIL  files")


def test_the_page_has_every_key_of_a_hand_file() -> None:
    """And no other."""
    rows = re.findall(r"^\| (`[^|]*) \|", PAGE[: PAGE.index("## 3.")], re.MULTILINE)
    named = {key.split(".")[0] for row in rows for key in re.findall(r"`([\w.\[\]]+)`", row)}
    fingers = {
        key
        for row in rows
        if "fingers[]" in row
        for key in re.findall(r"`(?:fingers\[\]\.)?(\w+)`", row)
    }
    top = {key for key in named if "[" not in key} - fingers
    assert top == set(HandFile.model_fields)
    assert fingers == set(Finger.__dataclass_fields__)
    assert all(key in PAGE for key in (*Coupling.__dataclass_fields__, *Spread.model_fields))
    assert all(f"palm.{key}" in PAGE for key in Palm.model_fields)
