"""The doctor: quiet on a healthy machine, and for each lack the line that mends it."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from helpers.machine import needs_egl

from drakegrasp.cli import doctor
from drakegrasp.cli.doctor import Finding, diagnose
from drakegrasp.vision import probe_image


@pytest.mark.sim
@needs_egl
def test_healthy_machine_lacks_nothing() -> None:
    findings = diagnose()
    assert [f for f in findings if not f.ok] == []
    assert {f.remedy for f in findings} == {""}
    assert all(f.what for f in findings)
    names = "Python, Drake, EGL, test image, cores, memory"
    assert [f.name for f in findings] == names.split(", ")


EGL, DRAKE = "apt-get install libegl1 libgl1-mesa-dri", "pip install 'drake>=1.51.1,!=1.52.0'"
#: What a machine may have: the check, what is there, whether it will do, what is said, the remedy.
MACHINES = [
    ("python", (3, 10, 12, "final", 0), False, "", "install Python 3.11 or newer"),
    ("drake", "1.51.1", True, "1.51.1", ""),
    ("drake", "1.52.0", False, "1.52.0", DRAKE),
    ("drake", "1.52.0.post1", False, "1.52.0.post1", DRAKE),
    ("drake", "1.52.1", True, "1.52.1", ""),
    ("drake", "1.58.0", True, "1.58.0", ""),
    ("drake", "1.51.0", False, "1.51.0", DRAKE),
    ("drake", "0.0.20260101", False, "0.0.20260101", DRAKE),
    ("drake", "2.0", True, "2.0", ""),
    ("drake", None, False, "not installed", DRAKE),
    ("egl", "libEGL-none.so.1", False, "libEGL-none.so.1", EGL),
]


@pytest.mark.parametrize(("check", "there", "ok", "what", "remedy"), MACHINES)
def test_what_is_missing_is_told_with_what_mends_it(
    monkeypatch: pytest.MonkeyPatch, check: str, there: Any, ok: bool, what: str, remedy: str
) -> None:
    def version(package: str) -> Any:
        if there is None:
            raise metadata.PackageNotFoundError(package)
        return there

    place, name, value = {
        "python": (sys, "version_info", there),
        "drake": (doctor.metadata, "version", version),
        "egl": (doctor, "EGL_LIBRARY", there),
    }[check]
    monkeypatch.setattr(place, name, value)
    finding = getattr(doctor, f"check_{check}")()
    assert (finding.ok, finding.remedy) == (ok, remedy)
    assert finding.what.startswith(what)


@pytest.mark.parametrize(
    ("child", "what"),
    [
        ("import no_such_library", "ModuleNotFoundError: No module named 'no_such_library'"),
        ("print('0 3012')", "blank image: 0 pixels of a box that has 3012"),
        ("print('16384 3012')", "16384 pixels of a box that has 3012"),
        ("import os; os.kill(os.getpid(), 11)", "the renderer crashed with SIGSEGV"),
        ("raise RuntimeError('no GL')", "RuntimeError: no GL"),
        ("raise SystemExit(3)", "nothing"),
        ("", "the renderer must print two numbers, got 'nothing'"),
        ("print('what?')", "the renderer must print two numbers, got 'what?'"),
        ("import time; time.sleep(60)", "no image within 0.3 s"),
    ],
)
def test_image_that_fails_is_told_and_kills_nobody(
    monkeypatch: pytest.MonkeyPatch, child: str, what: str
) -> None:
    monkeypatch.setattr(probe_image, "_CHILD", child)
    monkeypatch.setattr(probe_image, "IMAGE_SECONDS", 0.3 if "sleep" in child else 60.0)
    finding = doctor.check_image()
    assert (finding.ok, finding.what) == (False, what)
    assert finding.remedy.startswith("pip install" if "no_such" in child else EGL)


def test_neither_a_warning_nor_what_lies_in_the_current_directory_does_harm_to_the_image(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's own numpy.py or test.py beside the dataset must not break the diagnosis."""
    (tmp_path / "colorsys.py").write_text("raise SystemExit('the wrong one')")
    monkeypatch.chdir(tmp_path)
    child = "import colorsys; print('a notice'); print('3000 3012')"
    monkeypatch.setattr(probe_image, "_CHILD", child)
    assert doctor.check_image().ok


def test_memory_is_the_machines_or_the_containers_whichever_is_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """8.2 GB for 6 cores will do; 3 GB of a container will not, but for three workers."""
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(doctor.os, "sysconf", {"SC_PAGE_SIZE": 4096, "SC_PHYS_PAGES": 2000000}.get)
    monkeypatch.setattr(doctor, "CGROUP_LIMIT", limit)
    monkeypatch.setattr(doctor, "available_cores", lambda: 6)
    whole = Finding(name="memory", ok=True, what="8.2 GB for 6 cores")
    assert doctor.check_memory() == whole
    for text in ("max\n", "9000000000\n"):
        limit.write_text(text)
        assert doctor.check_memory() == whole
    limit.write_text("3000000000\n")
    finding = doctor.check_memory()
    assert (finding.ok, finding.what) == (False, "3.0 GB for 6 cores")
    assert finding.remedy.endswith("--workers 3")


def test_doctor_works_where_drake_and_all_else_are_missing(tmp_path: Path) -> None:
    """It is called exactly then: it must come to its end and report."""
    code = (
        "import sys\n"
        "for name in ('pydrake', 'numpy', 'trimesh', 'h5py', 'pydantic', 'dask'):\n"
        "    sys.modules[name] = None\n"
        "from drakegrasp.cli import doctor\n"
        "from drakegrasp.vision import probe_image\n"
        "probe_image._CHILD = 'raise ImportError(1)'\n"
        "print(*(f.name for f in doctor.diagnose() if not f.ok), sep=',')\n"
    )
    child = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert child.stdout.strip().split(",") == ["test image"]
