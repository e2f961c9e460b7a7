"""The data card: its counts are those of the files, its bytes depend on nothing else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import SLIPPED, end_lift

from drakegrasp.config import CarriedHand
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.card import card_content, card_text, content_of
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.dataset.paths import CARD_FILES
from drakegrasp.outcomes import Outcome


def test_counts_are_those_of_the_files(out: Path) -> None:
    counts = json.loads((out / CARD_FILES[0]).read_text(encoding="utf-8"))["counts"]
    with (
        h5py.File(out / "trials.hdf5") as trials,
        h5py.File(out / "grasping_otm.hdf5") as data,
    ):
        names = trials["objects/name"].asstr()[:]
        index, outcome = trials["trials/object"][:], trials["trials/outcome"][:]
        assert list(counts["objects"]) == names.tolist()
        for i, name in enumerate(names):
            row, here = counts["objects"][name], index == i
            assert row["attempts"] == here.sum()
            assert row["held"] == (outcome[here] == Outcome.SUCCESS).sum()
            assert row["stable"] == trials["trials/stable"][:][here].sum()
            for split in ("train", "valid", "test"):
                of = data[split]["object_props/object_name"].asstr()[:]
                assert row[split] == np.count_nonzero(of == name)
            assert row["samples"] == row["train"] + row["valid"] + row["test"]
        assert counts["outcomes"] == {
            o.label: int((outcome == o).sum()) for o in Outcome if (outcome == o).any()
        }
        for split in ("train", "valid", "test"):
            assert counts["splits"][split]["samples"] == len(data[split]["grasps"]) > 0
    for key in ("attempts", "held", "samples", "test"):
        for part in ("objects", "classes"):
            assert counts["all"][key] == sum(row[key] for row in counts[part].values()) > 0
    assert {name: row["objects"] for name, row in counts["classes"].items()} == {
        "box": 2,
        "brick": 1,
    }


def test_text_has_the_counts_and_nothing_that_is_markup(out: Path) -> None:
    content = card_content(out)
    assert (out / CARD_FILES[1]).read_text(encoding="utf-8") == card_text(content)
    row = content["counts"]["objects"].pop("3_brick")
    content["counts"]["objects"]["<b>a|b\\|c"] = {**row, "attempts": 1234567}
    text = card_text(content)
    assert "| &lt;b&gt;a\\|b\\\\\\|c | brick | 1,234,567 |" in text
    for each in content["limits"]:
        assert each["limit"] in text


def test_card_says_that_held_grasps_are_a_lower_bound(out: Path) -> None:
    """Where lifts were ended, and only there."""
    assert "lower bound" not in card_text(card_content(out))
    end_lift(out, SLIPPED, 0.02)
    content = card_content(out)
    assert content["counts"]["outcomes"]["moved"] == 1
    (limit,) = [each for each in content["limits"] if "lower bound" in each["limit"]]
    assert "1 lift ended early" in limit["limit"]
    assert limit["docs"] == "docs/reference/outcomes.md"


def test_limits_name_pages_that_exist(out: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    for each in card_content(out)["limits"]:
        assert (root / each["docs"]).is_file()


def test_the_same_dataset_has_the_same_bytes(out: Path) -> None:
    before = [(out / name).read_bytes() for name in CARD_FILES]
    assemble(out)
    assert [(out / name).read_bytes() for name in CARD_FILES] == before


def test_the_rule_of_the_split_is_named(out: Path) -> None:
    for rule in ("class", "object"):
        assemble(out, overrides=[f"split.by={rule}"])
        assert json.loads((out / CARD_FILES[0]).read_text(encoding="utf-8"))["split_by"] == rule
        assert f"### Samples by split, which is by {rule}\n" in (out / CARD_FILES[1]).read_text()


def test_licences_are_those_of_the_manifest(out: Path) -> None:
    manifest = read_manifest(out)
    first, *others = manifest.objects
    write_manifest(replace(manifest, objects=(replace(first, licence="CC-BY-4.0"), *others)), out)
    assert read_manifest(out).objects[0].licence == "CC-BY-4.0"
    assemble(out)
    card = json.loads((out / CARD_FILES[0]).read_text(encoding="utf-8"))
    assert card["licences"] == {
        "CC-BY-4.0": [first.name],
        "not stated": [entry.name for entry in others],
    }


def test_objects_are_those_of_the_files_while_a_build_adds_some(out: Path) -> None:
    before = card_content(out)
    manifest = read_manifest(out)
    more = replace(manifest.objects[0], name="9_new", licence="MIT")
    write_manifest(replace(manifest, objects=(*manifest.objects, more)), out)
    assert card_content(out) == before
    assert before["title"] == "Simulated grasps of 3 objects"


def test_drive_and_fingers_are_named(out: Path) -> None:
    content = card_content(out)
    assert content["settings"]["lift.drive"] == "worm"
    manifest = replace(read_manifest(out), fingers={"thumb": True, "ring": False})
    for drive, hand, expected in (
        ("locked", "barrett", "locked"),
        (None, "/gone/my.yaml", "that of the hand file"),
    ):
        lift = manifest.config.lift.model_copy(update={"drive": drive})
        config = manifest.config.model_copy(update={"hand": hand, "lift": lift})
        files = (out / "trials.hdf5", out / "grasping_oto.hdf5")
        content = content_of(replace(manifest, config=config), *files)
        assert content["settings"]["lift.drive"] == expected
        assert "in the order of a grasp: thumb, ring." in card_text(content)


def test_check_finds_the_card_of_other_files(out: Path) -> None:
    path = out / CARD_FILES[0]
    content = json.loads(path.read_text(encoding="utf-8"))
    content["counts"]["all"]["samples"] += 1
    for text in (json.dumps(content), "[]", "{"):
        path.write_text(text, encoding="utf-8")
        (violation,) = check_dataset(out)
        assert (violation.file, violation.what) == (
            CARD_FILES[0],
            "the data card must count what the files hold",
        )
    path.unlink()
    assert check_dataset(out) == []


@pytest.mark.parametrize("text", ["version: 1\nfingers: 3\n", "model: ../../elsewhere.sdf\n"])
def test_a_damaged_hand_of_a_dataset_leaves_out_what_the_card_says_of_it(
    out: Path, text: str
) -> None:
    manifest, path = read_manifest(out), out / "hand" / "own_hand.yaml"
    path.parent.mkdir()
    path.write_text(text)
    config = manifest.config.with_hand("hand/own_hand.yaml", CarriedHand(path=path, digest=""))
    files = (out / "trials.hdf5", out / "grasping_oto.hdf5")
    content = content_of(replace(manifest, config=config), *files)
    assert content["settings"]["lift.drive"] == "that of the hand file"
    assert content["hand_licences"] == {}
