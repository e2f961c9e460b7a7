"""A build with fingers that need not touch: a grasp without them is a success, but no sample."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import trimesh
from helpers.builds import build
from helpers.hands import write_with_optional_fingers
from helpers.meshes import SMALL
from helpers.objects import write_above

from drakegrasp.dataset.check import check_dataset
from drakegrasp.filters import Removal
from drakegrasp.generation.pipeline import BuildReport
from drakegrasp.generation.replay import replay_trial
from drakegrasp.hand.settings import load_config
from drakegrasp.page.snapshot import read_snapshot

pytestmark = [pytest.mark.sim, pytest.mark.slow]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> BuildReport:
    """A build on a slim pole, past which one of two parallel fingers closes."""
    folder = tmp_path_factory.mktemp("optional")
    (folder / "meshes").mkdir()
    pole = trimesh.creation.box([0.03, 0.03, 0.14]).subdivide().subdivide()
    pole.export(folder / "meshes" / "11_box_slim.obj")
    sampler = write_above(folder, 0.06, x=0.013)
    rules = ["candidates.max=1", f"candidates.method={sampler}", "candidates.standoffs=[0.06]"]
    config = load_config(
        hand=str(write_with_optional_fingers(folder, 0, 1)),
        overrides=[*SMALL, *rules, "camera.size=32"],
    )
    return build(folder / "meshes", folder / "out", config)


def test_a_grasp_without_an_optional_finger_is_a_success_but_no_sample(report: BuildReport) -> None:
    assert report.assembly.removed[Removal.MISSING_FINGER] == 1
    assert check_dataset(report.out) == []
    with h5py.File(report.out / "trials.hdf5") as file:
        removal = file["successes/removal"][:]
        row = int(file["successes/trial_id"][:][removal == Removal.MISSING_FINGER][0])
        touching = file["trials/closed_touching"][row]
        for name in ("surface_distance", "normal_angle"):
            np.testing.assert_array_equal(np.isnan(file[f"trials/{name}"][row]), ~touching)
    assert not touching.all()
    assert replay_trial(report.out, row).same

    # What is not there makes it no more anomalous.
    snapshot = read_snapshot(report.out)
    for part in ("normal_angle", "surface_distance", "normal_sum"):
        assert np.isfinite(snapshot.table[part][row])
