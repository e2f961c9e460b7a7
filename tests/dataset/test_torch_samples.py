"""Samples as tensors: their values, their types, and torch's DataLoader with its workers."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import FIELDS, GraspDataset, TorchSamples

torch = pytest.importorskip("torch")

from torch.utils.data import DataLoader, Dataset, Subset  # noqa: E402  (torch may be missing)


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


def test_a_batch_has_the_samples_of_its_rows(data: GraspDataset) -> None:
    loader = DataLoader(Subset(data.to_torch(tuple(FIELDS)), [1, 0]), batch_size=2)
    (batch,) = loader
    assert list(batch) == list(FIELDS)
    for name, field in FIELDS.items():
        expected = data.column(name)[[1, 0]]
        if field.dtype == "str":
            assert batch[name] == expected.tolist()
        else:
            assert (batch[name].numpy() == expected).all()


class Witness(Dataset):
    """Samples, with the process that read each and its handles of the file."""

    def __init__(self, samples: TorchSamples) -> None:
        self.samples = samples

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> dict[str, Any]:
        item, path = self.samples[index], str(self.samples.data.path.resolve())
        handles = [
            name
            for name in os.listdir("/proc/self/fd")
            if os.path.realpath(f"/proc/self/fd/{name}") == path
        ]
        return {**item, "handles": len(handles), "pid": os.getpid()}


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_workers_read_each_sample_once_with_a_file_of_their_own(
    data: GraspDataset, method: str
) -> None:
    samples = data.to_torch(["images", "grasps", "trial_id", "object_props/object_name"])
    _ = samples[0]  # opens the file here
    loader = DataLoader(
        Witness(samples),
        batch_size=2,
        shuffle=True,
        num_workers=2,
        multiprocessing_context=method,
    )
    rows = {int(number): row for row, number in enumerate(data.column("trial_id"))}
    seen, readers = [], set()
    for batch in loader:
        for k, number in enumerate(batch["trial_id"].tolist()):
            row = rows[number]
            seen.append(number)
            assert (batch["images"][k].numpy() == data.column("images")[row]).all()
            assert (batch["grasps"][k].numpy() == data.column("grasps")[row]).all()
            assert batch["object_props/object_name"][k] == data[row].props["object_name"]
        assert (batch["handles"] == 1).all()
        readers |= set(batch["pid"].tolist())
    assert sorted(seen) == sorted(rows)
    assert len(readers) == 2
    assert os.getpid() not in readers


def test_a_pickle_holds_neither_file_nor_columns(data: GraspDataset) -> None:
    samples = data.to_torch()
    _ = samples[0]
    content = pickle.dumps(samples)
    assert len(content) < 2000
    assert (pickle.loads(content)[0]["grasps"] == samples[0]["grasps"]).all()


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
