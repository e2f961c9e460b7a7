"""A hand of two fingers without spread: what must work for it is not made for the Barrett Hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

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


def changed_finger(**changes: object) -> list[object]:
    """Return the gripper's fingers, the first one with changes."""
    return [{**PINCER["fingers"][0], **changes}, PINCER["fingers"][1]]
