"""Files that are spoilt by chance: whoever reads them gets equal values, or one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.scripts import load_script

#: Cases that a run of the tests tries; the scripts try more.
CASES, SEED = 16, 7
MODELS = {"meshes": 12, "hands": 8}


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_spoilt_files_are_read_with_equal_values_or_refused_in_a_line(out: Path) -> None:
    fuzz = load_script("measurements/fuzz_files").fuzz
    assert [finding for finding in fuzz(out, CASES, SEED) if finding] == []


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("kind", MODELS)
def test_spoilt_meshes_and_hands_are_taken_or_refused_in_a_line(kind: str) -> None:
    fuzz = load_script("measurements/fuzz_models").fuzz
    assert [finding for finding in fuzz(kind, MODELS[kind], SEED) if finding] == []
