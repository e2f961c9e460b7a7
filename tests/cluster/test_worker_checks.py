"""Workers of several threads and machines that cannot render do no work."""

from __future__ import annotations

import os
import socket

import pytest
from distributed import Client, Worker
from server.processes import small_cluster

from drakegrasp.cluster.connect import connect
from drakegrasp.cluster.worker_checks import checked_workers
from drakegrasp.errors import MachineError
from drakegrasp.hand.settings import load_config

pytestmark = [pytest.mark.cluster, pytest.mark.slow]

#: With it the loader of OpenGL finds no driver.
NO_DRIVER = "__EGL_VENDOR_LIBRARY_FILENAMES"


def _become_a_machine(dask_worker: Worker) -> None:
    """Have a worker stand for a machine of its own; the second cannot render."""
    name = str(dask_worker.name)
    socket.gethostname = lambda: f"machine{name}"
    if name == "1":
        _lose_the_driver()


def _lose_the_driver() -> None:
    os.environ[NO_DRIVER] = os.devnull


def _name(dask_worker: Worker) -> str:
    return str(dask_worker.name)


def test_worker_of_several_threads_is_refused_at_the_start() -> None:
    with (
        small_cluster(1, threads=2) as cluster,
        Client(cluster) as client,
        pytest.raises(MachineError, match=r"^worker inproc://.*: must have one thread .*, got 2$"),
        checked_workers(client, load_config()),
    ):
        raise AssertionError


@pytest.mark.nightly
def test_machine_without_opengl_is_left_out_and_one_must_be_left(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with connect(workers=2) as client:
        client.run(_become_a_machine)
        with checked_workers(client, load_config()):
            assert list(client.run(_name).values()) == ["0"]

        # A build with none does not begin.
        client.run(_lose_the_driver)
        with (
            pytest.raises(MachineError, match=r"a test image, got .*`drakegrasp doctor`"),
            checked_workers(client, load_config()),
        ):
            raise AssertionError
    assert "not used: workers on machine1: must render a test image" in capfd.readouterr().err
