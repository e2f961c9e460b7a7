"""Shards are whole or absent: what is written comes back, what is harmed is refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from drakegrasp import shards
from drakegrasp.errors import DataError
from drakegrasp.schema import LOOK_FIELDS, SCHEMA_VERSION, TRIAL_FIELDS, Field, sizes
from drakegrasp.shards import (
    Shard,
    ShardHeader,
    atomic_hdf5,
    read_shard,
    seal,
    trial_columns,
    write_shard,
)

SIZES = sizes(fingers=3, joints=8, image=8)
HEADER = ShardHeader(
    config_hash="0123456789abcdef",
    mesh_sha256="f" * 64,
    object_name="24_mug_final",
    start=50,
    stop=100,
)


def column(field: Field, count: int, rng: np.random.Generator) -> npt.NDArray[Any]:
    """Return rows of random bytes of a field's type: every NaN, infinity and denormal, too."""
    shape, dtype = (count, *field.row_shape(SIZES)), np.dtype(field.dtype)
    if dtype.kind == "b":
        return rng.integers(0, 2, shape).astype(bool)
    return np.frombuffer(rng.bytes(dtype.itemsize * int(np.prod(shape))), dtype).reshape(shape)


def some_shard(*, trials: int = 12, looks: int = 3, seed: int = 0) -> Shard:
    rng = np.random.default_rng(seed)
    return Shard(
        header=HEADER,
        trials={f.name: column(f, trials, rng) for f in trial_columns()},
        looks={f.name: column(f, looks, rng) for f in LOOK_FIELDS},
    )


def assert_same_bits(one: Mapping[str, Any], two: Mapping[str, Any]) -> None:
    assert set(one) == set(two)
    for name in one:
        assert one[name].dtype == two[name].dtype, name
        assert one[name].shape == two[name].shape, name
        assert one[name].tobytes() == two[name].tobytes(), name


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.integers(0, 40), st.integers(0, 3), st.integers(0, 2**32))
def test_shard_comes_back_bit_by_bit(tmp_path: Path, trials: int, looks: int, seed: int) -> None:
    shard = some_shard(trials=trials, looks=looks, seed=seed)
    back = read_shard(write_shard(tmp_path, shard), HEADER)
    assert back.header == HEADER
    assert_same_bits(back.trials, shard.trials)
    assert_same_bits(back.looks, shard.looks)


def test_unit_without_a_success_has_no_looks(tmp_path: Path) -> None:
    back = read_shard(write_shard(tmp_path, some_shard(looks=0)))
    assert {len(values) for values in back.looks.values()} == {0}
    assert back.looks["image_oto"].shape == (0, 4, 8, 8)
    assert {len(values) for values in back.trials.values()} == {12}


def test_path_tells_object_and_range(tmp_path: Path) -> None:
    path = write_shard(tmp_path, some_shard())
    assert path == tmp_path / "shards" / "24_mug_final" / "0000050-0000100.h5"


def test_same_shard_gives_the_same_bytes(tmp_path: Path) -> None:
    """No time, process or order of keys gets into a file."""
    shard = some_shard()
    turned = replace(shard, trials=dict(reversed(shard.trials.items())))
    one, two = (write_shard(tmp_path / d, s) for d, s in (("a", shard), ("b", turned)))
    assert one.read_bytes() == two.read_bytes()
    one.write_bytes(b"")
    assert write_shard(tmp_path / "a", shard).read_bytes() == two.read_bytes()


def test_shard_has_every_column_but_those_of_the_whole_dataset() -> None:
    names = [f.name for f in trial_columns()]
    assert names == [f.name for f in TRIAL_FIELDS if f.name not in ("trial_id", "object")]


def test_every_column_states_its_unit_frame_and_meaning(tmp_path: Path) -> None:
    with h5py.File(write_shard(tmp_path, some_shard())) as file:
        for group, fields in (("trials", trial_columns()), ("looks", LOOK_FIELDS)):
            assert set(file[group]) == {f.name for f in fields}
            for f in fields:
                attributes = dict(file[group][f.name].attrs)
                assert attributes == {"unit": f.unit, "frame": f.frame, "meaning": f.meaning}


def test_images_lie_one_to_a_chunk(tmp_path: Path) -> None:
    """A loader reads single samples: it must not unpack their neighbours."""
    with h5py.File(write_shard(tmp_path, some_shard())) as file:
        for name in ("image_oto", "mask_oto", "image_otm", "mask_otm"):
            assert file["looks"][name].chunks == (1, *file["looks"][name].shape[1:])


@pytest.mark.parametrize("part", [0.0, 0.001, 0.1, 0.5, 0.9, 0.999])
def test_truncated_file_is_refused(tmp_path: Path, part: float) -> None:
    path = write_shard(tmp_path, some_shard())
    data = path.read_bytes()
    path.write_bytes(data[: int(part * len(data))])
    with pytest.raises(
        DataError, match=r"0000050-0000100\.h5: must be a complete shard, got one that is dam"
    ):
        read_shard(path)


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"none\.h5: must be a complete shard"):
        read_shard(tmp_path / "none.h5")


def test_hdf5_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["trials"] = np.arange(3)
    with pytest.raises(DataError, match=r"other\.h5: must be a complete shard"):
        read_shard(tmp_path / "other.h5")


def test_missing_column_is_refused(tmp_path: Path) -> None:
    path = write_shard(tmp_path, some_shard())
    with h5py.File(path, "r+") as file:
        del file["trials"]["outcome"]
    seal(path)
    with pytest.raises(DataError, match=r"\.h5: must be a complete shard.*outcome"):
        read_shard(path)


def test_any_flipped_bit_is_found(tmp_path: Path) -> None:
    """Wherever it is: in data, in HDF5's own records, in unused space, or in the seal."""
    path = write_shard(tmp_path, some_shard())
    whole = path.read_bytes()
    for flip in np.linspace(0, len(whole) - 1, 200).astype(int):
        data = bytearray(whole)
        data[flip] ^= 0x10
        path.write_bytes(data)
        with pytest.raises(DataError, match=r"0000050-0000100\.h5: must be a complete shard"):
            read_shard(path)


def test_absurd_number_of_rows_is_refused(tmp_path: Path) -> None:
    """One flipped byte of the header claims rows that no memory holds."""
    path = write_shard(tmp_path, some_shard())
    with h5py.File(path, "r+") as file:
        file["trials"]["slip"].resize(2**57, axis=0)
    with pytest.raises(DataError, match=r"0000050-0000100\.h5: must be a complete shard"):
        read_shard(path)


@pytest.mark.parametrize("column", ["trials/slip", "trials/outcome", "looks/mask_otm"])
def test_rewritten_value_is_refused(tmp_path: Path, column: str) -> None:
    """HDF5 finds nothing wrong here: the seal does."""
    path = write_shard(tmp_path, some_shard())
    with h5py.File(path, "r+") as file:
        first = np.atleast_1d(file[column][0])
        first.flat[0] = 1 if first.flat[0] != 1 else 2
        file[column][0] = first.reshape(file[column].shape[1:])
    with pytest.raises(DataError, match=r"0000050-0000100\.h5: must be a complete shard"):
        read_shard(path)


def test_rewritten_header_is_refused(tmp_path: Path) -> None:
    """A file that was copied to another object's name and told so is still not that object's."""
    path = write_shard(tmp_path, some_shard())
    with h5py.File(path, "r+") as file:
        file.attrs["object_name"] = "other"
    with pytest.raises(DataError, match="must be a complete shard"):
        read_shard(path, replace(HEADER, object_name="other"))


@pytest.mark.parametrize(
    "other",
    [
        {"config_hash": "0" * 16},
        {"mesh_sha256": "0" * 64},
        {"object_name": "mug"},
        {"start": 0},
        {"stop": 99},
    ],
)
def test_shard_of_something_else_is_refused(tmp_path: Path, other: dict[str, Any]) -> None:
    path = write_shard(tmp_path, some_shard())
    wanted = replace(HEADER, **other)
    with pytest.raises(DataError, match=r"0000050-0000100\.h5: must be a shard of .*, got one of"):
        read_shard(path, wanted)
    assert read_shard(path).header == HEADER


def test_shard_of_another_schema_is_refused(tmp_path: Path) -> None:
    path = write_shard(tmp_path, some_shard())
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION + 1
    seal(path)
    message = rf"0000050-0000100\.h5: schema must be {SCHEMA_VERSION}, got {SCHEMA_VERSION + 1}"
    with pytest.raises(DataError, match=message):
        read_shard(path)


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


def test_failed_rename_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk shows when the file is closed or synced; the temporary file goes then, too."""

    def full(temporary: Path, path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shards, "sync_and_rename", full)
    with pytest.raises(OSError, match="No space left"):
        write_shard(tmp_path, some_shard())
    assert everything_in(tmp_path) == []
