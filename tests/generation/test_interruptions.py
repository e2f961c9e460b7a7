"""The client of a build is killed wherever it is; the script kills it thirty times."""

from __future__ import annotations

import random
import subprocess
from pathlib import Path

import pytest
from helpers.scripts import load_script


@pytest.mark.nightly
@pytest.mark.cluster
@pytest.mark.sim
def test_killed_client_leaves_one_state_and_the_same_command_finishes(tmp_path: Path) -> None:
    script = load_script("measurements/interruptions")
    meshes, reference = tmp_path / "meshes", tmp_path / "reference"
    script.write_boxes(meshes)
    subprocess.run(script.build_command(meshes, reference, 2), check=True, capture_output=True)
    told = script.kill_round(meshes, reference, tmp_path / "out", random.Random(1), times=1)
    assert [kill["meant"] for kill in told] == ["prepare", "simulate", "assemble"]
    assert all(kill["well"] for kill in told), told
    assert all(kill["workers"] for kill in told)
