"""Tasks on Dask's workers: what is in flight, what is tried again, and which workers do work."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from distributed import Client, KilledWorker, LocalCluster, Worker
from server.processes import dask_scheduler, small_cluster

from drakegrasp.cluster import executor as tasks
from drakegrasp.cluster.connect import connect
from drakegrasp.cluster.executor import DaskExecutor
from drakegrasp.cluster.worker_checks import checked_workers
from drakegrasp.errors import BlankImageError, MachineError
from drakegrasp.hand.settings import load_config
from drakegrasp.vision import rendering

pytestmark = pytest.mark.cluster


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with small_cluster(2) as cluster, Client(cluster) as client:
        yield client


def _blank_at_first(path: str) -> str:
    """Fail as often as the name says, and say so in a file."""
    done = Path(path).read_text() if Path(path).exists() else ""
    if len(done) < int(path[-1]):
        Path(path).write_text(done + "x")
        raise BlankImageError(rendering.BLANK)
    return path


def test_blank_image_is_tried_again_but_not_for_ever(client: Client, tmp_path: Path) -> None:
    execute, names = DaskExecutor(client), [str(tmp_path / f"f{i}") for i in range(3)]
    assert sorted(execute(_blank_at_first, names)) == names
    with pytest.raises(BlankImageError):
        list(execute(_blank_at_first, [str(tmp_path / "f3")]))


def _killed_at_first(path: str) -> str:
    """Fail once as a task whose workers died."""
    if not Path(path).exists():
        Path(path).touch()
        raise KilledWorker("task", SimpleNamespace(address="tcp://127.0.0.1:1"), 0)
    return path


def test_task_whose_workers_died_is_tried_as_often_as_asked(client: Client, tmp_path: Path) -> None:
    first, second = str(tmp_path / "a"), str(tmp_path / "b")
    assert list(DaskExecutor(client, resubmissions=1)(_killed_at_first, [first])) == [first]
    with pytest.raises(MachineError, match="workers died again and again"):
        list(DaskExecutor(client)(_killed_at_first, [second]))


def test_items_are_taken_as_there_is_room(client: Client) -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        while taken < 200:
            taken += 1
            yield taken

    results = DaskExecutor(client)(abs, items())
    for done, _ in enumerate(results):
        assert taken <= done + 1 + 2 * 2
    assert taken == 200


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks, "COUNT_SECONDS", 0.1)
    monkeypatch.setattr(tasks, "SAY_SECONDS", 0.2)
    monkeypatch.setattr(tasks, "LOST_SECONDS", 0.5)


@pytest.fixture
def cluster() -> Iterator[LocalCluster]:
    with small_cluster(1) as cluster:
        yield cluster


@pytest.mark.usefixtures("impatient")
def test_where_no_worker_comes_back_it_says_so(cluster: LocalCluster) -> None:
    with Client(cluster) as client:
        execute = DaskExecutor(client)
        results = execute(time.sleep, [0.0, 2.5])
        assert next(results) is None
        assert execute.pool.size == 1
        cluster.scale(0)
        with pytest.raises(MachineError, match=r"no worker for 0\.5 s; the same"):
            next(results)
        assert execute.pool.size == 0


@pytest.mark.usefixtures("impatient")
def test_where_workers_may_come_the_work_waits(cluster: LocalCluster) -> None:
    """As under SLURM, where all jobs reached their walltime and the next ones queue."""
    with Client(cluster.scheduler_address) as client:
        execute = DaskExecutor(client)
        results = execute(str, [1, 2, 3, 4])
        found = [next(results)]
        cluster.scale(0)
        threading.Timer(1.0, lambda: cluster.scale(1)).start()
        client.run_on_scheduler(lambda dask_scheduler: None)
        while client.nthreads():
            time.sleep(0.05)
        found += list(results)
        assert sorted(found) == ["1", "2", "3", "4"]


@pytest.mark.nightly
def test_lost_scheduler_is_one_error(tmp_path: Path) -> None:
    with (
        dask_scheduler(tmp_path) as (scheduler, _),
        connect(scheduler_file=tmp_path / "scheduler.json", tls=False) as client,
    ):
        client.wait_for_workers(1, timeout=60)
        results = DaskExecutor(client)(time.sleep, [0.0, 0.0, 600.0, 600.0])
        assert [next(results), next(results)] == [None, None]
        scheduler.kill()
        with pytest.raises(MachineError, match=r"the scheduler was lost: .*; the same"):
            next(results)


# Which workers do work


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


@pytest.mark.slow
def test_worker_of_several_threads_is_refused_at_the_start() -> None:
    with (
        small_cluster(1, threads=2) as cluster,
        Client(cluster) as client,
        pytest.raises(MachineError, match=r"^worker inproc://.*: must have one thread .*, got 2$"),
        checked_workers(client, load_config()),
    ):
        raise AssertionError


@pytest.mark.slow
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
