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
  "-m venv") for last; do :; done
             test "$3" = --clear && rm -rf "$last"
             mkdir -p "$last/bin"; cp "$0" "$last/bin/python"
             for tool in drakegrasp ruff mypy mkdocs; do
               ln -s {shutil.which("true")} "$last/bin/$tool"
             done
             echo "{version}" > "$last/pyvenv.cfg" ;;
  "-m pip") echo "$@" >> "${{0%/bin/python}}/pip.log" ;;
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


def environment(path: Path, *words: str) -> str:
    """Return of which Python the environment is, after one was asked for."""
    config = path.parent / "venv" / "pyvenv.cfg"
    make(path, str(config), *words)
    return config.read_text().strip()


def installed(path: Path) -> None:
    """Say that the package was installed there."""
    (path.parent / "venv" / ".installed").touch()


def test_newest_that_starts_is_taken(path: Path) -> None:
    fake(path, "python3.11", "3 11")
    assert environment(path) == "3 11"
    installed(path)
    fake(path, "python3.12", "3 12")
    assert environment(path) == "3 12"
    assert not (path.parent / "venv" / ".installed").exists()  # so it is installed again
    installed(path)
    config = path.parent / "venv" / "pyvenv.cfg"
    before = config.stat().st_mtime_ns
    assert environment(path) == "3 12"
    assert config.stat().st_mtime_ns == before


def test_newer_environment_is_kept_but_for_who_asks(path: Path) -> None:
    fake(path, "python3.13", "3 13")
    environment(path)
    installed(path)
    program(path, "python3.13", SHIM)
    fake(path, "python3", "3 11")
    assert environment(path) == "3 13"
    assert environment(path, "PYTHON=python3") == "3 11"


def test_what_was_not_made_here_is_not_cleared(path: Path) -> None:
    kept = path.parent / "venv" / "kept"
    kept.parent.mkdir()
    kept.touch()
    fake(path, "python3.11", "3 11")
    assert environment(path) == "3 11"
    fake(path, "python3.12", "3 12")
    assert environment(path) == "3 11"
    assert environment(path, "PYTHON=python3.12") == "3 11"
    assert kept.exists()


def test_demo_installs_the_package_and_the_others_what_they_need_beside_it(path: Path) -> None:
    fake(path, "python3.11", "3 11")
    log, package, rest = path.parent / "venv" / "pip.log", "--editable .", "--editable .[dev]"

    def added(target: str) -> list[str]:
        """Return what pip is asked to install for a target."""
        before = log.read_text() if log.exists() else ""
        make(path, target)
        words = log.read_text().removeprefix(before).splitlines()
        return [line[line.index("--editable") :] for line in words if "--editable" in line]

    assert added("demo") == [package]
    assert added("demo") == []
    for target in ("install", "test", "test-fast", "test-nightly", "lint", "format", "docs"):
        (path.parent / "venv" / ".installed-dev").unlink(missing_ok=True)
        assert added(target) == [rest]
        assert added(target) == added("demo") == []
