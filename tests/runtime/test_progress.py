"""The progress bar fits the terminal, and its speed is that of the work."""

from __future__ import annotations

import io
from typing import Any

import pytest
from rich.console import Console

from drakegrasp.runtime.progress import ONE_LINE, _Bar, progress_bar

FIGURES = "130 grasps 2 crashed 1 timeout 64 workers"


def lines(width: int) -> list[str]:
    """Return what a terminal of a width shows after a while."""
    now = 0.0
    how: Any = {"force_terminal": True, "color_system": None, "get_time": lambda: now}
    console = Console(file=io.StringIO(), width=width, **how)
    bar = _Bar("attempts", console)
    task = bar.add_task("simulate  ", total=1_260_000, figures=FIGURES)
    for now in (0.0, 10.0, 20.0):
        bar.update(task, completed=8350 - 64.2 * (20.0 - now))
    with console.capture() as capture:
        console.print(bar.get_renderable())
    return [line.rstrip() for line in capture.get().splitlines()]


@pytest.mark.parametrize("width", [60, 80, 120, ONE_LINE - 1, ONE_LINE, 250])
def test_nothing_is_cut_off(width: int) -> None:
    shown = lines(width)
    assert len(shown) == (1 if width >= ONE_LINE else 2)
    whole = " ".join(shown)
    assert "\N{HORIZONTAL ELLIPSIS}" not in whole
    for words in ("simulate", "8350/1260000", "64.2 attempts/s", FIGURES, "5:24:57"):
        assert words in whole
    assert max(map(len, shown)) <= width


def test_time_left_is_by_the_speed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The total becomes known later."""
    now = 0.0
    monkeypatch.setattr("rich.console.monotonic", lambda: now)
    with progress_bar("simulate", "attempts") as report:
        report(0, None)
        for now in (10.0, 20.0):
            report(int(2 * now), 100)
    assert "40/100 2.0 attempts/s" in " ".join(capsys.readouterr().err.split())
