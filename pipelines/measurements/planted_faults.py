"""Plant faults in a copy of the source, one at a time, and say which of them the tests find.

The table `planted_faults.yaml` has faults that were once planted by hand and that no test saw;
`draw_faults.py` draws others. A fault is a text that is replaced in one file, and the tests that
must notice. Prints JSON: for each fault whether a test failed, and the seconds that took. Exits
with 1 if a fault was not found that is not called equivalent.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_suffix(".yaml")
#: Exit codes of pytest: all tests passed, some failed; others mean that nothing was learnt.
PASSED, FAILED = 0, 1


def copy_source(folder: Path) -> None:
    """Copy the files that Git knows of, with what has changed in them, into a folder."""
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
    """Return a file's text with a fault in it.

    Args:
        text: Of the file.
        fault: Has `old` and `new`; `line` says where `old` begins if it occurs several times.

    Raises:
        ValueError: If the text is not there, or not only once.
    """
    lines = text.splitlines(keepends=True)
    start = sum(map(len, lines[: fault.get("line", 1) - 1]))
    count = text.count(fault["old"], start)
    if not count or ("line" not in fault and count > 1):
        raise ValueError(f"{fault['file']}: must have {fault['old']!r} once, got {count} times")
    return text[:start] + text[start:].replace(fault["old"], fault["new"], 1)


def try_fault(folder: Path, fault: dict[str, Any], timeout: float) -> dict[str, Any]:
    """Plant a fault in a copy, run its tests, and take it out again.

    Args:
        folder: The copy.
        fault: Of a table.
        timeout: For one test [s]; a test that hangs has found the fault.

    Returns:
        What was found: `found`, the first test that failed, and `seconds`.
    """
    path, began = folder / fault["file"], time.monotonic()
    original = path.read_text(encoding="utf-8")
    try:
        path.write_text(with_fault(original, fault), encoding="utf-8")
        code, said = run_tests(folder, fault["tests"], timeout)
    finally:
        path.write_text(original, encoding="utf-8")
    failed = [line for line in said.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return {
        "fault": fault["fault"],
        "file": fault["file"],
        "found": code != PASSED,
        "by": failed[0][:200] if failed else "" if code in (PASSED, FAILED) else said[-300:],
        "seconds": round(time.monotonic() - began, 1),
    }


def run_tests(folder: Path, tests: Sequence[str], timeout: float) -> tuple[int, str]:
    """Run tests in a copy until one fails; return pytest's exit code and what it said."""
    environment = {**os.environ, "PYTHONPATH": f"{folder}:{folder / 'tests'}"}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "--tb=no"]
    command += ["-p", "no:cacheprovider", f"--timeout={timeout:g}", *tests]
    run = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    return run.returncode, run.stdout


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", type=Path, nargs="?", default=TABLE, help="YAML with faults")
    parser.add_argument("--only", default="", help="faults with this text in their name or file")
    parser.add_argument(
        "--timeout", type=float, default=120.0, help="seconds that a test may take (default: 120)"
    )
    arguments = parser.parse_args(argv)
    faults = yaml.safe_load(arguments.table.read_text(encoding="utf-8"))
    chosen = [f for f in faults if arguments.only in f["fault"] or arguments.only in f["file"]]

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        copy_source(folder)

        # Without a fault all tests must pass, or nothing is learnt.
        tests = sorted({test for fault in chosen for test in fault["tests"]})
        code, said = run_tests(folder, tests, arguments.timeout)
        if code != PASSED:
            sys.stderr.write(f"the tests must pass without a fault, got:\n{said}")
            return 2

        missed = 0
        for fault in chosen:
            result = try_fault(folder, fault, arguments.timeout)
            if "equivalent" in fault:
                result["equivalent"] = fault["equivalent"]
            missed += not result["found"] and "equivalent" not in fault
            sys.stdout.write(json.dumps(result) + "\n")
            sys.stdout.flush()
    sys.stdout.write(json.dumps({"faults": len(chosen), "not found": missed}) + "\n")
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
