"""A network proposes grasps for what a camera saw, and puts the best first."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files

import numpy as np
import pytest
from helpers.depth_images import X_TC, K, image

import drakegrasp as dg
from drakegrasp.scoring.network import DEFAULT, _predict_view, _View


@pytest.fixture(scope="module")
def cloud():
    """A cup-sized box on the table, seen from above and from two sides."""
    points = np.random.default_rng(0).uniform([-0.04, -0.03, 0.0], [0.04, 0.03, 0.1], (3000, 3))
    points[:1000, 2], points[1000:2000, 0], points[2000:, 1] = 0.1, 0.04, 0.03
    return points


@pytest.fixture(scope="module")
def network():
    return dg.load_network()


def test_grasps_come_with_the_best_first(network, cloud):
    found = network.predict(cloud, "mug")
    assert found.frame == "table" and set(found.objects) == {"mug"} and not any(found.invalid)
    assert (np.diff(found.confidence) <= 0.0).all() and 0.0 < found.confidence[0] <= 1.0
    assert found.row.tolist() == list(range(len(found)))

    # They are those that `propose` returns, in the order of the network's judge.
    proposed = dg.propose(cloud, network.hand)
    ranked = dg.rank(proposed, cloud, network.hand, judge=DEFAULT)
    np.testing.assert_array_equal(found.confidence, ranked.score[ranked.order])
    for name in ("X_FG", "q_grasp", "q_pregrasp"):
        np.testing.assert_array_equal(getattr(found, name), getattr(proposed, name)[ranked.order])

    few = network.predict(cloud, count=2)
    np.testing.assert_array_equal(few.X_FG, found.X_FG[:2])
    np.testing.assert_array_equal(few.confidence, found.confidence[:2])


def test_a_network_is_known_by_its_name(network):
    assert network.name == DEFAULT and network.hand.name == "barrett"
    with pytest.raises(dg.GraspError, match=r"barrett-1.*got 'magic'"):
        dg.load_network("magic")


def test_a_network_states_what_it_was_trained_on(network):
    about = dict(line.split(": ", 1) for line in network.card.splitlines())
    assert about["hand"] == "barrett" and about["licence"] == "BSD-3-Clause"
    assert len(about["data_sha256"]) == 64 and "from one side" in about["limits"]
    assert "features" not in about


def test_a_file_of_weights_is_a_network(network, cloud, tmp_path):
    path = tmp_path / "own.npz"
    path.write_bytes(files("drakegrasp.scoring").joinpath(f"{DEFAULT}.npz").read_bytes())
    assert dg.load_network(path).card == network.card
    path.write_bytes(b"weights")
    with pytest.raises(dg.GraspError, match=r"own\.npz: must be the file of a judge"):
        dg.load_network(path)


def test_the_number_of_grasps_is_positive(network, cloud):
    with pytest.raises(dg.GraspError, match="count must be 1 or more, got 0"):
        network.predict(cloud, count=0)


def test_a_view_without_its_object_is_told_from_a_bad_one(network):
    """Too few points, none high enough, or a flat object yield no grasps; other mistakes raise."""
    depth, mask = image()
    view = _View(name="box", resting=0, X_TO=np.eye(4), depth=depth, K=K, mask=mask, X_TC=X_TC)
    lower = X_TC - np.eye(4, k=1) * [[0.0], [0.0], [0.12], [0.0]]
    beside = np.zeros_like(mask)
    beside[-20:-10, 60:90] = True
    for changes in ({"mask": 0 * mask}, {"mask": beside}):
        assert _predict_view(network, 1, replace(view, **changes)) is None
    for changes in ({"mask": mask[1:]}, {"K": 2 * K}, {"depth": 1e3 * depth}, {"X_TC": lower}):
        with pytest.raises(dg.GraspError, match="view of box"):
            _predict_view(network, 1, replace(view, **changes))
