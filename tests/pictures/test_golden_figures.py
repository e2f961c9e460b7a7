"""What all figures of a dataset show, compared with stored texts; see `helpers/golden.py`."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.golden import Golden, drawn
from helpers.machine import needs_egl
from matplotlib.figure import Figure

from drakegrasp.pictures import figures, rendered
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are written, in turn, which are not rasterized."""
    found: list[Figure] = []

    def keep(figure: Figure, **_: object) -> bytes:
        found.append(figure)
        return b""

    monkeypatch.setattr(figures, "png_bytes", keep)
    monkeypatch.setattr(figures, "svg_bytes", lambda *_, **__: b"")
    monkeypatch.setattr(rendered, "PIXELS", 64)
    return found


@needs_egl
def test_figures_of_a_dataset(
    sound: Path, tmp_path: Path, pages: list[Figure], golden: Golden
) -> None:
    written = write_figures(sound, tmp_path)
    for name, figure in zip(written.names, pages, strict=True):
        golden(f"figures/{name}", drawn(figure, pixels=name != "phases"))
    golden("figures/numbers", (tmp_path / NUMBERS_FILE).read_text(encoding="utf-8"))
