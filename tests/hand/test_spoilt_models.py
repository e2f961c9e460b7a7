"""Spoilt models of hands: each is refused in one line that names the fault."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from helpers.vendors import JAWS, JAWS_MJCF, fixed, link, write_model

from drakegrasp.cli.main import main
from drakegrasp.errors import HandError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.parsing import read_model
from drakegrasp.hand.draft.source import read_source
from drakegrasp.hand.files import MODELS
from drakegrasp.hand.shapes import link_shapes

MIMIC = '<mimic joint="left_slide"/>'
JAW = '<geometry><box size="0.02 0.012 0.06"/></geometry>'
EMPTY = '<model name="{}"><link name="x"/></model>'
BOMB = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>'


def changed(old: str, new: str, *, text: str = JAWS, count: int = -1) -> str:
    assert old in text
    return text.replace(old, new, count)


def mesh(uri: str) -> str:
    return changed(JAW, f'<geometry><mesh filename="{uri}"/></geometry>', count=1)


#: A model, the name of its file, and what is said of it.
SPOILT: dict[str, tuple[str, str, str]] = {
    "not XML": ("<robot", "hand.urdf", "must be XML, got text that is not"),
    "empty": ("", "hand.urdf", "must be XML, got text that is not"),
    "another language": ("<html/>", "hand.urdf", "must be a model in URDF, SDFormat or MJCF"),
    "xacro": (JAWS, "hand.xacro", "must be URDF, got xacro: run `xacro hand.xacro"),
    "another suffix": (JAWS, "hand.step", r"must end in \.urdf, \.sdf or \.xml"),
    "XML bomb": (BOMB + changed('name="jaws"', 'name="&b;"'), "hand.urdf", "document type"),
    "deep": ("<robot>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>", "hand.urdf", "200 levels"),
    "missing mesh": (mesh("lost.stl"), "hand.urdf", "lost.stl' must be a file, got none"),
    "mesh of the web": (mesh("https://x.org/a.stl"), "hand.urdf", "nothing is fetched"),
    "mesh of another format": (mesh("jaw.step"), "hand.urdf", r"one of \.obj, .* got '\.step'"),
    "broken mesh": (mesh("broken.glb"), "hand.urdf", "broken.glb' must be readable, got"),
    "loop": (
        changed("</robot>", fixed("bridge", "right_jaw", "left_jaw") + "</robot>"),
        "hand.urdf",
        "link 'left_jaw'|loop",
    ),
    "links in a circle": (
        changed("</robot>", fixed("bridge", "left_jaw", "mount") + "</robot>"),
        "hand.urdf",
        "one tree of links|loop",
    ),
    "two trees": (
        changed("</robot>", link("other", 0.1, JAW) + "</robot>"),
        "hand.urdf",
        r"must be one tree of links, with one root, got 2 \(.*other\)",
    ),
    "negative mass": (
        changed('<mass value="0.05"/>', '<mass value="-0.05"/>', count=1),
        "hand.urdf",
        "link 'left_jaw' must have a mass of 0 kg or more, got -0.05",
    ),
    "mass that is no number": (
        changed('<mass value="0.05"/>', '<mass value="heavy"/>', count=1),
        "hand.urdf",
        "mass of link 'left_jaw' must be a number, got 'heavy'",
    ),
    "units in mm": (
        changed(JAW, '<geometry><box size="20 12 60"/></geometry>'),
        "hand.urdf",
        "must be a hand in metres, got one of 6[0-9] m",
    ),
    "circle of mimics": (
        changed(
            '<limit lower="0" upper="0.05" effort="60" velocity="1"/></joint>',
            '<limit lower="0" upper="0.05" effort="60" velocity="1"/>'
            '<mimic joint="right_slide"/></joint>',
            count=1,
        ),
        "hand.urdf",
        "joint '(left|right)_slide' must follow a joint that leads, got a circle of mimics",
    ),
    "mimic of nothing": (
        changed(MIMIC, '<mimic joint="thumb"/>'),
        "hand.urdf",
        "thumb",
    ),
    "no shapes": (
        re.sub(r"<(collision|visual)>.*?</\1>", "", JAWS),
        "hand.urdf",
        "must have shapes, got links without any",
    ),
    "joint that floats": (
        changed(MIMIC, "").replace(
            'name="right_slide" type="prismatic"', 'name="right_slide" type="planar"'
        ),
        "hand.urdf",
        "joint 'right_slide' must be revolute, prismatic or fixed",
    ),
    "limits the wrong way": (
        changed('lower="0" upper="0.05"', 'lower="0.05" upper="0"', count=1),
        "hand.urdf",
        "lower|limit",
    ),
    "effort of a placeholder": (
        changed('effort="60"', 'effort="0"'),
        "hand.urdf",
        r"the effort of joint '\w+_slide' must be .* N, got none in the model: .* --effort N",
    ),
    "one finger": (
        re.sub(r'<link name="right_jaw">.*?</link>\n', "", JAWS, flags=re.DOTALL).replace(
            JAWS[JAWS.index('<joint name="right_slide"') : JAWS.index('<joint name="left_end_')],
            "",
        ),
        "hand.urdf",
        r"must have two fingers or more, got one chain of links: .* --palm LINK",
    ),
    "includes itself": (
        changed("<worldbody>", '<include file="hand.xml"/><worldbody>', text=JAWS_MJCF),
        "hand.xml",
        "got a loop of them",
    ),
    "curve in place of a line": (
        changed('"0 1 0 0 0"', '"0 1 2 0 0"', text=JAWS_MJCF),
        "hand.xml",
        "polycoef of joint 'right_slide' must be a line, got a curve",
    ),
    "shape of a light second": (
        changed("0 0.006 0.03", "0 0.006 4294967295", text=JAWS_MJCF, count=1),
        "hand.xml",
        r"must be a hand in metres, got a shape that reaches 4\.29e\+09 m from its link",
    ),
    "mass without a value": (
        changed('<mass value="0.05"/>', '<mass value="nan"/>', count=1),
        "hand.urdf",
        "mass of link 'left_jaw' must be a number, got 'nan'",
    ),
    "effort that is no number": (
        changed('effort="60"', 'effort="strong"', count=1),
        "hand.urdf",
        "effort of joint 'left_slide' must be a number, got 'strong'",
    ),
    "multiplier that is no number": (
        changed(MIMIC, '<mimic joint="left_slide" multiplier="twice"/>'),
        "hand.urdf",
        "multiplier of joint 'right_slide' must be a number, got 'twice'",
    ),
    "mimic without motion": (
        changed(MIMIC, '<mimic joint="left_slide" multiplier="0"/>'),
        "hand.urdf",
        "joint 'right_slide' must follow 'left_slide' by a ratio, got 0",
    ),
    "equality with nothing": (
        changed('joint2="left_slide"', 'joint2="lost"', text=JAWS_MJCF),
        "hand.xml",
        "must be MJCF that MuJoCo reads, got .*unknown element 'lost' in equality",
    ),
    "axis of no length": (
        changed('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', count=1),
        "hand.urdf",
        "'left_slide' axis is zero",
    ),
    "origin that is no number": (
        changed('xyz="0 0 0.1"', 'xyz="0 0 nan"'),
        "hand.urdf",
        "xyz of joint '\\w+' must be a number, got '0 0 nan'",
    ),
    "size below zero": (
        changed(JAW, '<geometry><box size="-0.02 0.012 0.06"/></geometry>', count=1),
        "hand.urdf",
        "width = -0.02",
    ),
    "missing link": (
        changed('<child link="left_jaw"/>', '<child link="lost"/>'),
        "hand.urdf",
        "Could not find link named 'lost'",
    ),
    "link without a name": (
        changed('<link name="left_end"/>', "<link/>"),
        "hand.urdf",
        "link tag is missing name attribute",
    ),
    "two links of a name": (
        changed("</robot>", link("left_jaw", 0.1, JAW) + "</robot>"),
        "hand.urdf",
        "already contains a body named 'left_jaw'",
    ),
    "link that carries itself": (
        changed(
            '<parent link="body"/><child link="left_jaw"/>',
            '<parent link="left_jaw"/><child link="left_jaw"/>',
        ),
        "hand.urdf",
        "connect body left_jaw to itself",
    ),
    "joints without limits": (
        changed('<limit lower="0" upper="0.05" effort="60" velocity="1"/>', ""),
        "hand.urdf",
        "no fingers of left_jaw, right_jaw close against each other: .* --reverse JOINT",
    ),
    "joint without a range": (
        changed('upper="0.05"', 'upper="0"'),
        "hand.urdf",
        "must have two fingers that can close from the palm 'body', got 0: .* --fingers",
    ),
    "no joints": (
        f'<robot name="block">{link("body", 0.5, JAW)}</robot>',
        "hand.urdf",
        r"must have two fingers or more, got one chain of links: .* --palm LINK \(body\)",
    ),
    "mesh outside": (
        mesh("../broken.glb"),
        "hand.urdf",
        "'../broken.glb' must lie in the model's folder, got .* --root FOLDER",
    ),
    "mesh of an unknown package": (
        mesh("package://other/jaw.stl"),
        "hand.urdf",
        "must lie in a known package: .* --package other=FOLDER",
    ),
    "mesh without triangles": (
        mesh("empty.obj"),
        "hand.urdf",
        "'empty.obj' must hold triangles with finite corners",
    ),
    "mesh of no name": (mesh(""), "hand.urdf", r"must be one of \.obj, .* got ''"),
    "missing mesh of MJCF": (
        '<mujoco><asset><mesh file="lost.stl"/></asset></mujoco>',
        "hand.xml",
        "lost.stl' must be a file, got none",
    ),
    "two models": (
        f'<sdf version="1.7">{"".join(map(EMPTY.format, "ab"))}</sdf>',
        "hand.sdf",
        "can only contain one model",
    ),
    "other files": (
        '<sdf version="1.7"><model name="a"><include><uri>model://b</uri></include></model></sdf>',
        "hand.sdf",
        "must be complete by itself, got <include>",
    ),
    "xacro's call": (
        changed("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"').replace(
            "</robot>", '<xacro:finger prefix="x_"/></robot>'
        ),
        "hand.urdf",
        "in which xacro left nothing to expand, got '<finger>'",
    ),
    "xacro's argument": (
        changed("</robot>", "<gazebo><p>$(find hand)/x</p></gazebo></robot>"),
        "hand.urdf",
        r"in which xacro left nothing to expand, got '\$\(find hand\)/x'",
    ),
    "frame that holds a joint": (
        re.sub("(<joint name=.*?/>)", r"<frame>\1</frame>", JAWS_MJCF, count=1),
        "hand.xml",
        "<joint> must lie in a body, got it in a <frame>",
    ),
    "bodies that are not written out": (
        changed("</worldbody>", '<replicate count="9"/></worldbody>', text=JAWS_MJCF),
        "hand.xml",
        "must have its bodies written out, got <replicate>",
    ),
    "equality with a constant": (
        changed('joint2="left_slide" ', "", text=JAWS_MJCF),
        "hand.xml",
        "joint 'right_slide' must follow a joint, got an equality with a constant",
    ),
    "inertia of no body in MJCF": (
        changed(
            '<body name="left_jaw">',
            '<body name="left_jaw"><inertial pos="0 0 0" mass="1" diaginertia="1 1e-3 1e-3"/>',
            text=JAWS_MJCF,
        ),
        "hand.xml",
        "must be MJCF that MuJoCo reads, got .*inertia must satisfy A",
    ),
    "bytes": ("\x00\x01\x02", "hand.urdf", "must be XML, got text that is not"),
}


@pytest.mark.parametrize("fault", SPOILT)
def test_a_spoilt_model_is_refused_in_one_line(tmp_path: Path, fault: str) -> None:
    """Nothing is left behind."""
    text, name, message = SPOILT[fault]
    path = write_model(tmp_path, text, name)
    (tmp_path / "broken.glb").write_bytes(bytes(range(256)))
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    out = tmp_path / "out"
    result = CliRunner().invoke(main, ["hand", "new", str(path), "--out", str(out)])
    assert result.exit_code == 2, result.output
    assert len(result.output.strip().splitlines()) == 1, result.output
    assert re.search(message, result.output), result.output
    assert not out.exists()


@pytest.mark.parametrize("word", ["0,05", "0.05m", "nan", "", "0x1", "0_1"])
@pytest.mark.parametrize(
    ("name", "text", "old", "new"),
    [
        ("hand.urdf", JAWS, 'upper="0.05"', 'upper="{}"'),
        ("hand.urdf", JAWS, 'xyz="0 1 0"', 'xyz="{} {} {}"'),
        ("hand.urdf", JAWS, 'ixx="1e-4"', 'ixx="{}"'),
        ("hand.urdf", JAWS, MIMIC, '<mimic joint="left_slide" multiplier="{}"/>'),
        ("hand.xml", JAWS_MJCF, 'range="0 0.05"', 'range="{} {}"'),
        ("hand.xml", JAWS_MJCF, 'mass="0.05"', 'mass="{}"'),
    ],
)
def test_what_is_no_number_is_refused(
    tmp_path: Path, name: str, text: str, old: str, new: str, word: str
) -> None:
    """Parsers read its start, or nothing."""
    path = write_model(tmp_path, changed(old, new.replace("{}", word), text=text, count=1), name)
    with pytest.raises(HandError, match=r"must be a number, got|does not have enough data"):
        read_model(read_source(path, {}))


def test_a_sound_model_is_not_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the faults were planted in."""
    drawn: list[Callable[..., None]] = []
    monkeypatch.setattr("drakegrasp.commissioning.draft.run.GRASPS", ())
    monkeypatch.setattr("drakegrasp.cli.hand._draw", lambda *files: drawn.append(files))
    for n, (text, name) in enumerate(((JAWS, "hand.urdf"), (JAWS_MJCF, "hand.xml"))):
        path, out = write_model(tmp_path / str(n), text, name), tmp_path / f"out{n}"
        result = CliRunner().invoke(main, ["hand", "new", str(path), "--out", str(out)])
        assert result.exit_code == 0, result.output
        assert len(list(out.glob("*.urdf"))) == 1
    assert len(drawn) == 2


def test_fault_of_an_sdformat_file_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("allegro_hand.sdf", "allegro_hand.yaml", "allegro_fingertip.obj"):
        shutil.copyfile(MODELS / name, tmp_path / name)
    model = tmp_path / "allegro_hand.sdf"
    model.write_text(model.read_text().replace("<pose>0 ", "<pose>", 1))
    with pytest.raises(HandError, match="Error reading element <pose>"):
        load_hand(tmp_path / "allegro_hand.yaml")
    with pytest.raises(HandError, match="Error reading element <pose>"):
        read_model(read_source(model, {}))
    assert caplog.text == ""


def test_pipe_in_place_of_a_model_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "hand.urdf")
    with pytest.raises(HandError, match=r"hand\.urdf: must be a readable file, got: a pipe"):
        read_source(tmp_path / "hand.urdf", {})


@pytest.mark.parametrize(
    ("hand", "name", "spoil", "said"),
    [
        (
            "barrett",
            "barrett_palm_plate.obj",
            lambda text: re.sub(r"(?m)^v \S+", "v 26.5", text, count=1),
            r"within 3 m of it, got one that reaches 26\.5 m",
        ),
        (
            "franka",
            "franka_hand.urdf",
            lambda text: re.sub(r'<box size="\S+', '<box size="-0.5', text, count=1),
            r"must be a file of one model, got .*width = -0\.5",
        ),
        ("barrett", "barrett_palm_plate.obj", None, "plate.obj: must be a file, got a pipe, a s"),
    ],
)
def test_spoilt_file_of_a_hand_is_refused(
    tmp_path: Path, hand: str, name: str, spoil: Callable[[str], str] | None, said: str
) -> None:
    for path in MODELS.glob(f"{hand}_*"):
        shutil.copyfile(path, tmp_path / path.name)
    text = (tmp_path / name).read_text()
    (tmp_path / name).unlink()
    if spoil is None:
        (tmp_path / name).symlink_to("/dev/zero")
    else:
        (tmp_path / name).write_text(spoil(text))
    with pytest.raises(HandError, match=said):
        link_shapes(load_hand(tmp_path / f"{hand}_hand.yaml"))
