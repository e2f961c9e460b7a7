"""The baseline in pipelines/baseline: its networks, and its commands from scenes to predictions."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml
from helpers.commands import run

import drakegrasp as dg
from drakegrasp.dataset.scenes import SceneDataset
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.hand.description import load_hand

# Where torch is said to be there, a test that skips is a failure.
if os.environ.get("DRAKEGRASP_TORCH") != "1":
    pytest.importorskip("torch")
import predict
import torch
from assess import assessment, auc
from batches import centred, object_points, turned
from fitting import ahead
from networks import HandCoordinates, PostureNetwork, PostureSize, farthest_points, orthonormal
from predict import proposals
from train import temperature

BASELINE = Path(__file__).resolve().parents[1] / "pipelines" / "baseline"
SMALL = PostureSize(closing=2, seeds=8, modes=2, neighbours=4, width=16)


def made_up(seed: int = 0) -> dict[str, torch.Tensor]:
    """Return a batch of two clouds with three grasps each."""
    draw = torch.Generator().manual_seed(seed)
    X_TG = torch.eye(4).repeat(2, 3, 1, 1)
    X_TG[..., :3, :3] = orthonormal(torch.randn(2, 3, 2, 3, generator=draw))
    X_TG[..., :3, 3] = torch.randn(2, 3, 3, generator=draw)
    return {"points": torch.randn(2, 64, 3, generator=draw), "X_TG": X_TG}


def test_augmentation_moves_clouds_with_their_grasps() -> None:
    """What the palm sees stays, but for the noise; the table stays below."""
    before = made_up()
    after = centred(turned(before, torch.Generator().manual_seed(1)))
    for batch in (before, after):
        R, p = batch["X_TG"][..., :3, :3], batch["X_TG"][..., :3, 3]
        batch["seen"] = (batch["points"][:, None] - p[:, :, None]) @ R
    assert (after["seen"] - before["seen"]).abs().max() < 6e-3
    assert (after["points"][..., 2] - before["points"][..., 2]).abs().max() < 6e-3
    assert (after["points"] - before["points"]).abs().max() > 0.1
    assert after["points"].mean(1)[:, :2].abs().max() < 1e-6
    moved = after["points"] + after["shift"][:, None]
    assert (moved.norm(dim=-1) - before["points"].norm(dim=-1)).abs().max() < 6e-3


def test_points_of_the_network_are_on_the_object() -> None:
    points, on_object = np.arange(30.0).reshape(10, 3), np.arange(10) % 2 == 0
    assert set(object_points(points, on_object, 8)[:, 0]) == {0.0, 6.0, 12.0, 18.0, 24.0}
    assert len(object_points(points, np.zeros(10, dtype=bool), 8)) == 8


def test_farthest_points_spread() -> None:
    line = torch.tensor([0.0, 1.0, 2.0, 9.0, 10.0])
    points = torch.stack([line, 0 * line, 0 * line], -1)[None]
    assert farthest_points(points, 3).tolist() == [[0, 4, 2]]


def test_a_posture_at_a_mode_is_likelier_than_one_beside_it() -> None:
    torch.manual_seed(0)
    # In double precision: kernels of other CPUs sum in another order.
    network, points = PostureNetwork(SMALL).double(), made_up()["points"].double()
    weight, p, R, closing = network(points)
    one = torch.ones(2, dtype=torch.float64)
    assert torch.allclose(weight.exp().sum(1), one)
    assert torch.allclose(R.mT @ R, torch.eye(3).to(one).expand_as(R))
    assert torch.allclose(torch.linalg.det(R), one[0].expand(R.shape[:2]))
    best = weight.argmax(1)
    rows = torch.arange(2)
    mode = [each[rows, best][:, None] for each in (p, R, closing)]
    turn = orthonormal(torch.tensor([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0]]).to(one))
    least = network.loss(points, *mode)
    assert least < network.loss(points, mode[0] + 0.1, *mode[1:])
    assert least < network.loss(points, mode[0], mode[1] @ turn, mode[2])
    assert least < network.loss(points, *mode[:2], mode[2] + 1.0)
    # Of several postures each counts, whichever mode it is at.
    both = [torch.cat([m, m + shift], 1) for m, shift in zip(mode, (0.1, 0.0, 0.0), strict=True)]
    losses = [network.loss(points, *[m[:, k : k + 1] for m in both]) for k in range(2)]
    assert torch.isclose(network.loss(points, *both), torch.stack(losses).mean())


def test_proposals_are_ranked_and_differ() -> None:
    torch.manual_seed(0)
    hand = HandCoordinates(torch.zeros(3), torch.eye(3)[:2], torch.zeros(3))
    cloud = made_up()["points"][:1]
    network = PostureNetwork(SMALL)
    density, X_TG, q = proposals(network, hand, cloud, 4)
    assert (density[:-1] >= density[1:]).all() and len(density) == len(X_TG) == len(q) == 4
    # By the density of all modes, not by a mode's own weight.
    modes = network(cloud)
    assert density[0] == network.log_density(modes, *modes[1:]).max()
    gaps = torch.cdist(X_TG[:, :3, 3], X_TG[:, :3, 3]) + torch.eye(4)
    turned_by = (X_TG[:, None, :3, :3] * X_TG[None, :, :3, :3]).sum((-1, -2)) < 1 + 2 * 0.9659
    assert ((gaps > 0.01) | turned_by).all()


def test_closing_ranks_a_networks_proposals_with_grasps_from_above() -> None:
    """A palm within the object is last; joints keep the order of the data."""
    x, y = np.meshgrid(np.linspace(-0.05, 0.05, 30), np.linspace(-0.025, 0.025, 15))
    cloud = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.08)])
    hand = load_hand()
    joints = hand.joint_order[::-1]
    inside = np.diag([1.0, -1.0, -1.0, 1.0])[None]
    q = np.zeros((1, len(joints)))
    own = predict.Choice(inside, q, q, np.ones(1))
    found = predict.chosen_by_closing(own, cloud, hand, joints)
    above = dg.propose(cloud, hand)
    assert len(found.confidence) == 1 + len(above)
    assert found.confidence.argmin() == 0 and found.confidence.max() > 0.5
    assert np.array_equal(found.q_grasp[1:], above.q_grasp[:, ::-1])
    # Too little is seen of this object.
    assert predict.chosen_by_closing(own, cloud[:3], hand, joints) is own


def test_coordinates_of_a_hand_keep_its_couplings() -> None:
    draw = torch.Generator().manual_seed(0)
    motors = torch.rand(50, 2, generator=draw)
    closed = torch.stack([motors[:, 0], motors[:, 0] / 3, motors[:, 1]], 1)
    opened = torch.stack([torch.zeros(50), torch.zeros(50), motors[:, 1]], 1)
    hand = HandCoordinates.fit(closed, opened)
    coordinates = hand.coordinates(closed)
    assert coordinates.shape == (50, 2)
    assert torch.allclose(hand.closed(coordinates), closed, atol=1e-5)
    assert torch.allclose(coordinates.std(0), torch.ones(2), atol=1e-3)
    some = hand.closed(torch.tensor([[0.3, -2.0]]))
    assert torch.allclose(some[:, 1] * 3, some[:, 0], atol=1e-5)
    # The third joint is set before closing, as a spread is.
    assert torch.equal(hand.opened(some), torch.tensor([[0.0, 0.0, float(some[0, 2])]]))


def test_batches_are_made_ahead_in_their_order() -> None:
    asked = threading.Event()

    def batches() -> Iterator[int]:
        yield 1
        # Nobody has asked for it: the first is still in use.
        asked.set()
        yield 2
        raise ValueError("a damaged file")

    given = ahead(batches())
    assert next(given) == 1
    assert asked.wait(timeout=60)
    assert next(given) == 2
    with pytest.raises(ValueError, match="a damaged file"):
        next(given)
    assert not list(ahead(iter(range(0))))


def test_temperature_makes_confident_logits_honest() -> None:
    draw = torch.Generator().manual_seed(0)
    logits = torch.randn(4000, 2, generator=draw)
    labels = (torch.rand(4000, 2, generator=draw) < logits.sigmoid()).float()
    assert torch.allclose(temperature(3 * logits, labels), torch.tensor([3.0, 3.0]), rtol=0.2)


def script(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", BASELINE / name, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.sim
@pytest.mark.slow
def test_from_scenes_to_predictions(out: Path) -> None:
    made = run("scenes", out, "--quiet")
    assert made.exit_code == 0, made.output
    scenes, oto = out / "scenes.hdf5", out / "grasping_oto.hdf5"
    for task, data in (("postures", scenes), ("classifier", scenes), ("contacts", oto)):
        for name in ("one", "again") if task == "postures" else ("one",):
            path = out / f"{task} {name}.pt"
            done = script("train.py", task, data, path, "--epochs", 2, "--batch", 8)
            assert done.returncode == 0, done.stderr
            assert "epoch 2/2" in done.stdout
    weights = [torch.load(out / f"postures {k}.pt")["weights"] for k in ("one", "again")]
    assert all(torch.equal(weights[0][k], weights[1][k]) for k in weights[0])

    judge = ("--judge", out / "classifier one.pt", "--proposals", 2)
    done = script("predict.py", out / "postures one.pt", scenes, out / "p.h5", *judge)
    assert done.returncode == 0, done.stderr
    views = SceneDataset(scenes, split="test", negatives="none", balance="view").views
    with h5py.File(out / "p.h5") as file:
        assert file["row"][:].tolist() == np.repeat(range(len(views)), 2).tolist()
        confidence = file["confidence"][:].reshape(-1, 2)
    assert (confidence[:, 0] >= confidence[:, 1]).all()
    # A build takes them as they are.
    assert not any(read_attempts(out / "p.h5", load_hand()).invalid)
    done = script("predict.py", out / "contacts one.pt", oto, out / "c.h5")
    assert done.returncode == 0, done.stderr
    assert_assessed(out, scenes)
    assert_described(out, scenes)
    wrong = script("predict.py", out / "classifier one.pt", scenes, out / "p.h5")
    assert wrong.returncode == 2 and "must be a checkpoint of postures" in wrong.stderr


def assert_assessed(out: Path, scenes: Path) -> None:
    """Each tested grasp of the split is judged once, and the picture is one."""
    judge = out / "classifier one.pt"
    done = script("assess.py", judge, scenes, out / "curve.png", "--split", "train")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    data = SceneDataset(scenes, split="train", negatives="tested", positives="lifted")
    grasps, ours = data.tables["grasps"], data.tables["views"]["scene"][data.views]
    lifted = grasps["lifted"][grasps["tested"] & np.isin(grasps["scene"], ours)]
    assert found["grasps"] == len(lifted) == sum(b["grasps"] for b in found["lifted"]["curve"])
    assert found["lifted"]["share"] == pytest.approx(lifted.mean(), abs=1e-4)
    assert (out / "curve.png").read_bytes().startswith(b"\x89PNG")


def assert_described(out: Path, scenes: Path) -> None:
    """A model card says what the file and the score say, and refuses another file as a score."""
    arguments = ("model_card.py", out / "postures one.pt", out / "README.md")
    done = script(*arguments)
    assert done.returncode == 0, done.stderr
    text = (out / "README.md").read_text()
    assert hashlib.sha256(scenes.read_bytes()).hexdigest() in text and "Nothing was scored" in text
    assert yaml.safe_load(text.split("---")[1])["library_name"] == "pytorch"
    done = script(*arguments, "--score", scenes)
    assert done.returncode == 2 and "must be a card of drakegrasp score" in done.stderr


def test_auc_counts_pairs_and_halves_ties() -> None:
    label = np.array([False, True, False, True])
    assert auc(np.array([0.1, 0.9, 0.2, 0.8]), label) == 1.0
    assert auc(np.array([0.1, 0.1, 0.2, 0.3]), label) == 2.5 / 4
    assert np.isnan(auc(np.array([0.1, 0.2]), np.array([True, True])))


def test_reliability_bins_have_what_is_said_and_what_is_true() -> None:
    chance = np.arange(20) / 20
    found = assessment(chance, chance >= 0.5, np.repeat(range(5), 4))
    assert found["curve"][0] == {"said": 0.025, "true": 0.0, "grasps": 2}
    assert found["curve"][-1] == {"said": 0.925, "true": 1.0, "grasps": 2}
    assert found["auc"][0] == 1.0 and found["brier"] == round(
        float(np.square(chance - (chance >= 0.5)).mean()), 4
    )
