"""Ctrl-C and SIGTERM end a command wherever it is, in one line."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

#: A library that swallows whatever is raised while it is imported.
GREEDY = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.{name})
    time.sleep(0.2)
    whole = True
except BaseException:
    pass
"""
COMMAND = """
import sys, time
from drakegrasp.cli.console import run_command

def command(words, **_):
    import greedy
    print(f"whole: {greedy.whole}", flush=True)
    time.sleep(20.0)
    print("went on")

sys.path.insert(0, sys.argv.pop())
run_command(command, [], resumable=True)
"""


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_signal_in_an_import_ends_the_command_after_it(
    tmp_path: Path, name: str, code: int
) -> None:
    """The library is there whole, and the command does not go on."""
    (tmp_path / "greedy.py").write_text(GREEDY.format(name=name))
    found = subprocess.run(
        [sys.executable, "-c", COMMAND, str(tmp_path)], capture_output=True, text=True, timeout=60
    )
    assert (found.returncode, found.stdout) == (code, "whole: True\n")
    assert found.stderr == "stopped; the same command continues from here\n"


def test_signal_that_the_shell_ignores_stays_ignored(tmp_path: Path) -> None:
    """As in the background of a shell, or under nohup."""
    (tmp_path / "greedy.py").write_text(GREEDY.format(name="SIGINT"))
    shorter = COMMAND.replace("20.0", "0.5")
    found = subprocess.run(
        [sys.executable, "-c", shorter, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    assert (found.returncode, found.stdout) == (0, "whole: True\nwent on\n")
