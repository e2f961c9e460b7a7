"""Files that are spoilt by chance: whoever reads them gets equal values, or one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.scripts import load_script

#: Cases that a run of the tests tries; the script tries more.
CASES, SEED = 16, 7


@pytest.mark.slow
@pytest.mark.timeout(240)
def test_spoilt_files_are_read_with_equal_values_or_refused_in_a_line(out: Path) -> None:
    fuzz = load_script("measurements/fuzz_files").fuzz
    assert [finding for finding in fuzz(out, CASES, SEED) if finding] == []
