"""The doctor: quiet on a healthy machine, and for each lack the line that mends it."""

from __future__ import annotations

import subprocess
import sys
from collections import namedtuple
from importlib import metadata
from pathlib import Path

import pytest
from helpers.machine import needs_egl

from drakegrasp.cli import doctor
from drakegrasp.cli.doctor import Finding, diagnose
from drakegrasp.vision import probe_image


@pytest.fixture
def no_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare the tests that are about something else the child process."""
    monkeypatch.setattr(
        doctor, "check_image", lambda: Finding(name="test image", ok=True, what="not made")
    )


@pytest.mark.sim
@needs_egl
def test_healthy_machine_lacks_nothing(tmp_path: Path) -> None:
    findings = diagnose(tmp_path)
    assert [f for f in findings if not f.ok] == []
    assert {f.remedy for f in findings} == {""}
    assert all(f.what for f in findings)
    names = "Python, glibc, Drake, allocator, EGL, test image, writing, disk, cores, memory"
    assert [f.name for f in findings] == names.split(", ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("no_image")
def test_current_directory_is_the_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (writing,) = (f for f in diagnose() if f.name == "writing")
    assert writing == Finding(name="writing", ok=True, what=str(tmp_path))


def test_old_python_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "version_info", (3, 10, 12, "final", 0))
    finding = doctor.check_python()
    assert not finding.ok
    assert "3.11 or newer" in finding.remedy


@pytest.mark.parametrize(
    ("libc", "ok", "what"),
    [
        (("glibc", "2.34"), True, "glibc 2.34"),
        (("glibc", "2.4"), False, "glibc 2.4"),
        (("glibc", "2.31"), False, "glibc 2.31"),
        (("glibc", "3.0"), True, "glibc 3.0"),
        (("musl", "1.2.5"), False, "musl 1.2.5"),
        (("", ""), False, "another C library"),
    ],
)
def test_old_or_other_c_library_is_told(
    monkeypatch: pytest.MonkeyPatch, libc: tuple[str, str], ok: bool, what: str
) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(doctor.platform, "libc_ver", lambda: libc)
    finding = doctor.check_glibc()
    assert (finding.ok, finding.what) == (ok, what)
    assert ("container" in finding.remedy) is not ok


@pytest.mark.parametrize(
    ("version", "ok"),
    [
        ("1.51.1", True),
        ("1.52.0", False),
        ("1.52.0.post1", False),
        ("1.52.1", True),
        ("1.58.0", True),
        ("1.51.0", False),
        ("0.0.20260101", False),
        ("2.0", True),
    ],
)
def test_drake_that_crashes_or_is_too_old_is_told(
    monkeypatch: pytest.MonkeyPatch, version: str, ok: bool
) -> None:
    monkeypatch.setattr(doctor.metadata, "version", lambda package: version)
    mend = "" if ok else "pip install 'drake>=1.51.1,!=1.52.0'"
    finding = doctor.check_drake()
    assert (finding.ok, finding.what.partition(":")[0], finding.remedy) == (ok, version, mend)
    assert ("a tenth longer" in finding.what) == (version in ("1.51.1", "1.52.1"))


def test_missing_drake_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(package: str) -> str:
        raise metadata.PackageNotFoundError(package)

    monkeypatch.setattr(doctor.metadata, "version", missing)
    finding = doctor.check_drake()
    assert (finding.ok, finding.what) == (False, "not installed")
    assert finding.remedy.startswith("pip install 'drake")


@pytest.mark.skipif(sys.platform != "linux", reason="EGL is Linux's")
def test_missing_egl_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "EGL_LIBRARY", "libEGL-none.so.1")
    finding = doctor.check_egl()
    assert not finding.ok
    assert "libEGL-none.so.1" in finding.what
    assert finding.remedy == "apt-get install libegl1 libgl1-mesa-dri"


@pytest.mark.parametrize(
    ("child", "what"),
    [
        ("print('0 3012')", "blank image: 0 pixels of a box that has 3012"),
        ("print('16384 3012')", "16384 pixels of a box that has 3012"),
        ("import os; os.kill(os.getpid(), 11)", "the renderer crashed with SIGSEGV"),
        ("raise RuntimeError('no GL')", "RuntimeError: no GL"),
        ("raise SystemExit(3)", "nothing"),
        ("", "the renderer must print two numbers, got 'nothing'"),
        ("print('what?')", "the renderer must print two numbers, got 'what?'"),
        ("import time; time.sleep(60)", "no image within 1 s"),
    ],
)
def test_image_that_fails_is_told_and_kills_nobody(
    monkeypatch: pytest.MonkeyPatch, child: str, what: str
) -> None:
    monkeypatch.setattr(probe_image, "_CHILD", child)
    monkeypatch.setattr(probe_image, "IMAGE_SECONDS", 1.0 if "sleep" in child else 60.0)
    finding = doctor.check_image()
    assert (finding.ok, finding.what) == (False, what)
    assert finding.remedy == "apt-get install libegl1 libgl1-mesa-dri"


def test_image_that_lacks_a_library_is_mended_by_installing_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(probe_image, "_CHILD", "import no_such_library")
    finding = doctor.check_image()
    assert finding.what == "ModuleNotFoundError: No module named 'no_such_library'"
    assert finding.remedy.startswith("pip install")


def test_last_line_counts_so_that_warnings_do_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe_image, "_CHILD", "print('a notice'); print('3000 3012')")
    assert doctor.check_image().ok


def test_child_does_not_import_what_lies_in_the_current_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A user's own numpy.py or test.py beside the dataset must not break the diagnosis."""
    (tmp_path / "colorsys.py").write_text("raise SystemExit('the wrong one')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(probe_image, "_CHILD", "import colorsys; print('3000 3012')")
    assert doctor.check_image().ok


@pytest.mark.usefixtures("no_image")
def test_directory_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    """A file is in the way: that stops even root."""
    (tmp_path / "file").write_text("")
    (writing,) = (f for f in diagnose(tmp_path / "file" / "out") if f.name == "writing")
    assert not writing.ok
    assert writing.what == f"{tmp_path / 'file'}: Not a directory"
    assert "--out" in writing.remedy


@pytest.mark.usefixtures("no_image")
def test_directory_that_does_not_exist_yet_is_no_lack(tmp_path: Path) -> None:
    """`build` makes it; the doctor does not."""
    writing = {f.name: f for f in diagnose(tmp_path / "new" / "out")}["writing"]
    assert (writing.ok, writing.what) == (True, str(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda path: usage(1e12, 1e12, 3e8))
    finding = doctor.check_disk(tmp_path)
    assert (finding.ok, finding.what) == (False, "0.3 GB free")
    assert "free 2 GB" in finding.remedy
    monkeypatch.undo()
    assert not doctor.check_disk(tmp_path / "none").ok


def test_memory_is_the_machines_or_the_containers_whichever_is_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """8 GB for 6 cores will do; 3 GB of a container will not, but for three workers."""
    meminfo, limit = tmp_path / "meminfo", tmp_path / "memory.max"
    meminfo.write_text("MemTotal:        8000000 kB\nMemFree:          100000 kB\n")
    limit.write_text("max\n")
    monkeypatch.setattr(doctor, "MEMINFO", meminfo)
    monkeypatch.setattr(doctor, "CGROUP_LIMITS", (limit, tmp_path / "none"))
    monkeypatch.setattr(doctor, "available_cores", lambda: 6)
    assert doctor.check_memory() == Finding(name="memory", ok=True, what="8.2 GB for 6 cores")
    limit.write_text("3000000000\n")
    finding = doctor.check_memory()
    assert (finding.ok, finding.what) == (False, "3.0 GB for 6 cores")
    assert finding.remedy.endswith("--workers 3")
    limit.write_text(f"{2**63 - 4096}\n")
    assert doctor.check_memory().what == "8.2 GB for 6 cores"
    limit.unlink()
    meminfo.unlink()
    assert doctor.check_memory() == Finding(name="memory", ok=True, what="unknown")


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
