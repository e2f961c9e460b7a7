"""Serving: one line for what cannot be served, the loopback address and nothing else."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest
from helpers.commands import run
from helpers.datasets import TRIALS

from drakegrasp.page.app import ASSETS, LOOPBACK, listen

#: The program, with Ctrl-C as at a terminal: a test that runs in the background inherits a shell's
#: choice to ignore it.
CODE = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from drakegrasp.cli.main import run; run()"
)


def test_only_the_loopback_address_is_listened_on() -> None:
    with listen(0) as listener:
        assert listener.getsockname()[0] == LOOPBACK == "127.0.0.1"


def test_a_taken_port_is_one_line(sound: Path) -> None:
    with socket.socket() as other:
        other.bind((LOOPBACK, 0))
        other.listen()
        port = str(other.getsockname()[1])
        result = run("inspect", str(sound), "--port", port, "--no-browser")
    assert result.exit_code == 1
    assert result.stderr.startswith(f"error: --port must be free on this machine, got {port}")


def test_a_build_that_has_not_ended_is_one_line_that_says_how_to_end_it(out: Path) -> None:
    (out / TRIALS).unlink()
    result = run("inspect", str(out))
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line == (
        f"error: {out}: must be a finished dataset, got one without trials.hdf5; finish it first, "
        "with the same command that began to build it"
    )


@pytest.mark.parametrize("library", ["starlette", "uvicorn", "jinja2"])
def test_missing_extra_is_one_line(
    library: str, sound: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in list(sys.modules):
        if name.startswith("drakegrasp.page"):
            monkeypatch.delitem(sys.modules, name)
        if name.partition(".")[0] == library:
            monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, library, None)
    monkeypatch.setattr("socket.socket.listen", None)  # else a mistake would serve for ever
    result = run("inspect", str(sound), "--no-browser")
    assert result.exit_code == 1
    (line,) = result.stderr.splitlines()
    assert line.startswith("error: inspect needs its packages: pip install 'drakegrasp[inspect]' (")
    assert library in line


def test_command_serves_until_it_is_stopped(sound: Path) -> None:
    command = [sys.executable, "-c", CODE, "inspect", str(sound), "--port", "0", "--no-browser"]
    server = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ
    )
    assert server.stdout is not None
    try:
        address = server.stdout.readline().strip()
        assert re.fullmatch(r"http://127\.0\.0\.1:\d+/", address)
        with urllib.request.urlopen(address, timeout=60.0) as answer:
            assert b"1_box_a" in answer.read()
    finally:
        server.send_signal(signal.SIGINT)
        _, errors = server.communicate(timeout=60.0)
    assert server.returncode == 130
    assert errors.strip() == "stopped"


def test_vendored_files_are_those_of_their_readme() -> None:
    folder = ASSETS / "vendor"
    rows = re.findall(r"\| `(\S+)` \|.*\| ([0-9a-f]{64}) \|", (folder / "README.md").read_text())
    assert {name for name, _ in rows} == {path.name for path in folder.glob("*.js")}
    for name, digest in rows:
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    assert (folder / "LICENSE").read_text(encoding="utf-8").startswith("The MIT License")
