"""Workers that do not see the dataset give the same files, whatever dies."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import h5py
import pytest
import trimesh
from distributed import Client, Worker
from helpers.assertions import contents
from helpers.builds import FAST, build
from helpers.file_tasks import Join, join
from helpers.tiers import in_second_tier
from server.processes import small_cluster

from drakegrasp.cluster import wire
from drakegrasp.cluster.apart import ProcessApart
from drakegrasp.cluster.connect import connect
from drakegrasp.cluster.executor import DaskExecutor
from drakegrasp.cluster.wire import by_wire
from drakegrasp.cluster.worker_checks import checked_workers
from drakegrasp.errors import MachineError
from drakegrasp.hand.settings import load_config
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import WorkerPool

pytestmark = pytest.mark.cluster

#: One attempt, which gives a sample.
SAMPLE = [*FAST, "candidates.method=closing", "candidates.max=1", "physics.friction_hand=1.5"]
#: Every kind of step of a unit: also repeats.
EVERY_STEP = [*SAMPLE, "robustness.repeats=1"]


@pytest.fixture(scope="module")
def client() -> Iterator[Client]:
    with small_cluster(1) as cluster, Client(cluster) as client:
        yield client


@pytest.fixture
def out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory that the process beside a worker does not see: its own one is another."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(os.path.abspath, sys.path)))
    monkeypatch.chdir(tmp_path)
    return Path("/proc/self/cwd/out")


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("box")
    trimesh.creation.box([0.06, 0.05, 0.12]).export(folder / "1_box_a.obj")
    return folder


def put(out: Path, count: int) -> None:
    """Write the files that tasks read."""
    (out / "in").mkdir(parents=True)
    (out / "in/common").write_text("common")
    for number in range(count):
        (out / f"in/{number}").write_text(str(number))


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[str]]:
    """Returns the names of the files that workers got from the scheduler."""
    fetch = Mock(wraps=wire._fetched)
    monkeypatch.setattr(wire, "_fetched", fetch)
    return lambda: [call.args[0] for call in fetch.call_args_list]


def test_files_go_once_and_results_come_back(
    client: Client, out: Path, fetched: Callable[[], list[str]]
) -> None:
    put(out, 12)
    (out / "old").write_text("")
    tasks = [Join(out=out, number=number) for number in range(12)]
    with by_wire(DaskExecutor(client), client, out) as execute:
        assert sorted(execute(join, tasks)) == list(range(12))
        (copies,) = Path(next(iter(client.run(local_directory).values())), "drakegrasp").iterdir()
        assert len(list(copies.glob("in/*"))) == 1 + wire.KEPT_TASKS
        assert not list(copies.glob("out/*"))
        assert not (out / "old").exists()
        assert all((out / f"out/{i}").read_text() == f"common {i}" for i in range(12))
        assert len(fetched()) == len(set(fetched())) == 13

        # What the scheduler was told to forget comes again, under another name.
        assert list(execute(join, tasks[:1])) == [0]
        assert len(fetched()) == len(set(fetched())) == 14
    assert not copies.exists()
    wait_for_variables(client, 0)


def test_builds_at_the_same_time_keep_their_copies_and_share_a_process(
    client: Client, out: Path, fetched: Callable[[], list[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    put(out, 4)
    start = Mock(wraps=ProcessApart)
    monkeypatch.setattr(wire, "ProcessApart", start)
    tasks = [Join(out=out, number=number) for number in range(4)]
    with by_wire(DaskExecutor(client), client, out) as one:
        list(one(join, tasks[:1]))
        with by_wire(DaskExecutor(client), client, out) as other:
            done = zip(one(join, tasks), other(join, tasks), strict=True)
            assert sorted(done) == [(i, i) for i in range(4)]
        assert start.call_count == 1
        assert len(fetched()) == len(set(fetched())) == 2 * 5
        assert list(one(join, tasks)) == list(range(4))


def test_scheduler_forgets_the_files_of_a_client_that_is_killed(client: Client, out: Path) -> None:
    put(out, 1)
    with by_wire(DaskExecutor(client), client, out) as execute:
        with Client(client.scheduler.address, set_as_default=False) as killed:
            killed.register_plugin(wire.ForgetFiles())
            wire._Wire(execute, killed, out, "a")._offer(out / "in/common")
            wire._Wire(execute, client, out, "b")._offer(out / "in/0")
            assert len(client.run_on_scheduler(variables)) == 2
        wait_for_variables(client, 1)
        (left,) = client.run_on_scheduler(variables)
        assert client.id in left
        wire.Variable(left, client=client).delete()


def local_directory(dask_worker: Worker) -> str:
    return str(dask_worker.local_directory)


def wait_for_variables(client: Client, count: int) -> None:
    """The scheduler forgets what it was told to, a moment later."""
    end = time.monotonic() + 30.0
    while len(client.run_on_scheduler(variables)) != count:
        assert time.monotonic() < end
        time.sleep(0.01)


def variables(dask_scheduler: object) -> list[str]:
    """Return the names of what the scheduler keeps."""
    return list(dask_scheduler.extensions["variables"].variables)  # type: ignore[attr-defined]


def test_process_that_dies_is_started_again_but_not_for_ever(
    client: Client, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put(out, 2)
    monkeypatch.setattr(wire, "MOST_DEATHS", 3)
    with by_wire(DaskExecutor(client), client, out) as execute:
        assert list(execute(join, [Join(out=out, number=0, deaths=2)])) == [0]
        with pytest.raises(MachineError, match="again and again"):
            list(execute(join, [Join(out=out, number=1, deaths=3)]))


def test_error_of_a_task_is_raised_here_and_nothing_is_kept(client: Client, out: Path) -> None:
    put(out, 1)
    (out / "in/-1").write_text("")
    with by_wire(DaskExecutor(client), client, out) as execute:
        with pytest.raises(ValueError, match="-1 < 0"):
            list(execute(join, [Join(out=out, number=-1), Join(out=out, number=0)]))
        wait_for_variables(client, 0)
        # Other items stay here.
        assert list(execute(abs, [-1])) == [1]


def test_worker_does_not_wait_for_files_of_a_task_that_was_forgotten(client: Client) -> None:
    files = {"in/0": f"drakegrasp-gone-build-0-{64 * '0'}"}
    parcel = wire.Parcel(number=0, build="gone", call=b"", files=files, writes=())
    with pytest.raises(MachineError, match="must be at the scheduler, got none"):
        client.submit(wire.do_parcel, parcel).result(timeout=30)


class Slow:
    """Takes a minute to be unpickled."""

    def __reduce__(self) -> tuple[Callable[[float], None], tuple[float]]:
        return time.sleep, (60.0,)


def test_process_that_takes_too_much_memory_is_killed(tmp_path: Path) -> None:
    began = time.monotonic()
    with closing(ProcessApart(tmp_path)) as process, pytest.raises(wire.ApartError):
        process.call(pickle.dumps(Slow()), tmp_path, memory=1.0)
    assert time.monotonic() - began < 30.0


def test_process_does_its_calls_though_ctrl_c_reaches_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The client stops its workers itself."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(os.path.abspath, sys.path)))
    put(tmp_path, 1)
    call = pickle.dumps((join, Join(out=tmp_path, number=0)))
    with closing(ProcessApart(tmp_path)) as process:
        for _ in range(2):
            assert pickle.loads(process.call(call, tmp_path, memory=1e12)) == 0
            process._process.send_signal(signal.SIGINT)


@pytest.mark.sim
@pytest.mark.parametrize("settings", [SAMPLE, in_second_tier(EVERY_STEP)])
def test_every_kind_of_task_gives_the_same_bytes(
    client: Client, meshes: Path, out: Path, tmp_path: Path, settings: list[str]
) -> None:
    config, here = load_config(overrides=settings), tmp_path / "here"
    build(meshes, here, config)
    with by_wire(DaskExecutor(client), client, out) as execute:
        build(meshes, out, config, execute, pool=WorkerPool())
    assert contents(here) == contents(out)
    with h5py.File(out / "trials.hdf5") as file:
        assert file["trials/outcome"][0] == Outcome.SUCCESS


@pytest.mark.nightly
def test_worker_that_joins_later_must_see_what_the_others_do(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with connect(workers=1) as client, checked_workers(client, load_config(), tmp_path) as travels:
        assert not travels
        (probe,) = tmp_path.iterdir()
        probe.unlink()
        client.cluster.scale(2)
        line, end = f"must see {tmp_path} like those at the start", time.monotonic() + 120
        said = ""
        while line not in said and time.monotonic() < end:
            time.sleep(0.1)
            said += capfd.readouterr().err
    assert line in said
