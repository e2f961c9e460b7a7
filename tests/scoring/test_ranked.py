"""Predicted contacts and postures: ranked by confidence, and refused where they do not fit."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from helpers.scores import ranked_array

from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import GraspError
from drakegrasp.exchange.columns import read_contacts
from drakegrasp.frames import invert_pose, unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.scoring.verdict import rank_file
from drakegrasp.verification.placing import dataset_config, place_on_rows

GRASPS = np.arange(2 * 3 * 18, dtype=float).reshape(2, 3, 18)


def test_predictions_of_a_row_are_ranked_by_confidence_and_equal_ones_keep_their_order():
    ranked = ranked_array("a", GRASPS, length=2, confidence=[[0.1, 0.9, 0.9], [0.5, 0.4, 0.6]])
    assert ranked.of_row.tolist() == [0, 0, 0, 1, 1, 1]
    assert ranked.rank.tolist() == [0, 1, 2, 0, 1, 2]
    np.testing.assert_array_equal(
        ranked.grasps, [GRASPS[0, 1], GRASPS[0, 2], GRASPS[0, 0], *GRASPS[1, [2, 0, 1]]]
    )


def test_without_confidence_the_order_is_the_rank():
    ranked = ranked_array("a", GRASPS, length=2)
    np.testing.assert_array_equal(ranked.grasps, GRASPS.reshape(6, 18))
    assert ranked.confidence is None


@pytest.mark.parametrize("none", [np.nan, np.inf, -np.inf, True, 1j])
def test_a_confidence_that_is_no_finite_number_is_refused(none):
    """It would have a rank, and nobody could say which."""
    with pytest.raises(GraspError, match=r"confidence must be \(1, 3\) finite numbers, .*, got"):
        ranked_array("a", GRASPS[:1], length=1, confidence=[[none, 0.2, 0.3]])


def test_bad_numbers_stay_as_they_are_failures_of_the_network():
    assert np.isnan(ranked_array("a", np.full((2, 18), np.nan), length=2).grasps).all()


def test_a_file_states_rows_and_confidence(tmp_path):
    path, flat, rows = tmp_path / "p.h5", GRASPS.reshape(6, 18), np.array([4, 4, 4, 7, 7, 7])
    with h5py.File(path, "w") as file:
        file["test/grasps"], file["test/rows"] = flat, rows
        file["test/confidence"] = np.arange(6.0)
    ranked = ranked_array("a", **read_contacts(path, split="test"), length=9)
    assert ranked.of_row.tolist() == rows.tolist()
    np.testing.assert_array_equal(ranked.grasps, flat[[2, 1, 0, 5, 4, 3]])
    assert len(ranked.sha256) == 64 and ranked.file == "a"
    np.save(tmp_path / "p.npy", GRASPS)
    np.testing.assert_array_equal(read_contacts(tmp_path / "p.npy", axes=3)["grasps"], GRASPS)


@pytest.mark.parametrize(
    ("rows", "confidence", "message"),
    [
        (None, None, "for each of the 5 rows of test in data.hdf5, got 2"),
        ([0, 5], None, "rows must be 0 to 4 of test in data.hdf5, got 5"),
        ([0.0, 1.0], None, "rows must be whole numbers"),
        ([0, 1], [0.5, 0.5], r"confidence must be \(2, 3\)"),
    ],
)
def test_what_does_not_fit_is_refused(rows, confidence, message):
    with pytest.raises(GraspError, match=message):
        ranked_array("a", GRASPS, length=5, rows=rows, confidence=confidence)


# Postures

HAND = load_hand()


def own_postures(data, rows):
    """The samples of some rows as arrays of a file of predicted postures, in {O}."""
    trials = Trials(data.path.parent)
    chosen = data.column("trial_id")[rows]
    opened = [joint_positions(HAND, s, np.zeros(3)) for s in trials["spread"][chosen]]
    return {
        "row": rows,
        "X_FG": unpack_pose(trials["X_OG"][chosen]),
        "q_grasp": trials["closed_q"][chosen],
        "q_pregrasp": np.array([[q[name] for name in HAND.joint_order] for q in opened]),
    }


def camera_poses(data, rows):
    """X_OC of the camera of some rows."""
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{data.camera}")[rows])
    X_TO = unpack_pose(Trials(data.path.parent)["X_TO"][data.column("trial_id")[rows]])
    return np.asarray(invert_pose(X_TO) @ X_TC)


def test_postures_of_rows_are_ranked_and_bad_ones_keep_their_reason(data, tmp_path):
    given = own_postures(data, np.array([2, 0, 2, 1]))
    given["q_grasp"][2, 0] = np.nan
    names = data.column("object_props/object_name")[given["row"]]
    np.savez(
        tmp_path / "p.npz",
        **given,
        confidence=[0.2, 0.5, 0.9, 0.1],
        object=[names[0], names[1], names[2], "cup"],
    )
    ranked = rank_file(tmp_path / "p.npz", data)
    assert ranked.of_row.tolist() == [0, 1, 2, 2]
    assert ranked.rank.tolist() == [0, 0, 0, 1]
    assert ranked.row.tolist() == [1, 3, 2, 0]
    assert ranked.invalid[0] == ranked.invalid[3] == ""
    assert ranked.invalid[1] == f"object must be that of row 1, {names[3]}, got cup"
    assert ranked.invalid[2] == "q_grasp must be finite numbers, got others"


def test_posture_in_the_frame_of_the_rows_camera_is_that_in_the_objects(data, tmp_path):
    rows = np.arange(len(data))
    given = own_postures(data, rows)
    X_OGs = given["X_FG"]
    X_CG = invert_pose(camera_poses(data, rows)) @ given["X_FG"]
    # An object lies as in its row, whatever the file says.
    given |= {"X_FG": X_CG, "resting": np.full(len(rows), 7)}
    np.savez(tmp_path / "p.npz", **given, frame="camera")
    table = rank_file(tmp_path / "p.npz", data)
    placed = sorted(
        place_on_rows(table, data, rows.tolist(), config=dataset_config(data)),
        key=lambda g: g.index,
    )
    for grasp, X_OG, row in zip(placed, X_OGs, rows.tolist(), strict=True):
        np.testing.assert_allclose(grasp.postures[0].X_OG, X_OG, atol=1e-5)
        assert grasp.placed.model.name == data.value("object_props/object_name", row)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"row": np.array([0, 99])}, "rows must be 0 to .*, got 99"),
        ({"row": np.array([0.5, 1.0])}, "rows must be whole numbers"),
        ({"X_TC": np.tile(np.eye(4), (2, 1, 1))}, "X_TC must be left out: the camera is that of"),
        ({"confidence": np.zeros(3)}, r"confidence must be \(2,\) finite numbers"),
    ],
)
def test_what_belongs_to_no_row_is_refused(data, tmp_path, changes, words):
    np.savez(tmp_path / "p.npz", **(own_postures(data, np.array([0, 1])) | changes))
    with pytest.raises(GraspError, match=words) as caught:
        rank_file(tmp_path / "p.npz", data)
    assert str(caught.value).startswith(str(tmp_path / "p.npz"))


def test_postures_that_name_objects_alone_are_for_each_of_their_rows(data, tmp_path):
    names = data.column("object_props/object_name")
    given = own_postures(data, np.array([0, 0, 0]))
    del given["row"]
    objects = [names[0], names[0], "unknown"]
    np.savez(tmp_path / "p.npz", **given, object=objects, confidence=[0.1, 0.9, 0.5])
    ranked, rows = rank_file(tmp_path / "p.npz", data), np.flatnonzero(names == names[0])
    assert len(data) != 2
    assert ranked.of_row.tolist() == np.repeat(rows, 2).tolist()
    assert ranked.confidence.tolist() == [0.9, 0.1] * len(rows)
    assert ranked.left_out.endswith("are left out, as the split has no row of unknown")

    # Nobody knows the rows of postures that name neither.
    np.savez(tmp_path / "p.npz", **given)
    with pytest.raises(GraspError, match=r"\(`row` in the file says for which row each is, or `ob"):
        rank_file(tmp_path / "p.npz", data)
