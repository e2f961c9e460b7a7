"""Class sheets: one grasp of each class, the first."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest
from helpers.datasets import OTO

from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.pictures.figures import class_sheet
from drakegrasp.pictures.figures.class_sheet import class_sheets


def titles(pages: list) -> list[str]:
    return [text.get_text() for page in pages for axes in page.axes for text in axes.texts]


def test_each_class_has_its_first_sample(sound: Path) -> None:
    pages, trials = class_sheets(sound / OTO)
    first: dict[str, int] = {}
    with h5py.File(sound / OTO, "r") as file:
        for split in SPLITS:
            group = file[split]
            names = group["object_props/class_name"].asstr()[:]
            for name, trial in zip(names, group["trial_id"][:], strict=True):
                first[name] = min(int(trial), first.get(name, 10**6))
    assert trials == first
    assert list(trials) == ["box", "brick"]
    assert titles(pages) == ["box", f"trial {first['box']}", "brick", f"trial {first['brick']}"]


def test_many_classes_fill_pages(sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(class_sheet, "PER_PAGE", 1)
    pages, _ = class_sheets(sound / OTO)
    assert len(pages) == 2


def test_a_file_without_samples_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="must be a data file"):
        class_sheets(tmp_path / OTO)
