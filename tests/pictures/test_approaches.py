"""Approaches: from where palms come, what they cover, their map, and rays over objects."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import CERTIFIED, TRIALS, edit_file, make_dataset
from helpers.meshes import FIXED
from matplotlib.collections import LineCollection

from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.errors import DataError
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.approaches import (
    NEAR_DEG,
    approach_directions,
    coverage,
    map_directions,
    palm_poses_figure,
    view_rotation,
)
from drakegrasp.pictures.samplers import caption, compare_samplers, palm_rays
from drakegrasp.simulation.candidates import Candidates

CAP = 1.0 - np.cos(np.deg2rad(NEAR_DEG))


def directions(count: int) -> np.ndarray:
    values = np.random.default_rng(0).standard_normal((count, 3))
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def test_palms_come_from_against_their_axis() -> None:
    """Of an object that lies on its side, too."""
    lying = make_pose(rotation_about([1.0, 0.0, 0.0], np.pi / 2), [0.0, 0.0, 0.03])
    # A palm on +Oz that looks at the object; +Oz is -Ty then.
    palm = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.2])
    np.testing.assert_allclose(approach_directions(np.eye(4), palm[None]), [[0.0, 0.0, 1.0]])
    np.testing.assert_allclose(approach_directions(lying, palm[None]), [[0, -1, 0]], atol=1e-12)


def test_one_approach_covers_its_cap() -> None:
    up, slanted = np.array([[0.0, 0.0, 1.0]]), np.array([[0.6, 0.0, 0.8]])
    assert coverage(up) == pytest.approx(CAP, abs=1e-3)
    assert coverage(np.concatenate([up, slanted])) == pytest.approx(2 * CAP, abs=1e-3)
    assert coverage(np.concatenate([up, up])) == coverage(up)
    # Half of a cap on the horizon is below it.
    assert coverage(np.array([[1.0, 0.0, 0.0]])) == pytest.approx(CAP / 2, abs=1e-3)


def test_coverage_is_of_the_half_sphere_above() -> None:
    assert coverage(np.zeros((0, 3))) == 0.0
    assert coverage(-np.array([[0.0, 0.0, 1.0]])) == 0.0
    assert coverage(directions(5000)) == 1.0


def test_the_map_keeps_areas_and_azimuths() -> None:
    found = directions(200)
    places = map_directions(found)
    # The area within a place's circle is that of the cap above its direction: 2 pi (1 - z).
    np.testing.assert_allclose((places**2).sum(axis=1), 1.0 - found[:, 2], atol=1e-12)
    turned = places[:, 0] * found[:, 1] - places[:, 1] * found[:, 0]
    np.testing.assert_allclose(turned, 0.0, atol=1e-12)
    assert np.all((places * found[:, :2]).sum(axis=1) > 0.0)
    np.testing.assert_array_equal(map_directions(np.array([[0.0, 0.0, 1.0]])), [[0.0, 0.0]])


BOX = FIXED["10_box_tall"]
RAYS = np.array([[[0.2, 0.0, 0.0], [0.0, 0.0, 0.0]], [[0.0, 0.0, 0.2], [0.0, 0.0, 0.1]]])
NUMBERS = {
    "palm_rays": 87,
    "palm_poses": 200,
    "coverage": 0.541,
    "attempts": 1600,
    "successes": 22,
    "successes_per_1000_attempts": 13.75,
}


def test_rays_are_drawn_beside_each_other() -> None:
    figure = palm_poses_figure(
        BOX.vertices, BOX.faces, {"a": RAYS, "b": RAYS[:1]}, captions={"a": "x\ny"}, name="$$"
    )
    first, second = figure.axes
    assert (first.get_title(), second.get_title()) == ("a", "b")
    assert first.get_xlim() == second.get_xlim()
    # Those before the object's middle are drawn once; those behind it also shine through.
    segments = [
        segment
        for collection in first.collections
        if isinstance(collection, LineCollection)
        for segment in collection.get_segments()
    ]
    ends = (RAYS @ view_rotation().T)[..., :2]
    for ray in ends:
        assert any(np.allclose(ray, segment) for segment in segments)


def test_a_view_keeps_lengths_and_shows_up_as_up() -> None:
    R = view_rotation()
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0.0
    up = R @ [0.0, 0.0, 1.0]
    assert abs(up[0]) < 1e-12
    assert up[1] > 0.9


def test_a_caption_says_what_was_not_tried() -> None:
    text = caption(NUMBERS, {**NUMBERS, "coverage": 0.6}, 5)
    assert "87 of 200 palm rays" in text
    assert "54 % of the directions" in text
    assert "13.8 successes per 1,000 attempts (22 of 1,600)" in text
    assert "all 5 objects: 60 %; 13.8 per 1,000" in text
    assert "all" not in caption(NUMBERS, NUMBERS, 1)
    drawn = {**NUMBERS, "attempts": None, "successes": None, "successes_per_1000_attempts": None}
    assert caption(drawn, None, 5).endswith("not tried in this dataset")


def test_what_was_not_tried_has_no_successes(sound: Path) -> None:
    found = compare_samplers(sound)
    assert found.numbers["object"] == "1_box_a"
    tried, drawn = (found.numbers["of_object"][name] for name in ("rotations", "normals"))
    assert (tried["attempts"], tried["successes"]) == (12, 3)
    assert tried["successes_per_1000_attempts"] == 250.0
    # The made-up palm poses of the dataset have no rays; those that are drawn here have.
    assert (tried["palm_rays"], tried["coverage"]) == (0, 0.0)
    assert drawn["attempts"] is drawn["successes_per_1000_attempts"] is None
    assert drawn["palm_rays"] == drawn["palm_poses"] > 1000
    # A box has five sides: a cap of 10 degrees above, and half a cap at each of four.
    assert drawn["coverage"] == pytest.approx(3 * (1.0 - np.cos(np.deg2rad(10.0))), abs=1e-3)
    assert list(found.numbers["of_objects"]) == ["rotations"]
    assert found.numbers["of_objects"]["rotations"]["attempts"] == 36
    assert found.standoff == 0.12


def test_objects_without_trials_are_left_out(sound: Path, tmp_path: Path) -> None:
    """A build that adds meshes writes the manifest first."""
    out = Path(shutil.copytree(sound, tmp_path / "out"))
    manifest = read_manifest(out)
    more = replace(manifest.objects[0], name="0_new")
    write_manifest(replace(manifest, objects=(more, *manifest.objects)), out)
    assert compare_samplers(out).numbers == compare_samplers(sound).numbers


def test_both_samplers_have_numbers_of_their_own_datasets(sound: Path, tmp_path: Path) -> None:
    other = make_dataset(
        tmp_path / "other", tmp_path, overrides=[*CERTIFIED, "candidates.method=normals"]
    )
    for first, second in ((sound, other), (other, sound)):
        numbers = compare_samplers(first, second).numbers
        for method in ("normals", "rotations"):
            assert numbers["of_object"][method]["attempts"] == 12
            assert numbers["of_objects"][method]["successes"] == 9


def test_datasets_must_differ_by_the_sampler_alone(sound: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"candidates.method=normals .* got another candidates"):
        compare_samplers(sound, sound)
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
    rough = make_dataset(
        tmp_path / "a" / "out",
        tmp_path / "a",
        overrides=[
            *CERTIFIED,
            "candidates.method=normals",
            "physics.friction_hand=0.9",
            "filters.max_slip=0.02",
        ],
    )
    with pytest.raises(DataError, match=r"got another physics.friction_hand$"):
        compare_samplers(sound, rough)


def test_a_dataset_of_two_samplers_is_refused_and_says_what_it_is(out: Path) -> None:
    manifest = read_manifest(out)
    rules = manifest.config.candidates.model_copy(update={"method": ("normals", "rotations")})
    config = manifest.config.model_copy(update={"candidates": rules})
    write_manifest(replace(manifest, config=config), out)
    with pytest.raises(DataError, match=r"resting_poses 1, got normals and rotations and 1$"):
        compare_samplers(out)


def test_rays_end_on_the_surface(sound: Path) -> None:
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (3, 1, 1))
    poses[:, 2, 3] = [0.3, 0.4, 0.5]
    candidates = Candidates(
        X_OG=poses,
        distance=np.array([0.25, np.nan, 0.45]),
        resting=np.zeros(3, dtype=np.int64),
        source=np.zeros(3, dtype=np.int64),
        combinations=3,
        valid=3,
        distinct=3,
    )
    rays = palm_rays(candidates, 0.12, 10)
    np.testing.assert_allclose(rays[:, 1], [[0.0, 0.0, 0.05], [0.0, 0.0, 0.05]], atol=1e-12)
    np.testing.assert_allclose(rays[:, 0], [[0.0, 0.0, 0.17], [0.0, 0.0, 0.17]], atol=1e-12)
    assert len(palm_rays(candidates, 0.12, 1)) == 1


def test_attempts_that_the_simulator_did_not_decide_do_not_count(
    sound: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(sound, tmp_path / "out"))

    def time_out(file: h5py.File) -> None:
        file["trials/outcome"][2] = Outcome.TIMEOUT

    edit_file(out / TRIALS, time_out)
    numbers = compare_samplers(out).numbers
    assert numbers["of_object"]["rotations"]["attempts"] == 11
    assert numbers["of_objects"]["rotations"]["attempts"] == 35
