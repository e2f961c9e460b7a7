"""`drakegrasp score` and `bench-set`: a card that no worker changes, and one-line errors."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.commands import error_line, run
from helpers.datasets import OTO
from helpers.tiers import few

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError
from drakegrasp.scoring.benchmark import read_benchmark

#: Rows that take little time.
FEW = ("--per-object", 1, "--reference", "own", "--reference", "constant", "--quiet")


@pytest.fixture
def given(out: Path) -> tuple[object, ...]:
    """Words of a score of one row of zeros."""
    np.save(out.parent / "net.npy", np.zeros((1, 18)))
    return "score", out.parent / "net.npy", "--dataset", out / OTO


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.cluster
@pytest.mark.parametrize("counts", few([[1], [1, 2]], 1))
def test_a_card_does_not_depend_on_the_number_of_workers(
    small_dataset: Path, tmp_path: Path, counts: list[int]
) -> None:
    path = small_dataset / OTO
    test = GraspDataset(path, split="test")
    np.save(tmp_path / "net.npy", np.flip(test.column("grasps"), axis=0))
    np.save(tmp_path / "old.npy", test.column("grasps"))
    against = ("--against", tmp_path / "old.npy")
    given = ("score", tmp_path / "net.npy", "--dataset", path, *against, *FEW)
    texts = []
    for workers in counts:
        out = tmp_path / f"by {workers}"
        result = run(*given, "--out", out, "--workers", workers)
        assert result.exit_code == 0, result.output
        assert result.stdout.splitlines()[0].startswith("net.npy: ")
        assert {"card.json", "card.md", "card.png", "verdicts.jsonl"} == {
            each.name for each in out.iterdir()
        }
        texts.append((out / "card.json").read_text().replace(shlex.quote(str(out)), "DIR"))
    assert len(set(texts)) == 1

    # Verdicts that are there are not tried again, and the card goes to standard output.
    again = run(*given, "--out", tmp_path / "by 1", "--json")
    card = json.loads(again.stdout)
    assert card | {"again": ""} == json.loads(texts[0]) | {"again": ""}
    assert list(card["sets"]) == ["net.npy", "old.npy", "own", "constant"]
    assert card["sets"]["own"]["measures"]["lifted"]["value"] > 0.0


@pytest.mark.nightly
@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.cluster
def test_a_part_of_the_benchmark_is_built_and_all_of_it_tests(tmp_path: Path) -> None:
    out, name = tmp_path / "bench", "6_can_1"
    settings = ("samples_per_object=1", "samples_patience=20", "camera.size=32")
    changes = [word for text in settings for word in ("--set", text)]
    result = run("bench-set", out, "--only", name, *changes, "--workers", 1, "--quiet")
    assert result.exit_code == 0, result.output
    assert "different_meshes" in (out / "builtin" / "benchmark.json").read_text()
    about = read_benchmark(out, read_manifest(out).config, {})
    assert about is not None
    assert about["different_meshes"] == []
    assert "samples_per_object" in about["other_settings"]
    assert not len(GraspDataset(out / OTO, split="train"))


def test_the_card_has_the_command_as_it_was_given(
    given: tuple[object, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without options that were not given, and with the folder, where the score continues."""

    def refuse(*_: object, again: str, **__: object) -> None:
        raise GraspError(again)

    monkeypatch.setattr("drakegrasp.api.scoring.score", refuse)
    words = [*given, "--out", tmp_path / "by 1", *FEW[:-1]]
    said = error_line(run(*words, "--workers", 1, "--quiet"))
    found = shlex.split(said.partition("drakegrasp ")[2])
    assert sorted(found) == sorted(map(str, words))


@pytest.mark.parametrize(
    ("ends", "said"), [((0.125, 0.5), "(12.5 to 50.0)"), ((0.25, 0.25), "(no interval)")]
)
def test_shares_and_their_intervals_are_printed_as_percent(
    given: tuple[object, ...],
    monkeypatch: pytest.MonkeyPatch,
    ends: tuple[float, float],
    said: str,
) -> None:
    """The interval of one object is none."""
    share = {"value": 0.25, "low": ends[0], "high": ends[1]}
    scored = SimpleNamespace(card={"headline": {"net.npy": share}})
    monkeypatch.setattr("drakegrasp.api.scoring.score", lambda *_, **__: scored)
    result = run(*given, "--workers", 1, "--quiet")
    assert result.stdout == f"net.npy: 25.0 % {said}\n"


def test_the_share_of_clean_grasps_is_printed_beside_the_headline(
    out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the card has it, as among other objects."""
    some, none = {"value": 0.5, "low": 0.25, "high": 0.75}, {"value": 0.0, "low": 0.0, "high": 0.0}
    sets = {
        "own": {"measures": {"headline": some, "clean": none}},
        "constant": {"measures": {"headline": none}},
    }
    scored = SimpleNamespace(card={"headline": {}, "sets": sets, "warnings": []})
    monkeypatch.setattr("drakegrasp.api.scoring.score", lambda *_, **__: scored)
    assert run("score", "--dataset", out / OTO, "--workers", 1).stderr == (
        "own: 50.0 % (25.0 to 75.0), clean 0.0 % (no interval)\nconstant: 0.0 % (no interval)\n"
    )


@pytest.mark.sim
def test_without_a_folder_nothing_is_written(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    words = ("--dataset", out / OTO, "--per-object", 1, "--reference", "constant")
    result = run("score", *words, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert "constant" in result.stderr
    assert sorted(tmp_path.rglob("*")) == before


def test_mistakes_are_one_line(given: tuple[object, ...], out: Path) -> None:
    wrong = ("score", "--reference", "magic", "--dataset", out / OTO)
    for words, said in (
        (given, "without rows there must be a grasp for each of the"),
        (wrong, "references must be of own, nearest image,"),
    ):
        result = run(*words)
        assert (result.exit_code, said in error_line(result)) == (2, True)
