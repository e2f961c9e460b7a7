"""Sound hands pass; a spoilt copy of one fails with a message that names what is wrong."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.hands import write_tongs

from drakegrasp.commissioning.finding import Finding
from drakegrasp.commissioning.model_checks import check_masses
from drakegrasp.commissioning.run import check_hand
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.files import MODELS, hand_names
from drakegrasp.verification.wrist_problem import hand_constants


def copied(folder: Path, name: str = "barrett") -> Path:
    """Copy a hand's files, and return the hand file of the copy."""
    for source in MODELS.glob(f"{name}_*"):
        shutil.copy(source, folder)
    return folder / f"{name}_hand.yaml"


def changed(suffix: str, old: str, new: str, count: int = 1) -> Callable[[Path], None]:
    """Return a change of a text in the hand file, or in the model."""

    def change(path: Path) -> None:
        path = path.with_suffix(suffix)
        text = path.read_text()
        assert text.count(old) >= count
        path.write_text(text.replace(old, new, count))

    return change


def swap_fingers(path: Path) -> None:
    """Exchange the first two fingers of a hand file."""
    head, first, second, rest = re.split(r"(?=  - name: )", path.read_text(), maxsplit=3)
    path.write_text(head + second + first + rest)


def remove_mesh(path: Path) -> None:
    (path.parent / "barrett_distal.obj").unlink()


RATIO = "ratio: 0.333333333333"
REGION = "pad_region: [[1, 0, 0, 0.018], [0.085, 1, 0, 0.00153]]"
POINT = "pad_point: [0.052, 0.0063, 0.0]"
PALM_SHAPE = (
    '    <collision><origin xyz="0 0 -0.015"/><geometry><box size="0.06 0.14 0.03"/></geometry>'
    "</collision>\n"
)
SPREAD_AXIS = "<child>finger2_spread</child>\n      <axis>\n        <xyz>0 0 1</xyz>"
MIMIC = "<mimic joint='{}'><multiplier>{}</multiplier></mimic>"
#: The hand, what spoils it, which check fails, and what it says.
FAULTS: dict[str, tuple[str, Callable[[Path], None], str, str]] = {
    "missing fingertip": (
        "barrett",
        changed(".yaml", "fingertip: finger1_distal", "fingertip: finger1_nail"),
        "files",
        r"fingers\.0\.fingertip: must be a link of the model .* got 'finger1_nail'",
    ),
    "palm axis into the hand": (
        "barrett",
        changed(".yaml", "rpy_deg: [0.0, 0.0, 0.0]", "rpy_deg: [180.0, 0.0, 0.0]"),
        "palm",
        r"the palm ray along \+Gz must be free, got link 'base' .* check palm\.p_BG and "
        r"palm\.rpy_deg; \+Gz must point to where the fingertips close",
    ),
    "palm buried": (
        "barrett",
        changed(".yaml", "p_BG: [0.0, 0.0, 0.07795]", "p_BG: [0.0, 0.0, 0.05]"),
        "palm",
        r"the palm ray along \+Gz must be free, got link 'base' up to 29 mm",
    ),
    "joint without limit": (
        "barrett",
        changed(".sdf", "<lower>0</lower><upper>2.443460953</upper>", ""),
        "limits",
        r"joint 'finger1_proximal_joint' must have limits, got -inf\.\.inf",
    ),
    "mirrored finger order": (
        "barrett",
        swap_fingers,
        "finger order",
        r"fingers must run counter-clockwise about \+Gz \(F2, F3, F1\), got F2, F1, F3",
    ),
    "zero mass": (
        "barrett",
        changed(".sdf", "<mass>0.04166</mass>", "<mass>0</mass>"),
        "masses",
        r"link 'finger1_distal' must have a mass above 0 kg, got 0",
    ),
    "missing mesh": (
        "barrett",
        remove_mesh,
        "files",
        r"model: .*barrett_distal\.obj",
    ),
    "wrong sign of a ratio that limits catch": (
        "barrett",
        changed(".yaml", RATIO, RATIO.replace("0.3", "-0.3")),
        "limits",
        r"finger 'F1' must be able to close, but limits of its coupled joints "
        r"\(finger1_distal_joint by -0\.333333\) leave .*: check the signs of the ratios",
    ),
    "offset that opens too far": (
        "barrett",
        changed(".yaml", RATIO, f"{RATIO}, offset: -0.2"),
        "limits",
        r"finger 'F1' must be open at 0, but with their offsets \(finger1_distal_joint by -0\.2\) "
        r"limits of its coupled joints leave 0\.6\.\.",
    ),
    "wrong sign of a ratio that limits allow": (
        "allegro",
        changed(".yaml", "index_pip_joint, ratio: 1.0", "index_pip_joint, ratio: -1.0"),
        "fingertips",
        r"got that of index \d+ mm short; it does with the other sign of "
        r"fingers\.0\.coupled\.0\.ratio \(index_pip_joint -1\)",
    ),
    "pad region off the surface": (
        "barrett",
        changed(".yaml", f"{REGION}\n    {POINT}", POINT.replace("0.052", "0.09").replace(
            "pad_point", "pad_region: [[1, 0, 0, 0.07]]\n    pad_point")),
        "files",
        r"fingers\.0\.pad_region: must hold a part of the surface of link 'finger1_distal'",
    ),
    "pad point off the surface": (
        "barrett",
        changed(".yaml", POINT, POINT.replace("0.0063", "0.02")),
        "pads",
        r"fingers\.0\.pad_point must lie on the surface of link 'finger1_distal', got one 11",
    ),
    "pad on the back": (
        "barrett",
        changed(".yaml", f"{REGION}\n    {POINT}",
                "pad_region: [[0, -1, 0, 0]]\n    pad_point: [0.03, -0.0065, 0.0]"),
        "pads",
        r"the pad of finger 'F1' must face where the finger closes",
    ),
    "too slow for its motor": (
        "barrett",
        changed(".yaml", "closing_speed_deg: 60.0", "closing_speed_deg: 10.0"),
        "efforts",
        r"finger 'F3' must close fast enough for its motor: .* 3\.49 of 4 N m; .* close\.max_time",
    ),
    "payload beyond its strength": (
        "barrett",
        changed(".yaml", "payload: 2.5", "payload: 4.99"),
        "efforts",
        r"payload must be at most 4\.987 kg, which friction carries, got 4\.99 kg",
    ),
    "palm without a shape": (
        "tongs",
        changed(".urdf", PALM_SHAPE, ""),
        "palm",
        r"link 'palm', or one that is fixed to it, must have a collision shape, got none",
    ),
    "spread joints that the model turns against each other": (
        "barrett",
        changed(".sdf", SPREAD_AXIS, SPREAD_AXIS + MIMIC.format("finger1_spread_joint", -1.0)),
        "couplings",
        r"joint 'finger2_spread_joint' must be coupled to 'finger1_spread_joint' by -1 and 0, as",
    ),
    "finger that opens": (
        "franka",
        changed(".urdf", '<axis xyz="0 1 0"/>', '<axis xyz="0 -1 0"/>'),
        "pads",
        r"the pad of finger 'right' must face where the finger closes, got its back",
    ),
    "another coupling in the model": (
        "allegro",
        changed(".sdf", "<xyz>0 1 0</xyz>\n        <limit><lower>-0.174",
                '<xyz>0 1 0</xyz><mimic joint="index_mcp_joint"><multiplier>-1</multiplier>'
                "<offset>0.2</offset><reference>0</reference></mimic>\n"
                "        <limit><lower>-0.174"),
        "couplings",
        r"joint 'index_pip_joint' must follow 'index_mcp_joint' by -1 and 0\.2 as in the model, "
        r"got 'index_mcp_joint' by 1 and 0\.2",
    ),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_spoilt_hand_fails_with_a_message_that_names_the_fault(
    tmp_path: Path, fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No other check fails, and none of these needs a simulation to be seen."""
    monkeypatch.setattr("drakegrasp.commissioning.run.GRASPS", ())
    name, spoil, check, message = FAULTS[fault]
    path = write_tongs(tmp_path) if name == "tongs" else copied(tmp_path, name)
    spoil(path if name != "tongs" else tmp_path / "tongs.yaml")
    findings = check_hand(path)
    failed = [finding for finding in findings if not finding.ok]
    assert [finding.name for finding in failed] == [check]
    assert re.search(message, failed[0].text), failed[0].text
    assert "\n" not in failed[0].text


#: A link that is fixed to the palm, below or above it in the model, with a shape or without.
FIXED = """  <link name="{0}"><inertial><mass value="0.1"/>
    <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="{3}"/><geometry><box size="0.06 0.14 0.03"/></geometry></collision>
  </link>
  <joint name="{0}_fixed" type="fixed"><parent link="{1}"/><child link="{2}"/></joint>
</robot>"""
SHELL = FIXED.format("shell", "palm", "shell", "0 0 -0.015")
MOUNT = FIXED.format("mount", "mount", "palm", "0 0.05 0.015")
#: What a sound hand may have: the hand, and changes of its files.
SOUND: dict[str, tuple[str, tuple[Callable[[Path], None], ...]]] = {
    "shape of the palm on a link that is fixed to it": (
        "tongs",
        (changed(".urdf", PALM_SHAPE, ""), changed(".urdf", "</robot>", SHELL)),
    ),
    "link above the palm, among the fingers": ("tongs", (changed(".urdf", "</robot>", MOUNT),)),
    "spread joints that the model turns together": (
        "barrett",
        (changed(".sdf", SPREAD_AXIS, SPREAD_AXIS + MIMIC.format("finger1_spread_joint", 1.0)),),
    ),
    "joints of the preshape that the model ties": (
        "allegro",
        (
            changed(
                ".sdf",
                "<child>ring_roll</child>\n      <axis>\n",
                "<child>ring_roll</child>\n      <axis>\n" + MIMIC.format("middle_roll_joint", 1.0),
            ),
        ),
    ),
}


@pytest.mark.parametrize("change", SOUND)
def test_a_sound_hand_passes_whatever_else_its_model_has(
    tmp_path: Path, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drakegrasp.commissioning.run.GRASPS", ())
    name, changes = SOUND[change]
    path = write_tongs(tmp_path) if name == "tongs" else copied(tmp_path, name)
    for edit in changes:
        edit(path if name != "tongs" else tmp_path / "tongs.yaml")
    assert [finding.text for finding in check_hand(path) if not finding.ok] == []
    # What is checked can be used.
    hand = load_hand(path)
    assert len(hand_constants(hand).palm) == 8 or name != "tongs"


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("name", hand_names())
def test_every_hand_of_the_package_passes(name: str) -> None:
    reported: list[Finding] = []
    findings = check_hand(name, report=reported.append)
    assert [finding.text for finding in findings if not finding.ok] == []
    assert reported == findings
    assert [finding.name for finding in findings[-2:]] == [
        "cylinder, level",
        "sphere, level",
    ]


@pytest.mark.parametrize(
    ("moments", "said"),
    [
        ('ixx="1e-3" iyy="1e-6" izz="1e-6"', "principal moments 1e-06, 1e-06, 0.001"),
        ('ixx="0" iyy="0" izz="0"', "got 0"),
    ],
)
def test_an_inertia_that_no_body_has_fails_the_check_of_masses(
    tmp_path: Path, moments: str, said: str
) -> None:
    """Drake would replace it without a word."""
    path = copied(tmp_path, "franka")
    model = tmp_path / "franka_hand.urdf"
    inertia = f'<inertia {moments} ixy="0" ixz="0" iyz="0"/>'
    text, count = re.subn("<inertia .*?/>", inertia, model.read_text(), count=1)
    assert count == 1
    model.write_text(text)
    finding = check_masses(load_hand(path))
    assert not finding.ok
    assert said in finding.text
    assert check_masses(load_hand("franka")).ok
