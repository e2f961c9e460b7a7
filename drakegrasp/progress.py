"""Progress on standard error: what is done, how fast, and how long it will still take."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
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
from rich.text import Text


class Report(Protocol):
    """What long work calls as it goes on."""

    def __call__(self, done: int, total: int, **figures: int) -> None:
        """Say that `done` of `total` is done, with figures to show beside it."""


def silent(done: int, total: int, **figures: int) -> None:
    """Report nothing."""


class _Rate(ProgressColumn):
    """Steps per second."""

    def __init__(self, unit: str) -> None:
        super().__init__()
        self._unit = unit

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f} {self._unit}/s" if speed else f"- {self._unit}/s")


@contextmanager
def progress_bar(title: str, unit: str, *, show: bool = True) -> Iterator[Report]:
    """Show a progress bar on standard error while the block runs; yield what feeds it.

    Off a terminal only the last state is printed, so logs stay short.
    """
    if not show:
        yield silent
        return
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        _Rate(unit),
        TextColumn("{task.fields[figures]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task(f"{title:<10}", total=None, figures="")

    def report(done: int, total: int, **figures: int) -> None:
        bar.start()  # only now, so that an error before the first report stands alone
        text = " ".join(f"{value} {name}" for name, value in figures.items())
        bar.update(task, completed=done, total=total, figures=text)

    try:
        yield report
    finally:
        bar.stop()
