"""The jaws and the box of helpers/jaws.py as files, and a judge of grasps."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from helpers.jaws import EDGE, HAND, box_folder, changed, jaws

pytest.importorskip("mujoco")

from drakegrasp.protocols.protocol import GraspMotion, PostureVerdict
from drakegrasp.protocols.scene import ObjectFolder, ProtocolScene


@pytest.fixture(scope="session")
def hand(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("jaws") / "hand.xml"
    path.write_text(HAND)
    return path


@pytest.fixture(scope="session")
def box(tmp_path_factory: pytest.TempPathFactory) -> ObjectFolder:
    return box_folder(tmp_path_factory.mktemp("box") / "box", EDGE, EDGE, EDGE)


@pytest.fixture(scope="session")
def judge(hand: Path, box: ObjectFolder) -> Callable[..., PostureVerdict]:
    """Returns the verdict on a grasp of the box, by DexGraspBench's rules with changed numbers."""

    def run(
        motion: GraspMotion | None = None, thing: ObjectFolder = box, **numbers: Any
    ) -> PostureVerdict:
        rules = changed(**numbers)
        return rules.run(ProtocolScene(rules, hand, thing), motion or jaws(0.01))

    return run
