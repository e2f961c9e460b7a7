"""Progress on standard error: what is done, how fast, and the time left."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

#: Age of the reports of which the speed is [s]: a task may take a minute.
SPEED_SECONDS = 600.0
#: Width of a terminal [characters] from which on the figures fit on the same line.
ONE_LINE = 150
#: Width of everything except the bar, and the smallest and largest width of the bar [characters].
_BESIDES_BAR, _LEAST_BAR, _MOST_BAR = 70, 6, 24


class Report(Protocol):
    """Called by long computations to report their progress."""

    def __call__(self, done: int, total: int | None, **figures: int) -> None:
        """Report that `done` of `total` steps are done.

        Args:
            done: Number of finished steps.
            total: Number of all steps, which may change; None: it is not known yet.
            figures: Further numbers to show, by the name of what they count.
        """


def silent(done: int, total: int | None, **figures: int) -> None:
    """Report nothing."""


class _Rate(ProgressColumn):
    """Steps per second."""

    def __init__(self, unit: str) -> None:
        super().__init__(Column(no_wrap=True))
        self._unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f} {self._unit}/s" if speed else f"- {self._unit}/s")


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
            TimeRemainingColumn(table_column=Column(no_wrap=True)),
            console=console,
            speed_estimate_period=SPEED_SECONDS,
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
    task = bar.add_task(f"{title:<10}", total=None, figures="")

    def report(done: int, total: int | None, **figures: int) -> None:
        bar.start()  # not earlier: so an error before the first report is the only output
        text = " ".join(f"{value} {name}" for name, value in figures.items())
        bar.update(task, completed=done, total=total, figures=text)

    try:
        yield report
    finally:
        if bar.live.is_started:  # else rich would print an empty line
            bar.stop()
