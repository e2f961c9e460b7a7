"""What an arm can do about grasps that a network predicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.commands import error_line, run

import drakegrasp as dg
from drakegrasp.exchange.attempts import read_attempts

GRASP = [-0.025, 0.03, -0.009, 0.025, 0.03, -0.009, 0, -0.03, -0.009, 0, 1, 0, 0, 1, 0, 0, -1, 0]


@pytest.mark.sim
def test_a_verdict_tells_whether_the_arm_reaches_the_grasp(six: Path, tmp_path: Path) -> None:
    box = trimesh.creation.box([0.06, 0.06, 0.06])
    near, far = (dg.load_arm(six, (x, 0.0, 0.0, 0.0)) for x in (-0.5, -2.0))
    verdict = dg.verify_grasp(GRASP, box, arm=near)
    assert verdict.reach is not None
    assert verdict.reach.reachable
    assert "The arm reaches it, with a clearance of " in verdict.explain()
    verdict.save_html(tmp_path / "grasp.html")
    text = (tmp_path / "grasp.html").read_text()
    other = verdict.reached_by(far)
    other.save_html(tmp_path / "other.html")
    assert len(text) > len((tmp_path / "other.html").read_text()) + 10_000  # the arm
    assert other.reach is not None
    assert other.reach.outcome == "out_of_reach"
    assert "The arm does not reach it: the palm pose is out of its reach." in other.explain()

    # Where the object is moved to, the arm must reach.
    X_TO = verdict.placed.X_TO.copy()
    X_TO[0, 3] = -1.5
    moved = dg.verify_grasp(GRASP, dg.place_object(box, X_TO=X_TO), arm=far)
    assert moved.reach is not None
    assert moved.reach.reachable
    assert moved.lifted == verdict.lifted
    assert dg.verify_grasp(np.full(18, np.nan), box, arm=near).reach is None


@pytest.fixture(scope="module")
def cloud() -> np.ndarray:
    box = trimesh.creation.box([0.12, 0.05, 0.08])
    points = trimesh.sample.sample_surface(box, 1000, seed=0)[0] + np.array([0.0, 0.0, 0.04])
    return np.asarray(points[points @ [1, 1, 1] > 0.06])


@pytest.mark.sim
@pytest.mark.slow
def test_a_card_counts_what_an_arm_reaches(small_dataset: Path, six: Path, tmp_path: Path) -> None:
    data = dg.GraspDataset(small_dataset / "grasping_oto.hdf5", split="test")
    rows = {"rows": range(4), "references": (), "workers": 1}
    near, far = (dg.load_arm(six, (x, 0.0, 0.0, 0.0)) for x in (-0.5, -3.0))
    grasps = data.column("grasps")[:4]
    plain, reached, none = (dg.score(grasps, data, arm=a, **rows) for a in (None, near, far))
    measures = [each.card["sets"]["predictions"]["measures"] for each in (plain, reached, none)]
    assert "reachable" not in measures[0]
    assert 0.0 < measures[1]["reached"]["value"] <= measures[1]["reachable"]["value"]
    assert measures[2]["reachable"]["value"] == measures[2]["reached"]["value"] == 0.0
    assert measures[1]["headline"] == measures[2]["headline"] == measures[0]["headline"]
    with pytest.raises(dg.ConfigError, match="arm must be None with protocol dexgraspbench"):
        dg.score(grasps, data, arm=near, protocol="dexgraspbench", **rows)


def test_what_an_arm_does_not_reach_is_last(six: Path, cloud: np.ndarray) -> None:
    grasps = dg.propose(cloud)
    grasps = grasps.at(list(range(0, len(grasps), 4)))
    plain = dg.rank(grasps, cloud)
    assert plain.reach == ()
    ranking = dg.rank(grasps, cloud, arm=dg.load_arm(six, (-0.35, 0.0, 0.0, 0.0)))
    reachable = ranking.reachable[ranking.order]
    assert reachable[0]
    assert not reachable[-1]
    assert (np.diff(reachable.astype(int)) <= 0).all()
    for group in (ranking.order[reachable], ranking.order[~reachable]):
        assert (np.diff(ranking.chance[group]) <= 0.0).all()
    np.testing.assert_array_equal(ranking.chance, plain.chance)

    none = dg.rank(grasps, cloud, arm=dg.load_arm(six, (-3.0, 0.0, 0.0, 0.0)))
    assert not none.likely
    assert none.explain() == f"no grasp is within reach of the arm, of {len(grasps)}"


def test_predict_names_the_joints_of_the_first_grasp(
    six: Path, cloud: np.ndarray, tmp_path: Path
) -> None:
    np.save(tmp_path / "cloud.npy", cloud)
    given = ("predict", tmp_path / "cloud.npy", "--out", tmp_path / "out.h5", "--simulate", 0)
    result = run(*given, "--arm", six, "--base", "-0.35,0,0,0")
    assert result.exit_code == 0, result.output
    assert "joints at the first grasp: pan " in result.stdout
    confidence = np.array(read_attempts(tmp_path / "out.h5", dg.load_hand()).confidence)
    assert confidence[0] > 0.0
    assert confidence[-1] == 0.0
    assert "--base must be given with --arm" in error_line(run(*given, "--arm", six))
    assert "--arm must be given with --base" in error_line(run(*given, "--base", "0,0,0,0"))
