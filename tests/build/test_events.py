"""What a build says in its log, and learns from it."""

from __future__ import annotations

from pathlib import Path

import pytest

from drakegrasp.build import events
from drakegrasp.build.events import BuildEvents
from drakegrasp.config import load_config
from drakegrasp.dataset.log import BuildLog, read_log
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.runtime.executor import WorkerPool

MANIFEST = Manifest(config=load_config(), versions={})


def start(out: Path, kernel: str | None) -> list[str]:
    """Return the notices of a build on workers of a kernel, and log that it started."""
    log = BuildEvents(out, WorkerPool(kernel=kernel), show=False)
    notices = log.kernel_notice()
    log.started(MANIFEST, notices)
    return notices


def test_other_kernel_than_that_of_the_last_build_is_a_notice(tmp_path: Path) -> None:
    assert start(tmp_path, "Haswell") == []
    assert start(tmp_path, "Haswell") == []
    (notice,) = start(tmp_path, "Prescott")
    assert notice == (
        "begun with BLAS kernel Haswell, goes on with Prescott: last bits of simulated values "
        "may differ"
    )
    assert start(tmp_path, "Prescott") == []
    assert "goes on with several" in start(tmp_path, None)[0]
    logged = list(read_log(tmp_path))
    started = [event["kernel"] for event in logged if event["event"] == "started"]
    assert started == ["Haswell", "Haswell", "Prescott", "Prescott", None]
    assert notice in [event.get("text") for event in logged]


def test_log_without_a_kernel_is_no_reason_for_a_notice(tmp_path: Path) -> None:
    BuildLog(tmp_path)("started", config_hash="0")
    assert start(tmp_path, "Haswell") == []


def test_build_without_workers_runs_the_kernel_of_this_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "running_kernel", lambda: "Zen")
    assert BuildEvents(tmp_path, None, show=False).kernel() == "Zen"
