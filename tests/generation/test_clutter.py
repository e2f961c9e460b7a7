"""clutter.hdf5: the same bytes whoever makes it and however often it is killed, and its labels."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.commands import error_line, run
from helpers.pages import open_pages

import drakegrasp as dg
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.clutter import load_scene
from drakegrasp.dataset.paths import CLUTTER_FOLDER, clutter_path
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.schema import HITS_NOTHING, NOT_TRIED
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.generation import clutter_scene
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.objects.surroundings import surroundings_of
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import processes
from drakegrasp.simulation.fixtures import load_surroundings
from drakegrasp.simulation.pile import PileError

pytestmark = pytest.mark.sim


def asked(scenes: int = 2, low: int = 1, high: int = 2, *, tries: int = 3) -> ClutterRequest:
    around = [load_surroundings(name) for name in ("table", "bin")]
    return ClutterRequest(scenes=scenes, objects=(low, high), surroundings=around, tries=tries)


@pytest.fixture(scope="module")
def cluttered(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = Path(shutil.copytree(small_dataset, tmp_path_factory.mktemp("clutter") / "out"))
    make_clutter(out, asked())
    return out


def test_bytes_depend_neither_on_workers_nor_on_what_was_there(cluttered: Path) -> None:
    """One scene is there, one was cut off, one is of another request, and one is new."""
    before = (cluttered / "clutter.hdf5").read_bytes()
    whole = clutter_path(cluttered, 1)
    whole.write_bytes(whole.read_bytes()[:-100])
    with processes(2) as execute:
        make_clutter(cluttered, asked(), execute=execute)
    assert (cluttered / "clutter.hdf5").read_bytes() == before

    make_clutter(cluttered, asked(tries=0))
    with h5py.File(cluttered / "clutter.hdf5") as file:
        assert (file["grasps/outcome"][:] == NOT_TRIED).all()
    make_clutter(cluttered, asked())
    assert (cluttered / "clutter.hdf5").read_bytes() == before


def test_each_object_falls_from_one_of_its_resting_poses(
    small_dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two poses, of which the second is three times as probable."""
    drawn = []

    def load(*place: Any) -> PreparedObject:
        first = load_prepared(*place)
        poses = np.array([first.resting_poses[0], np.eye(4)])
        return replace(first, resting_poses=poses, probability=np.array([0.25, 0.75]))

    def fall(models: Any, resting: Sequence[np.ndarray], *_: Any) -> None:
        drawn.extend(np.array_equal(X, np.eye(4)) for X in resting)
        raise PileError("seen")

    monkeypatch.setattr(clutter_scene, "load_prepared", load)
    monkeypatch.setattr(clutter_scene, "pile_up", fall)
    out = Path(shutil.copytree(small_dataset, tmp_path / "out"))
    with pytest.raises(DataError, match="got: seen"):
        make_clutter(out, asked(scenes=1, low=3, high=3))
    assert len(drawn) >= 40
    assert 0.55 < np.mean(drawn) < 0.95


def test_every_sample_of_an_object_is_a_grasp_and_moves_with_it(cluttered: Path) -> None:
    samples = Trials(cluttered).where(kept=True)
    names = samples["object_name"]
    with h5py.File(cluttered / "clutter.hdf5") as file:
        grasps, scenes = file["grasps"], file["scenes"]
        known = file["objects/name"].asstr()[:]
        place, scene = grasps["object"][:], grasps["scene"][:]
        objects = scenes["object"][:][scene, place]
        for number in range(len(scenes["split"])):
            there = scenes["object"][number]
            due = sum((names == known[i]).sum() for i in there if i >= 0)
            assert (scene == number).sum() == due
        assert (
            known[objects] == names[np.searchsorted(samples.trial_ids, grasps["trial_id"])]
        ).all()
        X_TO = scenes["X_TO"][:][scene, place].reshape(-1, 3, 4)
        X_TG = grasps["X_TG"][:].reshape(-1, 3, 4)
        p_OG = np.einsum("nji,nj->ni", X_TO[:, :, :3], X_TG[:, :, 3] - X_TO[:, :, 3])
        X_OG = samples["X_OG"].reshape(-1, 3, 4)
        due = X_OG[np.searchsorted(samples.trial_ids, grasps["trial_id"]), :, 3]
    np.testing.assert_allclose(p_OG, due, atol=1e-6)


def test_labels_of_geometry_and_of_trials_agree_with_each_other(cluttered: Path) -> None:
    with h5py.File(cluttered / "clutter.hdf5") as file:
        grasps = {name: data[:] for name, data in file["grasps"].items()}
        share = file["views/visible_share"][:]
    tried = grasps["outcome"] != NOT_TRIED
    assert tried.any() and grasps["free"][tried].all()
    assert (grasps["free"] == (grasps["hit"] == HITS_NOTHING)).all()
    assert (grasps["lifted"] == (grasps["outcome"] == Outcome.SUCCESS)).all()
    assert not (grasps["kept"] & ~grasps["lifted"]).any()
    assert not (grasps["clean"] & ~grasps["kept"]).any()
    moved = np.nan_to_num(grasps["neighbour_shift"])
    assert (moved[grasps["clean"]] <= 0.01).all()
    assert np.nanmin(share) >= 0.0 and np.nanmax(share) == 1.0


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        (asked(scenes=0), "scenes must be at least 1, got 0"),
        (asked(tries=-1), "tries must be at least 0, got -1"),
        (
            ClutterRequest(surroundings=[load_surroundings("bin")] * 2),
            "surroundings must have different names, got bin, bin",
        ),
        (ClutterRequest(surroundings=[]), "surroundings must have different names, got none"),
        (asked(low=3, high=2), r"objects must be a range within 1 to 20, got 3\.\.2"),
    ],
)
def test_impossible_requests_are_refused(
    cluttered: Path, request_: ClutterRequest, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        make_clutter(cluttered, request_)


def test_objects_without_room_and_sets_without_samples_are_refused(
    small_dataset: Path, tmp_path: Path
) -> None:
    """In one line; nothing half-written is left."""
    small = tmp_path / "small.yaml"
    small.write_text("extent: [0.001, 0.001]\ndrops: false\n")
    out = Path(shutil.copytree(small_dataset, tmp_path / "out"))
    crowded = ClutterRequest(scenes=1, objects=(2, 2), surroundings=[load_surroundings(small)])
    with pytest.raises(DataError, match=r"scene 0: its objects must come to rest in the small, in"):
        make_clutter(out, crowded)
    assert not (out / "clutter.hdf5").exists()
    assert not list((out / CLUTTER_FOLDER).glob("*"))

    assemble(out, rejected=Trials(out).where(kept=True).trial_ids.tolist())
    with pytest.raises(DataError, match="must have samples to be grasped among others, got none"):
        make_clutter(out, asked())


def test_every_try_is_replayed_to_the_bit(small_clutter: Path) -> None:
    """From the stored poses alone."""
    with h5py.File(small_clutter / "clutter.hdf5") as file:
        outcomes, alone = file["grasps/outcome"][:], file["scenes/object"][:, 1] < 0
        among = ~alone[file["grasps/scene"][:]]
    tried = np.flatnonzero(outcomes != NOT_TRIED)
    assert among[tried].any() and len(set(outcomes[tried].tolist())) > 1
    for row in tried.tolist():
        again = dg.replay_clutter(small_clutter, row)
        assert again.same, again.differences
        assert again.found == outcomes[row]


def test_replay_says_what_differs_and_which_rows_there_are(
    small_clutter: Path, tmp_path: Path
) -> None:
    """A neighbour that stood elsewhere, an outcome of another row, and rows that were not tried."""
    out = Path(shutil.copytree(small_clutter, tmp_path / "out"))
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        tried = np.flatnonzero(file["grasps/outcome"][:] != NOT_TRIED)
        several = file["scenes/object"][:, 1] >= 0
        row = tried[several[file["grasps/scene"][:][tried]]][0]
        file["grasps/outcome"][row] = Outcome.DROPPED
        file["grasps/neighbour_shift"][row] += 1e-15
        untried = int(np.argmax(file["grasps/outcome"][:] == NOT_TRIED))
    result = run("replay", out, "--clutter", row, "--html", tmp_path / "page.html")
    assert result.exit_code == 1 and "was dropped, is " in result.stdout
    assert "outcome differs" in result.stdout and "neighbour_shift differs" in result.stdout
    assert (tmp_path / "page.html").stat().st_size > 100_000
    known = f"row must be of a grasp that was tried, {tried[0]} to {tried[-1]}, got"
    for wrong in (untried, 10**6):
        assert f"{known} {wrong}" in error_line(run("replay", out, "--clutter", wrong))
    for options in ((), ("--clutter", row, "--trial", 0)):
        assert "either --trial or --clutter must be given" in run("replay", out, *options).stderr


def test_own_boxes_are_read_back_with_the_same_bits(tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    for yaw in (*np.linspace(-180.0, 180.0, 181).tolist(), 123.4567890123):
        box = f"{{size: [0.1, 0.2, 0.3], position: [0, 0.1, 0], yaw_deg: {yaw}}}"
        path.write_text(f"extent: [0.1, 0.1]\nboxes: [{box}]\n")
        first = load_surroundings(path)
        again = surroundings_of("own", first.tree(), "own")
        np.testing.assert_array_equal(again.boxes[0].X_TB, first.boxes[0].X_TB)


def test_scenes_in_a_model_need_its_file_no_more(small_dataset: Path, tmp_path: Path) -> None:
    """They are loaded, tried again and shown from clutter.hdf5 alone."""
    path, out = tmp_path / "post.sdf", Path(shutil.copytree(small_dataset, tmp_path / "out"))
    post = "<cylinder><radius>0.01</radius><length>0.2</length></cylinder>"
    path.write_text(
        '<sdf version="1.9"><model name="post"><link name="post"><collision name="post">'
        f"<pose>0 0 0.1 0 0 0</pose><geometry>{post}</geometry></collision></link></model></sdf>"
    )
    surroundings = load_surroundings(path)
    (due,) = surroundings.hulls
    request = ClutterRequest(scenes=1, objects=(2, 2), surroundings=[surroundings], tries=1)
    make_clutter(out, request)
    path.unlink()
    line = error_line(run("clutter", out, "--surroundings", path))
    assert "a YAML file or a model (.sdf, .urdf, .dmd.yaml), got" in line
    around = load_scene(out / "clutter.hdf5", 0).surroundings
    assert around.name == "post"
    np.testing.assert_array_equal(around.hulls[0].corners, due.corners)
    with h5py.File(out / "clutter.hdf5") as file:
        tried = np.flatnonzero(file["grasps/outcome"][:] != NOT_TRIED)
    assert dg.replay_clutter(out, int(tried[0])).same
    page = open_pages(out).get("/clutter/0").text
    (text,) = re.findall(r'<script type="application/json" id="scene">(.*?)</script>', page)
    (wall,) = json.loads(text)["scene"]["walls"]
    shown = np.reshape(wall["vertices"], (-1, 3))[wall["faces"]]
    np.testing.assert_allclose(shown.min(axis=0), due.corners.min(axis=0), atol=1e-12)
    np.testing.assert_allclose(shown.max(axis=0), due.corners.max(axis=0), atol=1e-12)
