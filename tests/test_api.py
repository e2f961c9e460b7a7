"""Many grasps at once: the order, the workers and the neighbours of a grasp change nothing."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from distributed import Client

from drakegrasp.api.building import build_on
from drakegrasp.api.verifying import (
    PlacedObject,
    place_object,
    verify_grasp,
    verify_grasps,
    verify_rows,
)
from drakegrasp.cluster.connect import connect
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import ConfigError, GraspError, MeshError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.progress import silent
from drakegrasp.verification.batch import verify_batch
from drakegrasp.verification.hints import find_hints
from drakegrasp.verification.placed_grasp import place_on_object, place_on_rows
from drakegrasp.verification.result_files import write_results
from drakegrasp.verification.verify import PlacedGrasp

pytestmark = pytest.mark.sim

EDGE = 0.06
#: Contacts on two opposite faces of a cube of that edge, in {O}.
HALF = EDGE / 2.0
POINTS = np.array([[HALF, 0.0, 0.0], [-HALF, 0.01, 0.0], [-HALF, -0.01, 0.0]])
GRASP = np.concatenate([POINTS, np.sign(POINTS) * [1.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def cube() -> PlacedObject:
    return place_object(trimesh.creation.box([EDGE] * 3))


def place(grasps: np.ndarray, cube: PlacedObject) -> list[PlacedGrasp]:
    return place_on_object(grasps, cube, method="forces")


@pytest.fixture(scope="module")
def test_split(small_dataset: Path) -> GraspDataset:
    return GraspDataset(small_dataset / "grasping_oto.hdf5", split="test")


def rows_of_two_objects(data: GraspDataset) -> list[int]:
    """Return the last row of each object, the last object first, then the first row of all."""
    names = data.column("object_props/object_name")
    return [int(np.flatnonzero(names == name)[-1]) for name in sorted(set(names))[::-1]] + [0]


@pytest.mark.slow
@pytest.mark.cluster
def test_workers_change_nothing(test_split: GraspDataset, tmp_path: Path) -> None:
    rows = rows_of_two_objects(test_split)
    grasps = test_split.column("grasps")[rows].astype(float)
    config = read_manifest(test_split.path.parent).config
    here = verify_rows(test_split, grasps, rows)
    with connect(2) as client:
        there = verify_rows(test_split, grasps, rows, client=client)
    for name, results in (("here.h5", here), ("there.h5", there)):
        write_results(results, tmp_path / name, config)
    assert (tmp_path / "here.h5").read_bytes() == (tmp_path / "there.h5").read_bytes()
    names = test_split.column("object_props/object_name")[rows]
    assert [v.placed.model.name for v in here] == names.tolist()
    assert all(isinstance(v.placed, PlacedObject) for v in here)


def test_results_come_in_the_order_of_the_grasps(cube: PlacedObject) -> None:
    off = GRASP.copy()
    off[0, 0] = np.nan
    order = [off, GRASP, off, GRASP]
    results = cube.verify([g.ravel() for g in order], method="forces")
    assert [v.outcome for v in results] == [
        Outcome.INVALID if g is off else Outcome.SUCCESS for g in order
    ]
    np.testing.assert_array_equal([v.p_OQ[0, 0] for v in results], [g[0, 0] for g in order])


def test_every_grasp_is_placed_once(cube: PlacedObject) -> None:
    grasps = np.tile(GRASP.ravel(), (9, 1))
    grasps[:, 2] = 1e-3 * np.arange(9)
    placed = place(grasps, cube)
    assert [grasp.index for grasp in placed] == list(range(9))
    assert all(grasp.p_OQ.shape == grasp.nhat_Q_O.shape == (3, 3) for grasp in placed)
    assert [grasp.p_OQ[0, 2] for grasp in placed] == grasps[:, 2].tolist()


def test_grasps_of_one_object_stand_together(test_split: GraspDataset) -> None:
    """So a process builds each scene once; the indices keep the caller's order."""
    rows = rows_of_two_objects(test_split)
    rows += rows
    names = test_split.column("object_props/object_name")[rows]
    placed = place_on_rows(test_split.column("grasps")[rows], test_split, rows)
    assert sorted(grasp.index for grasp in placed) == list(range(len(rows)))
    of_objects = [grasp.placed.model.name for grasp in placed]
    assert of_objects == names[[grasp.index for grasp in placed]].tolist()
    assert sum(a != b for a, b in pairwise(of_objects)) == len(set(names)) - 1


@pytest.mark.parametrize("together", [1, 2, 9])
def test_results_are_delivered_in_order_from_any_executor(
    cube: PlacedObject, together: int
) -> None:
    """Workers finish in any order, and never send the object back."""

    def backwards(function, items):
        return (function(pickle.loads(pickle.dumps(item))) for item in reversed(list(items)))

    grasps = np.tile(GRASP.ravel(), (3, 1))
    grasps[:, 0] += 0.02 * np.arange(3)
    placed, delivered = place(grasps, cube), list[int]()
    results = verify_batch(
        placed, backwards, silent, lambda i, _: delivered.append(i), together=together
    )
    assert delivered == [0, 1, 2]
    assert [r.p_OQ[0, 0] for r in results] == pytest.approx(grasps[:, 0], abs=1e-4)
    assert all(r.placed is placed[0].placed for r in results)


@pytest.mark.parametrize("where", [{}, {"frame": "camera", "X_TC": np.eye(4)}])
def test_no_grasps_are_no_work(cube: PlacedObject, where: dict) -> None:
    assert cube.verify(np.zeros((0, 18)), **where) == []


def test_object_goes_to_a_worker_with_many_grasps_and_does_not_come_back(
    cube: PlacedObject,
) -> None:
    sent, received = list[int](), list[int]()

    def far_away(function, items):
        for item in items:
            there = pickle.dumps(item)
            back = pickle.dumps(function(pickle.loads(there)))
            sent.append(len(there))
            received.append(len(back))
            yield pickle.loads(back)

    placed = place(np.tile(GRASP.ravel(), (20, 1)), cube)
    verify_batch(placed, far_away, silent, together=16)
    size = len(pickle.dumps(cube))
    assert len(sent) == 2 and max(sent) < 2 * size + 20 * len(pickle.dumps(cube.config))
    assert not any(b"visual_vertices" in pickle.dumps(each) for each in received)


def test_row_knows_the_frames_of_both_cameras(test_split: GraspDataset) -> None:
    """A grasp in the frame of the other camera is tried as it is, and gets a hint."""
    other = GraspDataset(test_split.path.with_name("grasping_otm.hdf5"), split=test_split.split)
    rows = list(range(len(test_split)))
    placed = place_on_rows(other.column("grasps"), test_split, rows)
    hints = [
        find_hints(
            g.placed.model, load_hand("barrett"), g.p_OQ, g.nhat_Q_O, X_OA=g.X_OA, X_OB=g.X_OB
        )
        for g in placed
    ]
    assert any("the frame of the dataset's other camera" in each for each in hints)
    own = place_on_rows(test_split.column("grasps"), test_split, rows)
    assert not any(
        find_hints(
            g.placed.model, load_hand("barrett"), g.p_OQ, g.nhat_Q_O, X_OA=g.X_OA, X_OB=g.X_OB
        )
        for g in own
    )


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([0.5], "rows must be whole numbers, got values of type float64"),
        ([True], "rows must be whole numbers, got values of type bool"),
        ([-1], "rows must be 0 to"),
        ([0, 1], r"rows must be one per grasp \(1\), got 2"),
        (None, "without rows there must be a grasp for each of the"),
    ],
)
def test_wrong_rows_are_refused(test_split: GraspDataset, rows: list | None, words: str) -> None:
    grasps = test_split.column("grasps")[:1]
    with pytest.raises(GraspError, match=words):
        verify_rows(test_split, grasps, rows)


@pytest.mark.filterwarnings("ignore:verify_grasps will be gone")
@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"units": "cm"}, "units must be None with a dataset"),
        ({"X_TC": np.eye(4)}, "X_TC must be None with a dataset"),
        ({"mesh": "cup.obj"}, "mesh must be None with a dataset"),
        ({"dataset": "grasps.hdf5"}, "data must be a GraspDataset, .*, got a str"),
        ({"dataset": None}, "a mesh or a dataset must be given, got neither"),
        ({"dataset": None, "mesh": "cup.obj"}, "rows must be None without a dataset, got rows"),
        ({"config": "paper"}, "config must be a Config, see load_config, got a str"),
        ({"config": {}}, "config must be a Config, see load_config, got a dict"),
        ({"rows": []}, r"rows must be one per grasp \(1\), got 0"),
        # Its objects are prepared: what the configuration says of them could not be kept.
        (
            {"config": load_config(overrides=["objects.mass=2"])},
            "objects must be as in the dataset",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(
    test_split: GraspDataset, options: dict, words: str
) -> None:
    asked = {"dataset": test_split, "rows": [0], **options}
    with pytest.raises((GraspError, ConfigError), match=words):
        verify_grasps(test_split.column("grasps")[:1], **asked)


def test_calls_of_the_version_before_give_the_same_with_a_warning(cube: PlacedObject) -> None:
    (new,) = cube.verify(GRASP.ravel(), method="forces")
    with pytest.warns(FutureWarning, match=r"use place_object\(mesh, ...\).verify\(grasps\)"):
        (old,) = verify_grasps(GRASP.reshape(1, 18), cube, method="forces")
    with pytest.warns(FutureWarning, match="verify_grasp will be gone"):
        one = verify_grasp(GRASP.ravel(), cube, method="forces", frame="object")
    shares = [verdict.forces.planned_share for verdict in (new, old, one)]
    assert len(set(shares)) == 1


def test_row_of_a_dataset_may_be_given_to_the_call_of_the_version_before(
    test_split: GraspDataset,
) -> None:
    with pytest.warns(FutureWarning, match="use verify_rows"):
        verdict = verify_grasp(np.full(18, np.nan), dataset=test_split, row=0)
    assert verdict.outcome is Outcome.INVALID


def test_object_keeps_the_rules_that_it_was_placed_by() -> None:
    heavy = load_config(overrides=["objects.mass=2", "physics.friction_hand=0.3"])
    placed = place_object(trimesh.creation.box([EDGE] * 3), config=heavy)
    assert placed.config == place_object(placed).config == heavy
    # Friction and hand are no matter of the object, its mass is.
    slick = load_config(overrides=["objects.mass=2", "physics.friction_hand=0.1"])
    (grasp,) = place_on_object(GRASP.ravel(), place_object(placed, config=slick))
    assert grasp.config == slick
    assert place_object(placed, hand="franka").config.hand == "franka"
    with pytest.raises(ConfigError, match="objects must be as the object was placed with"):
        place_object(placed, config=load_config())
    with pytest.raises(MeshError, match="units must be None for a prepared object"):
        place_object(placed, units="cm")


@pytest.mark.parametrize("objects", [True, False], ids=["files", "builtin"])
def test_unknown_object_is_refused_before_anything_starts(
    small_meshes: Path, tmp_path: Path, objects: bool
) -> None:
    sources = find_meshes(small_meshes) if objects else None
    with pytest.raises(MeshError, match=r"only must be names of objects \(.*\), got '9_cup'"):
        build_on(_never(), sources, tmp_path / "out", load_config(), only=["9_cup"])
    assert not (tmp_path / "out").exists()


@contextmanager
def _never() -> Iterator[Client]:
    pytest.fail("a cluster was started")
    yield
