"""A build in which everything is drawn: the usual attempts, each in conditions of its own."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.builds import build
from helpers.meshes import SMALL

from drakegrasp.api.verifying import verify_grasps
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CONDITION_FIELDS
from drakegrasp.generation.replay import record_trial, replay_trial
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.outcomes import Outcome

pytestmark = [pytest.mark.sim, pytest.mark.slow]

#: The object that is built; of the small dataset it has most grasps.
NAME = "11_box_slim"


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config("randomized", overrides=SMALL)


@pytest.fixture(scope="module")
def sources(small_meshes: Path) -> list[MeshSource]:
    return [source for source in find_meshes(small_meshes) if source.name == NAME]


@pytest.fixture(scope="module")
def randomized(
    sources: list[MeshSource], config: Config, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The dataset. Read only."""
    out = tmp_path_factory.mktemp("randomized") / "out"
    build(sources, out, config)
    return out


def trials(out: Path) -> dict[str, np.ndarray]:
    """Return the columns of the object's rows in `/trials`."""
    with h5py.File(out / "trials.hdf5") as file:
        names = [name.decode() for name in file["objects/name"][:]]
        rows = file["trials/object"][:] == names.index(NAME)
        return {name: values[:][rows] for name, values in file["trials"].items()}


def test_attempts_are_those_of_a_build_without_draws(randomized: Path, small_dataset: Path) -> None:
    drawn = trials(randomized)
    usual = {k: v[: len(drawn["outcome"])] for k, v in trials(small_dataset).items()}
    for name in ("X_TO", "X_OG", "spread", "seed", "candidate", "standoff_index"):
        np.testing.assert_array_equal(drawn[name], usual[name])
    for name in (f.name for f in CONDITION_FIELDS):
        assert len(np.unique(usual[name], axis=0)) == 1
        assert len(np.unique(drawn[name], axis=0)) == len(drawn[name])
    # The simulation goes its own way.
    lifted = np.isfinite(drawn["slip"]) & np.isfinite(usual["slip"])
    assert lifted.any()
    assert np.all(drawn["slip"][lifted] != usual["slip"][lifted])


@pytest.mark.parametrize("outcome", [Outcome.SUCCESS, Outcome.MISSING_FINGERTIP])
def test_replay_gives_the_same_bits(randomized: Path, tmp_path: Path, outcome: Outcome) -> None:
    rows = np.flatnonzero(trials(randomized)["outcome"] == outcome)
    replay = replay_trial(randomized, int(rows[0]))
    assert replay.same, replay.differences
    assert record_trial(randomized, int(rows[0]), tmp_path / "trial.html") is outcome


def test_grasps_are_verified_with_their_own_friction_and_mass(randomized: Path) -> None:
    data = GraspDataset(randomized / "grasping_oto.hdf5", split="test")
    rows = [len(data) - 1, 0]
    grasps = np.array([data[row].grasp for row in rows])
    usual = load_prepared(randomized, NAME, read_manifest(randomized).config).model
    for row, verdict in zip(rows, verify_grasps(grasps, data, rows=rows), strict=True):
        props, conditions = data[row].props, data[row].conditions
        model = verdict.placed.model
        assert model.mass == pytest.approx(float(props["work2mass"][0]))
        inertia = model.mass / usual.mass * usual.I_OOcm_O
        np.testing.assert_allclose(model.I_OOcm_O, inertia, rtol=1e-9)
        physics = verdict.config.physics
        assert physics.friction_hand == pytest.approx(float(conditions["friction_hand"]))
        assert physics.friction_table == pytest.approx(float(conditions["friction_table"]))
