"""Files that are spoilt by chance: whoever reads them gets equal values, or one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from helpers.scripts import load_script

#: Cases that a run of the tests tries; the scripts try more.
CASES, SEED = 16, 7
MODELS = {"meshes": 12, "hands": 8}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timeout(240)
def test_spoilt_files_are_read_with_equal_values_or_refused_in_a_line(out: Path) -> None:
    fuzz = load_script("measurements/fuzz_files").fuzz
    assert [finding for finding in fuzz(out, CASES, SEED) if finding] == []


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("kind", MODELS)
def test_spoilt_meshes_and_hands_are_taken_or_refused_in_a_line(kind: str) -> None:
    fuzz = load_script("measurements/fuzz_models").fuzz
    assert [finding for finding in fuzz(kind, MODELS[kind], SEED) if finding] == []


def test_other_values_need_a_line_that_names_the_file() -> None:
    fuzz = load_script("measurements/fuzz_files")
    picture, name = Path("pictures/hold.png"), Path("objects/1_box_a.plan.h5")
    sound = fuzz.Said(code=0, out="8 figures\n", written={picture: "a"})
    assert fuzz.judge(replace(sound, err="⠙ draw 1/8\n"), sound, name) is None
    other = replace(sound, written={picture: "b"})
    assert fuzz.judge(other, sound, name) == "other values without a word"
    for said in ({"out": f"hold is left out: {name}: must be a plan\n"}, {"pages": f"{name}\n"}):
        assert fuzz.judge(replace(other, **said), sound, name) is None
    refused = replace(sound, code=2, err="⠙ export   0/12\nerror: no\n")
    assert fuzz.judge(refused, sound, name) is None
