"""Hands of two fingers, which turn or slide: no code is made for the Barrett Hand alone."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import hand_file
from drakegrasp.hand.folder import hand_folder
from drakegrasp.pictures.still_scene import StillScene

#: A gripper whose two fingers face each other along y, hinged at y = -+0.04, length 0.1.
PINCER_SDF = """<sdf version="1.9"><model name="pincer">
  <link name="palm"><collision name="slab">
    <geometry><box><size>0.04 0.12 0.02</size></box></geometry></collision></link>
  <link name="mount"><pose>0 -0.04 0.02 0 0 0</pose></link>
  <link name="left"><pose>0 -0.04 0.02 0 0 0</pose><collision name="rod">
    <pose>0 0 0.055 0 0 0</pose>
    <geometry><capsule><radius>0.01</radius><length>0.08</length></capsule></geometry>
  </collision></link>
  <link name="right"><pose>0 0.04 0.02 0 0 0</pose><collision name="bar">
    <pose>0 0 0.055 0 0 0</pose>
    <geometry><box><size>0.02 0.02 0.09</size></box></geometry></collision></link>
  <joint name="fixed" type="fixed"><parent>palm</parent><child>mount</child></joint>
  <joint name="left_hinge" type="revolute"><parent>mount</parent><child>left</child>
    <axis><xyz>-1 0 0</xyz><limit><lower>-0.1</lower><upper>1</upper></limit></axis></joint>
  <joint name="right_hinge" type="revolute"><parent>palm</parent><child>right</child>
    <axis><xyz>1 0 0</xyz><limit><lower>0</lower><upper>1</upper></limit></axis></joint>
</model></sdf>"""
PINCER: dict[str, Any] = {
    "version": 1,
    "model": "pincer.sdf",
    "palm": {"link": "palm", "p_BG": [0.0, 0.0, 0.01]},
    "fingers": [
        {
            "name": side,
            "fingertip": side,
            "closing_joint": f"{side}_hinge",
            "torque_limit": 1.0,
            "pad_point": [0.0, inward * 0.01, 0.09],
        }
        for side, inward in (("left", 1.0), ("right", -1.0))
    ],
    "closing_speed_deg": 90.0,
    "standoffs": [0.03, 0.05],
}


def write_pincer(folder: Path, sdf: str = PINCER_SDF, **changes: object) -> Path:
    """Write the gripper's two files, the YAML with changes, and return the YAML's path."""
    (folder / "pincer.sdf").write_text(sdf)
    path = folder / "pincer_hand.yaml"
    path.write_text(yaml.safe_dump({**PINCER, **changes}))
    return path


def write_linked(folder: Path) -> Path:
    """Write a gripper whose first finger carries the second one, and return the YAML's path."""
    before, after = (
        f'<joint name="right_hinge" type="revolute"><parent>{link}</parent>'
        for link in ("palm", "left")
    )
    assert before in PINCER_SDF
    return write_pincer(folder, PINCER_SDF.replace(before, after))


def changed_finger(**changes: object) -> list[object]:
    """Return the gripper's fingers, the first one with changes."""
    return [{**PINCER["fingers"][0], **changes}, PINCER["fingers"][1]]


#: A gripper in URDF whose fingers slide along y, 80 mm apart. Its model has efforts and a mimic.
SLIDER = """<robot name="slider">
  <link name="palm"><inertial><mass value="0.5"/>
    <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><box size="0.04 0.12 0.02"/></geometry></collision></link>
  <link name="left"><inertial><origin xyz="0 -0.01 0.055"/><mass value="0.05"/>
    <inertia ixx="4e-5" iyy="4e-5" izz="4e-6" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 -0.01 0.055"/>
    <geometry><box size="0.02 0.02 0.09"/></geometry></collision></link>
  <link name="right"><inertial><origin xyz="0 0.01 0.055"/><mass value="0.05"/>
    <inertia ixx="4e-5" iyy="4e-5" izz="4e-6" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0 0.01 0.055"/>
    <geometry><box size="0.02 0.02 0.09"/></geometry></collision></link>
  <joint name="left_slide" type="prismatic"><parent link="palm"/><child link="left"/>
    <origin xyz="0 -0.04 0.01"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.04" effort="20" velocity="1"/></joint>
  <joint name="right_slide" type="prismatic"><parent link="palm"/><child link="right"/>
    <origin xyz="0 0.04 0.01"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="0.04" effort="20" velocity="1"/>
    <mimic joint="left_slide" multiplier="1" offset="0"/></joint>
</robot>"""


def write_slider(folder: Path, urdf: str = SLIDER, **changes: object) -> Path:
    """Write the gripper that slides, the YAML with changes, and return the YAML's path."""
    described: dict[str, Any] = {
        "version": 1,
        "model": "slider.urdf",
        "palm": {"link": "palm", "p_BG": [0.0, 0.0, 0.01]},
        "fingers": slider_fingers(20.0),
        "closing_speed": 0.1,
        "standoffs": [0.02],
    }
    (folder / "slider.urdf").write_text(urdf)
    path = folder / "slider_hand.yaml"
    path.write_text(yaml.safe_dump({**described, **changes}))
    return path


def slider_fingers(force: float, **driven_by: object) -> list[object]:
    """Return the sliding gripper's fingers that press with a force each [N].

    With `driven_by` of the second finger the first one's motor moves both.
    """
    left, right = (
        {
            "name": side,
            "fingertip": side,
            "closing_joint": f"{side}_slide",
            "pad_point": [0.0, 0.0, 0.09],
        }
        for side in ("left", "right")
    )
    if not driven_by:
        return [{**left, "force_limit": force}, {**right, "force_limit": force}]
    # One motor gives what both press with.
    return [{**left, "force_limit": 2.0 * force}, {**right, "driven_by": driven_by}]


def drake_fingertip_poses(hand: Hand, spread: float, closing: Array) -> Array:
    """Return the poses X_GFi (k, 4, 4) of the fingertips as Drake computes them."""
    scene = StillScene(hand)
    scene.pose(np.eye(4), scene.positions(spread, closing))
    return np.array([scene.link_pose(link) for link in hand.fingertip_links])


#: The page of the tutorial's hand.
PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "add-a-hand.md"


def write_tongs(folder: Path) -> Path:
    """Write the two files of the tutorial as a reader would, and return the hand file."""
    page = PAGE.read_text()
    for name, language in (("tongs.urdf", "xml"), ("tongs_hand.yaml", "yaml")):
        assert f"Write this as `{name}`" in page
        (block,) = re.findall(rf"^```{language}\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
        (folder / name).write_text(block)
    return folder / "tongs_hand.yaml"


def write_with_optional_fingers(folder: Path, *fingers: int) -> Path:
    """Write the Barrett Hand's YAML with fingers that need not touch, and return its path."""
    tree = copy_model(folder, "barrett")
    for k in fingers:
        tree["fingers"][k]["required"] = False
    path = folder / "optional_hand.yaml"
    path.write_text(yaml.safe_dump(tree))
    return path


def write_with_preshapes(folder: Path, **preshapes: str) -> Path:
    """Write the Barrett Hand's YAML with preshapes by the names of their fingers: `"F1 F3"`."""
    shapes = [{"name": name, "fingers": fingers.split()} for name, fingers in preshapes.items()]
    path = folder / "shaped_hand.yaml"
    path.write_text(yaml.safe_dump(copy_model(folder, "barrett") | {"preshapes": shapes}))
    return path


def copy_model(folder: Path, name: str) -> dict[str, Any]:
    """Copy the model of a hand of the package and its meshes; return the keys of the hand."""
    tree: dict[str, Any] = yaml.safe_load(hand_file(name).read_text())
    for place, path in hand_folder(name).files.items():
        if not place.endswith(".yaml"):
            shutil.copy(path, folder)
    return tree
