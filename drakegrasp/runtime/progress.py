"""Progress on standard error: what is done, how fast, and the time left."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from math import ceil
from typing import Protocol

from rich.console import Console, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Column
from rich.text import Text

#: Age [s] and number of the reports of which the speed is: a task may take a minute, and the number
#: of workers changes.
SPEED_SECONDS, SPEED_REPORTS = 600.0, 1000
#: Width of a terminal [characters] from which on the figures fit on the same line.
ONE_LINE = 150
#: Width of everything except the bar, and the smallest and largest width of the bar [characters].
_BESIDES_BAR, _LEAST_BAR, _MOST_BAR = 70, 6, 24


class Report(Protocol):
    """Called by long computations to report their progress."""

    def __call__(self, done: int, total: int | None, *, found: int = 0, **figures: int) -> None:
        """Report that `done` of `total` steps are done.

        Args:
            done: Number of finished steps.
            total: Number of all steps, which may change; None: it is not known yet.
            found: Number of steps in `done` that were already done; they do not count for the
                speed.
            figures: Further numbers to show, by the name of what they count.
        """


def silent(done: int, total: int | None, *, found: int = 0, **figures: int) -> None:
    """Report nothing."""


class _Speed:
    """The speed of the latest steps; rich's own starts again whenever the total changes."""

    def __init__(self) -> None:
        self._reports = deque([(time.monotonic(), 0)], maxlen=SPEED_REPORTS)
        self._found = 0

    def __call__(self, done: int, found: int) -> float | None:
        """Return the steps per second after a report; None before the first step."""
        now = time.monotonic()
        if found > self._found:  # start again, since these steps took no time
            self._reports.clear()
            self._found = found
        self._reports.append((now, done))
        while len(self._reports) > 2 and self._reports[1][0] < now - SPEED_SECONDS:
            self._reports.popleft()
        then, before = self._reports[0]
        return (done - before) / (now - then) if done > before and now > then else None


class _Rate(ProgressColumn):
    """Steps per second."""

    def __init__(self, unit: str) -> None:
        super().__init__(Column(no_wrap=True))
        self._unit = unit

    def render(self, task: Task) -> Text:
        speed = task.fields["speed"]
        return Text(f"{speed:.1f} {self._unit}/s" if speed else f"- {self._unit}/s")


class _TimeLeft(ProgressColumn):
    """The time until all steps are done; nothing if their number or the speed is not known."""

    def render(self, task: Task) -> Text:
        speed = task.fields["speed"]
        if not speed or task.remaining is None:
            return Text("")
        return Text(f"{timedelta(seconds=ceil(task.remaining / speed))} left")


class _Bar(Progress):
    """A progress bar; on a narrow terminal the figures get a line of their own."""

    def __init__(self, unit: str, console: Console) -> None:
        self._wide = console.width >= ONE_LINE
        bar = min(_MOST_BAR, console.width - _BESIDES_BAR)
        roomy = bar >= _LEAST_BAR
        super().__init__(
            SpinnerColumn(),
            _text("{task.description}"),
            *([BarColumn(bar_width=bar)] if roomy else []),
            MofNCompleteColumn(table_column=Column(no_wrap=True)),
            _Rate(unit),
            *([_text("{task.fields[figures]}")] if self._wide else []),
            *([TimeElapsedColumn(Column(no_wrap=True))] if roomy else []),
            _TimeLeft(Column(no_wrap=True)),
            console=console,
        )

    def get_renderables(self) -> Iterator[RenderableType]:
        """Yield the lines to show; called by rich."""
        yield from super().get_renderables()
        if not self._wide:
            for task in self.tasks:
                if task.fields["figures"]:
                    figures = f"  {task.fields['figures']}"
                    yield Text(figures, no_wrap=True, overflow="ellipsis")


def _text(template: str) -> TextColumn:
    return TextColumn(template, table_column=Column(no_wrap=True))


@contextmanager
def progress_bar(title: str, unit: str, *, show: bool = True) -> Iterator[Report]:
    """Show a progress bar on standard error while the block runs; yield its `Report`.

    If standard error is not a terminal, only the last state is printed, so logs stay short.
    """
    if not show:
        yield silent
        return
    console = Console(stderr=True)
    bar = _Bar(unit, console if console.is_terminal else Console(stderr=True, width=ONE_LINE))
    task = bar.add_task(f"{title:<10}", total=None, figures="", speed=None)
    speed = _Speed()

    def report(done: int, total: int | None, *, found: int = 0, **figures: int) -> None:
        bar.start()  # not earlier: so an error before the first report is the only output
        text = " ".join(f"{value} {name}" for name, value in figures.items())
        bar.update(task, completed=done, total=total, figures=text, speed=speed(done, found))

    try:
        yield report
    finally:
        if bar.live.is_started:  # else rich would print an empty line
            bar.stop()
