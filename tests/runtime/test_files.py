"""Files that are whole or absent."""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np
import pytest

from drakegrasp.dataset.hdf5 import write_field
from drakegrasp.dataset.schema import Field
from drakegrasp.runtime.environment import host_label
from drakegrasp.runtime.files import (
    atomic_folder,
    atomic_hdf5,
    replaced_together,
    sweep_temporary,
    write_atomic,
)


def everything_in(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.is_file())


def test_exception_while_writing_keeps_the_file_that_was_there(tmp_path: Path) -> None:
    path = tmp_path / "file.h5"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), atomic_hdf5(path) as file:
        file["new"] = 1
        raise KeyboardInterrupt
    with pytest.raises(KeyboardInterrupt), replaced_together(tmp_path) as new:
        new("file.h5").write_text("new")
        raise KeyboardInterrupt
    assert everything_in(tmp_path) == [path] and path.read_bytes() == b"old"


def test_values_are_not_read_from_where_others_lie(tmp_path: Path) -> None:
    """A changed address of a chunk may be that of another chunk, whose own checksum is right."""
    path = tmp_path / "file.h5"
    with atomic_hdf5(path) as file:
        for number, name in enumerate(("mine", "other")):
            field = Field(name, "float32", "a column")
            write_field(file, field, np.full(5, number, dtype=np.float32))
    with h5py.File(path) as file:
        mine, other = (
            file[name].id.get_chunk_info(0).byte_offset.to_bytes(8, "little")
            for name in ("mine", "other")
        )
    path.write_bytes(path.read_bytes().replace(mine, other))
    with pytest.raises(OSError, match="checksum"), h5py.File(path) as file:
        file["mine"][:]


def test_file_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And its folder afterwards: after a power cut the name never stands for an empty file."""
    path, synced = tmp_path / "file.txt", watch_sync(monkeypatch)
    write_atomic(path, b"content")
    ((first, there), (second, named)) = [(name, path in seen) for name, seen in synced]
    assert first.parent == tmp_path and first.name.startswith(".file.txt.") and not there
    assert second == tmp_path and named


def test_files_that_are_replaced_together_are_on_the_disk_before_the_first_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = watch_sync(monkeypatch)
    with replaced_together(tmp_path) as new:
        for name in ("b", "a"):
            new(name).write_text(name)
    (first, before), (second, still), (end, seen) = synced
    assert [first.name[:3], second.name[:3], end] == [".b.", ".a.", tmp_path]
    assert not {tmp_path / "a", tmp_path / "b"} & (before | still)
    assert {tmp_path / "a", tmp_path / "b"} == seen
    assert [(tmp_path / name).read_text() for name in ("a", "b")] == ["a", "b"]


def test_files_get_their_names_in_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named, rename = list[str](), Path.replace
    monkeypatch.setattr(
        Path, "replace", lambda path, to: (named.append(to.name), rename(path, to))[1]
    )
    with replaced_together(tmp_path) as new:
        for name in ("z", "a", "m"):
            new(name).write_text(name)
    assert named == ["z", "a", "m"]


def watch_sync(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Path, set[Path]]]:
    """Return a list that gets what is synced, and what its folder holds at that time."""
    synced: list[tuple[Path, set[Path]]] = []
    sync = os.fsync

    def watch(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        synced.append((path, set((path if path.is_dir() else path.parent).iterdir())))
        sync(descriptor)

    monkeypatch.setattr(os, "fsync", watch)
    return synced


def test_a_folder_that_a_dead_process_was_filling_is_removed(tmp_path: Path) -> None:
    """One of a process that runs stays, and so does what a link leads to."""
    kept = tmp_path / "kept"
    kept.mkdir()
    out = tmp_path / "out"
    dead = out / f".hand.{host_label()}~999999999~0123456789ab.tmp"
    (dead / "meshes").mkdir(parents=True)
    (dead / "meshes" / "palm.obj").write_text("half")
    link = out / f".hand.{host_label()}~999999999~0123456789ac.tmp"
    link.symlink_to(kept)
    with atomic_folder(out / "hand") as alive:
        assert sweep_temporary(out) == [link]  # `atomic_folder` has removed the other one
        assert alive.exists()
    dead.mkdir()
    assert sweep_temporary(out) == [dead]
    assert kept.exists() and (out / "hand").exists() and not dead.exists()
