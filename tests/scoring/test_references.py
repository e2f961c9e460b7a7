"""Reference rows: what each makes of a row, and that the blind ones never look."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import drakegrasp as dg
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.frames import invert_pose, rotate_vectors, transform_points, unpack_pose
from drakegrasp.grasp import unpack_grasp
from drakegrasp.scoring import references
from drakegrasp.scoring.references import REFERENCES, ReferenceInput


@pytest.fixture(scope="module")
def inputs(data):
    return ReferenceInput(
        data=data, rows=range(len(data)), train=GraspDataset(data.path, split="train")
    )


def test_own_grasps_are_the_stored_ones(inputs):
    np.testing.assert_array_equal(references.own(inputs), inputs.data.column("grasps"))


@pytest.mark.parametrize("name", ["constant", "random"])
def test_blind_rows_are_training_grasps_and_never_look(inputs, name, monkeypatch):
    value = inputs.data.value

    def blind(field, row):
        assert field not in ("images", "masks")
        return value(field, row)

    monkeypatch.setattr(inputs.data, "value", blind)
    made = {tuple(grasp) for grasp in REFERENCES[name].make(inputs)}
    assert made <= {tuple(grasp) for grasp in inputs.train_grasps}
    assert name != "constant" or len(made) == 1


def test_the_nearest_image_of_a_training_image_is_itself(inputs):
    same = ReferenceInput(data=inputs.train, rows=range(len(inputs.train)), train=inputs.train)
    np.testing.assert_array_equal(references.nearest_image(same), inputs.train_grasps)


def test_the_thumb_is_the_finger_that_is_opposed_to_the_others_in_most_grasps(inputs):
    """In two of three grasps it is the third finger."""
    y, made = np.array([0.0, 1.0, 0.0]), replace(inputs)
    normals = np.array([[y, y, -y], [y, y, -y], [-y, y, y]])
    vars(made)["train_grasps"] = np.hstack([0.0 * normals, normals]).reshape(3, 18)
    assert made.thumb == 2


def test_a_grasp_from_above_closes_level_across_the_object(inputs):
    poses = inputs.data.column("object_props/frame_work2cam_oto")
    for row, grasp in zip(inputs.rows, references.top_down(inputs), strict=True):
        X_TC = unpack_pose(poses[row])
        points, normals = unpack_grasp(grasp)
        p_TQ, nhat_Q_T = transform_points(X_TC, points), rotate_vectors(X_TC, normals)
        np.testing.assert_allclose(p_TQ[:, 2], p_TQ[0, 2])
        np.testing.assert_allclose(nhat_Q_T[:, 2], 0.0, atol=1e-6)
        others = [i for i in range(3) if i != inputs.thumb]
        np.testing.assert_allclose(nhat_Q_T[others], -nhat_Q_T[[inputs.thumb] * 2], atol=1e-6)
        # Each contact is on the side to which its normal points.
        middle = p_TQ.mean(axis=0)
        assert (((p_TQ - middle) * nhat_Q_T).sum(axis=1) > 0.0).all()


def test_a_grasp_from_above_is_across_the_short_side_of_what_is_seen(inputs, monkeypatch):
    """The object is a box of 100 by 20 by 50 mm, 30 degrees about z from the axes of {T}."""
    x, y, z = np.meshgrid(np.linspace(-0.05, 0.05, 21), [-0.01, 0.01], [0.0, 0.05])
    long, short = np.array([np.sqrt(0.75), 0.5, 0.0]), np.array([-0.5, np.sqrt(0.75), 0.0])
    middle = np.array([0.02, 0.03, 0.0])
    p_TQ = middle + np.stack([x, y], axis=-1).reshape(-1, 2) @ np.stack([long, short])
    p_TQ[:, 2] = z.ravel()
    poses = unpack_pose(inputs.data.column("object_props/frame_work2cam_oto"))
    monkeypatch.setattr(
        ReferenceInput, "visible", lambda _, row: transform_points(invert_pose(poses[row]), p_TQ)
    )
    points, normals = unpack_grasp(references.top_down(inputs)[0])
    points, normals = transform_points(poses[0], points), rotate_vectors(poses[0], normals)
    np.testing.assert_allclose(np.abs(normals @ short), 1.0, atol=1e-6)
    np.testing.assert_allclose((points - middle) @ short, 0.01 * normals @ short, atol=1e-6)
    np.testing.assert_allclose(points[:, 2], 0.025, atol=1e-6)
    along = (points - middle) @ long
    assert along[inputs.thumb] == pytest.approx(0.0, abs=1e-6)
    others = np.delete(along, inputs.thumb)
    np.testing.assert_allclose(
        np.sort(others),
        [-0.5 * references.FINGER_SPACING, 0.5 * references.FINGER_SPACING],
        atol=1e-6,
    )


def test_closing_gives_the_posture_that_is_ranked_first_for_what_is_seen(inputs):
    inputs = replace(inputs, rows=inputs.rows[:2])
    table = references.closing(inputs)
    assert table.of_row.tolist() == list(inputs.rows)
    assert not table.refused
    assert table.frame == "table"
    poses = inputs.data.column("object_props/frame_work2cam_oto")
    for i, row in enumerate(inputs.rows):
        cloud = transform_points(unpack_pose(poses[row]), inputs.visible(row))
        found = dg.propose(cloud)
        best = dg.rank(found, cloud).order[0]
        for name in ("X_FG", "q_grasp", "q_pregrasp"):
            np.testing.assert_array_equal(getattr(table, name)[i], getattr(found, name)[best])


def test_a_row_of_which_nothing_is_seen_is_no_grasp(inputs, monkeypatch):
    visible = ReferenceInput.visible
    monkeypatch.setattr(ReferenceInput, "visible", lambda self, row: visible(self, row)[:5])
    table = references.closing(inputs)
    assert "10 or more, got 5" in table.invalid[0]
