"""Plant faults in a copy of the source, one at a time, and report which of them the tests find.

The table `planted_faults.yaml` contains faults that were once planted by hand and that no test
found; `draw_faults.py` draws others. A fault is a text that is replaced in one file, together with
the tests that must notice it. The script prints JSON: for each fault whether a test failed, and how
many seconds that took. The exit code is 1 if a fault was not found, and 2 if a test fails without
a fault.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import count
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest
import yaml

#: Modification times for written files, one second apart [s].
_TIMES = count(1_000_000_000)
ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_suffix(".yaml")
#: Exit codes: pytest's code if all tests passed, and the code of a run that was killed.
PASSED, KILLED = 0, -1
#: Maximum duration of a run, as a multiple of the maximum duration of one test.
HANG = 15.0
#: Libraries that the tests load; a fork of this process need not load them again.
LIBRARIES = (
    *("h5py", "networkx", "numpy", "pydantic", "rich.table", "trimesh", "yaml"),
    *("scipy.ndimage", "scipy.optimize", "scipy.spatial", "pydrake.multibody.plant"),
    *("pydrake.systems.analysis", "pydrake.systems.primitives", "pydrake.solvers"),
)


def copy_source(folder: Path) -> None:
    """Copy the files that Git knows, including uncommitted changes, into a folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)


def with_fault(text: str, fault: dict[str, Any]) -> str:
    """Return a file's text with a fault planted in it.

    Args:
        text: Text of the file.
        fault: The fault with `old` and `new`; `line` states where `old` begins if it occurs several
            times.

    Raises:
        ValueError: If the text does not contain `old` from the line on, or contains it several
            times and no line is stated.
    """
    lines = text.splitlines(keepends=True)
    start = sum(map(len, lines[: fault.get("line", 1) - 1]))
    times = text.count(fault["old"], start)
    if not times or ("line" not in fault and times > 1):
        raise ValueError(f"{fault['file']}: must have {fault['old']!r} once, got {times} times")
    return text[:start] + text[start:].replace(fault["old"], fault["new"], 1)


def try_fault(folder: Path, fault: dict[str, Any], timeout: float) -> dict[str, Any]:
    """Plant a fault in a copy, run its tests, and remove it again.

    Args:
        folder: Folder of the copy.
        fault: Fault from a table.
        timeout: Maximum duration of one test [s]; a test that hangs has found the fault.

    Returns:
        The result: `found`, the first test that failed as `by`, and `seconds`.
    """
    path, began = folder / fault["file"], time.monotonic()
    original = path.read_text(encoding="utf-8")
    try:
        _write(path, with_fault(original, fault))
        code, said = run_tests(folder, fault["tests"], timeout)
    finally:
        _write(path, original)
    failed = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if code not in (PASSED, KILLED) and not failed:
        raise RuntimeError(f"pytest must run the tests of {fault['fault']!r}, got:\n{said}")
    return {
        "fault": fault["fault"],
        "file": fault["file"],
        "found": code != PASSED,
        "by": failed[0] if failed else "killed" if code == KILLED else "",
        "seconds": round(time.monotonic() - began, 1),
    }


def _write(path: Path, text: str) -> None:
    """Write a module with a new modification time, by which Python detects stale compiled code."""
    path.write_text(text, encoding="utf-8")
    changed = next(_TIMES)
    os.utime(path, (changed, changed))


def run_tests(folder: Path, tests: Sequence[str], timeout: float) -> tuple[int, str]:
    """Run tests in a copy until one fails; return pytest's exit code and its output.

    The tests run in a fork of this process, in which the libraries are loaded.
    """
    with tempfile.TemporaryFile() as output:
        child = get_context("fork").Process(
            target=_run, args=(folder, list(tests), timeout, output.fileno())
        )
        child.start()
        child.join(HANG * timeout)
        # With the processes that the tests have started, also those that they left.
        with suppress(ProcessLookupError):
            os.killpg(child.pid or 0, signal.SIGKILL)
        child.join()
        output.seek(0)
        code = child.exitcode
        return KILLED if code is None or code < 0 else code, output.read().decode(errors="replace")


def _run(folder: Path, tests: list[str], timeout: float, output: int) -> None:
    os.setsid()
    # A process in the background of a shell ignores Ctrl-C, and so would those of the tests.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.chdir(folder)
    sys.path[:0] = [str(folder), str(folder / "tests")]
    os.environ["PYTHONPATH"] = f"{folder}:{folder / 'tests'}"
    options = ["-x", "-q", "--no-header", "--tb=no", "-p", "no:cacheprovider"]
    options += [f"--timeout={timeout:g}", "--hypothesis-seed=0"]
    sys.exit(pytest.main([*options, *tests], plugins=[SlowLast()]))


class SlowLast:
    """A plugin of pytest that runs the slow tests after all others."""

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Move slow tests to the end."""
        items.sort(key=lambda item: item.get_closest_marker("slow") is not None)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", type=Path, nargs="?", default=TABLE, help="YAML with faults")
    parser.add_argument("--only", default="", help="faults with this text in their name or file")
    parser.add_argument(
        "--timeout", type=float, default=60.0, help="seconds that a test may take (default: 60)"
    )
    parser.add_argument("--trust", action="store_true", help="do not try the tests without a fault")
    arguments = parser.parse_args(argv)
    faults = yaml.safe_load(arguments.table.read_text(encoding="utf-8"))
    chosen = [f for f in faults if arguments.only in f["fault"] or arguments.only in f["file"]]

    for library in LIBRARIES:
        importlib.import_module(library)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_source(folder)

        # Without a fault all tests must pass, otherwise a failed test proves nothing.
        tests = sorted({test for fault in chosen for test in fault["tests"]})
        code, said = (PASSED, "") if arguments.trust else run_tests(folder, tests, 600.0)
        if code != PASSED:
            sys.stderr.write(f"the tests must pass without a fault, got:\n{said}")
            return 2

        missed = 0
        for fault in chosen:
            result = try_fault(folder, fault, arguments.timeout)
            missed += not result["found"]
            sys.stdout.write(json.dumps(result) + "\n")
            sys.stdout.flush()
    sys.stdout.write(json.dumps({"faults": len(chosen), "not found": missed}) + "\n")
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
