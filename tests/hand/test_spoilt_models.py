"""Spoilt models of hands: each is refused in one line that names the fault."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.vendors import JAWS, JAWS_MJCF, fixed, link, write_model

from drakegrasp.errors import HandError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.shapes import link_shapes

MIMIC = '<mimic joint="left_slide"/>'
JAW = '<geometry><box size="0.02 0.012 0.06"/></geometry>'
LIMIT = '<limit lower="0" upper="0.05" effort="60" velocity="1"/>'
MASS = '<mass value="0.05"/>'
EMPTY = '<model name="{}"><link name="x"/></model>'
RIGHT = JAWS[JAWS.index('<joint name="right_slide"') : JAWS.index('<joint name="left_end_')]
FILE = '<geometry><mesh filename="{}"/></geometry>'
# fmt: off
#: Of a file of its own: its text, its name, and what is said of it.
FILES = {
    "not XML": ("<robot", "hand.urdf", "must be XML, got text that is not"),
    "another language": ("<html/>", "hand.urdf", "does not contain a robot tag"),
    "xacro": (JAWS, "hand.xacro", "must be URDF, got xacro: run `xacro hand.xacro"),
    "another suffix": (JAWS, "hand.step", r"must end in \.urdf, \.sdf or \.xml"),
    "XML bomb": ('<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>'
                 + JAWS.replace('name="jaws"', 'name="&b;"'), "hand.urdf", "document type"),
    "deep": ("<robot>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>", "hand.urdf", "DEPTH_EXCEEDED"),
    "no shapes": (re.sub(r"<(collision|visual)>.*?</\1>", "", JAWS), "hand.urdf",
                  "must have shapes, got links without any"),
    "one finger": (re.sub(r'<link name="right_jaw">.*?</link>\n', "", JAWS, flags=re.DOTALL)
                   .replace(RIGHT, ""), "hand.urdf",
                   r"must have two fingers or more, got one chain of links: .* --palm LINK"),
    "joint that floats": (
        re.sub('(right_slide" type=")prismatic', r"\1planar", JAWS.replace(MIMIC, "")),
        "hand.urdf", "joint 'right_slide' must be revolute, prismatic or fixed"),
    "no joints": (f'<robot name="block">{link("body", 0.5, JAW)}</robot>', "hand.urdf",
                  r"must have two fingers or more, got one chain .* --palm LINK \(body\)"),
    "two models": (f'<sdf version="1.7">{"".join(map(EMPTY.format, "ab"))}</sdf>', "hand.sdf",
                   "can only contain one model"),
    "other files": ('<sdf version="1.7"><model name="a"><include><uri>model://b</uri></include>'
                    "</model></sdf>", "hand.sdf", "must be complete by itself, got '<include'"),
    "missing mesh of MJCF": ('<mujoco><asset><mesh file="lost.stl"/></asset></mujoco>', "hand.xml",
                             "lost.stl: must be a readable file, got: No such file"),
}
#: Of the jaws in URDF: what is replaced, how often (-1: everywhere), and what is said of it.
URDF = {
    "missing mesh": (JAW, FILE.format("lost.stl"), 1, "lost.stl: must be a readable file, got"),
    "mesh of the web": (JAW, FILE.format("https://x.org/a.stl"), 1, "nothing is fetched"),
    "mesh of another format": (JAW, FILE.format("jaw.step"), 1, r"must be one of .* '\.step'"),
    "mesh of glTF": (JAW, FILE.format("tip.gltf"), 1, r"gltf: must be one of .* '\.gltf'"),
    "mesh of no name": (JAW, FILE.format(""), 1, "must be a readable file, got: a folder"),
    "broken mesh": (JAW, FILE.format("broken.glb"), 1, "mesh broken.glb: must be a valid .glb"),
    "mesh without triangles": (JAW, FILE.format("empty.obj"), 1,
                               "mesh empty.obj: must hold triangles, got no faces"),
    "mesh of an unknown package": (JAW, FILE.format("package://other/jaw.stl"), 1,
                                   "must lie in a known package: .* --package other=FOLDER"),
    "loop": ("</robot>", fixed("bridge", "right_jaw", "left_jaw") + "</robot>", -1,
             "link 'left_jaw'|loop"),
    "links in a circle": ("</robot>", fixed("bridge", "left_jaw", "mount") + "</robot>", -1,
                          "one tree of links|loop"),
    "two trees": ("</robot>", link("other", 0.1, JAW) + "</robot>", -1,
                  r"must be one tree of links, with one root, got 2 \(.*other\)"),
    "negative mass": (MASS, '<mass value="-0.05"/>', 1,
                      "link 'left_jaw' must have a mass of 0 kg or more, got -0.05"),
    "units in mm": (JAW, '<geometry><box size="20 12 60"/></geometry>', -1,
                    "must be a hand in metres, got one of 6[0-9] m"),
    "circle of mimics": (f"{LIMIT}</joint>", f'{LIMIT}<mimic joint="right_slide"/></joint>', 1,
                         "joint '(left|right)_slide' must follow a joint that leads, got a circle"),
    "mimic of nothing": (MIMIC, '<mimic joint="thumb"/>', -1,
                         "'right_slide' must follow a joint that moves, got 'thumb'"),
    "mimic without motion": (MIMIC, '<mimic joint="left_slide" multiplier="0"/>', -1,
                             "joint 'right_slide' must follow 'left_slide' by a ratio, got 0"),
    "multiplier that is no number": (
        MIMIC, '<mimic joint="left_slide" multiplier="twice"/>', -1,
        "multiplier of a mimic must be a number, got 'twice'"),
    "limits the wrong way": ('lower="0" upper="0.05"', 'lower="0.05" upper="0"', 1,
                             r"must have a lower limit below its upper one, got 0.05\.\.0"),
    "joints without limits": (LIMIT, "", -1, "must have two fingers that can close from .*, got 0"),
    "joint without a range": ('upper="0.05"', 'upper="0"', -1,
                              "must have two fingers that can close from .*, got 0: .* --fingers"),
    "effort of a placeholder": ('effort="60"', 'effort="0"', -1,
                                r"the effort of joint '\w+_slide' must be .* --effort N"),
    "xacro's call": (">\n", '><xacro:finger xmlns:xacro="http://ros.org/xacro"/>\n', 1,
                     "must be a model without xacro, got '<xacro:finger'"),
    "xacro's argument": ("</robot>", "<gazebo><p>$(find hand)/x</p></gazebo></robot>", -1,
                         r"must be a model without xacro, got '\$\(find hand\)/x'"),
}
#: And of the jaws in MJCF.
MJCF = {
    "includes itself": ("<worldbody>", '<include file="hand.xml"/><worldbody>', -1,
                        "must be MJCF that MuJoCo reads, got .*already included"),
    "curve in place of a line": ('"0 1 0 0 0"', '"0 1 2 0 0"', -1,
                                 "polycoef of joint 'right_slide' must be a line, got a curve"),
    "shape of a light second": ("0 0.006 0.03", "0 0.006 4294967295", 1,
                                r"must be a hand in metres, got one of 4\.29e\+09 m"),
    "equality with a constant": ('joint2="left_slide" ', "", -1,
                                 "joint 'right_slide' must follow a joint, got an equality with a"),
    "soft body": ("<equality>", '<deformable><flex name="f" dim="1" body="body left_jaw" '
                  'element="0 1"/></deformable><equality>', -1,
                  "must be of rigid bodies, got <flex>"),
    "ball joint": ("</body>\n  </body>", '<body name="b"><joint name="ball" type="ball"/><geom '
                   'size="0.01"/></body></body></body>', -1,
                   "joint 'ball' must be revolute, prismatic or fixed, got ball"),
    "two roots": ("</worldbody>", '<body name="table"><geom size="1"/></body></worldbody>', -1,
                  r"must be one tree of links, with one root, got 2 \(body, table\)"),
}
# fmt: on


def changed(text: str, old: str, new: str, count: int = -1) -> str:
    assert old in text
    return text.replace(old, new, count)


SPOILT = (
    FILES
    | {name: (changed(JAWS, *row[:3]), "hand.urdf", row[3]) for name, row in URDF.items()}
    | {name: (changed(JAWS_MJCF, *row[:3]), "hand.xml", row[3]) for name, row in MJCF.items()}
)


@pytest.mark.parametrize("fault", SPOILT)
def test_a_spoilt_model_is_refused_in_one_line(tmp_path: Path, fault: str) -> None:
    """Nothing is left behind."""
    text, name, message = SPOILT[fault]
    path = write_model(tmp_path, text, name)
    (tmp_path / "broken.glb").write_bytes(bytes(range(256)))
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    (tmp_path / "tip.gltf").write_text("{}")
    (tmp_path / "jaw.step").write_text("ISO-10303-21;")
    out = tmp_path / "out"
    result = run("hand", "new", str(path), "--out", str(out))
    assert result.exit_code == 2, result.output
    assert len(result.output.strip().splitlines()) == 1, result.output
    assert re.search(message, result.output), result.output
    assert not out.exists()


@pytest.mark.parametrize("word", ["0,05", "0.05m", "nan", "0_1"])
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
    """Drake reads the start of a single number, and MuJoCo its default."""
    path = write_model(tmp_path, changed(text, old, new.replace("{}", word), 1), name)
    with pytest.raises(HandError, match=r"must be a number|Expected|bad format|which is no number"):
        read_model(path)


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
        read_model(model)
    assert caplog.text == ""


def test_pipe_in_place_of_a_model_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "hand.urdf")
    with pytest.raises(HandError, match=r"hand\.urdf: must be a readable file, got: a pipe"):
        read_model(tmp_path / "hand.urdf")


@pytest.mark.parametrize(
    ("hand", "name", "spoil", "said"),
    [
        ("barrett", "barrett_palm_plate.obj", (r"(?m)^v \S+", "v 26.5"),
         r"within 3 m of it, got one that reaches 26\.5 m"),
        ("franka", "franka_hand.urdf", (r'<box size="\S+', '<box size="-0.5'),
         r"must be a file of one model, got .*width = -0\.5"),
        ("barrett", "barrett_palm_plate.obj", None, "plate.obj: must be a file, got a pipe, a s"),
    ],
)  # fmt: skip
def test_spoilt_file_of_a_hand_is_refused(
    tmp_path: Path, hand: str, name: str, spoil: tuple[str, str] | None, said: str
) -> None:
    for path in MODELS.glob(f"{hand}_*"):
        shutil.copyfile(path, tmp_path / path.name)
    text = (tmp_path / name).read_text()
    (tmp_path / name).unlink()
    if spoil is None:
        (tmp_path / name).symlink_to("/dev/zero")
    else:
        (tmp_path / name).write_text(re.sub(*spoil, text, count=1))
    with pytest.raises(HandError, match=said):
        link_shapes(load_hand(tmp_path / f"{hand}_hand.yaml").model)
