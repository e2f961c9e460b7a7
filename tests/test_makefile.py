"""The Makefile's Python: the newest that starts, and an environment that follows it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.skipif(
    shutil.which("make") is None or not (ROOT / "Makefile").is_file(), reason="needs make"
)


def program(folder: Path, name: str, text: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


#: A version manager's shim of a version that is not set.
SHIM = "echo 'pyenv: command not found' >&2; exit 127"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A PATH's first folder, with shims of everything that might be chosen."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in ("python3.13", "python3.12", "python3.11", "python3"):
        program(folder, name, SHIM)
    return folder


def fake(folder: Path, name: str, version: str) -> None:
    """Make a Python of a version, which makes environments of its kind."""
    program(
        folder,
        name,
        f"""case "$1 $2" in
  *base_prefix*) echo "{version} /usr" ;;
  *ensurepip*) exit 0 ;;
  "-m venv") for last; do :; done; mkdir -p "$last/bin"; cp "$0" "$last/bin/python"
             echo made >> "$last/pyvenv.cfg" ;;
  "-c "*) exec {sys.executable} "$@" ;;
esac""",
    )


def make(path: Path, *words: str) -> str:
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHON", "VENV", "MAKEFLAGS")}
    environment["PATH"] = f"{path}:{os.environ['PATH']}"
    venv = path.parent / "venv"
    done = subprocess.run(
        ["make", "-s", "-C", str(ROOT), f"VENV={venv}", *words],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def chosen(path: Path, *words: str) -> str:
    """Return for which Python an environment is made, or nothing where it is kept."""
    return make(path, f"{path.parent / 'venv'}/pyvenv.cfg", *words)


def test_newest_that_starts_is_taken(path: Path) -> None:
    fake(path, "python3.11", "3 11")
    assert "Python 3 11" in chosen(path)
    assert chosen(path) == ""
    fake(path, "python3.12", "3 12")
    assert "Python 3 12" in chosen(path)
    assert chosen(path) == ""


def test_newer_environment_is_kept_but_for_who_asks(path: Path) -> None:
    fake(path, "python3.13", "3 13")
    assert "Python 3 13" in chosen(path)
    program(path, "python3.13", SHIM)
    fake(path, "python3", "3 11")
    assert chosen(path) == ""
    assert "Python 3 11" in chosen(path, "PYTHON=python3")
    assert chosen(path, "PYTHON=python3") == ""


def test_help_starts_no_python(path: Path) -> None:
    for name in ("python3.13", "python3.12", "python3.11", "python3"):
        program(path, name, f"touch {path.parent}/started; exit 127")
    assert "make" not in make(path, "help").splitlines()[0]
    assert not (path.parent / "started").exists()
