"""What `drakegrasp verify` makes of its options: grasps of a dataset, each as it was tried."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from helpers.commands import error_line, run
from helpers.datasets import OTO, make_dataset
from helpers.hands import write_with_optional_fingers

import drakegrasp as dg
from drakegrasp.cli.verify import Target, place
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneRows
from drakegrasp.errors import DataError, GraspError, HandError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.page.app import Inspection

DRAWN = [
    "randomize.friction_hand=[0.7, 1.3]",
    "randomize.friction_table=[0.7, 1.3]",
    "randomize.mass=[0.5, 1.5]",
]
#: What a verdict among others has besides.
NEIGHBOURS = ("clean", "neighbour_shift", "neighbour_turn")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with drawn friction and mass; two objects are tested. Read only."""
    folder = tmp_path_factory.mktemp("drawn")
    return make_dataset(folder / "out", folder, overrides=[*DRAWN, "split.by=class"])


def placed(out: Path, grasps: Path | None = None, **options: Any) -> Any:
    """Return the grasps of a file, or a dataset's own, as options place them."""
    return place(grasps or out / OTO, Target(**options))


def test_a_value_that_is_set_wins_over_the_drawn_one(drawn: Path) -> None:
    data = GraspDataset(drawn / OTO, split="test")
    grasps, _, _ = placed(drawn, overrides=("physics.friction_hand=0.9",))
    for grasp in grasps:
        assert grasp.config.physics.friction_hand == 0.9
        assert grasp.placed.model.friction is None  # which would win
        assert grasp.config.physics.friction_table == pytest.approx(
            float(data[grasp.index].conditions["friction_table"])
        )


def test_a_given_configuration_draws_nothing(drawn: Path) -> None:
    grasps, config, _ = placed(drawn, config="paper")
    assert config == load_config("paper")
    assert {grasp.config for grasp in grasps} == {config}
    masses = [e.mass for e in read_manifest(drawn).objects]
    assert all(np.isclose(masses, grasp.placed.model.mass).any() for grasp in grasps)


def posture_file(path: Path, data: GraspDataset, **columns: object) -> Path:
    """Write open hands about the objects of the rows of a split."""
    count = len(load_hand().joint_names)
    X_FG = np.tile(np.eye(4), (len(data), 1, 1))
    np.savez(path, X_FG=X_FG, q_grasp=np.zeros((len(data), count)), **columns)  # type: ignore[arg-type]
    return path


def test_postures_of_rows_are_tried_with_the_friction_and_mass_of_their_rows(
    drawn: Path, tmp_path: Path
) -> None:
    data = GraspDataset(drawn / OTO, split="train")
    rows = np.arange(len(data))[::-1]
    path = posture_file(tmp_path / "p.npz", data, row=rows)
    grasps, _, told = place(path, Target(dataset=drawn / OTO, split="train"))
    assert sorted(grasp.index for grasp in grasps) == list(range(len(data)))
    for grasp in grasps:
        row = data[int(rows[grasp.index])]
        model, physics = grasp.placed.model, grasp.config.physics
        assert model.name == row.props["object_name"]
        assert model.mass == pytest.approx(float(row.props["work2mass"][0]))
        usual = load_prepared(drawn, model.name, read_manifest(drawn).config).model
        np.testing.assert_allclose(model.I_OOcm_O / model.mass, usual.I_OOcm_O / usual.mass)
        for name in ("friction_hand", "friction_table"):
            assert getattr(physics, name) == pytest.approx(float(row.conditions[name]))
    assert told is not None
    assert told.row.tolist() == rows.tolist()


@pytest.mark.sim
@pytest.mark.parametrize(
    ("names", "words", "count"),
    [
        (["box", "mug", "box"], "1 postures of mug are left out, as --object is box", 2),
        (["mug"] * 2, "postures of mug are tried on box, the --object", 2),
        (["mug", "can"], "postures must be of box, the --object, got can, mug", 0),
    ],
)
def test_postures_of_a_mesh_are_those_that_name_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], names: list[str], words: str, count: int
) -> None:
    trimesh.creation.box([0.06] * 3).export(tmp_path / "box.obj")
    q, X = np.zeros((len(names), len(load_hand().joint_names))), [np.eye(4)] * len(names)
    np.savez(tmp_path / "p.npz", X_FG=X, q_grasp=q, object=names)
    given = (tmp_path / "p.npz", Target(mesh=tmp_path / "box.obj"))
    if not count:
        with pytest.raises(GraspError, match=words):
            place(*given)
        return
    grasps, _, _ = place(*given)
    assert [grasp.index for grasp in grasps] == list(range(count))
    told = capsys.readouterr().err
    assert words in told


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"frame": "camera"}, "--frame must be left out with postures, got camera"),
        ({"hand": "allegro"}, "--hand must be left out with postures and --dataset, got allegro"),
        ({"mesh": Path("a.obj")}, "--object or --dataset must be given, got both"),
    ],
)
def test_options_that_postures_answer_are_refused(
    drawn: Path, tmp_path: Path, options: dict[str, object], words: str
) -> None:
    path = posture_file(tmp_path / "p.npz", GraspDataset(drawn / OTO, split="train"))
    with pytest.raises(GraspError, match=words):
        place(path, Target(**{"dataset": drawn / OTO, **options}))  # type: ignore[arg-type]


def test_a_hand_whose_files_have_changed_is_refused_unless_it_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hand file is named relative to a folder; the dataset is used from another."""
    (tmp_path / "meshes").mkdir()
    hand = write_with_optional_fingers(tmp_path)
    monkeypatch.chdir(tmp_path)
    config = load_config(overrides=[f"hand={hand.name}"])
    assert config.hand == str(hand) == load_config(hand=hand.name).hand
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", overrides=[f"hand={hand.name}"])
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    grasps, used, _ = placed(out)
    assert grasps and used.hand == str(hand)

    # A change since then.
    hand.write_text(f"{hand.read_text()}\n# changed\n")
    with pytest.raises(HandError, match="files of the hand must be those of the dataset"):
        placed(out)
    grasps, used, _ = placed(out, hand=f"../{hand.name}")
    assert grasps and load_hand(used.hand).name == "optional"


def test_a_hand_of_the_package_keeps_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "franka").write_text("a file of that name")
    monkeypatch.chdir(tmp_path)
    assert load_config(hand="franka").hand == "franka"


def test_grasps_of_others_are_tried_on_rows_that_leave_fingers_out(tmp_path: Path) -> None:
    """Only their objects and cameras are needed; the rows' own grasps are refused."""
    out = make_dataset(tmp_path / "out", tmp_path)
    with h5py.File(out / OTO, "r+") as file:
        file["test/grasp_props/unused"][:] = 0b001
        predicted = file["test/grasps"][:]
    np.save(tmp_path / "predicted.npy", predicted)
    given = {"dataset": out / OTO, "split": "test"}
    grasps, _, _ = placed(out, tmp_path / "predicted.npy", **given)
    assert len(grasps) == len(predicted) > 0
    with pytest.raises(GraspError, match="test must have contacts of all fingers, got "):
        placed(out, split="test")


@pytest.fixture(scope="module")
def views(small_clutter: Path) -> SceneRows:
    """Views of scenes of several objects."""
    return SceneRows(small_clutter / "clutter.hdf5", split="test")


@pytest.mark.sim
def test_grasps_of_views_have_the_verdicts_of_their_scenes(
    views: SceneRows, tmp_path: Path
) -> None:
    """On both outputs; the file of results is for no page of images."""
    rows, path, out = [len(views) - 1, 0], tmp_path / "grasps.h5", tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["grasps"], file["rows"] = views.column("grasps")[rows], rows
    given = ("verify", path, "--dataset", views.path, "--workers", 1, "--json", "--out", out)
    result = run(*given)
    assert result.exit_code == 0, result.output
    due = dg.verify_grasps(views.column("grasps")[rows], on=views, rows=rows)
    moved = np.array([(d.shift, d.turn) for d in (verdict.disturbance for verdict in due) if d])
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    with h5py.File(out) as file:
        columns = {name: file["grasps"][name][:].tolist() for name in NEIGHBOURS}
        told = {name: file["rows"][name][:].tolist() for name in ("row", "trial_id")}
        assert file["rows"].attrs["camera"] == "view"
    assert told == {"row": rows, "trial_id": views.column("trial_id")[rows].tolist()}
    assert [line["explain"] for line in lines] == [verdict.explain() for verdict in due]
    for found in (columns, {name: [line[name] for line in lines] for name in NEIGHBOURS}):
        assert found["clean"] == [verdict.clean for verdict in due]
        pairs = np.column_stack([found["neighbour_shift"], found["neighbour_turn"]])
        np.testing.assert_allclose(pairs, moved, rtol=1e-5)  # lines are rounded
    count = sum(verdict.clean for verdict in due)
    assert f", {count} clean\n" in run(*given[:-3]).stderr
    with pytest.raises(DataError, match="must be for rows of a data file, got views of scenes"):
        Inspection(views.path.parent, out)


@pytest.mark.sim
def test_postures_of_views_need_no_rows(views: SceneRows, tmp_path: Path) -> None:
    """One for each view, or those of an object on each view of it; always among its neighbours."""
    names = views.column("object_props/object_name").tolist()
    q = np.zeros((len(views), len(load_hand().joint_names)))
    np.savez(tmp_path / "each.npz", X_FG=np.tile(np.eye(4), (len(views), 1, 1)), q_grasp=q)
    np.savez(tmp_path / "one.npz", X_FG=np.eye(4)[None], q_grasp=q[:1], object=names[:1])
    for name, count in (("each", len(views)), ("one", names.count(names[0]))):
        grasps, _, told = place(tmp_path / f"{name}.npz", Target(dataset=views.path))
        assert told is not None and len(grasps) == len(told.row) == count
        assert all(grasp.placed.around for grasp in grasps)
    given = (tmp_path / "each.npz", "--dataset", views.path, "--protocol", "dexgraspbench")
    assert "--protocol must be lift for scenes of several objects, got dexgraspbench" in (
        error_line(run("verify", *given))
    )
