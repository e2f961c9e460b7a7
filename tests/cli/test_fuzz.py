"""Files that are spoilt by chance: whoever reads them gets equal values, or one line."""

from __future__ import annotations

from helpers.scripts import load_script


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
