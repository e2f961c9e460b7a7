"""The progress bar fits the terminal, and its speed is that of the work."""

from __future__ import annotations

import io
from collections.abc import Iterable

import pytest
from rich.console import Console

from drakegrasp.runtime.progress import ONE_LINE, _Bar, progress_bar

FIGURES = "130 grasps 2 crashed 1 timeout 64 workers"


def lines(width: int) -> list[str]:
    """Return what a terminal of a width shows after a while."""
    console = Console(file=io.StringIO(), width=width, force_terminal=True, color_system=None)
    bar = _Bar("attempts", console)
    task = bar.add_task("simulate  ", total=1_260_000, figures=FIGURES, speed=64.2)
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
    for words in ("simulate", "8350/1260000", "64.2 attempts/s", FIGURES, "5:24:57 left"):
        assert words in whole
    assert max(map(len, shown)) <= width


Reports = Iterable[tuple[float, int, int | None, int]]


def last_line(
    reports: Reports, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    """Return what a bar shows after reports: each its time [s], done, total and found."""
    now = 0.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    with progress_bar("simulate", "attempts") as report:
        for moment, done, total, found in reports:
            now = moment
            report(done, total, found=found)
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("reports", "words"),
    [
        # A thousand found at once, then one a second: 899 seconds are left, and not 80.
        (
            [(0, 500, 2000, 500), *((i, 1000 + i, 2000, 1000) for i in range(102))],
            "1101/2000 1.0 attempts/s 0:00:00 0:14:59 left",
        ),
        # The total is another one after each report, and the first report is after the first steps.
        ([(10.0, 20, 200, 0), (20, 40, 100, 0)], "40/100 2.0 attempts/s 0:00:00 0:00:30 left"),
        # Without a total there is a speed, but no time.
        ([(10.0, 20, None, 0)], "20/? 2.0 attempts/s 0:00:00"),
        # Before the first step nothing is known.
        ([(10.0, 0, 100, 0)], "0/100 - attempts/s 0:00:00"),
        # Of steps that each take longer than the window, the speed is that of the last.
        ([(i * 1000.0, i, 10, 0) for i in range(5)], "4/10 0.0 attempts/s 0:00:00 1:40:00 left"),
        # A speed of long ago does not count.
        (
            [(100.0, 1000, 3000, 0), *((100.0 + 100 * i, 1000 + i, 3000, 0) for i in range(9))],
            "1008/3000 0.0 attempts/s 0:00:00 2 days, 7:20:00 left",
        ),
    ],
)
def test_time_left_is_by_the_latest_speed(
    reports: Reports,
    words: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert last_line(reports, monkeypatch, capsys).endswith(words)
