"""Grasps verified in a scene of a dataset: neighbours count, and one object is as one alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drakegrasp.api.verifying import verify_grasp, verify_grasps
from drakegrasp.config import Config
from drakegrasp.dataset.clutter import Clutter, load_scene
from drakegrasp.dataset.scenes import SceneDataset
from drakegrasp.errors import DataError, DrakegraspError, GraspError
from drakegrasp.frames import invert_pose, make_pose, rotation_about
from drakegrasp.generation.clutter import ClutterRequest, make_clutter
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.fixtures import load_surroundings
from drakegrasp.simulation.placement import place_object

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def scene(small_clutter: Path) -> Clutter:
    """Two boxes on the table."""
    return load_scene(small_clutter / "clutter.hdf5", 2)


@pytest.fixture(scope="module")
def grasp(small_clutter: Path, scene: Clutter) -> np.ndarray:
    """A kept grasp of the scene, in the frame of its object."""
    data = SceneDataset(small_clutter / "clutter.hdf5", split="test")
    grasps, rows = data.tables["grasps"], data.rows_in(2)
    row = next(row for row in rows if grasps["kept"][row])
    packed = pack_grasp(grasps["p_TQ"][row], grasps["nhat_Q_T"][row])
    return transform_grasp(invert_pose(scene.X_TO[grasps["object"][row]]), packed)


def beside(scene: Clutter, y: float) -> Clutter:
    """Return the scene with object 1 beside object 0, moved along its y-axis."""
    X_TO = scene.X_TO.copy()
    X_TO[1] = X_TO[0]
    X_TO[1, :3, 3] += X_TO[0, :3, :3] @ [0.0, y, 0.0]
    return replace(scene, X_TO=X_TO)


def test_a_hand_that_presses_on_a_neighbour_fails(scene: Clutter, grasp: np.ndarray) -> None:
    verdict = verify_grasp(grasp, on=beside(scene, -0.055), object=0)
    assert verdict.outcome is Outcome.NEIGHBOUR_HIT and not verdict.clean
    assert "the closing hand presses on another object" in verdict.explain()


def test_a_neighbour_that_is_moved_is_told(scene: Clutter, grasp: np.ndarray) -> None:
    verdict = verify_grasp(grasp, on=beside(scene, 0.065), object=0)
    moved = verdict.disturbance
    assert moved is not None and moved.shift > 0.01 and not moved.is_small and not verdict.clean
    assert f"Of its neighbours 11_box_slim is shifted most, by {1e3 * moved.shift:.1f} mm" in (
        verdict.explain()
    )


def test_a_far_neighbour_is_left_in_place_in_any_frame(
    scene: Clutter, grasp: np.ndarray, tmp_path: Path
) -> None:
    far = beside(scene, 0.4)
    own = verify_grasp(grasp, on=far, object=0)
    assert own.disturbance is not None and own.disturbance.is_small
    assert own.clean == own.kept
    in_table = transform_grasp(scene.X_TO[0], grasp)
    (other,) = verify_grasps(in_table, on=far, object=0, frame="table")
    assert other.outcome is own.outcome and other.disturbance == own.disturbance
    own.save_html(tmp_path / "own.html")
    assert b"neighbour" in (tmp_path / "own.html").read_bytes()


def test_an_object_alone_in_its_scene_is_as_without_a_scene(
    small_dataset: Path, small_meshes: Path, small_config: Config, grasp: np.ndarray, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(small_dataset, tmp_path / "out"))
    table = [load_surroundings("table")]
    make_clutter(out, ClutterRequest(scenes=1, objects=(1, 1), surroundings=table, tries=0))
    alone = load_scene(out / "clutter.hdf5", 0)
    (name,) = alone.names
    placed = place_object(small_meshes / f"{name}.obj", config=small_config)
    due = verify_grasp(grasp, on=placed)
    # Turned on the table and moved, with the rounding of poses in scenes.
    turn = rotation_about([0.0, 0.0, 1.0], 0.7) @ rotation_about([1.0, 0.0, 0.0], 1e-6)
    elsewhere = replace(alone, X_TO=make_pose(turn, [0.1, -0.2, 0.0]) @ alone.X_TO)
    for object_, scene in ((0, alone), (name, alone), (name, elsewhere)):
        verdict = verify_grasp(grasp, on=scene, object=object_)
        assert verdict.findings().keys() == due.findings().keys()
        assert verdict.explain() == due.explain() and verdict.disturbance is None
        for mine, its in zip(verdict.tries, due.tries, strict=True):
            assert mine.trial.outcome is its.trial.outcome
            for end in ("closed", "lift"):
                ends = getattr(mine.trial, end), getattr(its.trial, end)
                assert all(ends) or not any(ends)
                if all(ends):
                    np.testing.assert_array_equal(*(each.contacts.f_Q_O for each in ends))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, r"object must be given with a scene, Clutter\(11_box_slim, .*; table\), got None"),
        ({"object": 2}, "object must be 0 to 1 or a name that is once in 11_box_slim, .*, got 2"),
        ({"object": True}, "object must be 0 to 1 or a name that .*, got True"),
        ({"object": "11_box_slim"}, "object must be 0 to 1 or a name that .*, got '11_box_slim'"),
        ({"object": 0, "units": "cm"}, "units must be None for a prepared object, got 'cm'"),
        ({"object": 0, "X_TO": np.eye(4)}, "X_TO must be None for an object among others, got a"),
        ({"object": 0, "row": 1}, "rows must be given with a GraspDataset only, got"),
        ({"object": 0, "frame": "camera"}, "X_TC must be the camera's pose"),
    ],
)
def test_wrong_arguments_get_one_line(
    scene: Clutter, grasp: np.ndarray, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(DrakegraspError, match=message):
        verify_grasp(grasp, on=scene, **arguments)


def test_an_object_needs_a_scene_and_a_scene_its_file(
    small_clutter: Path, small_meshes: Path, grasp: np.ndarray
) -> None:
    with pytest.raises(GraspError, match="object must be given with a scene only, got 0"):
        verify_grasp(grasp, on=small_meshes / "11_box_slim.obj", object=0)
    with pytest.raises(GraspError, match="number must be that of a scene, 0 to 2, got 3"):
        load_scene(small_clutter / "clutter.hdf5", 3)
    with pytest.raises(DataError, match=r"nothing\.hdf5"):
        load_scene(small_clutter / "nothing.hdf5", 0)
