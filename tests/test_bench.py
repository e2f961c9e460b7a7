"""The benchmark counts what it ran, and compares labels of the same attempts."""

from __future__ import annotations

import json

import pytest
import trimesh
from click.testing import CliRunner

from drakegrasp import bench
from drakegrasp.cli import main
from drakegrasp.outcomes import Outcome

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box([0.05, 0.07, 0.15]).subdivide().export(folder / "1_box_tall.obj")
    return folder


def test_report_says_what_attempts_cost(meshes, tmp_path):
    arguments = ["bench", "--objects", str(meshes), "--candidates", "4", "--fidelity", "2"]
    first = CliRunner().invoke(main, arguments)
    assert first.exit_code == 0, first.output
    report = json.loads(first.stdout)
    (found,) = report["objects"]
    assert found["attempts"] == report["all"]["attempts"] == 12
    assert sum(found["outcomes"].values()) == 12
    assert {"prepare", "scene", "field", "screen", "try", "look"} == set(found["seconds"])
    assert found["resolved_per_core_second"] > 0.0
    assert report["peak_memory"] > 50e6
    assert report["versions"]["drake"]
    assert set(report["all"]["fidelity"]) == set(bench.VARIANTS)
    path = tmp_path / "before.json"
    path.write_text(first.stdout)
    again = CliRunner().invoke(main, [*arguments[:-2], "--compare", str(path)])
    assert json.loads(again.stdout)["ratio"]["resolved_per_core_second"] > 0.0


def test_name_that_no_mesh_has_is_wrong_usage(meshes):
    result = CliRunner().invoke(main, ["bench", "--objects", str(meshes), "--only", "9_cup"])
    assert result.exit_code == 2
    assert "--only must name objects" in result.output


def test_screened_attempt_that_would_miss_a_fingertip_is_no_flip():
    pairs = [
        (Outcome.SCREENED, Outcome.MISSING_FINGERTIP),
        (Outcome.START_COLLISION, Outcome.START_COLLISION),
        (Outcome.SUCCESS, Outcome.SLIPPED),
        (Outcome.SCREENED, Outcome.SUCCESS),
    ]
    counts = bench._count(pairs)
    assert counts["flips"] == 2
    assert counts["successes_lost_by_screen"] == 1
    assert (counts["decided"], counts["simulated"]) == (3, 1)
