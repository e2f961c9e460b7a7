"""The check of clutter.hdf5: a sound file passes, and planted changes are found."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.datasets import edit_file, must_find

from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.schema import HITS_NOTHING, HITS_TABLE, NOT_TRIED

pytestmark = pytest.mark.sim
FILE, GRASPS = "clutter.hdf5", "/grasps"


@pytest.fixture
def out(small_clutter: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(small_clutter, tmp_path / "out"))


def test_a_sound_file_passes_also_if_scenes_differ_in_their_objects(out: Path) -> None:
    assert check_dataset(out) == []
    edit_file(out / FILE, lambda file: _without_second_object(file, scene=1))
    assert check_dataset(out) == []


def _without_second_object(file: Any, scene: int) -> None:
    file["scenes/object"][scene, 1] = -1
    file["scenes/resting"][scene, 1] = 255
    for name in ("X_TO", "mass", "friction_hand", "friction_table"):
        file["scenes"][name][scene, 1] = np.nan
    file["grasps/object"][file["grasps/scene"][:] == scene] = 0


def test_one_changed_byte_is_found(out: Path) -> None:
    content = bytearray((out / FILE).read_bytes())
    content[len(content) // 2] ^= 1
    (out / FILE).write_bytes(content)
    assert any(v.file == FILE for v in check_dataset(out))


@pytest.mark.parametrize(
    ("column", "value", "what"),
    [
        ("lifted", False, "lifted must be true exactly where outcome is success"),
        ("kept", True, "kept must be false where outcome is not success"),
        ("clean", True, "clean must be false where the grasp is not kept"),
        ("free", False, "free must be true exactly where hit is 255"),
        ("hit", HITS_TABLE, "free must be true exactly where hit is 255"),
        ("tested", True, "tested must be false where outcome is not that of a lift"),
        ("outcome", 200, "outcome must be one of 0, "),
        ("object", 2, "object must be that of an object in its scene"),
    ],
)
def test_labels_that_contradict_each_other_are_found(
    out: Path, column: str, value: Any, what: str
) -> None:
    row = _change(out, column, value)
    must_find(out, (FILE, GRASPS, row, what))


def _change(out: Path, column: str, value: Any) -> int:
    """Change the column of a grasp that has another value; return its row."""
    row = -1

    def edit(file: Any) -> None:
        nonlocal row
        kept, tried = file["grasps/kept"][:], file["grasps/outcome"][:] != NOT_TRIED
        free = file["grasps/hit"][:] == HITS_NOTHING
        one = {"lifted": kept, "kept": ~tried, "clean": ~tried, "free": free, "hit": free}
        row = int(np.flatnonzero(one.get(column, ~tried))[0])
        file["grasps"][column][row] = value

    edit_file(out / FILE, edit)
    return row


def test_objects_and_states_of_others_are_found(out: Path) -> None:
    edit_file(out / FILE, lambda file: file["scenes/object"].__setitem__((0, 0), 99))
    must_find(out, (FILE, "/scenes", 0, "object must be one of the rows of /objects"))
    edit_file(out / FILE, lambda file: file["scenes/object"].__setitem__((0, 0), 0))
    edit_file(out / FILE, lambda file: file.attrs.__setitem__("signature", "other"))
    must_find(out, (FILE, "", None, "attribute signature must be that of manifest.json"))
    shutil.move(out / FILE, out / "away")
    assert check_dataset(out) == []
