"""What is refused before it is read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from drakegrasp import foreign_files
from drakegrasp.foreign_files import validate_regular


def test_large_file_is_read_in_parts_unless_it_consists_of_holes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    solid, holes = tmp_path / "solid", tmp_path / "holes"
    solid.write_bytes(b"x" * 2**20)
    holes.write_bytes(b"x")
    os.truncate(holes, 2**40)
    validate_regular(solid)
    with pytest.raises(OSError, match=r"1,099,511,627,776 byte, of which only [0-9,]+ are on"):
        validate_regular(holes)
    monkeypatch.setattr(foreign_files, "LARGE", 2**10)
    validate_regular(solid)
    with pytest.raises(OSError, match="1,048,576 byte, more than 1,024"):
        validate_regular(solid, 2**10)


def test_share_of_a_file_that_is_on_the_disk_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of it must be: 300 kB of 1 MB are too few, 900 kB are enough."""
    monkeypatch.setattr(foreign_files, "LARGE", 2**10)
    monkeypatch.setattr(foreign_files, "SOLID", 0.5)
    path = tmp_path / "file"
    path.write_bytes(b"x" * 300_000)
    os.truncate(path, 1_000_000)
    with pytest.raises(OSError, match=r"1,000,000 byte, of which only 3\d\d,\d{3} are on"):
        validate_regular(path)
    path.write_bytes(b"x" * 900_000)
    os.truncate(path, 1_000_000)
    validate_regular(path)
