"""Builds of other settings: presets, drawn conditions, resting poses, growth, a finger less.

Each is a small set, whose files are sound and whose rows are those of its settings.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from itertools import product
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from cross_check import cross_check
from helpers.builds import build
from helpers.datasets import BOTH
from helpers.hands import write_with_optional_fingers
from helpers.meshes import SMALL, write, write_fixed
from helpers.objects import write_above
from helpers.physics import broken_physics
from helpers.tiers import few

from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.reader import FIELDS, GraspDataset
from drakegrasp.dataset.schema import CONDITION_FIELDS, SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.generation.replay import record_trial, replay_trial
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.page.snapshot import read_snapshot
from drakegrasp.verification.placing import dataset_config, place_on_rows

pytestmark = [pytest.mark.sim, pytest.mark.slow]

#: Few palm poses of one box, in small images.
ONE_BOX = ("candidates.max=6", "unit_candidates=3", "camera.size=32", "objects.resting_poses=1")


@pytest.mark.parametrize("preset", few(["fast", "randomized", "paper", "released"], 2))
def test_small_set_of_a_preset_is_sound(preset: str, small_meshes: Path, tmp_path: Path) -> None:
    """And its physics agrees with itself."""
    sources = [source for source in find_meshes(small_meshes) if "box" in source.name][:1]
    out = tmp_path / "out"
    build(sources, out, load_config(preset, overrides=ONE_BOX))
    assert len(Trials(out)) > 0
    assert check_dataset(out) == []
    assert broken_physics(out) == {}


# Everything is drawn: the usual attempts, each in conditions of its own

#: The object that is built; of the small dataset it has most grasps.
NAME = "11_box_slim"


@pytest.fixture(scope="module")
def randomized(small_meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset. Read only."""
    sources = [source for source in find_meshes(small_meshes) if source.name == NAME]
    out = tmp_path_factory.mktemp("randomized") / "out"
    build(sources, out, load_config("randomized", overrides=SMALL))
    return out


def test_attempts_are_those_of_a_build_without_draws(randomized: Path, small_dataset: Path) -> None:
    drawn, usual = (
        trials[trials["object_name"] == NAME].columns()
        for trials in map(Trials, (randomized, small_dataset))
    )
    for name in ("X_TO", "X_OG", "spread", "seed", "candidate", "standoff_index"):
        np.testing.assert_array_equal(drawn[name], usual[name])
    for name in (f.name for f in CONDITION_FIELDS):
        assert len(np.unique(usual[name], axis=0)) == 1
        assert len(np.unique(drawn[name], axis=0)) == len(drawn[name])
    # The simulation goes its own way.
    lifted = np.isfinite(drawn["slip"]) & np.isfinite(usual["slip"])
    assert lifted.any()
    assert np.all(drawn["slip"][lifted] != usual["slip"][lifted])


@pytest.mark.parametrize("outcome", [Outcome.SUCCESS, Outcome.MISSING_FINGERTIP])
def test_replay_gives_the_same_bits(randomized: Path, tmp_path: Path, outcome: Outcome) -> None:
    row = int(np.flatnonzero(Trials(randomized)["outcome"] == outcome)[0])
    replay = replay_trial(randomized, row)
    assert replay.same, replay.differences
    assert record_trial(randomized, row, tmp_path / "trial.html") is outcome


# Two samplers take turns at several resting poses


@pytest.fixture(scope="module")
def resting(
    tmp_path_factory: pytest.TempPathFactory,
    made_once: Callable[[str, Callable[[Path], object]], Path],
) -> Path:
    """The dataset. Read only."""
    folder = tmp_path_factory.mktemp("meshes")
    write_fixed(folder, "8_wineglass_flute")
    shutil.copy(folder / "8_wineglass_flute.obj", folder / "9_wineglass_twin.obj")
    rules = [
        *("candidates.max=16", "unit_candidates=8", "candidates.method=[normals, rotations]"),
        *("objects.resting_poses=3", "filters.outlier_sigma=0", "split.by=object"),
        "objects.mass=0.2",
        *("physics.friction_hand=1.5", "lift.max_speed=2", "lift.max_acceleration=20"),
        *("lift.hold_time=0.1", "camera.size=32"),
    ]
    config = load_config(overrides=rules)
    return made_once("resting poses", lambda out: build(folder, out, config))


def test_samplers_and_resting_poses_take_turns(resting: Path) -> None:
    columns = Trials(resting).columns()
    first = columns["standoff_index"] == 0
    manifest = json.loads((resting / "manifest.json").read_text())
    for i, entry in enumerate(manifest["objects"]):
        own = first & (columns["object"] == i)
        poses = len(entry["resting"])
        assert poses > 1
        turns = np.arange(own.sum())
        np.testing.assert_array_equal(columns["resting"][own], turns % poses)
        np.testing.assert_array_equal(columns["source"][own], 1 - turns // poses % 2)
        for k, stands in enumerate(entry["resting"]):
            rows = columns["X_TO"][(columns["object"] == i) & (columns["resting"] == k)]
            assert np.all(rows == stands["X_TO"])


def test_samples_are_verified_as_they_lay(resting: Path) -> None:
    """Grasps of all rows, those of other resting poses too, are put on the table as tried."""
    data, rows = GraspDataset(resting / "grasping_oto.hdf5"), Trials(resting).columns()
    tried, grasps = data.column("trial_id"), data.column("grasps")
    placed = place_on_rows(grasps, data, config=dataset_config(data))
    assert sorted(each.index for each in placed) == list(range(len(grasps)))
    assert len(np.unique(rows["resting"][tried])) > 1
    for each in placed:
        X_TO = unpack_pose(rows["X_TO"][tried[each.index]])
        np.testing.assert_array_equal(each.placed.X_TO, X_TO)


def test_lifts_are_tried_elsewhere_as_they_lay(
    resting: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mujoco_baseline = pytest.importorskip("mujoco_baseline")
    peer = Mock()
    peer.run.return_value = mujoco_baseline.PeerTrial(outcome=Outcome.MOVED)
    monkeypatch.setattr(mujoco_baseline, "MujocoBaseline", lambda *_: peer)
    lifts = cross_check(resting, 12)["lifts"]
    columns = Trials(resting).columns()
    ids = [lift["trial_id"] for lift in lifts]
    assert len(np.unique(columns["resting"][ids])) > 1
    # Each lift is run where it was placed.
    assert [name for name, *_ in peer.mock_calls] == len(ids) * ["place", "run"]
    stood = [call.args[0] for call in peer.place.call_args_list]
    np.testing.assert_array_equal(stood, [unpack_pose(columns["X_TO"][i]) for i in ids])


# More meshes and a larger target add rows and change none

#: Full extents [m].
BOXES = {"1_box_a": [0.05, 0.06, 0.12], "2_can_b": [0.06, 0.05, 0.1], "3_jar_c": [0.05, 0.05, 0.08]}


def rows_of(out: Path) -> dict[tuple[object, ...], object]:
    """Return the bytes of each attempt by its identity, and of each sample, with its split."""

    def row(columns: dict[str, np.ndarray], i: int) -> dict[str, bytes]:
        own = columns.keys() - {"trial_id", "object"}
        return {name: np.asarray(columns[name][i]).tobytes() for name in own}

    trials = Trials(out)
    columns, names = trials.columns(), ("object_name", "resting", "candidate", "standoff_index")
    identity = list(zip(*(trials[name].tolist() for name in names), strict=True))
    found: dict[tuple[object, ...], object] = {k: row(columns, i) for i, k in enumerate(identity)}
    for name, split in product(BOTH, SPLITS):
        data = GraspDataset(out / name, split=split)
        samples = {field: data.column(field) for field in FIELDS}
        for i, trial in enumerate(data.column("trial_id").tolist()):
            found[name, *identity[trial]] = split, row(samples, i)
    return found


def test_more_meshes_and_a_larger_target_only_add_rows(tmp_path: Path) -> None:
    meshes, out, known = tmp_path / "meshes", tmp_path / "out", {}
    meshes.mkdir()
    for names, samples in ((["1_box_a", "2_can_b"], 6), (BOXES, 7)):
        for name in names:
            write(meshes / f"{name}.obj", trimesh.creation.box(BOXES[name]).subdivide())
        small = ["objects.resting_poses=1", "camera.size=16", "seed=3", f"samples={samples}"]
        build(meshes, out, load_config("fast", small))
        rows = rows_of(out)
        assert sum(key[0] in BOTH for key in rows) == 2 * samples
        assert {key: rows.get(key) for key in known} == known
        known = rows


# Fingers that need not touch


def test_a_grasp_without_an_optional_finger_is_a_success_but_no_sample(tmp_path: Path) -> None:
    """On a slim pole, past which one of two parallel fingers closes."""
    (tmp_path / "meshes").mkdir()
    pole = trimesh.creation.box([0.03, 0.03, 0.14]).subdivide().subdivide()
    pole.export(tmp_path / "meshes" / "11_box_slim.obj")
    sampler = write_above(tmp_path, 0.06, x=0.013)
    rules = ["candidates.max=1", f"candidates.method={sampler}", "candidates.standoffs=[0.06]"]
    config = load_config(
        hand=str(write_with_optional_fingers(tmp_path, 0, 1)),
        overrides=[*SMALL, *rules, "camera.size=32"],
    )
    report = build(tmp_path / "meshes", tmp_path / "out", config)
    assert report.assembly.removed[Removal.MISSING_FINGER] == 1
    assert check_dataset(report.out) == []
    trials = Trials(report.out)
    (row,) = np.flatnonzero(trials["removal"] == Removal.MISSING_FINGER).tolist()
    touching = trials["closed_touching"][row]
    for name in ("surface_distance", "normal_angle"):
        np.testing.assert_array_equal(np.isnan(trials[name][row]), ~touching)
    assert not touching.all()
    assert replay_trial(report.out, row).same

    # What is not there makes it no more anomalous.
    snapshot = read_snapshot(report.out)
    for part in ("normal_angle", "surface_distance", "normal_sum"):
        assert np.isfinite(snapshot.table[part][row])
