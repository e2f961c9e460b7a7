"""Our own grasps under a protocol of MuJoCo: postures of a file, and predicted contacts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import error_line, run
from helpers.objects import CUBE, STANDOFF, box_model, from_above, standing

pytest.importorskip("mujoco")
pytest.importorskip("coacd")

from drakegrasp import mjcf
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.exchange.dexgraspbench import OBJECTS, fitted_postures, write_grasps
from drakegrasp.exchange.export import ClosedGrasp
from drakegrasp.frames import invert_pose
from drakegrasp.grasp import pack_grasp
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.settings import load_config
from drakegrasp.runtime import environment
from drakegrasp.simulation.attempts import quaternion_poses
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import Posture
from drakegrasp.simulation.trial import TrialRecord, run_attempt
from drakegrasp.verification.placing import place_on_object
from drakegrasp.verification.verify import first_fit

HAND = load_hand()


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrialRecord]:
    """A cube, and the trial of a grasp that holds it."""
    folder, config = tmp_path_factory.mktemp("cube"), load_config()
    model = box_model(folder, [CUBE] * 3)
    scene = build_scene(model, config.physics, HAND)
    record = run_attempt(scene, standing(model), from_above(model, STANDOFF), config)
    assert record.lift is not None
    return next(folder.glob("*.obj")), record


def lines_of(grasps: Path, *options: Any) -> list[dict[str, Any]]:
    result = run("verify", grasps, "--protocol", "dexgraspbench", "--workers", 1, *options)
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in result.stdout.splitlines()]


def test_postures_and_contacts_are_tried_and_a_bad_row_is_invalid(
    closed: tuple[Path, TrialRecord], tmp_path: Path
) -> None:
    mesh, record = closed
    end = record.closed
    assert end is not None
    far = record.X_OG.copy()
    far[2, 3] += 0.3
    named = joint_positions(HAND, 0.0, np.zeros(3))
    opened = [named[name] for name in HAND.joint_order]
    np.savez(
        tmp_path / "own.npz",
        object=np.array(["a", "a", "a"]),
        X_FG=np.array([record.X_OG, 0.0 * far, far]),
        q_grasp=np.array([end.q, end.q, end.q]),
        q_pregrasp=np.array([[np.nan] * 8, [np.nan] * 8, opened]),
    )
    held, none, lost = lines_of(tmp_path / "own.npz", "--object", mesh)
    assert held["success"] and held["file"].endswith("own.npz")
    assert none["reason"].startswith("invalid: the palm's pose must have 0 0 0 1")
    assert lost["reason"] == "moved"

    grasp = pack_grasp(end.contacts.p_OQ, end.contacts.nhat_Q_O)
    np.save(tmp_path / "18.npy", np.array([np.full(18, np.nan), grasp]))
    bad, fitted = lines_of(tmp_path / "18.npy", "--object", mesh)
    assert bad["reason"].startswith("invalid: number 1 is nan")
    assert fitted["success"]


def test_files_say_what_the_posture_says(tmp_path: Path, grasps: list[ClosedGrasp]) -> None:
    grasp = grasps[0]
    model = box_model(tmp_path, [0.06, 0.05, 0.10])
    X_OG = invert_pose(grasp.X_TO) @ grasp.X_TG
    squeeze = grasp.q + 0.05
    posture = Posture(X_OG, grasp.q, q_squeeze=squeeze)
    placed = PlacedObject(model=model, X_TO=grasp.X_TO)
    _, (path, why) = write_grasps(
        [(placed, posture), (placed, "it is none")], HAND, tmp_path / "to"
    )
    assert why == "it is none" and isinstance(path, Path)

    content = np.load(path, allow_pickle=True).item()
    place, root = (
        quaternion_poses(v[None, :3], v[None, 3:7])[0][0]
        for v in (content["obj_pose"], content["grasp_qpos"])
    )
    np.testing.assert_allclose(invert_pose(place) @ root @ HAND.X_BG, X_OG, atol=1e-12)
    assert sorted(content["grasp_qpos"][7:]) == sorted(grasp.q)
    np.testing.assert_allclose(content["squeeze_qpos"][7:] - content["grasp_qpos"][7:], 0.05)
    assert (content["pregrasp_qpos"][7:] <= content["grasp_qpos"][7:]).all()


def test_the_parts_of_an_object_are_cut_once_unless_their_file_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = box_model(tmp_path, [0.06] * 3)
    parts = [np.full((4 + k, 3), 0.1 * k) for k in range(11)]
    cut: list[Any] = []
    monkeypatch.setattr(mjcf, "convex_parts", lambda each: cut.append(each) or parts)
    for _ in range(2):
        found = mjcf.kept_convex_parts(model, tmp_path / "keep")
        assert all(np.array_equal(a, b) for a, b in zip(parts, found, strict=True))
    assert cut == [model]

    # Half a file, none, and one without a part.
    (path,) = (tmp_path / "keep").iterdir()
    content = path.read_bytes()
    np.savez(tmp_path / "empty.npz")
    for damaged in (content[:100], b"", (tmp_path / "empty.npz").read_bytes()):
        path.write_bytes(damaged)
        mjcf.kept_convex_parts(model, tmp_path / "keep")
        assert path.read_bytes() == content
    cut.clear()

    # Another object, and other rules.
    other = replace(model, collision_faces=model.collision_faces[::-1].copy())
    mjcf.kept_convex_parts(other, tmp_path / "keep")
    monkeypatch.setitem(mjcf.SETTINGS, "threshold", 0.03)
    mjcf.kept_convex_parts(other, tmp_path / "keep")
    assert cut == [other, other]


def test_workers_fit_and_cut_in_any_order(closed: tuple[Path, TrialRecord], tmp_path: Path) -> None:
    _, record = closed
    assert record.closed is not None
    points, normals = record.closed.contacts.p_OQ, record.closed.contacts.nhat_Q_O
    models = [box_model(tmp_path, [CUBE] * 3, f"1_box_{letter}") for letter in "abc"]
    numbers = pack_grasp(points, normals)
    placed = []
    for i, model in enumerate(models):
        asked = numbers + np.r_[np.tile([0.0, 0.0, 0.004 * i], 3), np.zeros(9)]
        asked[0] = np.nan if i == 2 else asked[0]
        (grasp,) = place_on_object(asked, PlacedObject(model=model, X_TO=standing(model)))
        placed.append(grasp)

    sent: list[int] = []

    def backwards(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        tasks = list(items)
        sent.append(len(tasks))
        return (function(item) for item in reversed(tasks))

    # Postures are those of their grasps.
    found = fitted_postures(placed, backwards)
    assert [thing for thing, _ in found] == [each.placed for each in placed]
    for (_, posture), grasp in zip(found[:2], placed, strict=False):
        assert isinstance(posture, Posture)
        np.testing.assert_array_equal(posture.X_OG, first_fit(grasp).X_OG)
    assert found[2][1] == "number 1 is nan, not finite"
    assert not np.array_equal(found[0][1].X_OG, found[1][1].X_OG)

    # The object of what is no grasp is not cut.
    write_grasps(found, HAND, tmp_path / "to", execute=backwards)
    assert sent == [2, 2]
    made = sorted(path.name for path in (tmp_path / "to" / OBJECTS).iterdir())
    assert made == sorted(model.name for model in models[:2])


def test_score_by_a_protocol_says_so_on_the_card(
    dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = (
        *("score", "--dataset", dataset / "grasping_oto.hdf5", "--reference", "constant"),
        *("--protocol", "dexgraspbench", "--per-object", 1, "--workers", 1),
        *("--out", tmp_path / "card", "--json", "--quiet"),
    )
    result = run(*given)
    assert result.exit_code == 0, result.output
    card = json.loads(result.stdout)
    assert card["settings"]["protocol"]["protocol"] == "dexgraspbench"
    assert set(card["settings"]["protocol"]["versions"]) == {"drakegrasp", "mujoco", "coacd"}
    assert set(card["measures"]) == {"headline", "objects"}
    known = {"penetration", "moved", "turned", "success"}
    assert set(card["sets"]["constant"]["outcomes"]) <= known
    assert " --protocol dexgraspbench " in card["again"]
    text = (tmp_path / "card" / "card.md").read_text()
    assert "lifted(d)" not in text and "JYChen18/DexGraspBench" in text

    # Convex parts stay in its folder: another score there cuts none.
    assert list((tmp_path / "card" / "convex_parts").iterdir())
    (tmp_path / "card" / "verdicts.jsonl").unlink()
    monkeypatch.setattr(mjcf, "convex_parts", pytest.fail)
    result = run(*given[:-2])
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "card" / "card.json").read_text()) == card
    assert "constant: " in result.stderr


@pytest.mark.parametrize("missing", ["mujoco", "coacd"])
@pytest.mark.parametrize("command", ["score", "verify"])
def test_a_missing_library_is_named(
    command: str, missing: str, dataset: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(name: str) -> object:
        return None if name == missing else object()

    monkeypatch.setattr(environment, "find_spec", found)
    rows = len(GraspDataset(dataset / "grasping_oto.hdf5", split="test"))
    np.save(tmp_path / "18.npy", np.full((rows, 18), np.nan))
    options = ("--dataset", dataset / "grasping_oto.hdf5", "--protocol", "dexgraspbench")
    given = ("--reference", "constant") if command == "score" else (tmp_path / "18.npy",)
    result = run(command, *given, *options, "--workers", 1)
    line = f"error: {missing} must be installed: pip install 'drakegrasp[peer]'"
    assert error_line(result) == line
