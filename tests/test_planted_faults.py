"""The table of planted faults is one of this code; the first tier of the tests finds them."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[1]
TABLE = ROOT / "pipelines" / "measurements" / "planted_faults.yaml"
FAULTS: list[dict[str, Any]] = yaml.safe_load(TABLE.read_text(encoding="utf-8"))


@cache
def first_tier(file: str) -> set[str]:
    """Return the names of the tests of a file that every change must pass."""
    body = ast.parse((ROOT / file).read_text(encoding="utf-8")).body
    if any("pytest.mark.nightly" in ast.unparse(n) for n in body if isinstance(n, ast.Assign)):
        return set()
    functions = (node for node in body if isinstance(node, ast.FunctionDef))
    nightly = "pytest.mark.nightly"
    return {f.name for f in functions if nightly not in map(ast.unparse, f.decorator_list)}


@pytest.mark.parametrize("fault", FAULTS, ids=[fault["fault"] for fault in FAULTS])
def test_fault_replaces_one_place_and_names_tests_of_the_first_tier(fault: dict[str, Any]) -> None:
    assert (ROOT / fault["file"]).read_text(encoding="utf-8").count(fault["old"]) == 1
    for test in fault["tests"]:
        file, _, name = test.partition("::")
        assert name.partition("[")[0] in first_tier(file)
