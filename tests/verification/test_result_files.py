"""Results of verification as files: complete, strict, and the same for the same results."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import h5py
import numpy as np
import pytest
import trimesh
from helpers.verdicts import (
    asked_otherwise,
    some_contacts,
    some_forces,
    some_trial,
    some_try,
    some_verdict,
)

from drakegrasp.dataset.schema import CONVENTIONS, SCHEMA_VERSION, VERIFICATION_FIELDS, sizes
from drakegrasp.errors import DataError
from drakegrasp.frames import make_pose, pack_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import make_object
from drakegrasp.outcomes import Outcome
from drakegrasp.verification.hints import Reading
from drakegrasp.verification.result_files import (
    json_line,
    part_path,
    refuse_unwritable,
    result_paths,
    text_lines,
    write_results,
)

CONFIG = load_config()
RNG = np.random.default_rng(0)
X_OG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.1])


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


def results():
    """One of each kind: held by the hand, held by forces, missed by the hand, and no grasp."""
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
    judged = replace(asked, margin=(0.1, 0.5))
    missing = replace(trial, outcome=Outcome.MISSING_FINGERTIP, closed=None, lift=None)
    no_contacts = np.full(3, np.nan)
    missed = replace(
        judged,
        outcome=Outcome.MISSING_FINGERTIP,
        margin=(0.1, np.inf),
        doubts=((Reading(factor=1e-3),), None),
        tries=(some_try(missing, contact_error=no_contacts, normal_error=no_contacts),),
    )
    held = replace(
        asked_otherwise(judged, normalised=True),
        outcome=Outcome.SUCCESS,
        reason="every fingertip holds it",
        tries=(some_try(trial), some_try(missing)),
    )
    by_forces = replace(judged, outcome=Outcome.SUCCESS, forces=some_forces())
    return [held, asked_otherwise(by_forces, method="forces"), missed, invalid]


@pytest.fixture(scope="module")
def found():
    return results()


def lines_of(found):
    def refuse(constant):
        raise AssertionError(f"{constant} is not strict JSON")

    return [
        json.loads(json_line(index, result), parse_constant=refuse)
        for index, result in enumerate(found)
    ]


def test_a_line_says_all_of_a_grasp_in_strict_json(found):
    held, by_forces, missed, invalid = lines_of(found)
    assert [line["index"] for line in (held, by_forces, missed, invalid)] == [0, 1, 2, 3]
    assert [line["outcome"] for line in (held, by_forces, missed, invalid)] == [
        "success",
        "success",
        "missing_fingertip",
        "invalid",
    ]
    assert held["object"] == "чашка"
    verdict = {name: held[name] for name in ("success", "held", "held_any", "sample")}
    assert verdict == {"success": True, "held": True, "held_any": True, "sample": True}
    assert (held["removal"], missed["removal"]) == ("kept", None)
    assert held["unjudged"] == ["not_seen", "flat_depth", "outlier"]
    assert (held["tries"], held["outcomes"]) == (2, ["success", "missing_fingertip"])
    assert held["contact_error"] == [0.001, 0.002, 0.003]
    assert held["normal_error_deg"] == pytest.approx([3.0, 4.0, 5.0])
    assert (held["normalised"], missed["normalised"]) == (True, False)
    assert missed["hints"] == ["points in millimetres instead of metres"]
    assert held["X_OG"] == X_OG.tolist()
    assert held["closed"]["touching"] == [True, False, True]
    assert held["closed"]["p_OQ"][1] == [None, None, None]
    assert held["closed"]["other_links"] == 2
    assert len(held["lifted"]["q"]) == 8
    assert by_forces["forces"]["planned_force"] == pytest.approx(5.0)
    assert by_forces["forces"]["points_share"] == 0.5
    assert by_forces["forces"]["patches_share"] == 0.25
    assert by_forces["forces"]["selected_inside"] == [False, True, False]
    assert held["solver"]["iterations"] == 12
    assert held["slip"] == 0.002
    assert held["forces"] is None
    assert by_forces["forces"]["selected_angle_deg"] == pytest.approx([1.0, 2.0, 3.0])
    assert by_forces["closed"] is None
    assert missed["fit_normal_error_deg"] == pytest.approx([1.0, 2.0, 60.0])
    assert missed["contact_error"] == [None, None, None]
    assert missed["smallest_friction"] is None
    can_hold = [line["friction_can_hold"] for line in (held, missed, invalid)]
    assert can_hold == [True, False, None]
    nothing = ("X_OG", "spread", "epsilon", "slip", "contact_error", "normal_error_deg")
    assert [invalid[name] for name in nothing] == [None] * len(nothing)
    assert invalid["p_OQ"] == [[None] * 3] * 3
    assert invalid["reason"] == "number 1 is nan, not finite"
    assert invalid["seconds"] == {"surface": 0.001}


def test_numbers_are_short(found):
    (held, *_) = lines_of(found)
    assert held["fit_residual"] == [0.0, 0.001, 0.333333]


def test_every_field_is_written_and_reads_back(found, tmp_path):
    write_results(found, tmp_path / "r.h5", CONFIG)
    shape = sizes(fingers=3, joints=8, image=0)
    with h5py.File(tmp_path / "r.h5") as file:
        group = file["grasps"]
        assert set(group) == {f.name for f in VERIFICATION_FIELDS}
        for field in VERIFICATION_FIELDS:
            dataset = group[field.name]
            assert dataset.shape == (4, *field.row_shape(shape))
            assert field.dtype == "str" or dataset.dtype == np.dtype(field.dtype)
            assert dataset.attrs["unit"] == field.unit
        columns = {name: dataset[:] for name, dataset in group.items()}
        group_texts = {"hints": group["hints"].asstr()[:].tolist()}
        assert group["object"].asstr()[0] == "чашка"
        assert file.attrs["schema_version"] == SCHEMA_VERSION
        assert {f"convention_{key}" for key in CONVENTIONS} <= set(file.attrs)
        assert json.loads(file.attrs["config"]) == CONFIG.to_dict()
        assert json.loads(file.attrs["versions"])["drake"]
    held = found[0]
    assert columns["outcome"].tolist() == [0, 0, 5, 17]
    assert columns["held_any"].tolist() == [True, True, False, False]
    assert columns["tries"].tolist() == [2, 0, 1, 0]
    assert group_texts["hints"] == ["", "", "points in millimetres instead of metres", ""]
    assert columns["contact_error"][0].tolist() == [0.001, 0.002, 0.003]
    assert np.isnan(columns["contact_error"][1:]).all()
    for name in ("p_OQ", "nhat_Q_O", "surface_distance", "epsilon", "smallest_friction", "success"):
        assert np.array_equal(columns[name], [getattr(v, name) for v in found], equal_nan=True)
    assert np.array_equal(columns["X_OG"][0], pack_pose(X_OG))
    assert np.array_equal(columns["closed_q"][0], held.trial.closed.q)
    assert np.array_equal(columns["closed_p_OQ"][0], held.closed.p_OQ, equal_nan=True)
    assert np.array_equal(columns["closing_start"][0], [0.1, 0.2, 0.3])
    assert columns["solver_status"].tolist() == [0, -1, 0, -1]
    assert columns["X_TO_lifted"][0, 11] == 0.5
    assert np.isnan(columns["X_TO_lifted"][1:]).all()
    assert columns["planned_share"][1] == 0.5
    assert np.isnan(columns["planned_share"][[0, 2, 3]]).all()
    assert np.isnan(columns["slip"][1:]).all()
    assert math.isinf(columns["smallest_friction"][2])


def test_equal_results_give_equal_bytes(found, tmp_path):
    """Whatever the clock said while they were found."""
    slower = [replace(v, seconds={"surface": 1.0, "fit": 2.0}) for v in found]
    write_results(found, tmp_path / "a.h5", CONFIG)
    write_results(slower, tmp_path / "b.h5", CONFIG)
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_lines_are_whole_in_the_end_and_not_lost_before(found, tmp_path):
    out = tmp_path / "new folder" / "run.1"
    with pytest.raises(KeyboardInterrupt), text_lines(out) as write:
        write(json_line(0, found[0]))
        assert len(part_path(out).read_text(encoding="utf-8").splitlines()) == 1
        raise KeyboardInterrupt
    assert [p.name for p in out.parent.iterdir()] == ["run.1.part.jsonl"]
    with text_lines(out) as write:
        for index, result in enumerate(found):
            write(json_line(index, result))
    (whole,) = out.parent.iterdir()
    assert whole.name == "run.1.jsonl"
    assert len(whole.read_text(encoding="utf-8").splitlines()) == 4
    with pytest.raises(ValueError, match="nothing"), text_lines(tmp_path / "deep" / "run"):
        raise ValueError("nothing was verified")
    assert [p.name for p in tmp_path.iterdir()] == ["new folder"]


def test_a_name_stands_for_two_files(tmp_path):
    for name in ("run.h5", "run.jsonl", "run.hdf5", "run"):
        assert [p.name for p in result_paths(tmp_path / name)] == ["run.jsonl", "run.h5"]


def test_place_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(DataError, match="must be in a folder that can be written"):
        refuse_unwritable(tmp_path / "file" / "deep" / "run")
    with pytest.raises(DataError, match=r"folder\.h5: must be a file, got a folder"):
        refuse_unwritable(tmp_path / "folder")
    refuse_unwritable(tmp_path / "new" / "deep" / "run")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder.h5"]
