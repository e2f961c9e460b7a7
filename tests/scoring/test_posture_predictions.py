"""Predicted postures: read for rows of a split, ranked, and tried as what they are."""

from __future__ import annotations

import numpy as np
import pytest

from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import GraspError
from drakegrasp.frames import invert_pose, unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.scoring.verdict import rank_file
from drakegrasp.verification.placing import dataset_config, place_on_rows

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
