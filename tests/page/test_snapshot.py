"""The attempts in memory: what the files say of them, and how a query chooses and sorts them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qsl

import h5py
import numpy as np
import pytest
from helpers.datasets import OTM, TRIALS, make_dataset
from helpers.pages import numbered

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.rejections import AttemptKey, Decisions
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DataError
from drakegrasp.frames import invert_pose, transform_points, unpack_pose
from drakegrasp.page.attempts import AttemptGallery
from drakegrasp.page.renders import THUMBNAIL, contact_dots, read_render, read_rows
from drakegrasp.page.snapshot import Snapshot, read_snapshot
from drakegrasp.vision.camera import intrinsics, project

NOTHING = Decisions()


def test_rows_and_images_are_those_of_the_attempt(sound: Path) -> None:
    with h5py.File(sound / TRIALS) as trials, h5py.File(sound / OTM) as data:
        X_OG = trials["trials/X_OG"][15]
        split = next(s for s in data if 15 in data[s]["trial_id"][:])
        place = data[split]["trial_id"][:].tolist().index(15)
        image, mask = data[split]["images"][place], data[split]["masks"][place]
    snapshot = read_snapshot(sound)
    i = snapshot.find(AttemptKey("2_box_b", 1, 0))
    assert i == 15 and str(snapshot.key(i)) == "2_box_b, palm pose 1, stand-off 0"
    assert snapshot.find(AttemptKey("2_box_b", 99, 0)) is None
    (row,) = read_rows(snapshot, [i], ("X_OG",))
    np.testing.assert_array_equal(row["X_OG"], X_OG)
    found = read_render(snapshot, i, "otm")
    assert found is not None
    np.testing.assert_array_equal(found.image, image)
    np.testing.assert_array_equal(found.mask, mask)
    assert read_render(snapshot, i + 1, "otm") is None


def test_trials_that_are_a_link_to_nowhere_are_damaged_and_not_still_to_come(out: Path) -> None:
    (out / "trials.hdf5").unlink()
    (out / "trials.hdf5").symlink_to("trials.hdf5")
    with pytest.raises(DataError, match=r"trials\.hdf5: must be the trials of a dataset"):
        read_snapshot(out)


# Attempts with a mass and a camera of their own.


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The boxes, each attempt with a mass and cameras of its own. Read only."""
    folder = tmp_path_factory.mktemp("drawn")
    draws = ("mass=[0.5, 1.5]", "camera_shift=0.02", "camera_turn_deg=10")
    return make_dataset(folder / "out", folder, overrides=[f"randomize.{draw}" for draw in draws])


@pytest.mark.parametrize("camera", ["oto", "otm"])
def test_dots_are_where_the_moved_camera_sees_the_contacts(drawn: Path, camera: str) -> None:
    snapshot = read_snapshot(drawn)
    data = GraspDataset(drawn / f"grasping_{camera}.hdf5", split="test")
    trial = int(data.column("trial_id")[0])
    (row,) = read_rows(snapshot, [trial], THUMBNAIL)
    X_TC = unpack_pose(data.column(f"object_props/frame_work2cam_{camera}")[0].astype(float))
    X_CO = invert_pose(X_TC) @ unpack_pose(row["X_TO"])
    expected = project(
        intrinsics(snapshot.config.camera), transform_points(X_CO, row["closed_p_OQ"])
    )
    dots = contact_dots(snapshot, row, camera)
    assert len(dots) == 3
    np.testing.assert_allclose([[dot.u, dot.v] for dot in dots], expected, atol=0.01)


# Filters and order: each filter chooses by its own column, in the units that are shown.


@pytest.fixture
def snapshot(sound: Path) -> Snapshot:
    return read_snapshot(sound)


def chosen(snapshot: Snapshot, text: str, decisions: Decisions = NOTHING) -> list[str]:
    places = AttemptGallery(snapshot, decisions).select(AttemptGallery.query(dict(parse_qsl(text))))
    return [numbered(snapshot, str(i)) for i in places]


@pytest.mark.parametrize(
    ("text", "labels"),
    [
        ("outcome=slipped", ["0-1-1", "1-1-1", "2-1-1"]),
        ("object=2_box_b", ["1-0-0", "1-1-0", "1-3-2"]),
        ("class=brick", ["2-0-0", "2-1-0", "2-3-2"]),
        ("class=brick&object=2_box_b", []),
        ("object=nothing", []),
        ("split=none", []),
        ("removal=other_links", []),
    ],
)
def test_each_filter_chooses_its_own(snapshot: Snapshot, text: str, labels: list[str]) -> None:
    assert chosen(snapshot, f"{text}&sort=row&order=up") == labels


def test_any_sample_is_one_choice(snapshot: Snapshot) -> None:
    split = snapshot.table.split.copy()
    split[[0, 3]] = NONE
    changed = replace(snapshot, table=snapshot.table.with_columns(split=split))
    assert len(chosen(changed, "split=samples&outcome=any")) == 7
    assert set(chosen(changed, "split=none")) == {"0-0-0", "0-1-0"}


def test_order_is_by_the_quantity_and_those_without_come_last(snapshot: Snapshot) -> None:
    score = snapshot.table.anomaly.copy()
    score[[0, 3, 11]] = [5.0, np.nan, 7.0]
    changed = replace(snapshot, table=snapshot.table.with_columns(anomaly=score))
    down, up = chosen(changed, ""), chosen(changed, "order=up")
    assert down[:2] == ["0-3-2", "0-0-0"]
    assert up[-3:] == ["0-0-0", "0-3-2", "0-1-0"]
    assert down[-1] == up[-1] == "0-1-0"
    rows = chosen(snapshot, "sort=row&order=up")
    assert rows[:3] == ["0-0-0", "0-1-0", "0-3-2"]  # "smallest first"
    assert chosen(snapshot, "sort=row") == rows[::-1]


def test_decisions_choose_what_is_left(snapshot: Snapshot) -> None:
    a, b = AttemptKey("1_box_a", 0, 0), AttemptKey("3_brick", 1, 0)
    gone = AttemptKey("no object", 0, 0)
    decisions = Decisions(rejected=frozenset([a, gone]), kept=frozenset([b]))
    assert chosen(snapshot, "decision=rejected", decisions) == ["0-0-0"]
    # Failures are never decided, so they are not open either.
    for text in ("decision=open", "decision=open&outcome=any"):
        assert len(chosen(snapshot, text, decisions)) == 8


def test_address_of_a_query_gives_the_query_again() -> None:
    text = "outcome=any&object=a%26b%3Dc&sort=slip&order=up&page=3&hold=stable"
    query = AttemptGallery.query(dict(parse_qsl(text)))
    assert AttemptGallery.query(dict(parse_qsl(query.params()))) == query
    assert query["object"] == "a&b=c" and not query["outcome"]
    assert AttemptGallery.query().params() == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("outcome=good", "outcome must be one of any, success, .* got 'good'"),
        ("sort=x", "sort must be one of"),
        ("page=-1", "page must be a number"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(text: str, words: str) -> None:
    with pytest.raises(DataError, match=words):
        AttemptGallery.query(dict(parse_qsl(text)))
