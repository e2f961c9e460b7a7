"""What an arm can do about grasps in scenes of several objects, and OUT/reach/clutter/NAME.hdf5."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import h5py
import numpy as np
import pytest
from helpers.commands import error_line, run
from helpers.datasets import edit_file

import drakegrasp as dg
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.clutter import Clutter
from drakegrasp.dataset.paths import reach_path
from drakegrasp.dataset.scenes import SceneDataset
from drakegrasp.dataset.schema import REACHES
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import Array, invert_pose, make_pose, rotation_about
from drakegrasp.generation.attempts import find_attempt
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.reach import rows
from drakegrasp.reach.reaching import Reach, reach_attempt
from drakegrasp.reach.rows import reach_dataset
from drakegrasp.runtime.files import seal
from drakegrasp.simulation.fixtures import load_surroundings
from drakegrasp.table import Table

pytestmark = pytest.mark.sim
#: Places of the base: from the second one, some grasps are out of reach.
ASIDE, STRAIGHT = (-0.45, 0.25, 0.0, 0.0), (-0.5, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def arm(six: Path) -> dg.Arm:
    return dg.load_arm(six, ASIDE)


@pytest.fixture(scope="module")
def straight(six: Path) -> dg.Arm:
    return dg.load_arm(six, STRAIGHT)


@pytest.fixture(scope="module")
def scene(small_clutter: Path) -> Clutter:
    """Two boxes on the table."""
    return dg.load_scene(small_clutter / "clutter.hdf5", 2)


@pytest.fixture(scope="module")
def grasp(small_clutter: Path, scene: Clutter) -> Array:
    """A kept grasp of the scene, in the frame of its object."""
    data = SceneDataset(small_clutter / "clutter.hdf5", split="test")
    grasps, rows = data.tables["grasps"], data.rows_in(2)
    row = next(row for row in rows if grasps["kept"][row])
    packed = pack_grasp(grasps["p_TQ"][row], grasps["nhat_Q_T"][row])
    return transform_grasp(invert_pose(scene.X_TO[grasps["object"][row]]), packed)


# Verdicts


def beside(scene: Clutter, y: float) -> Clutter:
    """Return the scene with object 1 beside object 0, moved along its y-axis."""
    X_TO = scene.X_TO.copy()
    X_TO[1] = X_TO[0]
    X_TO[1, :3, 3] += X_TO[0, :3, :3] @ [0.0, y, 0.0]
    return replace(scene, X_TO=X_TO)


def test_a_neighbour_in_the_way_of_the_hand_is_out_of_reach(
    scene: Clutter, grasp: Array, arm: dg.Arm
) -> None:
    far, near = (
        dg.verify_grasp(grasp, on=beside(scene, y), object=0, arm=arm) for y in (0.4, -0.08)
    )
    assert far.reach is not None and near.reach is not None
    assert far.reach.reachable and near.reach.outcome == "approach"


def test_scene_and_base_are_moved_together(scene: Clutter, grasp: Array, six: Path) -> None:
    turn = rotation_about([0.0, 0.0, 1.0], 0.6)
    X = make_pose(turn, [0.05, -0.1, 0.0])
    moved = replace(scene, X_TO=X @ scene.X_TO)
    bases = ASIDE, (*(X @ [*ASIDE[:3], 1.0])[:3], ASIDE[3] + 0.6)
    found = [
        dg.verify_grasp(grasp, on=on, object=0, arm=dg.load_arm(six, base)).reach
        for on, base in zip((scene, moved), bases, strict=True)
    ]
    assert found[0] is not None and found[1] is not None
    assert found[0].reachable and found[1].reachable
    np.testing.assert_allclose(found[0].q, found[1].q, atol=1e-3)
    assert found[0].clearance == pytest.approx(found[1].clearance, abs=1e-3)


def test_an_object_alone_in_its_scene_has_the_reach_of_an_object_alone(
    scene: Clutter, grasp: Array, arm: dg.Arm
) -> None:
    alone = replace(scene, names=scene.names[:1], X_TO=scene.X_TO[:1], prepared=scene.prepared[:1])
    mine = dg.verify_grasp(grasp, on=alone, object=0, arm=arm).reach
    own = scene.prepared[0].model
    placed = dg.PlacedObject(model=own, X_TO=scene.X_TO[0], config=scene.config)
    its = dg.verify_grasp(grasp, on=placed, arm=arm).reach
    assert mine is not None and its is not None
    assert mine.reachable
    np.testing.assert_array_equal(mine.q, its.q)
    assert mine.clearance == its.clearance


def test_rows_of_scenes_are_asked_among_their_neighbours(
    small_clutter: Path, arm: dg.Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The card counts what the arm reaches, and each row is asked in its scene."""
    data = dg.SceneRows(small_clutter / "clutter.hdf5", split="test")
    spy = Mock(side_effect=reach_attempt)
    monkeypatch.setattr("drakegrasp.verification.result.reach_attempt", spy)
    scored = dg.score([], data, references=["own"], per_object=1, workers=1, arm=arm)
    measures = scored.card["sets"]["own"]["measures"]
    assert measures["reached"]["value"] <= measures["reachable"]["value"]
    (call,) = spy.call_args_list
    assert len(call.kwargs["around"].models) == 1
    (verdict,) = dg.verify_grasps(data.column("grasps")[:1], on=data, rows=[0], arm=arm)
    assert verdict.reach is not None
    assert spy.call_args.kwargs["around"] is verdict.placed.around


def test_predictions_in_scenes_are_asked_among_what_is_seen(
    small_clutter: Path, six: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = Reach(outcome="collision", q=np.full((3, 6), np.nan), clearance=np.nan)
    spy = Mock(return_value=nothing)
    monkeypatch.setattr("drakegrasp.scoring.ranking.reach_attempt", spy)
    arm = dg.load_arm(six, ASIDE)
    table, _ = dg.predict_scenes(small_clutter / "clutter.hdf5", count=1, arm=arm, workers=1)
    assert not np.any(table.confidence)
    around = [call.kwargs["around"] for call in spy.call_args_list]
    assert {len(each.models) for each in around} == {1}
    assert {len(each.walls) for each in around} == {0}, "the scenes of the split have no walls"


# The file


@pytest.fixture(scope="module")
def asked(small_clutter: Path, straight: dg.Arm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with a file of the arm about its scenes, of which the first one is put in a bin."""
    out = tmp_path_factory.mktemp("asked") / "out"
    shutil.copytree(small_clutter, out)
    edit_file(out / "clutter.hdf5", _put_in_bin)
    reach_dataset(out, straight, clutter=True)
    return out


def _put_in_bin(file: h5py.File) -> None:
    file["scenes/surroundings"][0] = "bin"


@pytest.fixture
def out(asked: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(asked, tmp_path / "out"))


def read(out: Path, name: str = "six") -> Table:
    with h5py.File(reach_path(out, name, clutter=True)) as file:
        group = file["clutter"]
        return Table({key: group[key][:] for key in group})


def test_a_row_per_free_grasp_as_in_its_scene(asked: Path, straight: dg.Arm) -> None:
    with h5py.File(asked / "clutter.hdf5") as file:
        names = ("scene", "object", "trial_id", "free")
        grasps = Table({key: file["grasps"][key][:] for key in names})
    found, trials = read(asked), Trials(asked)
    assert found.grasp.tolist() == np.flatnonzero(grasps.free).tolist()
    assert 0 < found.reachable.sum() < found.count
    for name in ("scene", "object"):
        np.testing.assert_array_equal(found[name], grasps[name][found.grasp])

    # Asked in another way: as an attempt, in the scene.
    for row in range(0, found.count, 3):
        i, scene = (int(found[name][row]) for name in ("object", "scene"))
        there = dg.load_scene(asked / "clutter.hdf5", scene)
        trial = trials[int(grasps.trial_id[found.grasp[row]])]
        place = (int(trial[name]) for name in ("candidate", "standoff_index"))
        due = reach_attempt(
            straight,
            there.models[i].field,
            find_attempt(there.prepared[i], *place, there.config),
            there.X_TO[i],
            there.config,
            q_closed=trial["closed_q"],
            X_TO_simulated=there.simulated(i)[0],
            around=there.around(i),
        )
        assert REACHES[found.reach_outcome[row]] == due.outcome
        q = [found[name][row] for name in ("q_approach", "q_grasp", "q_lift")]
        np.testing.assert_allclose(q, due.q, atol=1e-6)
        np.testing.assert_allclose(found.clearance[row], due.clearance, atol=1e-6)
    assert not check_dataset(asked)


def test_rows_are_kept_as_long_as_the_scenes_are_of_one_request(
    out: Path, straight: dg.Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = reach_path(out, "six", clutter=True).read_bytes()
    spy = Mock(side_effect=rows.reach_grasp)
    monkeypatch.setattr(rows, "reach_grasp", spy)
    table = reach_dataset(out, straight, clutter=True)
    assert not spy.call_count
    assert reach_path(out, "six", clutter=True).read_bytes() == before

    # One scene less, and one more again: the grasps of the others stay.
    around = [load_surroundings(name) for name in ("table", "bin")]
    request = ClutterRequest(scenes=3, objects=(1, 2), surroundings=around, tries=4)
    make_clutter(out, replace(request, scenes=2))
    fewer = reach_dataset(out, straight, clutter=True)
    assert not spy.call_count
    assert fewer.count == (table.scene < 2).sum()
    make_clutter(out, request)
    reach_dataset(out, straight, clutter=True)
    assert spy.call_count == (table.scene == 2).sum() > 0
    assert reach_path(out, "six", clutter=True).read_bytes() == before

    # Other scenes are asked for anew.
    make_clutter(out, replace(request, tries=0))
    (found,) = check_dataset(out)
    assert str(found) == (
        "reach/clutter/six.hdf5: attribute clutter must be that of clutter.hdf5, got another; run "
        "`drakegrasp reach` again"
    )
    spy.reset_mock()
    assert reach_dataset(out, straight, clutter=True).count == spy.call_count == table.count
    assert not check_dataset(out)


def test_the_command_and_what_is_told(out: Path, six: Path) -> None:
    first = reach_path(out, "six", clutter=True).read_bytes()
    given = ("reach", out, "--arm", six, "--base", "-0.5,0,0,0", "--quiet", "--clutter")
    result = run(*given, "--name", "again")
    assert result.exit_code == 0, result.output
    table, path = read(out), reach_path(out, "again", clutter=True)
    assert f"{table.count} grasps in {path}\nreachable: {table.reachable.sum()}\n" in result.stdout
    assert path.read_bytes() == first
    assert "--clutter must not be given with --map, got both" in error_line(
        run(*given, "--map", out / "map.png")
    )

    # How many it reaches is told by surroundings, and no longer once the scenes are others.
    around = np.array(["bin", "table", "table"])[table.scene]
    due = {name: int((table.reachable & (around == name)).sum()) for name in ("bin", "table")}
    told = json.loads(run("stats", out, "--json").stdout)["clutter"]
    assert {each["surroundings"]: each["reachable"]["six"] for each in told} == due
    text = run("stats", out).stdout
    assert f"again reaches {due['bin']} of these, six reaches {due['bin']} of these; of " in text
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        file["grasps/free"][:] = True
    told = json.loads(run("stats", out, "--json").stdout)["clutter"]
    assert [each["reachable"] for each in told] == [{}, {}]


def test_scenes_must_be_there_and_of_these_trials(out: Path, straight: dg.Arm) -> None:
    with h5py.File(out / "clutter.hdf5", "r+") as file:
        file.attrs["shards"] = "0"
    with pytest.raises(dg.DataError, match="run `drakegrasp clutter` again"):
        reach_dataset(out, straight, clutter=True)
    (out / "clutter.hdf5").unlink()
    with pytest.raises(dg.DataError, match=r"clutter\.hdf5"):
        reach_dataset(out, straight, clutter=True)


@pytest.mark.parametrize(
    ("column", "what"),
    [
        ("reachable", "reachable must be true"),
        ("grasp", "grasp must be one of the rows of /grasps"),
    ],
)
def test_check_finds_a_fault(out: Path, column: str, what: str) -> None:
    path = reach_path(out, "six", clutter=True)
    with h5py.File(path, "r+") as file:
        values = file["clutter"][column][:]
        file["clutter"][column][...] = ~values if values.dtype == bool else values + 10**6
    seal(path)
    (found, *_) = check_dataset(out)
    assert found.file == "reach/clutter/six.hdf5"
    assert found.what.startswith(what)
