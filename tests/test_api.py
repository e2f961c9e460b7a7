"""Many grasps at once: the order, the workers and the neighbours of a grasp change nothing."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from distributed import Client
from helpers.datasets import make_dataset

from drakegrasp.api import building
from drakegrasp.api.building import build_dataset
from drakegrasp.api.verifying import run_verification, verify_grasp, verify_grasps
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared, save_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import ConfigError, GraspError, MachineError, MeshError
from drakegrasp.frames import invert_pose
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import run_here
from drakegrasp.runtime.progress import silent
from drakegrasp.simulation.placement import PlacedObject, place_object
from drakegrasp.verification.hints import find_hints
from drakegrasp.verification.placing import (
    PlacedGrasp,
    dataset_config,
    place_on_object,
    place_on_rows,
)
from drakegrasp.verification.result import Verification
from drakegrasp.verification.verify import verify_batch

pytestmark = pytest.mark.sim

EDGE = 0.06
#: Contacts on two opposite faces of a cube of that edge, in {O}; the hand holds it there.
HALF = EDGE / 2.0
POINTS = np.array([[-0.025, HALF, -0.009], [0.025, HALF, -0.009], [0.0, -HALF, -0.009]])
GRASP = np.concatenate([POINTS, np.sign(POINTS) * [0.0, 1.0, 0.0]])


@pytest.fixture(scope="module")
def cube() -> PlacedObject:
    return place_object(trimesh.creation.box([EDGE] * 3))


def place(grasps: np.ndarray, cube: PlacedObject) -> list[PlacedGrasp]:
    return place_on_object(grasps, cube)


@pytest.fixture(scope="module")
def test_split(small_dataset: Path) -> GraspDataset:
    return GraspDataset(small_dataset / "grasping_oto.hdf5", split="test")


def rows_of_two_objects(data: GraspDataset) -> list[int]:
    """Return the last row of each object, the last object first, then the first row of all."""
    names = data.column("object_props/object_name")
    return [int(np.flatnonzero(names == name)[-1]) for name in sorted(set(names))[::-1]] + [0]


def test_grasps_of_one_object_stand_together(test_split: GraspDataset) -> None:
    """So a process builds each scene once; the indices keep the caller's order."""
    rows = rows_of_two_objects(test_split)
    rows += rows
    names = test_split.column("object_props/object_name")[rows]
    config, grasps = dataset_config(test_split), test_split.column("grasps")[rows]
    placed = place_on_rows(grasps, test_split, rows, config=config)
    assert sorted(grasp.index for grasp in placed) == list(range(len(rows)))
    of_objects = [grasp.placed.model.name for grasp in placed]
    assert of_objects == names[[grasp.index for grasp in placed]].tolist()
    assert sum(a != b for a, b in pairwise(of_objects)) == len(set(names)) - 1


@pytest.mark.parametrize(("together", "tasks"), [(1, 20), (16, 2), (30, 1)])
def test_results_are_delivered_in_order_and_the_object_is_sent_once_in_a_task(
    cube: PlacedObject, together: int, tasks: int
) -> None:
    """Workers finish in any order, and never send the object back."""
    sent, received, delivered = list[bytes](), list[bytes](), list[int]()

    def backwards(function, items):
        for item in reversed(list(items)):
            sent.append(pickle.dumps(item))
            received.append(pickle.dumps(function(pickle.loads(sent[-1]))))
            yield pickle.loads(received[-1])

    grasps = np.tile(GRASP.ravel(), (20, 1))
    grasps[:, 0] += 0.002 * np.arange(20)
    grasps[3:, 9:] = 0.0  # no grasps, so that they cost nothing
    placed = place(grasps, cube)
    results = verify_batch(
        placed, backwards, silent, lambda i, _: delivered.append(i), together=together
    )
    assert delivered == list(range(20)) and len(sent) == tasks
    assert [r.p_OQ[0, 0] for r in results[:3]] == pytest.approx(grasps[:3, 0], abs=1e-4)
    assert [r.outcome for r in results[3:]] == [Outcome.INVALID] * 17
    assert all(r.placed is placed[0].placed for r in results)
    size, config = len(pickle.dumps(cube)), len(pickle.dumps(cube.config))
    assert max(map(len, sent)) < 2 * size + 20 * config
    assert not any(b"visual_vertices" in each for each in received)


@pytest.mark.parametrize(("count", "sizes"), [(9, [2, 2, 2, 2, 1]), (200, [16] * 12 + [8])])
def test_workers_get_tasks_of_few_grasps(
    cube: PlacedObject, monkeypatch: pytest.MonkeyPatch, count: int, sizes: list[int]
) -> None:
    """One worker gets four tasks or more, and no task has more than 16 grasps."""
    (result,) = verify_batch(place(GRASP.reshape(1, 18), cube), run_here, silent)
    client, given = SimpleNamespace(nthreads=lambda: {"worker": 1}), list[int]()

    def execute(_: object, tasks: Iterable[list[PlacedGrasp]]) -> Iterator[object]:
        for task in tasks:
            given.append(len(task))
            yield [(grasp.index, result.findings()) for grasp in task]

    monkeypatch.setattr("drakegrasp.cluster.connect.joined", lambda *_: nullcontext(client))
    checked = "drakegrasp.cluster.worker_checks.checked_workers"
    monkeypatch.setattr(checked, lambda *_: nullcontext())
    monkeypatch.setattr("drakegrasp.cluster.executor.DaskExecutor", lambda _: execute)
    placed = place(np.tile(GRASP.ravel(), (count, 1)), cube)
    run_verification(placed, cube.config, client=client, show=False)  # type: ignore[arg-type]
    assert given == sizes


@pytest.mark.parametrize("where", [{}, {"frame": "camera", "X_TC": np.eye(4)}])
def test_no_grasps_are_no_work(cube: PlacedObject, where: dict) -> None:
    assert verify_grasps(np.zeros((0, 18)), cube, **where) == []


def test_row_knows_the_frames_of_both_cameras(test_split: GraspDataset) -> None:
    """A grasp in the frame of the other camera is tried as it is, and gets a hint."""
    other = GraspDataset(test_split.path.with_name("grasping_otm.hdf5"), split=test_split.split)
    rows = list(range(len(test_split)))

    def hints(grasps: np.ndarray, frame: str) -> set[str]:
        config = dataset_config(test_split)
        placed = place_on_rows(grasps, test_split, rows, config=config, frame=frame)
        return {
            hint
            for grasp in placed
            for hint in find_hints(grasp, grasp.in_object_frame()[1], fits=False)
        }

    own = test_split.column("grasps")
    assert "the frame of the dataset's other camera" in hints(other.column("grasps"), "camera")
    assert hints(own, "object") == hints(own, "table") == {"the camera's frame (camera)"}
    assert not hints(own, "camera")


def test_contacts_in_the_frame_of_the_mesh_file_are_told_and_read_on_a_sample(
    tmp_path: Path,
) -> None:
    """The origin of the file is 0.3 m beside the object."""
    out = make_dataset(tmp_path / "out", tmp_path / "meshes")
    sample = GraspDataset(out / "grasping_oto.hdf5", split="train")[0]
    name, config = sample.props["object_name"], read_manifest(out).config
    prepared = load_prepared(out, name, config)
    moved = replace(prepared.model, p_OM=np.array([0.0, 0.3, 0.0]))
    save_prepared(replace(prepared, model=moved), out, config)
    right = verify_grasp(sample.grasp, sample)
    grasp_M = transform_grasp(invert_pose(moved.X_OM), pack_grasp(right.p_OQ, right.nhat_Q_O))
    lost = verify_grasp(grasp_M, sample)
    assert lost.misplaced and lost.hints == ("the mesh file's frame (mesh)",)
    assert ". This would fit much better: the mesh file's frame (mesh). The grasp" in lost.explain()
    found = verify_grasp(grasp_M, sample, frame="mesh")
    np.testing.assert_allclose(found.p_OQ, right.p_OQ, atol=1e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"units": "cm"}, "units must be None on a GraspDataset, which defines it, got a value"),
        ({"X_TC": np.eye(4)}, "X_TC must be None on a GraspDataset"),
        ({"X_TO": np.eye(4)}, "X_TO must be None on a GraspDataset"),
        ({"on": "OUT/data.hdf5"}, r"on must be GraspDataset\('OUT/data.hdf5', split=...\) for"),
        ({"on": None}, "on must be the path of a mesh, .* or a GraspDataset, got a NoneType"),
        ({"on": "cup.obj"}, r"rows must be given with a GraspDataset only, got \[0\]"),
        ({"config": "paper"}, "config must be a Config, see load_config, got a str"),
        ({"config": {}}, "config must be a Config, see load_config, got a dict"),
        ({"frame": "palm"}, "frame must be one of object, table, camera, world, mesh, got 'palm'"),
        ({"rows": [0.5]}, "rows must be whole numbers, got values of type float64"),
        ({"rows": [True]}, "rows must be whole numbers, got values of type bool"),
        ({"rows": [-1]}, "rows must be 0 to"),
        ({"rows": [0, 1]}, r"rows must be one per grasp \(1\), got 2"),
        ({"rows": []}, r"rows must be one per grasp \(1\), got 0"),
        ({"rows": None}, "without rows there must be a grasp for each of the"),
        # Its objects are prepared: what the configuration says of them could not be kept.
        ({"config": load_config(overrides=["objects.mass=2"])}, "objects must be as in the data"),
    ],
)
def test_what_does_not_go_together_is_refused(
    test_split: GraspDataset, options: dict, words: str
) -> None:
    asked = {"on": test_split, "rows": [0], **options}
    with pytest.raises((GraspError, ConfigError), match=words):
        verify_grasps(test_split.column("grasps")[:1], **asked)


def test_one_grasp_of_a_dataset_names_its_row(test_split: GraspDataset) -> None:
    grasp = test_split[0].grasp
    with pytest.raises(
        GraspError, match=r"row must be given with a GraspDataset, 0 to \d+, got None"
    ):
        verify_grasp(grasp, test_split)
    with pytest.raises(GraspError, match=r"row must be one whole number, got \[0\]"):
        verify_grasp(grasp, test_split, row=[0])
    with pytest.raises(GraspError, match="one grasp must be a vector, got 2 grasps; many go into"):
        verify_grasp([grasp, grasp], test_split, row=0)
    with pytest.raises(GraspError, match="rows must be None on a Sample, which is one row, got"):
        verify_grasp(grasp, test_split[0], row=0)


def same(one: Verification, other: Verification) -> bool:
    """Return whether two verdicts are the same, to the bit."""
    return (
        one.outcome is other.outcome
        and one.placed.model.name == other.placed.model.name
        and np.array_equal(one.p_OQ, other.p_OQ)
        and np.array_equal(one.placed.X_TO, other.placed.X_TO)
        and one.epsilon == other.epsilon
        and one.config == other.config
    )


def test_everything_that_a_grasp_can_be_on(test_split: GraspDataset, tmp_path: Path) -> None:
    """A mesh as file and in memory, a placed object, a row, and a sample are the same object."""
    box = trimesh.creation.box([EDGE] * 3)
    box.export(tmp_path / "cube.obj")
    scaled = trimesh.creation.box([100.0 * EDGE] * 3)
    placed = place_object(box)
    on_mesh = [
        verify_grasp(GRASP.ravel(), on, units=units)
        for on, units in [(tmp_path / "cube.obj", None), (str(tmp_path / "cube.obj"), "m"),
                          (box, None), (scaled, "cm"), (placed, None)]
    ]  # fmt: skip
    assert all(verdict.matches for verdict in on_mesh)
    assert len({verdict.epsilon for verdict in on_mesh}) == 1

    # A sample is its row, also as a copy, in another process, and of a slice.
    row = len(test_split) - 1
    sample = test_split[row]
    by_row = verify_grasp(sample.grasp, test_split, row=row)
    assert by_row.config.hand == "barrett" and by_row.surface_distance.max() < 0.005
    copies = [copy.deepcopy(sample), pickle.loads(pickle.dumps(sample))]
    for each in (sample, test_split[row:][0], *copies, replace(sample, trial_id=0)):
        assert same(by_row, verify_grasp(sample.grasp, each))
    pair = verify_grasps([sample.grasp, sample.grasp], sample)
    assert [same(by_row, each) for each in pair] == [True, True]
    (by_rows,) = verify_grasps(sample.grasp, test_split, rows=[row])
    assert same(by_row, by_rows)


@pytest.mark.parametrize("dtype", ["float64", "float32", "float16", "bfloat16"])
def test_tensors_go_in(cube: PlacedObject, dtype: str) -> None:
    torch = pytest.importorskip("torch")
    rounded = torch.tensor(GRASP.ravel(), dtype=getattr(torch, dtype), requires_grad=True)
    numbers = rounded.detach().double().numpy()
    due = verify_grasp(numbers, cube)
    X_TC = torch.tensor(cube.X_TO, dtype=torch.float32, requires_grad=True)
    assert same(due, verify_grasp(rounded, cube))
    on_table = verify_grasps(rounded[None], cube, frame="camera", X_TC=X_TC)
    assert same(due, on_table[0])
    both = verify_grasps([rounded, rounded], cube)
    lists = verify_grasps([list(rounded), numbers.tolist()], cube)
    assert all(same(due, each) for each in [*both, *lists])
    with pytest.raises(GraspError, match="a grasp must be 18 numbers"):
        verify_grasps([rounded, rounded[:3]], cube)


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
    meshes = small_meshes if objects else "builtin"
    with pytest.raises(MeshError, match=r"only must be names of objects \(.*\), got '9_cup'"):
        build_dataset(meshes, tmp_path / "out", only=["9_cup"], cluster=_never())
    assert not (tmp_path / "out").exists()


def test_work_is_for_a_client_or_for_workers(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="workers must not be given with a client, got both"):
        build_dataset("builtin", tmp_path / "out", client=object(), workers=2)
    assert not (tmp_path / "out").exists()


def test_build_that_gets_no_workers_leaves_nothing(small_meshes: Path, tmp_path: Path) -> None:
    with pytest.raises(MachineError, match="no workers"):
        build_dataset(small_meshes, tmp_path / "out", cluster=_none(), show=False)
    assert not (tmp_path / "out").exists()


@contextmanager
def _none() -> Iterator[Client]:
    raise MachineError("no workers")
    yield


@contextmanager
def _never() -> Iterator[Client]:
    pytest.fail("a cluster was started")
    yield


def test_few_grasps_and_those_of_one_worker_are_verified_in_this_process(
    cube: PlacedObject, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two workers save 16 of 32 verdicts of this process, which is what starting them takes."""
    module = "drakegrasp.api.verifying"
    monkeypatch.setattr(f"{module}.verify_batch", lambda grasps, execute, *_, **__: [execute])
    monkeypatch.setattr("drakegrasp.cluster.connect.joined", lambda *_: _none())
    few, more = (place([GRASP.ravel()] * count, cube) for count in (32, 33))
    for grasps, workers in ((few, 2), (more, 1)):
        found = run_verification(grasps, cube.config, workers=workers, show=False)
        assert found == [run_here]
    with pytest.raises(MachineError, match="no workers"):
        run_verification(more, cube.config, workers=2, show=False)


def test_workers_are_asked_whether_they_see_the_meshes_of_a_build(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    trimesh.creation.box([EDGE] * 3).export(folder / "1_box_a.obj")

    def refuse(_client: object, _config: object, _out: Path, meshes: list[Path]) -> None:
        raise MachineError(f"asked for {', '.join(path.name for path in meshes)}")

    monkeypatch.setattr(building, "checked_workers", refuse)
    client = nullcontext(SimpleNamespace(dashboard_link=""))
    with pytest.raises(MachineError, match="asked for 1_box_a"):
        build_dataset(folder, tmp_path / "out", cluster=client, show=False)  # type: ignore[arg-type]
