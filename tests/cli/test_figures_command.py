"""`drakegrasp figures`: files, a line for what is left out, and one line for a mistake."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.commands import run

from drakegrasp.errors import DataError
from drakegrasp.pictures import figures


def test_figures_are_written_beside_the_dataset(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise DataError("not in this test")

    monkeypatch.setattr(figures, "_sheet", refuse)
    for name in ("png_bytes", "svg_bytes"):
        monkeypatch.setattr(figures, name, lambda figure, *, dpi: b"")
    result = run("figures", out, "--quiet")
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines() == [
        "sheet is left out: not in this test",
        f"2 figures in {out / 'figures'}",
    ]
    assert (out / "figures" / "distributions.svg").is_file()
    # A build that goes on, and a second run, are not disturbed by them.
    assert run("figures", out, "--out", tmp_path / "other", "--quiet").exit_code == 0
    names = [
        {path.name for path in folder.iterdir()} for folder in (out / "figures", tmp_path / "other")
    ]
    assert names[0] == names[1]
