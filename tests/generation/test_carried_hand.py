"""A dataset of one's own hand is passed on: its hand is in it, and every command reads it there."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from helpers.builds import build
from helpers.commands import error_line, run
from helpers.hands import write_tongs
from helpers.machine import needs_egl

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.errors import DataError
from drakegrasp.generation.pipeline import BuildReport
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.folder import hand_digest
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.shapes.catalog import builtin_sources

pytestmark = [pytest.mark.sim, needs_egl]

#: A can of 0.2 kg, at one stand-off; lifts are quick.
SETTINGS = (
    *("builtin.per_class=1", "objects.mass=0.2", "camera.size=32", "candidates.max=9"),
    *("candidates.standoffs=[0.07]", "lift.max_speed=1", "lift.max_acceleration=10"),
    *("filters.outlier_sigma=0", "filters.require=lifted"),
)


def go_on(out: Path, hand: Path) -> BuildReport:
    """Begin the build, or go on with it, in this process."""
    config = load_config(overrides=[*SETTINGS, f"hand={hand}"])
    sources = builtin_sources(out / "builtin", config.builtin, only=["6_can_1"])
    return build(sources, out, config)


@pytest.fixture(scope="module")
def passed_on(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset in another folder than where it was built; the hand is gone."""
    folder = tmp_path_factory.mktemp("passed_on")
    (folder / "hands").mkdir()
    go_on(folder / "built", write_tongs(folder / "hands"))
    shutil.rmtree(folder / "hands")
    return Path(shutil.move(folder / "built", folder / "received"))


@pytest.fixture
def copy(passed_on: Path, tmp_path: Path) -> Path:
    """The dataset once more, to be changed."""
    return Path(shutil.copytree(passed_on, tmp_path / "copy"))


def test_a_trial_is_replayed_to_the_bit(passed_on: Path) -> None:
    with h5py.File(passed_on / TRIALS_FILE) as file:
        success = np.flatnonzero(file["trials/outcome"][:] == Outcome.SUCCESS)[0]
    result = run("replay", passed_on, "--trial", success)
    assert (result.exit_code, result.stderr) == (0, "")


def test_its_grasps_are_verified(passed_on: Path) -> None:
    result = run("verify", passed_on / DATA_FILES["oto"], "--split", "train", "--quiet")
    assert result.exit_code == 0, result.stderr
    verdicts = [json.loads(line) for line in result.stdout.splitlines()]
    assert verdicts and all(verdict["outcome"] != "invalid" for verdict in verdicts)


def test_an_export_has_the_palm_of_the_hand(passed_on: Path, tmp_path: Path) -> None:
    result = run("export", passed_on, tmp_path / "grasps", "--to", "isaac_grasp", "--quiet")
    assert result.exit_code == 0, result.output
    tree = yaml.safe_load(next((tmp_path / "grasps").glob("*.yaml")).read_text("utf-8"))
    assert tree["gripper_frame"] == load_hand(read_manifest(passed_on).config.hand_source).palm_link


def test_it_names_the_joints_of_the_hand(passed_on: Path) -> None:
    joints = load_hand(read_manifest(passed_on).config.hand_source).joint_names
    for name, field in (
        (TRIALS_FILE, "trials/closed_q"),
        (TRIALS_FILE, "trials/lifted_q"),
        (DATA_FILES["oto"], "train/grasp_props/q"),
    ):
        with h5py.File(passed_on / name) as file:
            assert json.loads(file.attrs["joints"]) == list(joints)
            assert file[field].attrs["joints"] == file.attrs["joints"]
    # No path of the machine that built it is in it.
    assert read_manifest(passed_on).config.hand == "hand/tongs_hand.yaml"


def test_a_build_goes_on_with_the_same_hand_from_elsewhere(copy: Path, tmp_path: Path) -> None:
    """Its name does not matter either."""
    before = (copy / TRIALS_FILE).read_bytes()
    hand = write_tongs(tmp_path)
    renamed = hand.rename(hand.with_name("pliers.yaml"))
    report = go_on(copy, renamed)
    assert (report.simulated, report.reused, report.assembled) == (0, 1, False)
    assert (copy / TRIALS_FILE).read_bytes() == before


def test_a_build_does_not_go_on_with_a_changed_hand(copy: Path, tmp_path: Path) -> None:
    hand = write_tongs(tmp_path)
    known = hand_digest(hand)
    hand.write_text(hand.read_text().replace("payload: 1.5", "payload: 1.4"))
    with pytest.raises(DataError, match=f"^.*continued with hand {known}, which made it, got .*$"):
        go_on(copy, hand)
    assert hand_digest(copy / "hand" / "tongs_hand.yaml") == known


def test_a_damaged_copy_is_found_refused_and_made_again(copy: Path, tmp_path: Path) -> None:
    model = copy / "hand" / "tongs.urdf"
    whole = model.read_text()
    model.write_text(whole.replace("0.012", "0.013"))
    found = run("check", copy)
    assert found.exit_code == 1
    assert "hand: the hand must be that of manifest.json" in found.output
    assert "must hold the hand of the dataset" in error_line(run("replay", copy, "--trial", 0))
    go_on(copy, write_tongs(tmp_path))
    assert model.read_text() == whole
