"""The wheel holds the whole package, and works where there is no checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import trimesh
from helpers.scripts import load_script

ROOT = Path(__file__).resolve().parents[1]
release = load_script("release")
VERSION = release.read_version(ROOT)

pytestmark = pytest.mark.slow


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command that must succeed, without the paths of this process; return what it prints."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in command], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built without the network in a copy of the checkout.

    In the checkout itself setuptools would leave a folder `build`, and take from it what an
    earlier build left there.
    """
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(
        ROOT / "drakegrasp", source / "drakegrasp", ignore=shutil.ignore_patterns("__pycache__")
    )
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    pip = (sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
    run(*pip, "--wheel-dir", folder, source, cwd=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of commands of an environment with the wheel and the libraries of this one."""
    environment = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=environment)
    python = environment / "bin" / "python"
    pip = (sys.executable, "-m", "pip", "--python", python, "install", "--quiet")
    run(*pip, "--no-deps", "--no-index", wheel, cwd=environment)
    (own,) = environment.glob("lib/python*/site-packages")
    # These come after the environment's own, and their .pth files are not read: the checkout,
    # which this environment may have installed as editable, stays out.
    theirs = [p for p in sys.path if Path(p).name in ("site-packages", "dist-packages")]
    (own / "libraries.pth").write_text("\n".join(theirs) + "\n", encoding="utf-8")
    return environment / "bin"


def test_wheel_has_every_file_of_the_package(wheel: Path) -> None:
    tree = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "drakegrasp").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    files = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert files == tree
    for name in (
        "py.typed",
        "models/barrett_hand.sdf",
        "presets/paper.yaml",
        "generation/work_unit.py",
    ):
        assert f"drakegrasp/{name}" in files


def test_changelog_and_citation_agree_with_the_version(tmp_path: Path) -> None:
    assert release.disagreements(ROOT) == []
    for name in ("pyproject.toml", "CHANGELOG.md", "CITATION.cff"):
        text = (ROOT / name).read_text("utf-8")
        (tmp_path / name).write_text(text.replace(f'version = "{VERSION}"', 'version = "9.0.0"'))
    citation, changelog = release.disagreements(tmp_path)
    assert "must be 9.0.0" in citation
    assert "must be 9.0.0 (" in changelog


@pytest.mark.nightly
def test_every_module_of_the_wheel_can_be_imported(installed: Path, tmp_path: Path) -> None:
    """Public names, hand and presets, too; the environment does not run the checkout."""
    code = """
import importlib, pkgutil, drakegrasp
names = [m.name for m in pkgutil.walk_packages(drakegrasp.__path__, "drakegrasp.")]
for name in names:
    importlib.import_module(name)
for name in drakegrasp.__all__:
    getattr(drakegrasp, name)
for preset in ("paper", "released"):
    drakegrasp.load_hand(drakegrasp.load_config(preset).hand)
print(drakegrasp.__file__, drakegrasp.__version__, len(names))
"""
    file, version, count = run(installed / "python", "-c", code, cwd=tmp_path).split()
    assert Path(file).is_relative_to(installed.parent)
    assert version == VERSION and int(count) > 100


@pytest.mark.nightly
@pytest.mark.sim
@pytest.mark.cluster
def test_the_installed_command_builds_a_dataset(installed: Path, tmp_path: Path) -> None:
    command, out = installed / "drakegrasp", tmp_path / "out"
    assert "MISSING" not in run(command, "doctor", cwd=tmp_path)
    trimesh.creation.box([0.065, 0.05, 0.14]).subdivide().export(tmp_path / "1_box_slim.obj")
    options = ("--candidates", "10", "--workers", "1", "--quiet")
    run(command, "build", "--objects", tmp_path, "--out", out, *options, cwd=tmp_path)
    assert "no broken invariants" in run(command, "check", out, cwd=tmp_path)
