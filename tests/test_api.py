"""Many grasps at once: the order, the workers and the neighbours of a grasp change nothing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from drakegrasp.api import verify_grasp, verify_grasps
from drakegrasp.cluster.connect import connect
from drakegrasp.config import load_config, parse_config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import ConfigError, GraspError, MeshError
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.placement import PlacedObject, place_object
from drakegrasp.verification.result_files import write_results
from drakegrasp.verification.tasks import TASK_GRASPS, plan_verification, split_task

pytestmark = pytest.mark.sim

EDGE = 0.06
#: Contacts on two opposite faces of a cube of that edge, in {O}.
HALF = EDGE / 2.0
POINTS = np.array([[HALF, 0.0, 0.0], [-HALF, 0.01, 0.0], [-HALF, -0.01, 0.0]])
GRASP = np.concatenate([POINTS, np.sign(POINTS) * [1.0, 0.0, 0.0]])


@pytest.fixture(scope="module")
def cube() -> PlacedObject:
    return place_object(trimesh.creation.box([EDGE] * 3))


def plan(grasps: np.ndarray, mesh: PlacedObject | None = None, **options: object):
    defaults = dict.fromkeys(("frame", "X", "X_TO", "hand", "config", "dataset", "rows"))
    return plan_verification(
        grasps, mesh, **{**defaults, "units": None, "method": "forces", **options}
    )


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
    here = verify_grasps(grasps, dataset=test_split, rows=rows)
    with connect(2) as client:
        there = verify_grasps(grasps, dataset=test_split, rows=rows, client=client)
    for name, found in (("here.h5", here), ("there.h5", there)):
        write_results(found, tmp_path / name, config)
    assert (tmp_path / "here.h5").read_bytes() == (tmp_path / "there.h5").read_bytes()
    names = test_split.column("object_props/object_name")[rows]
    assert [v.placed.model.name for v in here] == names.tolist()


def test_results_come_in_the_order_of_the_grasps(cube: PlacedObject) -> None:
    off = GRASP.copy()
    off[0, 0] += 0.02
    order = [off, GRASP, off, GRASP]
    found = verify_grasps([g.ravel() for g in order], cube, method="forces")
    assert [v.outcome for v in found] == [
        Outcome.OFF_SURFACE if g is off else Outcome.SUCCESS for g in order
    ]
    assert [v.p_OQ[0, 0] for v in found] == [g[0, 0] for g in order]


def test_tasks_are_small_and_cover_every_grasp_once(cube: PlacedObject) -> None:
    tasks = plan(np.tile(GRASP.ravel(), (2 * TASK_GRASPS + 1, 1)), cube)
    assert [len(task.indices) for task in tasks] == [TASK_GRASPS, TASK_GRASPS, 1]
    single = [part for task in tasks for part in split_task(task, 1)]
    assert [part.indices for part in single] == [(i,) for i in range(2 * TASK_GRASPS + 1)]
    assert all(part.p_OQ.shape == part.nhat_Q_O.shape == (1, 3, 3) for part in single)


@pytest.mark.parametrize("where", [{}, {"frame": "camera", "X": np.eye(4)}])
def test_no_grasps_are_no_work(cube: PlacedObject, where: dict) -> None:
    assert plan(np.zeros((0, 18)), cube, **where) == []
    assert verify_grasps(np.zeros((0, 18)), cube, **where) == []


def test_one_far_grasp_among_good_ones_is_a_result(test_split: GraspDataset) -> None:
    """Also where it is the only grasp of its object; if all are far, the caller is told."""
    rows = [*rows_of_two_objects(test_split)[:1], 0]
    grasps = test_split.column("grasps")[rows].astype(float)
    grasps[0, :9] += 5.0
    tasks = plan(grasps, dataset=test_split, rows=rows)
    assert sorted(i for task in tasks for i in task.indices) == [0, 1]
    grasps[1, :9] += 5.0
    with pytest.raises(GraspError, match="contact points must lie on the object"):
        plan(grasps, dataset=test_split, rows=rows)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ([0.5], "rows must be whole numbers, got values of type float64"),
        ([True], "rows must be whole numbers, got values of type bool"),
        ([-1], "rows must be 0 to"),
        ([0, 1], r"rows must be one per grasp \(1\), got 2"),
        (None, "there must be a grasp for each of the"),
    ],
)
def test_wrong_rows_are_refused(test_split: GraspDataset, rows: list | None, words: str) -> None:
    grasps = test_split.column("grasps")[:1]
    with pytest.raises(GraspError, match=words):
        plan(grasps, dataset=test_split, rows=rows)


def test_rows_without_a_dataset_are_refused(cube: PlacedObject) -> None:
    with pytest.raises(GraspError, match="rows must be those of a dataset"):
        plan(GRASP.ravel(), cube, rows=[0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"units": "cm"}, "units must be None with a dataset"),
        ({"X": np.eye(4)}, "X must be None with a dataset"),
        ({"mesh": "cup.obj"}, "a mesh or a dataset must be given, got both"),
        ({"dataset": "grasps.hdf5"}, "dataset must be a GraspDataset, .*, got a str"),
        ({"dataset": None}, "a mesh or a dataset must be given, got neither"),
        ({"config": "paper"}, "config must be a Config, see load_config, got a str"),
        ({"config": {}}, "config must be a Config, see load_config, got a dict"),
        ({"rows": []}, r"rows must be one per grasp \(1\), got 0"),
    ],
)
def test_what_does_not_go_together_is_refused(
    test_split: GraspDataset, options: dict, words: str
) -> None:
    asked = {"dataset": test_split, "rows": [0], **options}
    with pytest.raises((GraspError, ConfigError), match=words):
        plan(test_split.column("grasps")[:1], **asked)


def test_row_must_be_named(test_split: GraspDataset) -> None:
    with pytest.raises(GraspError, match=r"row must be that of the dataset .* got None"):
        verify_grasp(test_split.column("grasps")[0], dataset=test_split)


def test_object_keeps_the_rules_that_it_was_placed_by() -> None:
    heavy = load_config(overrides=["objects.mass=2", "physics.friction_hand=0.3"])
    box = trimesh.creation.box([EDGE] * 3)
    placed = place_object(box, config=heavy)
    (task,) = plan(GRASP.ravel(), placed)
    assert parse_config(task.config) == heavy
    # Friction is no matter of the object, its mass is.
    slick = load_config(overrides=["objects.mass=2", "physics.friction_hand=0.1"])
    (task,) = plan(GRASP.ravel(), placed, config=slick)
    assert parse_config(task.config) == slick
    with pytest.raises(ConfigError, match="objects must be as the object was placed with"):
        plan(GRASP.ravel(), placed, config=load_config())
    with pytest.raises(MeshError, match="units must be None for an object that is prepared"):
        plan(GRASP.ravel(), placed, units="cm")


def test_other_mass_than_the_datasets_is_refused(test_split: GraspDataset) -> None:
    """Its objects are prepared: what the configuration says of them could not be kept."""
    with pytest.raises(ConfigError, match="objects must be as in the dataset"):
        plan(
            test_split.column("grasps"),
            dataset=test_split,
            config=load_config(overrides=["objects.mass=2"]),
        )
