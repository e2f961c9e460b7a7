"""Samples as tensors: their values, their types, and torch's DataLoader with its workers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import FIELDS, GraspDataset

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader, Subset  # noqa: E402  (torch may be missing)


@pytest.fixture(scope="module")
def data(sound: Path) -> GraspDataset:
    return GraspDataset(sound / DATA_FILES["oto"], split="test")


def test_every_field_has_its_value_and_type(data: GraspDataset) -> None:
    samples = data.to_torch(tuple(FIELDS))
    assert len(samples) == len(data) > 1
    for row in range(len(data)):
        item = samples[row]
        assert list(item) == list(FIELDS)
        for name, field in FIELDS.items():
            stored = data.column(name)[row]
            if field.dtype == "str":
                assert item[name] == str(stored)
                assert type(item[name]) is str
            else:
                assert item[name].numpy().dtype == np.dtype(field.dtype)
                assert (item[name].numpy() == stored).all()
    assert (samples[-1]["grasps"] == samples[len(data) - 1]["grasps"]).all()
    with pytest.raises(IndexError):
        samples[len(data)]


def test_a_tensor_is_its_callers_own(data: GraspDataset) -> None:
    samples = data.to_torch()
    for name in ("images", "grasps"):
        samples[0][name].fill_(7.0)
        assert (samples[0][name].numpy() == data.column(name)[0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_batch_of_workers_has_the_samples_of_its_rows(data: GraspDataset, method: str) -> None:
    samples = data.to_torch(tuple(FIELDS))
    _ = samples[0]  # opens the file here
    rows = Subset(samples, [1, 0])
    (batch,) = DataLoader(rows, batch_size=2, num_workers=2, multiprocessing_context=method)
    assert list(batch) == list(FIELDS)
    for name, field in FIELDS.items():
        expected = data.column(name)[[1, 0]]
        if field.dtype == "str":
            assert batch[name] == expected.tolist()
        else:
            assert (batch[name].numpy() == expected).all()


def test_a_process_that_has_rendered_can_train() -> None:
    code = """
import numpy as np, torch
from drakegrasp.hand.description import load_hand
from drakegrasp.pictures.still_scene import StillScene, camera_pose

scene = StillScene(load_hand())
scene.picture(camera_pose(0.1 * np.eye(3), 0.3, 0.4), 60)
torch.optim.Adam(torch.nn.Linear(2, 1).parameters())
"""
    # In a process of its own, because the fault would be a segmentation fault.
    subprocess.run([sys.executable, "-c", code], check=True)
