"""The progress bar fits the terminal, and its speed is that of the work."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from drakegrasp.runtime.progress import ONE_LINE, _Bar, progress_bar

FIGURES = "130 grasps 2 crashed 1 timeout 64 workers"


def lines(width: int) -> list[str]:
    """Return what a terminal of a width shows after a while."""
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    bar = _Bar("attempts", console)
    task = bar.add_task("simulate  ", total=1_260_000, figures=FIGURES)
    bar.update(task, completed=8350)
    with console.capture() as capture:
        console.print(bar.get_renderable())
    return [line.rstrip() for line in capture.get().splitlines()]


@pytest.mark.parametrize("width", [60, 80, 120, ONE_LINE - 1, ONE_LINE, 250])
def test_nothing_is_cut_off(width: int) -> None:
    shown = lines(width)
    assert len(shown) == (1 if width >= ONE_LINE else 2)
    whole = " ".join(shown)
    assert "\N{HORIZONTAL ELLIPSIS}" not in whole
    for words in ("simulate", "8350/1260000", "attempts/s", FIGURES, "left"):
        assert words in whole
    assert max(map(len, shown)) <= width


def test_what_was_there_before_says_nothing_of_the_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand found at once, then one a second: 899 seconds are left, and not 80."""
    now = 0.0
    bars: list[_Bar] = []
    monkeypatch.setattr("rich.console.monotonic", lambda: now)
    monkeypatch.setattr(_Bar, "start", lambda bar: None)
    monkeypatch.setattr("rich.live.Live.is_started", True)
    monkeypatch.setattr(_Bar, "stop", lambda bar: bars.append(bar))
    with progress_bar("simulate", "attempts") as report:
        report(500, 2000, found=500)
        report(1000, 2000, found=1000)
        for _ in range(101):
            now += 1.0
            report(1000 + round(now), 2000, found=1000)
    (bar,) = bars
    assert bar.tasks[0].speed == pytest.approx(1.0)
    assert bar.tasks[0].time_remaining == 899
