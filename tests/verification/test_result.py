"""What a verdict is called, what is said of it, and how it is written."""

from __future__ import annotations

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
import trimesh
from helpers.objects import standing
from helpers.verdicts import asked_otherwise, some_contacts, some_trial, some_try, some_verdict

from drakegrasp.dataset.schema import CONVENTIONS, SCHEMA_VERSION, VERIFICATION_FIELDS, sizes
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import make_pose, pack_pose
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import make_object
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.files import validate_writable
from drakegrasp.verification.result import json_line, write_results

CONFIG = load_config()


def lifted(*, slip_mm, turn_deg, links, outcome=Outcome.SUCCESS):
    """Return the verdict on a grasp whose object moved so much in the hand."""
    box = trimesh.creation.box([0.06, 0.05, 0.12])
    model = make_object(
        box.vertices, box.faces, CONFIG.objects, name="vase", class_name="vase", mesh_sha256=""
    )
    contacts = some_contacts(other_links=links)
    removal = Removal.OTHER_LINKS if links else Removal.KEPT
    removal = removal if outcome is Outcome.SUCCESS else None
    trial = some_trial(
        standing(model),
        contacts,
        contacts,
        outcome=outcome,
        slip=1e-3 * slip_mm,
        turn=np.deg2rad(turn_deg),
    )
    return some_verdict(model, outcome=outcome, tries=(some_try(trial, removal=removal),))


TIPS_ALONE, ANOTHER = "no other link of the hand touches it", "another link touches it"


@pytest.mark.parametrize(
    ("slip_mm", "turn_deg", "links", "stable", "said"),
    [
        (0.2, 0.3, 0, True, f"{TIPS_ALONE}: a precision grasp, stable."),
        (4.9, 4.9, 0, True, f"{TIPS_ALONE}: a precision grasp, stable."),
        # The limits themselves are beyond.
        (5.0, 0.3, 0, False, f"{TIPS_ALONE}: a precision grasp, not stable."),
        (0.2, 5.0, 0, False, f"{TIPS_ALONE}: a precision grasp, not stable."),
        (0.2, 0.3, 1, False, f"{ANOTHER}: no precision grasp, not stable."),
        (73.0, 98.0, 2, False, "2 other links touch it: no precision grasp, not stable."),
    ],
)
def test_words_and_sentences_follow_from_slip_turn_and_other_links(
    slip_mm, turn_deg, links, stable, said
):
    verdict = lifted(slip_mm=slip_mm, turn_deg=turn_deg, links=links)
    assert verdict.lifted is verdict.matches is True
    assert (verdict.precision, verdict.stable, verdict.kept) == (not links, stable, not links)
    assert repr(verdict) == "Verification(success: so it is)"
    text, load = verdict.explain(), "1.0 N, 0.1 times the hand's rated load of 19.6 N."
    moved = f"slips by {slip_mm:.1f} mm and turns by {turn_deg:.1f}° in the hand"
    assert text.startswith("The grasp of vase holds: so it is. Before closing, the fingertips are ")
    assert f" During the lift the object {moved}, and at the end {said} In a dataset" in text
    assert f"The largest force of a fingertip is {load}" in text


def test_grasp_that_fails_is_none_of_the_words_and_gets_no_mark():
    verdict = lifted(slip_mm=80.0, turn_deg=9.0, links=0, outcome=Outcome.DROPPED)
    assert (verdict.lifted, verdict.precision, verdict.stable) == (False, False, False)
    text = verdict.explain()
    assert text.startswith("The grasp of vase fails (dropped): so it is. ")
    assert text.endswith("touches it; 3 of 3 fingertips still touch it.")
    # What was not lifted is nothing, either.
    verdict = replace(verdict, tries=(), outcome=Outcome.INVALID)
    assert (verdict.lifted, verdict.precision, verdict.stable) == (False, False, False)
    assert "slips" not in verdict.explain()


@pytest.mark.parametrize(
    ("removal", "said"),
    [(Removal.KEPT, "it would be a sample;"), (Removal.SLID, "it would be no sample (slid);")],
)
def test_explanation_says_whether_it_is_a_sample_and_what_is_not_judged(removal, said):
    verdict = lifted(slip_mm=0.1, turn_deg=0.1, links=0)
    verdict = replace(verdict, tries=(replace(verdict.tries[0], removal=removal),))
    text = verdict.explain()
    assert verdict.kept is (removal is Removal.KEPT)
    assert f"In a dataset {said} not judged: not_seen, flat_depth, outlier." in text
    config = override_config(verdict.config, ["filters.outlier_sigma=0"])
    text = replace(verdict, grasp=replace(verdict.grasp, config=config)).explain()
    assert "not judged: not_seen, flat_depth." in text


def test_hints_and_normalised_normals_are_told():
    verdict = lifted(slip_mm=80.0, turn_deg=9.0, links=0, outcome=Outcome.DROPPED)
    verdict = replace(verdict, told=("points in millimetres instead of metres",))
    text = asked_otherwise(verdict, normalised=True).explain()
    assert "A predicted normal was not of unit length; it was normalised." in text
    assert text.endswith("This would fit much better: points in millimetres instead of metres.")


def test_lifted_within_a_distance_follows_from_the_farthest_contact():
    verdict = lifted(slip_mm=0.1, turn_deg=0.1, links=0)
    error = np.array([0.003, np.nan, 0.019])
    near = replace(verdict, tries=(replace(verdict.tries[0], contact_error=error),))
    assert near.farthest_contact == 0.019 and near.matches
    far = replace(verdict, tries=(replace(verdict.tries[0], contact_error=error + 0.002),))
    assert far.lifted and not far.matches
    assert "fingertip 3 is more than 20.0 mm from its point" in far.explain()


RNG = np.random.default_rng(0)
X_OG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.1])
HINT = "points in millimetres instead of metres"


def contacts():
    """Two fingertips touch, the second does not."""
    touching = np.array([True, False, True])
    return some_contacts(
        touching=touching,
        p_OQ=np.where(touching[:, None], RNG.normal(size=(3, 3)), np.nan),
        nhat_Q_O=np.where(touching[:, None], [1.0, 0.0, 0.0], np.nan),
        f_Q_O=RNG.normal(size=(3, 3)),
        other_links=2,
        object_on_table=True,
        point_contacts=1,
    )


@pytest.fixture(scope="module")
def found():
    """One of each kind: held by the hand, missed by the hand, and no grasp."""
    box = trimesh.creation.box([0.06, 0.05, 0.12])
    model = make_object(
        box.vertices, box.faces, CONFIG.objects, name="чашка", class_name="cup", mesh_sha256=""
    )
    asked = some_verdict(
        model,
        config=CONFIG,
        outcome=Outcome.INVALID,
        reason="number 1 is nan, not finite",
        p_OQ=RNG.normal(size=(3, 3)),
        nhat_Q_O=np.tile([0.0, 0.0, 1.0], (3, 1)),
        surface_distance=np.array([0.02, 0.0, 0.0]),
        seconds={"surface": 0.001},
    )
    nothing = np.full((3, 3), np.nan)
    invalid = replace(asked, p_OQ=nothing, nhat_Q_O=nothing, surface_distance=nothing[0])
    trial = some_trial(
        asked.placed.X_TO, contacts(), contacts(), outcome=Outcome.SUCCESS, slip=0.002, turn=0.01
    )
    missing = replace(trial, outcome=Outcome.MISSING_FINGERTIP, closed=None, lift=None)
    no_contacts = np.full(3, np.nan)
    missed = replace(
        asked,
        outcome=Outcome.MISSING_FINGERTIP,
        margin=0.1,
        told=(HINT,),
        tries=(some_try(missing, contact_error=no_contacts, normal_error=no_contacts),),
    )
    held = replace(
        asked_otherwise(asked, normalised=True, confidence=0.75, rank=2),
        outcome=Outcome.SUCCESS,
        reason="every fingertip holds it",
        margin=0.1,
        tries=(some_try(trial), some_try(missing)),
    )
    return [held, missed, invalid]


def lines_of(found):
    def refuse(constant):
        raise AssertionError(f"{constant} is not strict JSON")

    return [
        json.loads(json_line(index, result), parse_constant=refuse)
        for index, result in enumerate(found)
    ]


def test_a_line_says_all_of_a_grasp_in_strict_json(found):
    lines = lines_of(found)
    names = {field.name for field in VERIFICATION_FIELDS}
    assert all(names < line.keys() for line in lines)
    expected = {
        "index": [0, 1, 2],
        "outcome": ["success", "missing_fingertip", "invalid"],
        "matches": [True, False, False],
        "kept": [True, False, False],
        "removal": ["kept", None, None],
        "unjudged": [["not_seen", "flat_depth", "outlier"], [], []],
        "outcomes": [["success", "missing_fingertip"], ["missing_fingertip"], []],
        "confidence": [0.75, None, None],
        "rank": [2, -1, -1],
        "normalised": [True, False, False],
        "hints": ["", HINT, ""],
        "contact_error": [[0.001, 0.002, 0.003], [None, None, None], None],
        "fit_residual": [[0.0, 0.001, 0.333333], [0.0, 0.001, 0.333333], None],
        "epsilon": [0.1, 0.1, None],
        "slip": [0.002, None, None],
        "closed_other_links": [2, None, None],
        "seconds": [{"surface": 0.001}] * 3,
    }
    for name, values in expected.items():
        assert [line[name] for line in lines] == values, name
    held, _, invalid = lines
    assert held["object"] == "чашка" and held["X_OG"] == X_OG.tolist()
    assert held["closed_p_OQ"][1] == [None, None, None]
    assert invalid["p_OQ"] == [[None] * 3] * 3 and "not finite" in invalid["explain"]


def test_every_field_is_written_and_reads_back(found, tmp_path):
    write_results(found, tmp_path / "r.h5", CONFIG)
    shape = sizes(fingers=3, joints=8, image=0)
    with h5py.File(tmp_path / "r.h5") as file:
        group = file["grasps"]
        assert set(group) == {f.name for f in VERIFICATION_FIELDS}
        for field in VERIFICATION_FIELDS:
            dataset = group[field.name]
            assert dataset.shape == (3, *field.row_shape(shape))
            assert field.dtype == "str" or dataset.dtype == np.dtype(field.dtype)
            assert dataset.attrs["unit"] == field.unit
        columns = {name: dataset[:] for name, dataset in group.items()}
        assert group["hints"].asstr()[:].tolist() == ["", HINT, ""]
        assert group["object"].asstr()[0] == "чашка"
        assert file.attrs["schema_version"] == SCHEMA_VERSION
        assert {f"convention_{key}" for key in CONVENTIONS} <= set(file.attrs)
        assert json.loads(file.attrs["config"]) == CONFIG.to_dict()
        assert json.loads(file.attrs["versions"])["drake"]
    assert columns["outcome"].tolist() == [0, 5, 17]
    np.testing.assert_array_equal(columns["X_OG"][0], pack_pose(X_OG))
    # Values are those of the lines, see above; what a grasp did not come to is missing.
    for name in ("p_OQ", "matches"):
        np.testing.assert_array_equal(columns[name], [getattr(v, name) for v in found])
    for name in ("contact_error", "X_TO_lifted", "slip"):
        assert np.isfinite(columns[name][0]).all() and np.isnan(columns[name][1:]).all()


def test_equal_results_give_equal_bytes(found, tmp_path):
    """Whatever the clock said while they were found."""
    slower = [replace(v, seconds={"surface": 1.0, "fit": 2.0}) for v in found]
    write_results(found, tmp_path / "a.h5", CONFIG)
    write_results(slower, tmp_path / "b.h5", CONFIG)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_place_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(DataError, match="must be in a folder that can be written"):
        validate_writable(tmp_path / "file" / "deep" / "run.h5")
    with pytest.raises(DataError, match=r"folder\.h5: must be a file, got a folder"):
        validate_writable(tmp_path / "folder.h5")
    validate_writable(tmp_path / "new" / "deep" / "run.h5")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.h5"]
