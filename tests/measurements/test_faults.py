"""Drawn faults are those that the script lists; fuzzing finds other values without a word."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from helpers.scripts import load_script


@pytest.fixture
def draw_faults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, for a package with two rooms, in a folder of its own."""
    script = load_script("measurements/draw_faults")
    for room in ("hand", "pictures"):
        folder = tmp_path / "drakegrasp" / room
        folder.mkdir(parents=True)
        (folder / "module.py").write_text("WIDTH = 5\nNAMED = open('a', 'b')\n")
    (tmp_path / "drakegrasp" / "frames.py").write_text("UP = -1\n")
    monkeypatch.setattr(script, "ROOT", tmp_path)
    return script


@pytest.mark.parametrize(
    ("source", "changes"),
    [
        ("c = a < b", {("bound", "c = (a) <= (b)"), ("operator", "c = (a) >= (b)")}),
        ("c = a @ b", {("frame", "c = (b) @ (a)")}),
        ("c = A.T", {("frame", "c = (A)")}),
        ("c = multiply(A, B)", {("frame", "c = multiply(B, A)")}),
        ("c = invert_pose(X)", {("frame", "c = (X)")}),
        ("c = np.deg2rad(x)", {("unit", "c = (x)")}),
        ("c = 1e3 * x", {("unit", "c = 1 * x"), ("operator", "c = (1e3) / (x)")}),
        ("c = f(a, b, k=d)", {("swapped", "c = f(b, a, k=d)")}),
        ("c = f('ä', *a), isinstance(a, b)", set()),
        ("if a: b = c", {("branch", "if False: b = c")}),
        ("c = a if b else d", {("branch", "c = (a) if not (b) else (d)")}),
        ("ä = 'ä', 5", {("number", "ä = 'ä', (2 * 5)")}),
        ("f()", {("result", "pass")}),
        ("def f(a: 5 = True) -> 5: return a", {
            ("number", "def f(a: 5 = False) -> 5: return a"),
            ("result", "def f(a: 5 = True) -> 5: return None"),
        }),
    ],
)  # fmt: skip
def test_fault_changes_one_place(
    draw_faults: ModuleType, source: str, changes: set[tuple[str, str]]
) -> None:
    (draw_faults.ROOT / "drakegrasp" / "frames.py").write_text(source)
    faults = list(draw_faults.faults_of("drakegrasp/frames.py"))
    assert {(fault["kind"], fault["new"]) for fault in faults} == changes
    assert all(fault["old"] == source for fault in faults)


def test_rooms_have_equally_many_faults_but_for_layout_and_equivalent_ones(
    draw_faults: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(draw_faults, "EQUIVALENT", tmp_path / "equivalent.yaml")
    draw_faults.EQUIVALENT.write_text("- {file: drakegrasp/frames.py, new: UP = (1), why: none}\n")
    assert draw_faults.main(["--count", "4"]) == 0
    drawn = [(fault["file"], fault["kind"]) for fault in yaml.safe_load(capsys.readouterr().out)]
    assert Counter(drawn) == Counter(
        [
            ("drakegrasp/frames.py", "number"),
            ("drakegrasp/pictures/module.py", "swapped"),
            ("drakegrasp/hand/module.py", "number"),
            ("drakegrasp/hand/module.py", "swapped"),
        ]
    )


def test_fault_without_effect_is_one_of_this_source(
    draw_faults: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert load_script("measurements/draw_faults").equivalent_faults()
    monkeypatch.setattr(draw_faults, "EQUIVALENT", tmp_path / "equivalent.yaml")
    draw_faults.EQUIVALENT.write_text("- {file: drakegrasp/frames.py, new: UP = (2), why: none}\n")
    with pytest.raises(ValueError, match=r"frames\.py must have one fault 'UP = \(2\)', got 0"):
        draw_faults.equivalent_faults()


def test_tests_of_a_module_are_those_of_its_room_and_near_ones(draw_faults: ModuleType) -> None:
    imports = {
        "hand/test_far.py": "",
        "hand/test_module.py": "import drakegrasp.hand.module",
        "test_all.py": "from drakegrasp.hand import module",
        "test_nothing.py": "import drakegrasp.frames",
    }
    for name, text in imports.items():
        path = draw_faults.ROOT / "tests" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    tests = draw_faults.tests_of("drakegrasp/hand/module.py")
    assert tests == [
        f"tests/{name}" for name in ("hand/test_module.py", "hand/test_far.py", "test_all.py")
    ]


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
