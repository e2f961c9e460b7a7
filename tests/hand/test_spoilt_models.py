"""Spoilt models of hands: each is refused in one line that names the fault."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.tables import table
from helpers.vendors import JAWS, JAWS_MJCF, link, write_model

from drakegrasp.errors import HandError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.shapes import link_shapes

MIMIC = '<mimic joint="left_slide"/>'
JAW = '<geometry><box size="0.02 0.012 0.06"/></geometry>'
EMPTY = '<model name="{}"><link name="x"/></model>'
RIGHT = JAWS[JAWS.index('<joint name="right_slide"') : JAWS.index('<joint name="left_end_')]
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
# fmt: on


TABLE = table("spoilt_models")


def changed(text: str, old: str, new: str, count: int = -1) -> str:
    assert old in text
    return text.replace(old, new, count)


SPOILT = (
    FILES
    | {name: (changed(JAWS, *row[:3]), "hand.urdf", row[3]) for name, row in TABLE["urdf"].items()}
    | {
        name: (changed(JAWS_MJCF, *row[:3]), "hand.xml", row[3])
        for name, row in TABLE["mjcf"].items()
    }
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
