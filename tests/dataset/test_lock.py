"""Two builds in one directory: the second is refused, a dead one is taken over."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from drakegrasp.dataset.lock import LOCK_FILE, build_lock
from drakegrasp.errors import DataError

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


def test_second_build_is_refused_and_names_the_first(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        message = rf"one process at a time, got process {process.pid} on \S+, since .*; wait"
        with pytest.raises(DataError, match=message), build_lock(tmp_path):
            raise AssertionError
    with build_lock(tmp_path) as dead:
        assert dead is None


def test_dead_build_is_taken_over_and_named(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        process.kill()
        process.wait()
        assert (tmp_path / LOCK_FILE).exists()
        with build_lock(tmp_path) as dead:
            assert dead is not None
            assert dead.startswith(f"process {process.pid} on ")
    assert list(tmp_path.iterdir()) == []


def test_lock_file_without_content_is_nobodys(tmp_path: Path) -> None:
    (tmp_path / LOCK_FILE).write_text("")
    with build_lock(tmp_path) as dead:
        assert dead is None


def test_lock_is_not_taken_twice_in_one_process(tmp_path: Path) -> None:
    """Of two threads, too, only one may build."""
    with build_lock(tmp_path):
        message = f"one process at a time, got process {os.getpid()} "
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


def test_lock_on_a_file_that_its_holder_removed_is_none(tmp_path: Path) -> None:
    """Between opening the file and locking it; somebody may have made another one since."""
    path, flock, tries = tmp_path / LOCK_FILE, fcntl.flock, list[int]()

    def late(descriptor: int, operation: int) -> None:
        if not tries:
            path.unlink()
            path.write_text("")
        tries.append(descriptor)
        flock(descriptor, operation)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fcntl, "flock", late)
        with suppress(DataError), build_lock(tmp_path):
            assert path.read_text().startswith(f"process {os.getpid()} on ")
    assert tries


def test_file_system_without_locks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(DataError, match="got: No locks available"), build_lock(tmp_path / "out"):
        raise AssertionError
