"""jemalloc: where it is there, workers and commands have it, and nothing else changes."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from drakegrasp.cli import doctor
from drakegrasp.cli import main as cli
from drakegrasp.cluster.connect import connect
from drakegrasp.runtime import allocator
from drakegrasp.runtime import environment as memory
from drakegrasp.runtime.allocator import (
    LIBRARY,
    PRELOAD,
    SETTINGS,
    TUNING,
    dask_setup,
    jemalloc_environment,
    kept_variables,
    restart_with_jemalloc,
)

#: What `jemalloc_environment` is with the library and without anything of the user's.
OURS = {PRELOAD: LIBRARY, SETTINGS: TUNING}


@pytest.fixture
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of the user's is preloaded or set."""
    for name in OURS:
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def library(monkeypatch: pytest.MonkeyPatch, plain: None) -> None:
    """As on a machine with jemalloc."""
    monkeypatch.setattr(allocator, "_serves", lambda preload, settings: True)


@pytest.fixture
def jemalloc(plain: None) -> dict[str, str]:
    """A real jemalloc's variables; tests that need it skip without."""
    found = jemalloc_environment()
    if not found:
        pytest.skip(f"{LIBRARY} is not on this machine")
    return found


def run_child(code: str, environment: dict[str, str]) -> str:
    child = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=True,
    )
    assert child.stderr == ""
    return child.stdout


@pytest.mark.skipif(sys.platform != "linux", reason="named on Linux only")
def test_allocator_is_named_by_its_library() -> None:
    assert allocator.allocator().startswith(("libc.", "libjemalloc", "libc-"))


def test_allocator_of_a_program_at_a_fixed_address_is_named_too() -> None:
    """Debian's Python is one: the address of its `malloc` is its own."""
    python = "/usr/bin/python3"
    if not Path(python).exists():
        pytest.skip("the system has no Python")
    code = f"import runpy; print(runpy.run_path({allocator.__file__!r})['allocator']())"
    child = subprocess.run([python, "-c", code], capture_output=True, text=True, check=True)
    assert child.stdout.startswith(("libc", "libjemalloc"))


def test_a_library_that_does_not_load_is_not_used(
    monkeypatch: pytest.MonkeyPatch, plain: None
) -> None:
    monkeypatch.setattr(allocator, "LIBRARY", "libjemalloc-that-nobody-has.so.2")
    assert jemalloc_environment() == {}


@pytest.mark.usefixtures("library")
def test_what_the_user_preloads_comes_first(monkeypatch: pytest.MonkeyPatch) -> None:
    assert jemalloc_environment() == OURS
    monkeypatch.setenv(PRELOAD, "libasan.so.8")
    monkeypatch.setenv(SETTINGS, "narenas:1")
    wanted = {PRELOAD: f"libasan.so.8:{LIBRARY}", SETTINGS: "narenas:1"}
    assert jemalloc_environment() == wanted
    monkeypatch.setenv(PRELOAD, "/opt/libjemalloc.so.2")
    assert jemalloc_environment()[PRELOAD] == "/opt/libjemalloc.so.2"


def test_another_allocator_of_the_users_stays(
    monkeypatch: pytest.MonkeyPatch, jemalloc: dict[str, str]
) -> None:
    monkeypatch.setenv(PRELOAD, "libc.so.6")
    assert jemalloc_environment() == {}


@pytest.mark.parametrize("command", ["score", "verify"])
@pytest.mark.usefixtures("library")
def test_commands_that_simulate_start_again(monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    calls: list[tuple[str, list[str], dict[str, str]]] = []
    monkeypatch.setattr(os, "execve", lambda *call: calls.append(call))
    monkeypatch.setattr(allocator, "has_jemalloc", lambda: False)
    monkeypatch.setattr(cli, "main", lambda: None)
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "drakegrasp", command])
    monkeypatch.setattr(sys, "argv", ["drakegrasp", command])
    cli.run()
    ((path, arguments, environment),) = calls
    assert (path, arguments) == (
        sys.executable,
        [sys.executable, "-X", "dev", "drakegrasp", command],
    )
    assert environment == {**os.environ, **OURS}
    # The second time it is there, or at least was asked for: never again.
    monkeypatch.setenv(PRELOAD, environment[PRELOAD])
    cli.run()
    monkeypatch.delenv(PRELOAD)
    monkeypatch.setattr(sys, "argv", ["drakegrasp", "stats"])
    cli.run()
    assert len(calls) == 1


def test_without_the_library_nothing_starts_again(
    monkeypatch: pytest.MonkeyPatch, plain: None
) -> None:
    monkeypatch.setattr(allocator, "_serves", lambda preload, settings: False)
    monkeypatch.setattr(os, "execve", lambda *call: pytest.fail("started again"))
    restart_with_jemalloc()


def test_program_that_started_again_has_jemalloc(jemalloc: dict[str, str]) -> None:
    code = (
        "import sys; from drakegrasp.cli import main as cli; "
        "from drakegrasp.runtime.allocator import allocator; "
        "sys.argv = ['drakegrasp', 'verify']; cli.main = lambda: print(allocator()); cli.run()"
    )
    assert run_child(code, {}) == f"{LIBRARY}\n"


@pytest.mark.usefixtures("library")
def test_nanny_is_told_on_its_machine() -> None:
    nanny = SimpleNamespace(pre_spawn_env={"LP_NUM_THREADS": "0"})
    dask_setup(nanny)
    assert nanny.pre_spawn_env == {"LP_NUM_THREADS": "0", **OURS}


def test_environment_of_the_caller_is_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PRELOAD, "theirs.so")
    monkeypatch.delenv(SETTINGS, raising=False)
    with kept_variables(*OURS):
        os.environ.update(OURS)
    assert os.environ[PRELOAD] == "theirs.so"
    assert SETTINGS not in os.environ


@pytest.mark.cluster
def test_workers_have_jemalloc_and_their_caller_does_not_change(jemalloc: dict[str, str]) -> None:
    before = dict(os.environ)
    with connect(1) as client:
        (found,) = client.run(allocator.allocator).values()
    assert found == LIBRARY
    assert {k: os.environ.get(k) for k in OURS} == {k: before.get(k) for k in OURS}


def test_jemalloc_gives_memory_back(jemalloc: dict[str, str]) -> None:
    """Pages of many small blocks stay resident when they are freed, until they are purged."""
    code = """
from pathlib import Path
from drakegrasp.runtime.environment import release_memory

def resident():
    return 4096 * int(Path("/proc/self/statm").read_text().split()[1])

blocks = [b'x' * (20_000 + k) for k in range(10_000)]
del blocks
before = resident()
release_memory()
print(before - resident())
"""
    assert int(run_child(code, jemalloc)) > 50e6


def test_each_allocator_is_asked_in_its_own_words(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[object] = []
    process = SimpleNamespace(
        mallctl=lambda order, *rest: said.append(order), malloc_trim=said.append
    )
    monkeypatch.setattr(ctypes, "CDLL", lambda name: process)
    for has, words in ((True, [b"thread.tcache.flush", b"arena.4096.purge"]), (False, [0])):
        monkeypatch.setattr(memory, "has_jemalloc", lambda has=has: has)
        said.clear()
        memory.release_memory()
        assert said == words


@pytest.mark.usefixtures("library")
def test_doctor_tells_the_allocator(monkeypatch: pytest.MonkeyPatch) -> None:
    assert doctor.check_allocator().what.startswith(LIBRARY)
    monkeypatch.setattr(allocator, "_serves", lambda preload, settings: False)
    finding = doctor.check_allocator()
    assert finding.ok
    assert allocator.allocator() in finding.what
    assert "libjemalloc2" in finding.what
