"""Datasets in object stores are read as local files are, from a copy in a cache."""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import fsspec
import numpy as np
import pytest
from fsspec.implementations.memory import MemoryFileSystem
from helpers.datasets import OTO

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.remote import CACHE_VARIABLE, local_file
from drakegrasp.dataset.scenes import SceneDataset
from drakegrasp.errors import DataError, MachineError

ADDRESS = f"memory://bucket/data/{OTO}"


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def store(out: Path) -> Iterator[MemoryFileSystem]:
    files = fsspec.filesystem("memory")
    files.pipe(ADDRESS, (out / OTO).read_bytes())
    yield files
    files.rm("/bucket", recursive=True)


def downloads(cache: Path) -> list[Path]:
    return [path for path in cache.rglob("*") if path.is_file()]


@pytest.mark.parametrize("address", [ADDRESS, Path(ADDRESS)])
def test_a_split_at_an_address_is_that_of_the_file(
    out: Path, store: MemoryFileSystem, address: str | Path
) -> None:
    here, there = GraspDataset(out / OTO), GraspDataset(address)
    assert there.content == here.content
    np.testing.assert_array_equal(there[1].image, here[1].image)
    again = pickle.loads(pickle.dumps(there))
    np.testing.assert_array_equal(again[0].grasp, here[0].grasp)


def test_a_file_is_downloaded_once_and_again_when_it_is_another(
    out: Path, store: MemoryFileSystem, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = local_file(ADDRESS)
    with monkeypatch.context() as patch:
        patch.delattr(MemoryFileSystem, "cat_file")
        patch.setattr(MemoryFileSystem, "get_file", None)
        assert local_file(ADDRESS) == first
    assert downloads(cache) == [first]
    # Even one of the same size.
    store.pipe(ADDRESS, bytes(first.stat().st_size))
    assert local_file(ADDRESS) != first
    with pytest.raises(DataError, match="must be a data file of drakegrasp"):
        GraspDataset(ADDRESS)


def test_a_download_that_breaks_off_leaves_nothing(
    store: MemoryFileSystem, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(self: MemoryFileSystem, name: str, path: str) -> None:
        Path(path).write_bytes(self.cat_file(name)[:1000])

    monkeypatch.setattr(MemoryFileSystem, "get_file", half)
    with pytest.raises(DataError, match=r"must have [\d,]+ bytes, got 1,000: download again"):
        GraspDataset(ADDRESS)
    assert downloads(cache) == []

    def reset(self: MemoryFileSystem, name: str, path: str) -> None:
        raise ConnectionResetError("the peer\nis gone")

    monkeypatch.setattr(MemoryFileSystem, "get_file", reset)
    with pytest.raises(DataError, match="must be a file that can be read, got none") as caught:
        GraspDataset(ADDRESS)
    assert "\n" not in str(caught.value) and ADDRESS in str(caught.value)
    assert downloads(cache) == []


@pytest.mark.parametrize("read", [GraspDataset, SceneDataset])
@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("memory://bucket/none.hdf5", "memory://bucket/none.hdf5: must be a file that can be read"),
        ("memory://bucket/data", "must be a file, got a directory"),
        ("nothing://bucket/a.hdf5", "Protocol not known"),
    ],
)
def test_what_is_no_file_is_refused(
    store: MemoryFileSystem,
    address: str,
    message: str,
    read: type[GraspDataset] | type[SceneDataset],
) -> None:
    with pytest.raises(DataError, match=message):
        read(address)


def test_a_missing_package_is_named_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(MachineError, match=r"s3://b/a.hdf5 .*pip install 'drakegrasp\[remote\]'"):
        GraspDataset("s3://b/a.hdf5")


def test_local_files_do_not_load_fsspec(out: Path) -> None:
    code = (
        "import sys; from drakegrasp.dataset.reader import GraspDataset;"
        f"GraspDataset({str(out / OTO)!r})[0]; print('fsspec' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
