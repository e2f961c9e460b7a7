"""All figures of a dataset: the same bytes every time, and one line for what is missing."""

from __future__ import annotations

import json
from pathlib import Path
from xml.etree import ElementTree

import h5py
import matplotlib as mpl
import pytest
from helpers import datasets
from helpers.assertions import contents
from helpers.datasets import OTO, TRIALS, edit_file, make_dataset

from drakegrasp.dataset.assemble import assemble
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures

ALL = {"sheet", "outcomes", "distributions"}


def lose_all(out: Path) -> None:
    """Let every attempt of a dataset end as a failure."""

    def lose(file: h5py.File) -> None:
        file["trials/outcome"][:] = Outcome.DROPPED
        file["successes/removal"][:] = Removal.SLID

    edit_file(out / TRIALS, lose)


@pytest.mark.nightly
def test_the_same_dataset_gives_the_same_bytes(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = write_figures(sound, tmp_path / "a")
    assert written.left_out == {}
    assert set(written.names) == ALL
    files = contents(tmp_path / "a")
    assert set(files) == {f"{n}{s}" for n in ALL for s in (".png", ".svg")} | {NUMBERS_FILE}
    for name, content in files.items():
        if name.endswith(".svg"):
            ElementTree.fromstring(content)
            assert b"<dc:date>" not in content
    numbers = json.loads(files[NUMBERS_FILE])
    assert numbers["outcomes"]["samples"] == 9

    # The style of somebody's papers changes nothing.
    with mpl.rc_context({"font.size": 25, "axes.grid": True, "savefig.dpi": 30}):
        write_figures(sound, tmp_path / "b")
    again = contents(tmp_path / "b")
    assert {name for name in files if files[name] != again[name]} == set()


def test_what_the_dataset_lacks_is_left_out(out: Path, tmp_path: Path) -> None:
    (out / OTO).unlink()
    lose_all(out)
    folder = tmp_path / "figures"
    folder.mkdir()
    for name in ("distributions.png", "sheet.svg", "mine.png"):
        (folder / name).touch()
    written = write_figures(out, folder)
    assert set(written.names) == {"outcomes"}
    assert written.left_out["distributions"] == "no attempt became a sample"
    assert OTO in written.left_out["sheet"]
    # A picture of what was there before is removed, and nothing else.
    assert {p.name for p in folder.glob("*.png")} == {
        *(f"{name}.png" for name in written.names),
        "mine.png",
    }
    assert not (folder / "sheet.svg").exists()
    assert json.loads((folder / NUMBERS_FILE).read_text())["outcomes"]["samples"] == 0


def test_pictures_of_samples_count_the_same_rows(out: Path, tmp_path: Path) -> None:
    """Two of the nine successes are removed; each picture tells of the seven samples."""
    assemble(out, rejected=[0, 12])
    assert "sheet" in write_figures(out, tmp_path / "figures").names
    numbers = json.loads((tmp_path / "figures" / NUMBERS_FILE).read_text())
    assert numbers["outcomes"]["samples"] == 7
    assert numbers["outcomes"]["removed: rejected"] == 2
    assert sum(numbers["outcomes"].values()) == 36
    assert sorted(numbers["sheet"]["trial_ids"]) == [3, 11, 15, 23, 24, 27, 35]


def test_names_are_drawn_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one object, whose name would be a formula, a tag, and letters that the font lacks."""
    name = "1_$^$ <script>&\"' 碗 x" + 30 * "y"
    monkeypatch.setattr(datasets, "BOXES", {name: ((0.06, 0.05, 0.10), "a $^$ class")})
    out = make_dataset(tmp_path / "out", tmp_path)
    written = write_figures(out, tmp_path / "figures")
    assert set(written.names) == ALL
    for svg in (tmp_path / "figures").glob("*.svg"):
        assert b"<script" not in svg.read_bytes()
