"""Rules of the conditions: as drawn in a trial, as in the trial in a sample; noise is taken off."""

from __future__ import annotations

import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import (
    BELOW,
    OTM,
    OTO,
    TRIALS,
    change,
    found,
    make_dataset,
    must_find,
    must_find_without_shards,
    set_at,
)

from drakegrasp.dataset.checks.run import check_dataset
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CONDITION_FIELDS

#: Small turns: the boxes' contacts stay in view.
DRAWN = (
    *("randomize.object_colour=1", "randomize.table_colour=1", "randomize.light_angle_deg=60"),
    *("randomize.light_strength=[0.2,1.5]", "randomize.camera_shift=0.005"),
    *("randomize.camera_turn_deg=2", "randomize.depth_noise=[0.002,0.004]"),
    *("randomize.depth_baseline=0.02", "randomize.friction_hand=[0.7,1.3]"),
    *("randomize.friction_table=[0.7,1.3]", "randomize.mass=[0.5,1.5]"),
)


@pytest.fixture(scope="session")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of boxes in which everything is drawn. Read only."""
    folder = tmp_path_factory.mktemp("drawn")
    return make_dataset(folder, tmp_path_factory.mktemp("meshes"), overrides=DRAWN)


@pytest.fixture
def spoilt(drawn: Path, tmp_path: Path) -> Path:
    """A copy of it to spoil."""
    return Path(shutil.copytree(drawn, tmp_path / "out"))


def test_nothing_is_found_where_everything_is_drawn(drawn: Path) -> None:
    assert check_dataset(drawn) == []
    for name in (OTO, OTM, TRIALS):
        assert check_dataset(drawn / name) == []


def test_every_condition_of_a_sample_differs_from_the_others(drawn: Path) -> None:
    data = GraspDataset(drawn / OTO, split="test")
    names = [f.name for f in CONDITION_FIELDS if f.name != "mass"]
    assert list(data[0].conditions) == names
    for name in (f"conditions/{n}" for n in names):
        assert len(np.unique(data.column(name), axis=0)) == len(data)
    mass, inertia = data.column("object_props/work2mass")[:, 0], [s.props for s in data]
    assert len(np.unique(mass)) == len(data)
    assert all(p["work2inertia"][0] > 0.0 for p in inertia)


CONDITIONS = [f.name for f in CONDITION_FIELDS]


def other_conditions(out: Path, file: str, group: str, row: int, names: list[str]) -> None:
    for name in names:
        # A pose stays one.
        edit = set_at(3, to=0.5) if name == "X_C0C" else lambda v: v + v.dtype.type(1)
        change(out, file, f"{group}/{name}", row, edit)


@pytest.mark.parametrize("where", ["sound", "drawn"])
def test_a_condition_that_was_not_drawn_is_found(
    request: pytest.FixtureRequest, tmp_path: Path, where: str
) -> None:
    out = Path(shutil.copytree(request.getfixturevalue(where), tmp_path / "out"))
    other_conditions(out, TRIALS, "trials", BELOW, CONDITIONS)
    row = (TRIALS, "/trials", BELOW)
    must_find(out, *((*row, f"{name} must follow from its shard") for name in CONDITIONS))
    what = "must follow from what the seed gives the attempt"
    must_find_without_shards(out, *((*row, f"{name} {what}") for name in CONDITIONS))


def test_a_condition_of_a_sample_that_is_not_its_trials_is_found(spoilt: Path) -> None:
    names = [name for name in CONDITIONS if name != "mass"]
    other_conditions(spoilt, OTM, "train/conditions", 1, names)
    what = "must follow from its trial"
    must_find(spoilt, *((OTM, "/train", 1, f"conditions/{name} {what}") for name in names))


def test_noise_of_another_seed_is_found_as_a_wrong_depth(spoilt: Path) -> None:
    for name in (OTO, OTM):
        change(spoilt, name, "train/conditions/depth_seed", 1, lambda v: v + v.dtype.type(1))
    hits = found(spoilt / OTO)
    assert {h[:3] for h in hits} == {(OTO, "/train", 1)}
    assert any("points beside the mask must be on the table" in h[3] for h in hits)


def test_a_depth_that_is_off_by_more_than_its_noise_is_found(spoilt: Path) -> None:
    with h5py.File(spoilt / OTO) as file:
        row = 1
        beside = np.argwhere((file["train/masks"][row] == 0) & (file["train/images"][row, 3] < 0.7))
    v, u = beside[len(beside) // 2]
    change(spoilt, OTO, "train/images", row, lambda i: _raised(i, v, u))
    must_find_without_shards(
        spoilt, (OTO, "/train", row, "points beside the mask must be on the table within 0.0003 m")
    )


def _raised(image: np.ndarray, v: int, u: int) -> np.ndarray:
    image[3, v, u] -= 0.001
    return image


def test_lost_pixels_are_found_where_none_can_be_lost(out: Path) -> None:
    with h5py.File(out / OTO) as file:
        v, u = np.argwhere(file["train/masks"][1] == 1)[0]
    change(out, OTO, "train/images", 1, set_at(3, v, u, to=0.75))
    must_find_without_shards(
        out, (OTO, "/train", 1, "points in the mask must be in the object's box")
    )
