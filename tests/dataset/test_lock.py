"""Two builds in one directory: the second is refused, a dead one is taken over."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from pathlib import Path

import pytest

from drakegrasp.dataset import lock
from drakegrasp.dataset.lock import LOCK_FILE, build_lock
from drakegrasp.errors import DataError
from drakegrasp.runtime.environment import this_process

HOLD = """
import sys
from pathlib import Path
from drakegrasp.dataset.lock import build_lock
with build_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@contextmanager
def holder(out: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Hold a directory in another process while the block runs."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, out], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n", "the process must not die"
    try:
        yield process
    finally:
        process.communicate()


@pytest.fixture(params=[True, False], ids=["locks", "no locks"])
def advice(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """On a file system with locks and on one without: what a refused build is told to do."""
    if request.param:
        return "wait for it or choose another --out"
    monkeypatch.setattr(fcntl, "flock", refuse_lock)
    return "wait for it, or remove build.lock there if it is dead"


def refuse_lock(file: object, operation: int) -> None:
    raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))


def test_second_build_is_refused_and_names_the_first(tmp_path: Path, advice: str) -> None:
    with holder(tmp_path) as process:
        message = rf"one process at a time, got process {process.pid} on \S+, since .*; {advice}"
        with pytest.raises(DataError, match=message), build_lock(tmp_path):
            raise AssertionError
    with build_lock(tmp_path) as dead:
        assert dead is None


@pytest.mark.usefixtures("advice")
def test_dead_build_is_taken_over_and_named(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        process.kill()
        process.wait()
        assert (tmp_path / LOCK_FILE).exists()
        with build_lock(tmp_path) as dead:
            assert dead is not None
            assert dead.process.pid == process.pid
            assert str(process.pid) in str(dead)
    assert list(tmp_path.iterdir()) == []


def test_lock_file_without_content_is_nobodys(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).write_text("")
    with build_lock(tmp_path) as dead:
        assert dead is None


def test_lock_file_names_its_holder_and_goes_with_the_block(tmp_path: Path) -> None:
    with build_lock(tmp_path):
        assert json.loads((tmp_path / LOCK_FILE).read_text())["process"]["pid"] == os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_lock_is_not_taken_twice_in_one_process(tmp_path: Path) -> None:
    """Of two threads, too, only one may build."""
    with build_lock(tmp_path):
        message = "one process at a time, got this process, which has it already"
        with pytest.raises(DataError, match=message), build_lock(tmp_path / "."):
            raise AssertionError
        assert (tmp_path / LOCK_FILE).exists()


def test_directory_in_which_nothing_was_made_goes_again(tmp_path: Path) -> None:
    with build_lock(tmp_path / "deep" / "out"):
        assert (tmp_path / "deep" / "out").is_dir()
    assert not (tmp_path / "deep" / "out").exists()


def test_directory_that_cannot_be_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    message = "must be a directory that can be written"
    with pytest.raises(DataError, match=message), build_lock(tmp_path / "file" / "out"):
        raise AssertionError


@pytest.mark.parametrize(
    ("change", "taken"),
    [({"host": "elsewhere"}, False), ({"began": 1}, True), ({"boot": "before"}, True), ({}, False)],
)
def test_without_locks_a_number_alone_is_no_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, object], taken: bool
) -> None:
    """The same number after a restart is another process; another machine's may be alive."""
    monkeypatch.setattr(fcntl, "flock", refuse_lock)
    process = {**vars(this_process()), **change}
    content = {"process": process, "since": "2026-01-01T00:00:00", "command": []}
    (tmp_path / LOCK_FILE).write_text(json.dumps(content))
    if taken:
        with build_lock(tmp_path) as dead:
            assert dead is not None
    else:
        with pytest.raises(DataError, match="one process at a time"), build_lock(tmp_path):
            raise AssertionError


def test_two_threads_do_not_hold_a_directory_both(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Though the kernel of a network file system gives its lock to all threads of a process."""
    monkeypatch.setattr(fcntl, "flock", lambda file, operation: None)
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "out")
    with build_lock(tmp_path / "out"):
        for name in (tmp_path / "out", link):
            with pytest.raises(DataError, match="got this process"), build_lock(name):
                raise AssertionError
    with build_lock(tmp_path / "out"):
        pass


def test_lock_on_a_file_that_its_holder_removed_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between opening the file and locking it; somebody may have made another one since."""
    path, lock_file, tries = tmp_path / LOCK_FILE, lock.lock_file, []

    def late(file: FileIO) -> bool | None:
        if not tries:
            path.unlink()
            path.write_text("")
        tries.append(file)
        return lock_file(file)

    monkeypatch.setattr(lock, "lock_file", late)
    with build_lock(tmp_path):
        assert len(tries) == 2
        assert json.loads(path.read_text())["process"]["pid"] == os.getpid()
