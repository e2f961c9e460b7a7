"""Files that are whole or absent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers.shards import some_shard

from drakegrasp.dataset.shards import write_shard
from drakegrasp.runtime import files
from drakegrasp.runtime.files import atomic_hdf5, atomic_path, probe_folder, write_atomic


def everything_in(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def test_exception_while_writing_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), atomic_hdf5(tmp_path / "deep" / "file.h5") as file:
        file["some"] = np.zeros(1000)
        raise KeyboardInterrupt
    assert everything_in(tmp_path) == []


def test_exception_while_writing_keeps_the_file_that_was_there(tmp_path: Path) -> None:
    path = write_shard(tmp_path, some_shard())
    before = path.read_bytes()
    incomplete = some_shard(seed=1)
    incomplete = replace(
        incomplete, looks={k: v for k, v in incomplete.looks.items() if k != "X_CI_otm"}
    )
    with pytest.raises(KeyError, match="X_CI_otm"):
        write_shard(tmp_path, incomplete)
    assert everything_in(tmp_path) == [path]
    assert path.read_bytes() == before


def test_file_appears_only_when_it_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    with atomic_hdf5(path) as file:
        file["some"] = np.zeros(3)
        assert not path.exists()
    assert everything_in(tmp_path) == [path]


def test_bytes_replace_an_older_file(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "file.txt"
    for content in (b"one", b"two\r\n"):
        write_atomic(path, content)
        assert path.read_bytes() == content
    assert everything_in(tmp_path) == [path]


def test_block_that_fails_keeps_the_older_file(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    write_atomic(path, b"old")
    with pytest.raises(ValueError, match="half"), atomic_path(path) as temporary:
        temporary.write_bytes(b"ne")
        raise ValueError("half")
    assert path.read_bytes() == b"old"
    assert everything_in(tmp_path) == [path]


def test_probe_leaves_nothing_and_needs_a_folder(tmp_path: Path) -> None:
    probe_folder(tmp_path)
    assert everything_in(tmp_path) == []
    with pytest.raises(FileNotFoundError):
        probe_folder(tmp_path / "missing")


def test_failed_rename_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk shows when the file is closed or synced; the temporary file goes then, too."""

    def full(temporary: Path, path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "sync_and_rename", full)
    with pytest.raises(OSError, match="No space left"):
        write_shard(tmp_path, some_shard())
    assert everything_in(tmp_path) == []
