"""Files that are spoilt by chance: whoever reads them gets equal values, or one line."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.scripts import load_script

#: Cases that a run of the tests tries; the script tries more.
SEED = 7
CASES = {"dataset": 8, "meshes": 12, "hands": 8}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timeout(500)
@pytest.mark.parametrize("kind", CASES)
def test_spoilt_files_are_read_with_equal_values_or_refused_in_a_line(kind: str, out: Path) -> None:
    fuzz = load_script("measurements/fuzz").fuzz
    assert list(fuzz(out if kind == "dataset" else kind, CASES[kind], SEED)) == []


def test_other_values_need_a_line() -> None:
    fuzz = load_script("measurements/fuzz")
    sound = fuzz.Said(code=0, out="8 figures\n", err="⠙ draw 1/8\n")
    other = fuzz.Said(code=0, out="7 figures\n", err="⠙ draw 1/7\n")
    assert fuzz.judge(sound, sound) is None
    assert fuzz.judge(other, sound) == "other values without a word"
    told = fuzz.Said(code=0, out="7 figures\n", err="objects/a.plan.h5: must be a plan\n")
    assert fuzz.judge(told, sound) is None
    refused = fuzz.Said(code=2, err="⠙ export   0/12\nerror: no\n")
    assert fuzz.judge(refused, sound) is None
