"""A build whose palm poses are refined, of two samplers and several resting poses."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from cross_check import cross_check
from helpers.assertions import assert_same_arrays, assert_same_dataset
from helpers.meshes import write_fixed
from helpers.objects import CUBE, write_above

from drakegrasp.config import CloseConfig, Config
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.assembly.split import rank_in_split, split_samples
from drakegrasp.dataset.checks.run import check_dataset
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.rejections import (
    AttemptKey,
    Decisions,
    read_decisions,
    write_decisions,
)
from drakegrasp.dataset.statistics import count_funnel, count_splits
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import MachineError
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.generation import attempts
from drakegrasp.generation.pipeline import NEAR_BORDER, build
from drakegrasp.generation.replay import record_trial, replay_trial
from drakegrasp.generation.work_unit import WorkUnit, run_unit
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.page.attempts import Attempts
from drakegrasp.page.catalog import Catalog
from drakegrasp.pictures.approaches import read_approaches
from drakegrasp.pictures.figures import read_held
from drakegrasp.runtime.executor import run_here
from drakegrasp.verification.placing import place_on_rows

pytestmark = [pytest.mark.sim, pytest.mark.slow]

CHILDREN = 2


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(
        overrides=[
            *("candidates.max=16", "unit_candidates=8", "candidates.method=[normals, rotations]"),
            *(f"refine.children={CHILDREN}", "refine.generations=2", "objects.resting_poses=3"),
            *("filters.outlier_sigma=0", "split.by=object", "objects.mass=0.2"),
            *("physics.friction_hand=1.5", "lift.max_speed=2", "lift.max_acceleration=20"),
            *("lift.hold_time=0.1", "camera.size=32"),
        ]
    )


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> list[MeshSource]:
    folder = tmp_path_factory.mktemp("meshes")
    write_fixed(folder, "8_wineglass_flute")
    shutil.copy(folder / "8_wineglass_flute.obj", folder / "9_wineglass_twin.obj")
    return find_meshes(folder)


@pytest.fixture(scope="module")
def refined(
    sources: list[MeshSource],
    config: Config,
    made_once: Callable[[str, Callable[[Path], object]], Path],
) -> Path:
    """The dataset. Read only."""
    return made_once("refined", lambda out: build(sources, out, config, run_here, show=False))


def trials(out: Path) -> dict[str, np.ndarray]:
    with h5py.File(out / "trials.hdf5") as file:
        return {name: values[:] for name, values in file["trials"].items()}


def samples(out: Path) -> np.ndarray:
    """Return the rows of the samples, whatever split they are in."""
    with h5py.File(out / "trials.hdf5") as file:
        removal, ids = file["successes/removal"][:], file["successes/trial_id"][:]
    return np.asarray(ids[np.isin(removal, [Removal.KEPT, Removal.REFINED_TEST])])


def test_check_finds_nothing(refined: Path) -> None:
    assert [str(v) for v in check_dataset(refined)] == []


def test_hands_whose_image_is_flat_are_not_lifted_and_no_sample_is_lost(
    refined: Path,
    sources: list[MeshSource],
    config: Config,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no OpenGL")

    seeing = override_config(config, ["lift.least_depth_variance=0.001"])
    out = tmp_path / "out"
    build(sources[1:], out, seeing, run_here, show=False)
    assert [str(v) for v in check_dataset(out)] == []

    # The same attempts of the second object; of those that were lifted, the same bits.
    whole, now = trials(refined), trials(out)
    begin = int(np.argmax(whole["object"] == 1))
    whole = {name: values[begin:] for name, values in whole.items()}
    left = now["outcome"] == Outcome.NOT_LIFTED
    assert left.any()
    assert not now["audited"][left].any()
    for name in ("candidate", "child", "closed_p_OQ", "X_OG"):
        assert np.array_equal(whole[name], now[name], equal_nan=True)
    assert np.array_equal(whole["lifted_p_OQ"][~left], now["lifted_p_OQ"][~left], equal_nan=True)
    before, after = samples(refined), samples(out)
    assert len(after) > 2
    assert (before[before >= begin] - begin).tolist() == after.tolist()

    # A recording of such a hand shows no lift; a renderer that fails is the machine's failure.
    (flat, *_) = np.flatnonzero(left & (whole["outcome"] == Outcome.SUCCESS)).tolist()
    assert record_trial(out, flat, tmp_path / "trial.html") is Outcome.NOT_LIFTED
    monkeypatch.setattr(attempts, "render", fail)
    with pytest.raises(MachineError, match="cannot render: no OpenGL"):
        replay_trial(out, flat)


def test_samplers_and_resting_poses_take_turns(refined: Path) -> None:
    columns = trials(refined)
    first = (columns["generation"] == 0) & (columns["standoff_index"] == 0)
    manifest = json.loads((refined / "manifest.json").read_text())
    for i, entry in enumerate(manifest["objects"]):
        own = first & (columns["object"] == i)
        poses = len(entry["resting"])
        assert poses > 1
        turns = np.arange(own.sum())
        np.testing.assert_array_equal(columns["resting"][own], turns % poses)
        np.testing.assert_array_equal(columns["source"][own], 1 - turns // poses % 2)
        for k, resting in enumerate(entry["resting"]):
            rows = columns["X_TO"][(columns["object"] == i) & (columns["resting"] == k)]
            assert np.all(rows == resting["X_TO"])


def test_children_are_those_of_samples_and_near_them(refined: Path) -> None:
    columns = trials(refined)
    names = ("object", "candidate", "standoff_index", "child")
    keys = list(zip(*(columns[name].tolist() for name in names), strict=True))
    row_of = {key: row for row, key in enumerate(keys)}
    later = np.flatnonzero(columns["generation"] > 0)
    assert set(columns["generation"][later].tolist()) == {1, 2}
    for row in later.tolist():
        parent = row_of[*keys[row][:3], int(columns["parent"][row])]
        if columns["outcome"][parent] == Outcome.SUCCESS:
            assert columns["precision"][parent]
        else:
            # One that the scraping of the table alone kept from being a sample.
            assert columns["outcome"][parent] == Outcome.TABLE_CONTACT
            assert columns["clearance_close"][parent] < -CloseConfig().scrape_depth
        assert columns["generation"][row] == columns["generation"][parent] + 1
        assert columns["resting"][row] == columns["resting"][parent]
        # Five standard deviations of 7.5 mm, in three directions.
        X_GP, X_GC = (unpack_pose(columns["X_OG"][i]) for i in (parent, row))
        assert 0.0 < np.linalg.norm(X_GP[:3, 3] - X_GC[:3, 3]) < 5 * 0.0075 * np.sqrt(3)

    # Every sample of the first generations has all of its children, and so has each other parent.
    sample = samples(refined)
    children = Counter(
        row_of[*keys[row][:3], int(columns["parent"][row])] for row in later.tolist()
    )
    assert {*sample[columns["generation"][sample] < 2].tolist()} <= {*children}
    assert {*children.values()} == {CHILDREN}


def test_refined_trial_replays_bit_for_bit(refined: Path) -> None:
    generation = trials(refined)["generation"]
    for wanted in (1, 2):
        again = replay_trial(refined, int(np.flatnonzero(generation == wanted)[-1]))
        assert again.same, again.differences


def test_samples_are_verified_as_they_lay(refined: Path) -> None:
    """Grasps of all rows, those of other resting poses too, are put on the table as tried."""
    dataset = GraspDataset(refined / "grasping_oto.hdf5")
    rows = trials(refined)
    tried, grasps = dataset.column("trial_id"), dataset.column("grasps")
    placed = place_on_rows(grasps, dataset, method="forces")
    assert sorted(each.index for each in placed) == list(range(len(grasps)))
    assert len(np.unique(rows["resting"][tried])) > 1
    for each in placed:
        X_TO = unpack_pose(rows["X_TO"][tried[each.index]])
        np.testing.assert_array_equal(each.placed.X_TO, X_TO)


def test_lifts_are_tried_elsewhere_as_they_lay(
    refined: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mujoco_baseline = pytest.importorskip("drakegrasp.bench.mujoco_baseline")
    stood: list[np.ndarray] = []

    class Peer:
        """Says where the object stood when a lift was tried."""

        def __init__(self, *_: object) -> None:
            pass

        def place(self, X_TO: np.ndarray) -> None:
            self.X_TO = X_TO

        def run(self, _: object) -> object:
            stood.append(self.X_TO)
            return mujoco_baseline.PeerTrial(outcome=Outcome.MOVED)

    monkeypatch.setattr(mujoco_baseline, "MujocoBaseline", Peer)
    lifts = cross_check(refined, 12)["lifts"]
    columns = trials(refined)
    ids = [lift["trial_id"] for lift in lifts]
    assert len(np.unique(columns["resting"][ids])) > 1
    np.testing.assert_array_equal(stood, [unpack_pose(columns["X_TO"][i]) for i in ids])


def test_pictures_are_of_the_first_round_in_one_resting_pose(refined: Path) -> None:
    columns, name = trials(refined), "8_wineglass_flute"
    own = (columns["object"] == 0) & (columns["outcome"] == Outcome.SUCCESS)
    first = columns["generation"] == 0
    counts = np.bincount(columns["resting"][own & first])
    assert (own & ~first).any() and 0 < counts.max() < counts.sum()
    shown = read_approaches(refined, name, read_manifest(refined).config_of(name))
    assert len(shown.successes) == counts.max()
    pose = (columns["object"] == 0) & first & (columns["resting"] == counts.argmax())
    assert shown.attempts == np.count_nonzero(pose)
    held = first & (columns["outcome"] == Outcome.SUCCESS)
    assert read_held(refined).trial_ids.tolist() == np.flatnonzero(held).tolist()


def test_each_of_a_family_is_inspected_by_itself(refined: Path) -> None:
    """A page, a decision and an image are of the attempt itself, not of the first of its family."""
    snapshot, columns = Catalog(refined).current(), trials(refined)
    places = np.flatnonzero(columns["outcome"] == Outcome.SUCCESS)
    labels = {snapshot.label(int(i)) for i in places}
    assert len(labels) == len(places)
    refined_ones = [int(i) for i in places if columns["child"][i]]
    for i in refined_ones:
        assert snapshot.find(snapshot.label(i)) == snapshot.find_key(snapshot.key(i)) == i
    key = snapshot.key(refined_ones[0])
    decisions = Decisions(rejected=frozenset({key}))
    table, query = Attempts(snapshot, decisions), Attempts.query({"decision": "rejected"})
    assert table.select(query).tolist() == [refined_ones[0]]


def test_rejected_child_is_written_and_read(refined: Path, tmp_path: Path) -> None:
    key = AttemptKey("8_wineglass_flute", 3, 1, 7)
    write_decisions(tmp_path / "reject.json", Decisions(rejected=frozenset({key})))
    assert read_decisions(tmp_path / "reject.json").rejected == {key}


def test_refined_grasps_train_and_never_test(refined: Path) -> None:
    child = {
        split: GraspDataset(refined / "grasping_oto.hdf5", split=split).column("grasp_props/child")
        for split in ("train", "test")
    }
    assert (child["train"] > 0).any() and (child["train"] == 0).any()
    assert len(child["test"]) and not child["test"].any()
    with h5py.File(refined / "trials.hdf5") as file:
        assert (file["successes/removal"][:] == Removal.REFINED_TEST).any()


def test_objects_that_are_tested_first_are_spared(
    sources: list[MeshSource], config: Config, tmp_path: Path
) -> None:
    units: list[WorkUnit] = []

    def execute(function: Callable[..., object], items: Iterable[object]) -> Iterator[object]:
        if function is run_unit:
            units.extend(items)  # type: ignore[arg-type]
            raise KeyboardInterrupt
        return run_here(function, items)

    first, last = sorted(sources, key=lambda source: rank_in_split(source.name, config.seed))
    between = np.mean([rank_in_split(source.name, config.seed) for source in sources])
    rules = [f"refine.spared={between}", f"split.test_fraction={between - NEAR_BORDER}"]
    spared = override_config(config, [*rules, "split.valid_fraction=0"])
    with pytest.raises(KeyboardInterrupt):
        build(sources, tmp_path, spared, execute, show=False)
    refined = {unit.header.object_name: unit.refined for unit in units}
    assert refined == {first.name: False, last.name: True}
    assert all(unit.likely_tested is not unit.refined for unit in units)

    # What is spared is what is tested.
    objects, names = np.arange(2, dtype=np.int32), [source.name for source in sources]
    split = split_samples(objects, names, names, names, config.split, config.seed)
    assert [names[i] for i in split["test"]] == [first.name]


def test_unit_that_is_not_refined_has_the_first_round_alone(refined: Path, tmp_path: Path) -> None:
    shutil.copytree(refined, tmp_path, dirs_exist_ok=True)
    manifest = read_manifest(tmp_path)
    header = next(manifest.headers())
    header.path(tmp_path).unlink()
    run_unit(WorkUnit(out=tmp_path, header=header, config=manifest.config, refined=False))
    with h5py.File(header.path(tmp_path)) as shard, h5py.File(header.path(refined)) as whole:
        generation = shard["trials/generation"][:]
        assert len(generation) < len(whole["trials/generation"])
        assert not generation.any()


def test_counts_are_of_the_first_round(refined: Path, config: Config) -> None:
    funnel, columns = count_funnel(refined), trials(refined)
    assert funnel.outcomes.sum() == np.count_nonzero(columns["generation"] == 0) == 2 * 16 * 3
    assert funnel.candidates.tolist() == [16, 16]
    assert funnel.refined[:, 0].sum() == np.count_nonzero(columns["generation"])
    samples = sum(row.samples for row in count_splits(refined))
    assert samples == funnel.removals[:, Removal.KEPT].sum() + funnel.refined[:, 2].sum()
    for row in count_splits(refined):
        assert 0 < row.effective <= row.samples or row.samples == row.effective == 0


@pytest.mark.nightly
def test_more_palm_poses_extend_a_dataset(
    refined: Path, sources: list[MeshSource], config: Config, tmp_path: Path
) -> None:
    """Eight and then sixteen give what sixteen give at once; only the last unit is run."""
    fewer = override_config(config, ["candidates.max=8"])
    build(sources[:1], tmp_path, fewer, run_here, show=False)
    report = build(sources[:1], tmp_path, config, run_here, show=False)
    assert (report.simulated, report.reused) == (1, 1)
    shards = sorted(tmp_path.glob("shards/*/*.h5"))
    assert len(shards) == 2
    for shard in shards:
        assert_same_arrays(shard, refined / shard.relative_to(tmp_path))


def test_target_is_met_and_extended(
    refined: Path, sources: list[MeshSource], config: Config, tmp_path: Path
) -> None:
    # All units are done; the target says which of them belong to the dataset.
    out = tmp_path / "out"
    shutil.copytree(refined, out)
    few = override_config(config, ["samples=2"])
    build(sources, out, few, run_here, show=False)
    assert [str(v) for v in check_dataset(out)] == []
    with h5py.File(out / "trials.hdf5") as file:
        before = {row.tobytes() for row in file["trials/X_OG"][:]}
    assert len(before) < len(trials(refined)["outcome"])

    # More than there can be: all palm poses are tried.
    most = override_config(config, ["samples=1000", "samples_patience=1000"])
    assert build(sources, out, most, run_here, show=False).simulated == 0
    columns = trials(out)
    for name, values in trials(refined).items():
        np.testing.assert_array_equal(columns[name], values)
    assert before <= {row.tobytes() for row in columns["X_OG"]}


def test_assembling_again_gives_the_same(refined: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(refined, copy)
    assemble(copy)
    assert_same_dataset(copy, refined)


def test_palm_poses_about_one_that_only_scrapes_the_table_are_tried(tmp_path: Path) -> None:
    """It is no sample; those about it may be."""
    (tmp_path / "meshes").mkdir()
    can = trimesh.creation.cylinder(CUBE / 2, CUBE, sections=64)
    can.export(tmp_path / "meshes" / "1_can.obj")
    rules = [f"candidates.method={write_above(tmp_path, 0.042)}", "candidates.standoffs=[0.042]"]
    rules += ["refine.children=2", "candidates.max=1", "objects.resting_poses=1"]
    rules += ["lift.max_speed=2", "lift.max_acceleration=20", "lift.hold_time=0.1"]
    out = tmp_path / "out"
    build(find_meshes(tmp_path / "meshes"), out, load_config(overrides=rules), run_here, show=False)
    trials = Trials(out)
    scraped = trials["outcome"][0], trials["clearance_close"][0] < -0.5e-3
    assert scraped == (Outcome.TABLE_CONTACT, True)
    assert trials["child"].tolist() == [0, 1, 2]
    assert check_dataset(out) == []
