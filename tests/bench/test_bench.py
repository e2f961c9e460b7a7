"""The benchmark counts what it ran."""

from __future__ import annotations

import json

import pytest
import trimesh
from helpers.commands import run

import drakegrasp as dg
from drakegrasp.bench import measure
from drakegrasp.errors import DataError

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box([0.05, 0.07, 0.15]).subdivide().export(folder / "1_box_tall.obj")
    return folder


def test_report_says_what_attempts_cost(meshes, tmp_path):
    path, other = tmp_path / "first.json", tmp_path / "second.json"
    arguments = ["bench", "--objects", str(meshes), "--candidates", "4", "--quiet"]
    first = run(*arguments, "--peer", "--out", str(path))
    assert first.exit_code == 0, first.output
    report = json.loads(path.read_text())
    (found,) = report["objects"]
    assert found["attempts"] == report["all"]["attempts"] == 12
    assert sum(found["outcomes"].values()) == sum(found["peer"]["outcomes"].values()) == 12
    assert {"prepare", "scene", "field", "screen", "try", "look"} == set(found["seconds"])
    assert found["resolved_per_core_second"] > 0.0
    assert report["peak_memory"] > 50e6
    assert report["versions"]["drake"]
    assert "MuJoCo" in first.stdout
    assert "peak memory" in first.stdout
    assert (
        f"preparing, 4 palm poses per object: here {report['all']['with_preparing']['1']:,.0f}"
        in (first.stdout)
    )
    for outcome, count in report["all"]["outcomes"].items():
        assert f"{count} {outcome}" in first.stdout
    again = run(*arguments, "--out", str(other), "--compare", str(path))
    ratio = json.loads(other.read_text())["ratio"]["resolved_per_core_second"]
    assert f"{ratio:.2f} times that of {path}" in again.stdout.replace("\n", "")


def test_report_of_something_else_is_wrong_usage(meshes, tmp_path):
    path = tmp_path / "report.json"
    path.write_text("[]")
    arguments = ["bench", "--objects", str(meshes), "--compare", str(path)]
    result = run(*arguments)
    assert result.exit_code == 2
    assert "--compare must be a report" in result.output


def test_name_that_no_mesh_has_is_wrong_usage(meshes):
    result = run("bench", "--objects", str(meshes), "--only", "9_cup")
    assert result.exit_code == 2
    assert "--only must name objects" in result.output


def test_objects_are_drawn_by_the_seed(tmp_path, monkeypatch):
    for name in "abcdef":
        trimesh.creation.box([0.05, 0.07, 0.15]).export(tmp_path / f"{name}.obj")
    drawn = []

    def only_named(sources, *_, **__):
        drawn.append(sources)
        raise DataError("not measured")

    monkeypatch.setattr(measure, "measure", only_named)
    arguments = ["bench", "--objects", str(tmp_path), "--draw", "3", "--out", str(tmp_path / "r")]
    for seed in (0, 0, 1):
        run(*arguments, "--quiet", "--set", f"seed={seed}")
    names = [[source.name for source in sources] for sources in drawn]
    assert names[0] == names[1] != names[2]
    assert len(set(names[0])) == len(set(names[2])) == 3


def test_preparing_is_paid_once_for_any_number_of_palm_poses():
    def report(**seconds):
        return {"outcomes": {"success": 2}, "seconds": seconds}

    one, other = report(**{"prepare": 5.0, "try": 2.0}), report(**{"prepare": 15.0, "try": 6.0})
    every = measure.summarize([one, other], dg.load_config())["all"]
    assert every["grasps_per_core_hour"] == pytest.approx(4 * 3600 / 8)
    assert every["with_preparing"] == pytest.approx({"1": 4 * 3600 / 28, "10": 4 * 3600 / 10})


def test_only_the_same_attempts_are_compared():
    def report(name, attempts, grasps):
        rates = {"resolved_per_core_second": 10.0, "grasps_per_core_hour": grasps}
        return {"objects": [{"name": name, "attempts": attempts}], "all": rates}

    same = measure.compare(report("a", 12, 3.0), report("a", 12, 0.0))
    assert same == {"resolved_per_core_second": 1.0, "grasps_per_core_hour": None}
    for other in (report("b", 12, 3.0), report("a", 15, 3.0)):
        with pytest.raises(DataError, match="must be of the same attempts"):
            measure.compare(report("a", 12, 3.0), other)


def test_report_that_cannot_be_written_is_refused_before_measuring(meshes, tmp_path):
    arguments = ["bench", "--objects", str(meshes), "--out", str(tmp_path / "no" / "x.json")]
    result = run(*arguments)
    assert result.exit_code == 2
    assert "--out must be a file that can be written" in result.output


def test_option_that_needs_mujoco_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("drakegrasp.runtime.environment.find_spec", lambda name: None)
    result = run("bench", "--peer", "--out", str(tmp_path / "report.json"))
    assert result.exit_code == 1
    assert "mujoco must be installed: pip install 'drakegrasp[peer]'" in result.output
