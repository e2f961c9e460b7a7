"""`Trials`: columns, rows, choices and contacts are those of the files."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers.datasets import OTO, TRIALS, edit_file

from drakegrasp.dataset import trials as trials_module
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.schema import SPLITS, TRIAL_FIELDS
from drakegrasp.dataset.trials import NONE, Trials
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import X_WT, invert_pose, rotate_vectors, transform_points, unpack_pose
from drakegrasp.outcomes import Outcome


def stored(out: Path, name: str) -> Any:
    with h5py.File(out / TRIALS) as file:
        return file["trials"][name][:]


@pytest.mark.parametrize("block", [1, 5, 36, 1000])
@pytest.mark.parametrize("rows", [None, [7], [20, 3, 3, 35, 0], []], ids=str)
def test_columns_are_those_of_the_file(
    sound: Path, block: int, rows: list[int] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials_module, "BLOCK", block)
    trials = Trials(sound) if rows is None else Trials(sound)[rows]
    columns = trials.columns([field.name for field in TRIAL_FIELDS])
    picked = slice(None) if rows is None else np.array(rows, dtype=int)
    assert len(trials) == (36 if rows is None else len(rows))
    for field in TRIAL_FIELDS:
        expected = stored(sound, field.name)[picked]
        np.testing.assert_array_equal(columns[field.name], expected)
        assert columns[field.name].dtype == expected.dtype


def test_blocks_are_the_columns_in_parts(sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trials_module, "BLOCK", 5)
    blocks = list(Trials(sound).blocks(["slip", "object_name"]))
    assert [len(block["slip"]) for block in blocks] == [5] * 7 + [1]
    np.testing.assert_array_equal(
        np.concatenate([block["slip"] for block in blocks]), stored(sound, "slip")
    )


def test_what_is_derived_is_that_of_the_other_groups_and_files(sound: Path) -> None:
    trials = Trials(sound)
    with h5py.File(sound / TRIALS) as file, h5py.File(sound / OTO) as data:
        hits, removal = file["successes/trial_id"][:], file["successes/removal"][:]
        names = file["objects/name"].asstr()[:][file["trials/object"][:]]
        ids = {split: data[split]["trial_id"][:] for split in SPLITS}
    assert trials["object_name"].tolist() == names.tolist()
    assert set(trials["class_name"]) == {"box", "brick"}
    np.testing.assert_array_equal(trials["removal"][hits], removal)
    assert (trials["removal"] != NONE).sum() == len(hits)
    for number, split in enumerate(SPLITS):
        np.testing.assert_array_equal(np.flatnonzero(trials["split"] == number), ids[split])


def test_choice_is_of_what_was_asked_for(sound: Path) -> None:
    for filters, name, wanted in (
        ({"outcome": "success"}, "outcome", [Outcome.SUCCESS]),
        ({"outcome": ["dropped", Outcome.SLIPPED]}, "outcome", [Outcome.SLIPPED, Outcome.DROPPED]),
        ({"object_name": "2_box_b"}, "object", [1]),
        ({"class_name": "box"}, "object", [0, 1]),
    ):
        (rows,) = np.nonzero(np.isin(stored(sound, name), wanted))
        assert Trials(sound).where(**filters).trial_ids.tolist() == rows.tolist()


def test_removed_success_is_no_sample(out: Path) -> None:
    assemble(out, rejected=[27])
    own = Trials(out).where(outcome="success", object_name="3_brick")
    assert own.where(kept=True).trial_ids.tolist() == [24, 35]
    assert own.where(kept=False).trial_ids.tolist() == [27]


def test_row_has_every_value_of_an_attempt(sound: Path) -> None:
    row = Trials(sound).trial(15)
    assert row.keys() == {f.name for f in TRIAL_FIELDS} | {"object_name", "class_name", "removal"}
    assert (row["object_name"], row["class_name"]) == ("2_box_b", "box")
    np.testing.assert_array_equal(row["X_OG"], stored(sound, "X_OG")[15])


@pytest.mark.parametrize("frame", ["object", "table", "palm", "world"])
@pytest.mark.parametrize("when", ["closed", "lifted"])
def test_contacts_are_those_of_the_file_in_any_frame(sound: Path, when: Any, frame: Any) -> None:
    trials = Trials(sound).where(outcome="success")
    contacts = trials.contacts(when, frame=frame)
    assert contacts.touching.all()
    for k, row in enumerate(trials.trial_ids):
        suffix = "_lifted" if when == "lifted" else ""
        X_TO, X_OG = (unpack_pose(stored(sound, f"{n}{suffix}")[row]) for n in ("X_TO", "X_OG"))
        in_world, in_palm = X_WT @ X_TO, invert_pose(X_OG)
        X_FO = {"object": np.eye(4), "table": X_TO, "palm": in_palm, "world": in_world}[frame]
        p_OQ, nhat_Q_O, f_Q_O = (
            stored(sound, f"{when}_{name}")[row] for name in ("p_OQ", "nhat_Q_O", "f_Q_O")
        )
        np.testing.assert_allclose(contacts.points[k], transform_points(X_FO, p_OQ), atol=1e-12)
        np.testing.assert_allclose(contacts.normals[k], rotate_vectors(X_FO, nhat_Q_O), atol=1e-12)
        np.testing.assert_allclose(contacts.forces[k], rotate_vectors(X_FO, f_Q_O), atol=1e-12)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (lambda t: t.where(outcome="mug"), "outcome must be one of success, .*, got 'mug'"),
        (lambda t: t.where(object_name="mug"), "^object_name must be one of the dataset's, got"),
        (lambda t: t.where(class_name="mug"), "class_name must be one of the dataset's, got 'mug'"),
        (lambda t: list(t[[3, 1]].blocks(["slip"])), "must be in rising order to be read in bl"),
        (lambda t: list(t[[2, 2]].blocks(["slip"])), "must be in rising order to be read in bl"),
        (lambda t: t.trial(36), r"trials\.hdf5: trial must be 0 to 35, got 36"),
        (lambda t: t[-37], "index must be below 36, got -37"),
        (lambda t: t["mug"], r"column must be one of trial_id, .*, got 'mug'"),
        (lambda t: t.contacts("open"), "when must be closed or lifted, got 'open'"),
        (lambda t: t.contacts(frame="camera"), "frame must be one of object, table, .* got 'cam"),
    ],
)
def test_what_there_is_not_is_refused(
    sound: Path, ask: Callable[[Trials], object], said: str
) -> None:
    with pytest.raises((DataError, IndexError), match=said):
        ask(Trials(sound))


def test_file_that_was_replaced_is_refused(out: Path) -> None:
    trials = Trials(out)
    shutil.copy(out / TRIALS, out / "other")
    (out / "other").replace(out / TRIALS)
    with pytest.raises(DataError, match="must stay while it is read, got another"):
        trials["slip"]


def test_numbers_that_stand_for_nothing_are_refused(out: Path) -> None:
    """Numbers of outcomes and removals that have left stand for nothing, too."""
    edit_file(out / TRIALS, lambda f: f["trials/outcome"].write_direct(np.full(36, 16, "u1")))
    with pytest.raises(DataError, match=r"/outcome must be one of 0, 1, .*, 19, got 16 in row 7"):
        Trials(out)[[7, 9]]["outcome"]
    edit_file(out / TRIALS, lambda f: f["successes/removal"].write_direct(np.full(9, 14, "u1")))
    with pytest.raises(
        DataError, match=rf"/removal must be one of 0, 1, .*, {max(Removal)}, got 14 in row 0"
    ):
        Trials(out)["removal"]
    edit_file(out / TRIALS, lambda f: f["trials/object"].write_direct(np.full(36, 3, "i4")))
    with pytest.raises(DataError, match="/trials/object must be 0 to 2, got 3 in row 0"):
        Trials(out)["object_name"]
