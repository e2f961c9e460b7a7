"""Shards are whole or absent: what is written comes back, what is harmed is refused."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.shards import HEADER, read_shard, some_shard, written_shard
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from drakegrasp.dataset.schema import LOOK_FIELDS, SCHEMA_VERSION
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.errors import DataError
from drakegrasp.runtime.files import seal


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
@example(12, 0, 0)
def test_shard_comes_back_bit_by_bit(tmp_path: Path, trials: int, looks: int, seed: int) -> None:
    """Also that of a unit without a success, which has no looks."""
    shard = some_shard(trials=trials, looks=min(looks, trials), seed=seed)
    back = read_shard(written_shard(tmp_path, shard), HEADER)
    assert back.header == HEADER
    assert_same_bits(back.trials, shard.trials)
    assert_same_bits(back.looks, shard.looks)


def test_same_shard_gives_the_same_bytes(tmp_path: Path) -> None:
    """No time, process or order of keys gets into a file."""
    shard = some_shard()
    turned = replace(shard, trials=dict(reversed(shard.trials.items())))
    one, two = (written_shard(tmp_path / d, s) for d, s in (("a", shard), ("b", turned)))
    assert one.read_bytes() == two.read_bytes()
    one.write_bytes(b"")
    assert written_shard(tmp_path / "a", shard).read_bytes() == two.read_bytes()


def test_profiler_that_holds_a_column_does_not_change_the_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As that of Dask's workers, which holds what the functions hold that it sees."""
    one, held = written_shard(tmp_path / "a", some_shard()), list[h5py.Dataset]()
    create = h5py.Group.create_dataset

    def creating(*args: Any, **options: Any) -> h5py.Dataset:
        dataset = create(*args, **options)
        held.extend([] if held else [dataset])
        return dataset

    monkeypatch.setattr(h5py.Group, "create_dataset", creating)
    two = written_shard(tmp_path / "b", some_shard())
    assert one.read_bytes() == two.read_bytes()


def test_shard_holds_values_and_little_else(tmp_path: Path) -> None:
    """HDF5 spends two kilobytes on a column that can grow and says what it means."""
    with h5py.File(written_shard(tmp_path, some_shard())) as file:
        for group, fields in (("trials", trial_columns()), ("looks", LOOK_FIELDS)):
            assert set(file[group]) == {f.name for f in fields}
        columns = [column for group in file.values() for column in group.values()]
        stored = sum(column.id.get_storage_size() for column in columns)
    (path,) = tmp_path.glob("shards/*/*.h5")
    assert path.stat().st_size - stored < 600 * len(columns)


def test_any_flipped_bit_or_lost_end_is_found(tmp_path: Path) -> None:
    """Wherever it is: in data, in HDF5's own records, in unused space, or in the seal."""
    path = written_shard(tmp_path, some_shard())
    whole = path.read_bytes()
    harmed = [whole[: int(part * len(whole))] for part in (0.0, 0.001, 0.1, 0.5, 0.9, 0.999)]
    for flip in np.linspace(0, len(whole) - 1, 200).astype(int):
        harmed.append(whole[:flip] + bytes([whole[flip] ^ 0x10]) + whole[flip + 1 :])
    message = r"0000050-0000100\.h5: must be a complete shard, got one that is damaged or cut off"
    for content in harmed:
        path.write_bytes(content)
        with pytest.raises(DataError, match=message):
            read_shard(path)


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
    path = written_shard(tmp_path, some_shard())
    wanted = replace(HEADER, **other)
    with pytest.raises(DataError, match=r"0000050-0000100\.h5: must be a shard of .*, got one of"):
        read_shard(path, wanted)
    assert read_shard(path).header == HEADER


def test_shard_of_another_schema_is_refused(tmp_path: Path) -> None:
    path = written_shard(tmp_path, some_shard())
    with h5py.File(path, "r+") as file:
        file.attrs["schema_version"] = SCHEMA_VERSION + 1
    seal(path)
    message = rf"0000050-0000100\.h5: schema must be {SCHEMA_VERSION}, got {SCHEMA_VERSION + 1}"
    with pytest.raises(DataError, match=message):
        read_shard(path)
