"""The processes of this machine: what is begun ends, and what they may use."""

from __future__ import annotations

import io
import multiprocessing
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import pytest
from rich.console import Console

from drakegrasp.cluster.connect import connect
from drakegrasp.config import CameraConfig
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime import executor
from drakegrasp.runtime.environment import prepare_rendering
from drakegrasp.runtime.executor import MOST_PROCESSES, count_workers, in_order, processes
from drakegrasp.runtime.progress import ONE_LINE, _Bar, progress_bar
from drakegrasp.vision.rendering import build_renderer

T = TypeVar("T")
R = TypeVar("R")


def touch_late(path: Path) -> Path:
    time.sleep(0.5)
    path.touch()
    return path


@pytest.mark.nightly
def test_what_is_begun_ends_before_the_executor_does(tmp_path: Path) -> None:
    """Nothing is written behind the back of who has stopped; what waits is not begun."""
    paths = [tmp_path / str(k) for k in range(8)]
    with processes(2) as execute:
        results = execute(touch_late, paths)
        next(results)
        results.close()  # type: ignore[attr-defined]
        there = set(tmp_path.iterdir())
        assert len(there) < len(paths)
        time.sleep(1.5)
        assert set(tmp_path.iterdir()) == there


def pid(_: object) -> int:
    return os.getpid()


def test_processes_start_by_default_only_where_the_work_is_long(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(executor, "available_cores", lambda: 2)
    now = 10.0
    monkeypatch.setattr(executor, "time", SimpleNamespace(monotonic=lambda: now))
    with processes() as execute:
        now += 0.99 * executor.ALONE_SECONDS
        assert list(execute(pid, range(3))) == [os.getpid()] * 3
        now += 0.02 * executor.ALONE_SECONDS
        assert os.getpid() not in list(execute(pid, range(3)))


def test_number_of_processes_may_be_the_largest() -> None:
    assert [count_workers(n) for n in (1, MOST_PROCESSES)] == [1, 10_000]
    for wrong in (0, -1, MOST_PROCESSES + 1):
        must = rf"workers must be at (least 1|most 10,000), got {wrong}"
        with pytest.raises(ConfigError, match=must), processes(wrong):
            pass


def test_results_come_in_the_order_of_the_items() -> None:
    taken: list[object] = []

    def backwards(function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        """Return results in threes, the last one first."""
        remaining = iter(items)
        try:
            while some := list(islice(remaining, 3)):
                for item in reversed(some):
                    taken.append(item)
                    yield function(item)
        finally:
            taken.append("closed")

    results = in_order(backwards)(abs, iter([-5, 1, -4, 3, -2]))
    assert next(results) == 5
    assert len(taken) == 3  # and not all of them
    assert list(results) == [1, 4, 3, 2]

    # Who closes it ends the work.
    taken.clear()
    results = in_order(backwards)(abs, iter([-5, 1, -4, 3, -2]))
    next(results)
    results.close()  # type: ignore[attr-defined]
    assert taken[-1] == "closed"


GUARDED = """
from drakegrasp.errors import MachineError
from drakegrasp.runtime.executor import processes
if __name__ == "__main__":
    try:
        with processes(2) as execute:
            list(execute(abs, [1.0] * 60))
    except MachineError as error:
        print(error)
"""


def test_script_that_is_no_file_is_told_to_be_one() -> None:
    """Its guard is there, and no other would help."""
    done = subprocess.run([sys.executable, "-"], input=GUARDED, capture_output=True, text=True)
    assert done.stdout == (
        "a script that starts workers must be a file, as each of them imports it, got <stdin>: "
        'save it, with the call under if __name__ == "__main__":\n'
    )


def refusals(_: int) -> list[str]:
    """Return how this process refuses to start workers, of both kinds."""
    with pytest.raises(MachineError) as caught, processes(2) as execute:
        list(execute(abs, [1]))
    first = str(caught.value)
    with pytest.raises(MachineError) as caught, connect(1):
        pass
    return [first, str(caught.value)]


def test_worker_of_a_pool_is_told_to_start_none() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        ((first, second),) = pool.map(refusals, [0])
    assert first == second
    assert first.startswith("workers must be started by a process that may have children, got one")
    assert 'under if __name__ == "__main__":' in first


def test_process_that_dies_is_one_error() -> None:
    with processes(2) as execute, pytest.raises(MachineError, match="a worker process died"):
        list(execute(os._exit, [1, 1, 1]))


# What this process may use


def test_too_little_memory_for_opengl_is_a_line(
    cube: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in (resource.RLIM_INFINITY, 2 * 10**9):
        monkeypatch.setattr(resource, "getrlimit", lambda _, limit=limit: (limit, limit))
        prepare_rendering()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (10**9, 10**9))
    with pytest.raises(MachineError, match=r"at least 1\.5 GB to render, got 1 GB: raise `ulimit"):
        build_renderer(cube, CameraConfig())


@pytest.mark.parametrize("content", ["", "raise RuntimeError('broken')"])
def test_triton_is_loaded_before_opengl_or_nothing_is_said(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "triton.py").write_text(f"import sys; sys.seen_triton = True\n{content}")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    monkeypatch.setattr(sys, "seen_triton", False, raising=False)
    prepare_rendering()
    assert sys.seen_triton
    monkeypatch.delitem(sys.modules, "triton", raising=False)


# Progress bars


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
