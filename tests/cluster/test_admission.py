"""All workers of a build run one BLAS kernel; where they cannot, the user is told."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from distributed import Worker

from drakegrasp.cluster.admission import admitted_workers
from drakegrasp.cluster.connect import connect
from drakegrasp.config import load_config
from drakegrasp.errors import MachineError
from drakegrasp.runtime.blas import running_kernel
from drakegrasp.runtime.kernels import KERNELS, VARIABLE, chosen_kernel

pytestmark = [
    pytest.mark.cluster,
    pytest.mark.slow,
    pytest.mark.skipif(
        running_kernel() not in KERNELS or running_kernel() == "Prescott",
        reason="this process must run a known kernel other than Prescott",
    ),
]


def test_workers_of_another_kernel_are_restarted_with_the_common_one(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(VARIABLE, "Prescott")
    with connect(workers=2) as client:
        before = client.run(os.getpid)
        assert set(client.run(chosen_kernel).values()) == {"Prescott"}
        with admitted_workers(client, load_config()) as kernel:
            client.wait_for_workers(2, timeout=60)
            assert kernel == running_kernel()
            assert list(client.run(running_kernel).values()) == [kernel, kernel]
            assert not set(client.run(os.getpid).values()) & set(before.values())
    assert "last bits" not in capfd.readouterr().err


def test_workers_of_the_client_s_kernel_are_not_restarted() -> None:
    with connect(workers=1) as client:
        before = client.run(os.getpid)
        with admitted_workers(client, load_config()) as kernel:
            assert client.run(os.getpid) == before
            assert list(client.run(running_kernel).values()) == [kernel]


def test_workers_that_join_later_get_the_kernel_or_say_so(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """One with a nanny starts with it; one without works on, with a line on standard error."""
    command, file = [sys.executable, "-m"], tmp_path / "scheduler.json"
    plain = os.environ | {VARIABLE: "Prescott"}
    flags = ["--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0"]
    join = [*command, "distributed.cli.dask_worker", "--scheduler-file", str(file)]
    join += ["--nthreads", "1"]
    processes = [
        subprocess.Popen(
            [*command, "distributed.cli.dask_scheduler", *flags, "--scheduler-file", str(file)],
            stderr=subprocess.DEVNULL,
        )
    ]
    try:
        while not file.exists():
            time.sleep(0.1)
        with (
            connect(scheduler_file=file) as client,
            admitted_workers(client, load_config()) as kernel,
        ):
            assert kernel == running_kernel()
            for options in (["--nanny"], ["--no-nanny"]):
                processes.append(
                    subprocess.Popen([*join, *options], env=plain, stderr=subprocess.DEVNULL)
                )
                client.wait_for_workers(len(processes) - 1, timeout=60)
            assert sorted(client.run(running_kernel).values()) == sorted([kernel, "Prescott"])
            error, end = "", time.monotonic() + 30.0
            while "last bits" not in error and time.monotonic() < end:
                time.sleep(0.1)
                error += capfd.readouterr().err
            assert error.count(f"runs BLAS kernel Prescott, not {kernel} like the others") == 1
    finally:
        for process in reversed(processes):
            process.terminate()
            process.wait(60)


#: With it the loader of OpenGL finds no driver.
NO_DRIVER = "__EGL_VENDOR_LIBRARY_FILENAMES"


def test_machine_that_cannot_render_is_refused_before_the_build(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv(NO_DRIVER, os.devnull)
    with (
        connect(workers=1) as client,
        pytest.raises(MachineError, match=r"must render a test image, got .*`drakegrasp doctor`"),
        admitted_workers(client, load_config()),
    ):
        raise AssertionError


def _become_a_machine(dask_worker: Worker) -> None:
    """Have a worker stand for a machine of its own; the second cannot render."""
    name = str(dask_worker.name)
    socket.gethostname = lambda: f"machine{name}"
    if name == "1":
        os.environ[NO_DRIVER] = os.devnull


def _name(dask_worker: Worker) -> str:
    return str(dask_worker.name)


def test_machine_without_opengl_is_left_out_and_the_others_work(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with connect(workers=2) as client:
        client.run(_become_a_machine)
        with admitted_workers(client, load_config()):
            assert list(client.run(_name).values()) == ["0"]
    assert "not used: workers on machine1: must render a test image" in capfd.readouterr().err
