"""Grasps are proposed and ranked by closing the hand on the points that a camera saw."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.hands import write_with_preshapes

import drakegrasp as dg
from drakegrasp.frames import invert_pose, make_pose, rotation_about
from drakegrasp.scoring import ranking
from drakegrasp.simulation.attempts import make_attempts
from drakegrasp.simulation.palms import SAME

#: Half extents of a box on the table, whose long side, along Tx, no hand spans [m].
HALF = np.array([0.18, 0.03, 0.04])
#: A palm that looks down on it closes across Ty.
DOWN = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 2 * HALF[2] + 0.06])


def seen(half=HALF, turn=0.0):
    """Return points on the top and on the sides +x and +y of a box on the table, turned [rad]."""
    x, y, z = (np.linspace(-each, each, int(each / 0.0015)) for each in half)
    faces = [(x, y, half[2:]), (half[:1], y, z), (x, half[1:2], z)]
    grids = [np.stack(np.meshgrid(*face), axis=-1).reshape(-1, 3) for face in faces]
    points = np.concatenate(grids)
    points[:, 2] += half[2]
    return points @ rotation_about([0.0, 0.0, 1.0], turn).T


def turned(X_TG, degrees):
    """Return a palm pose turned about its own Gz."""
    return X_TG @ make_pose(rotation_about([0.0, 0.0, 1.0], np.deg2rad(degrees)), np.zeros(3))


def test_a_grasp_across_the_narrow_side_beats_one_along_it():
    ranked = dg.rank([turned(DOWN, 90.0), DOWN], seen())
    assert ranked.order.tolist() == [1, 0]
    assert ranked.score[1] == dg.rank(DOWN, seen()).score  # one pose is one proposal
    assert ranked.features["touch"][1].tolist() == [1.0, 1.0, 1.0]
    assert ranked.features["opposition"][1] > 0.9
    assert ranked.features["opposition"][0] < 0.5
    assert ranked.features["robust"][1] == 1.0


def test_a_ranking_turns_and_moves_with_the_object():
    X = make_pose(rotation_about([0.0, 0.0, 1.0], 0.7), [0.1, -0.2, 0.0])
    palms = np.stack([DOWN, DOWN @ make_pose(np.eye(3), [0.1, 0.0, 0.0]), turned(DOWN, 40.0)])
    there = dg.rank(X @ palms, seen(turn=0.7) + X[:3, 3])
    assert there.order.tolist() == dg.rank(palms, seen()).order.tolist()


def test_a_score_is_a_mean_over_moves_along_the_palms_own_axes(monkeypatch):
    """A palm from the side that is moved there is one that begins there."""
    pole = seen(np.array([0.03, 0.03, 0.09]))
    side = make_pose([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], [0.09, 0.0, 0.12])
    for move in 0.02 * np.eye(3):
        monkeypatch.setattr(ranking, "MOVES", move[None])
        moved = dg.rank(side, pole)
        monkeypatch.setattr(ranking, "MOVES", np.zeros((1, 3)))
        due = dg.rank(side @ make_pose(np.eye(3), move), pole)
        for name in ("arm", "table", "push"):
            np.testing.assert_allclose(moved.features[name], due.features[name], atol=1e-6)


def test_proposals_begin_across_the_narrow_side_and_are_distinct():
    found = dg.propose(seen(turn=0.4), name="box")
    assert not found.refused
    assert found.frame == "table"
    assert set(found.objects) == {"box"}
    # Gy closes across the long side, which is turned by 0.4 rad.
    first = found.X_FG[0]
    assert abs(first[:3, 1] @ [np.cos(0.4), np.sin(0.4), 0.0]) < 1e-6
    np.testing.assert_allclose(first[:2, 3], 0.0, atol=1e-9)
    assert first[:3, 2] @ [0.0, 0.0, -1.0] == pytest.approx(1.0)
    for i, X in enumerate(found.X_FG):
        # The open hand tells the spread.
        same = (found.q_pregrasp[:i] == found.q_pregrasp[i]).all(axis=1)
        for Y in found.X_FG[:i][same]:
            angle = np.arccos(np.clip((np.trace(X[:3, :3].T @ Y[:3, :3]) - 1) / 2, -1, 1))
            assert np.linalg.norm(X[:3, 3] - Y[:3, 3]) >= SAME[0] or angle >= SAME[1] - 1e-9


def test_proposals_come_from_all_sides_and_stay_above_the_table():
    found = dg.propose(seen(np.array([0.03, 0.03, 0.09])))
    sides = found.X_FG[np.char.startswith(found.said, "from the side")]
    headings = np.rad2deg(np.arctan2(*sides[:, [1, 0], 2].T)).round() % 360.0
    assert len(set(headings.tolist())) == 8
    np.testing.assert_allclose(sides[:, 2, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(sides[:, 2, 1], 0.0, atol=1e-9)
    assert dg.rank(found, seen(np.array([0.03, 0.03, 0.09]))).features["table"].min() > 0.0


@pytest.mark.parametrize("hand", ["barrett", "franka", "allegro_four"])
def test_any_hand_proposes_and_ranks(hand):
    cloud = seen(np.array([0.05, 0.02, 0.03]))
    found = dg.propose(cloud, hand)
    ranked = dg.rank(found, cloud, hand)
    assert not found.refused
    assert sorted(ranked.order.tolist()) == list(range(len(found)))
    assert ranked.features["robust"].max() > 0.5
    # The grasp has closed, from the open hand.
    first = ranked.order[0]
    assert np.abs(found.q_grasp[first] - found.q_pregrasp[first]).max() > 0.0


def test_postures_of_the_object_are_ranked_with_its_pose():
    X_TO = make_pose(rotation_about([0.0, 0.0, 1.0], 0.3), [0.1, 0.0, 0.04])
    cloud = seen(turn=0.3)
    cloud[:, 0] += 0.1
    table = dg.propose(cloud)
    own = {"q_grasp": table.q_grasp, "q_pregrasp": table.q_pregrasp}
    X_OG = invert_pose(X_TO) @ table.X_FG
    names, count = table.objects, len(table)
    given = make_attempts(dg.load_hand(), names, X_OG, X_TO=[X_TO] * count, **own)
    # Where a pad slides along an edge, the last bit of a pose decides what it meets.
    np.testing.assert_allclose(dg.rank(given, cloud).score, dg.rank(table, cloud).score, atol=1e-2)
    with pytest.raises(dg.GraspError, match="must be in the frame table, or say X_TO, got object"):
        dg.rank(make_attempts(dg.load_hand(), names, X_OG, **own), cloud)


def test_a_row_that_is_no_posture_is_last():
    found = dg.propose(seen())
    spoilt = found.refuse(["bad", *[""] * (len(found) - 1)])
    ranked = dg.rank(spoilt, seen())
    assert ranked.order[-1] == 0
    assert ranked.score[0] == -1.0
    assert np.isnan(ranked.features["arm"][0])


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        (seen()[:, :2], "points .* shape"),
        (seen()[:5], "10 or more, got 5"),
        (1e3 * seen(), "in metres, got points 360 m apart"),
        (seen() * [1.0, 1.0, 0.0], "got none higher than 0 mm"),
        (np.where(np.arange(3) == 0, np.nan, seen()), "not finite"),
        (seen() * [1.0, 0.0, 1.0], "got a flat one"),
    ],
    ids=["two numbers", "few", "millimetres", "the table", "nan", "a wall"],
)
def test_a_cloud_that_is_none_is_refused(cloud, words):
    with pytest.raises(dg.GraspError, match=words):
        dg.rank([DOWN], cloud)
    with pytest.raises(dg.GraspError, match=words):
        dg.propose(cloud)


@pytest.mark.parametrize("spread", [-1.0, 30.0, np.nan])
def test_a_spread_that_the_hand_cannot_have_is_refused(spread):
    with pytest.raises(dg.GraspError, match=r"spread must be 0 to 3.14 rad for the hand barrett"):
        dg.rank(np.eye(4), seen(), spread=spread)


def test_proposals_of_another_hand_are_refused():
    grasps = dg.propose(seen(), "franka")
    with pytest.raises(dg.GraspError, match="proposals must be of the hand barrett with 8 joints"):
        dg.rank(grasps, seen())


def test_a_finger_that_a_preshape_leaves_out_touches_nothing(tmp_path):
    hand = dg.load_hand(write_with_preshapes(tmp_path, pinch="F1 F3", all="F1 F2 F3"))
    found = dg.propose(seen(), hand).at([0, 0])
    ranked = dg.rank(replace(found, preshape=("pinch", "all")), seen(), hand)
    assert np.isnan(ranked.features["touch"]).tolist() == [[False, True, False], [False] * 3]
    assert (ranked.score >= 0.0).all()
