"""Install archives of the package into empty environments, and build a tiny dataset in each.

pip takes the dependencies from its configured index. The checkout is not on the path, and
everything is written to a temporary folder.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import venv
from collections.abc import Sequence
from pathlib import Path

#: A box that the hand can grasp, in metres.
MESH = "import trimesh; trimesh.creation.box([0.065, 0.05, 0.14]).subdivide().export('1_box.obj')"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archives", type=Path, nargs="+", help="a wheel or an sdist")
    for archive in parser.parse_args(argv).archives:
        try_archive(archive.absolute())
        sys.stdout.write(f"{archive.name}: installed, built a dataset and checked it\n")
    return 0


def try_archive(archive: Path) -> None:
    """Install an archive into a new environment, and use it there.

    Raises:
        SystemExit: If a command fails, or the code that runs is not from the archive.
    """
    version = archive.name.removesuffix(".tar.gz").split("-")[1]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        venv.create(folder / "environment", with_pip=True)
        python = folder / "environment" / "bin" / "python"
        command = python.with_name("drakegrasp")
        # Most modules of the dependencies are never imported here, so compiling them only costs
        # time.
        run(folder, python, "-m", "pip", "install", "--quiet", "--no-compile", archive)

        # The command and the module that run are those of the archive.
        printed = run(folder, command, "--version")
        if version not in printed.split():
            raise SystemExit(f"drakegrasp --version must print {version}, got {printed!r}")
        module = run(folder, python, "-c", "import drakegrasp; print(drakegrasp.__file__)").strip()
        if not Path(module).is_relative_to(folder):
            raise SystemExit(f"drakegrasp must be imported from {archive.name}, got {module}")

        # The command describes the machine, builds a dataset, and finds no fault in it.
        run(folder, command, "doctor")
        (folder / "meshes").mkdir()
        run(folder / "meshes", python, "-c", MESH)
        options = ("--candidates", "10", "--workers", "1", "--quiet")
        run(folder, command, "build", "--objects", "meshes", "--out", "out", *options)
        run(folder, command, "check", "out")


def run(folder: Path, *words: str | Path) -> str:
    """Run a command in a folder without the paths of this process; return what it prints.

    Raises:
        SystemExit: If the command fails.
    """
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(map(str, words))} failed:\n{done.stdout}")
    return done.stdout


if __name__ == "__main__":
    raise SystemExit(main())
