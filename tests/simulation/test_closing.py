"""Closing the hand by geometry: jaws on a box and a ball, whose features have closed forms.

The jaws are 80 mm apart and slide by up to 40 mm each along Gy; their tips are 100 mm ahead.
"""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.hands import slider_fingers, write_slider

from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.mesh.cloud import Solid
from drakegrasp.mesh.distance_field import make_distance_field
from drakegrasp.simulation.closing import closing_features, closing_positions

#: Distance of the tips from the palm, and of a jaw from the middle; half the width of the box [m].
TIPS, JAW, HALF = 0.10, 0.04, 0.02
#: Height of the palm, whose tips then are 15 mm above the table [m].
HEIGHT = 0.115
#: Distances are read from a grid, which ends 5 mm beside a solid; and points of a pad are 3 mm
#: apart [m].
BLUR, SPACING = 2e-4, 3e-3


def solid(mesh: trimesh.Trimesh) -> Solid:
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.int32)
    return Solid(field=make_distance_field(vertices, faces), middle=np.asarray(mesh.center_mass))


def box(width: float = 2 * HALF, y: float = 0.0) -> trimesh.Trimesh:
    """Return a box on the table, 60 mm long and 80 mm high."""
    mesh = trimesh.creation.box([0.06, width, 0.08])
    return mesh.apply_translation([0.0, y, 0.04])


def ball() -> trimesh.Trimesh:
    """Return a ball of 60 mm, with its middle 50 mm above the table."""
    return trimesh.creation.icosphere(4, 0.03).apply_translation([0.0, 0.0, 0.05])


def down(*, x: float = 0.0, y: float = 0.0, z: float = HEIGHT) -> Array:
    """Return the pose of a palm that looks down; its Gy is -Ty."""
    return make_pose(np.diag([1.0, -1.0, -1.0]), [x, y, z])


@pytest.fixture(scope="module")
def jaws(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    """Two jaws, each with a motor."""
    return load_hand(write_slider(tmp_path_factory.mktemp("slider")))


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Hand:
    """Two jaws with one motor."""
    fingers = slider_fingers(20.0, finger="left")
    return load_hand(write_slider(tmp_path_factory.mktemp("shared"), fingers=fingers))


def test_jaws_stop_at_the_faces_of_a_box(jaws: Hand) -> None:
    X_TG = np.stack([down(), down(y=0.01)])
    found = closing_features(solid(box()), jaws, 0.0, X_TG)
    # The second palm is 10 mm beside the middle, and each jaw has its own motor.
    travel = np.array([[0.02, 0.02], [0.03, 0.01]])
    np.testing.assert_allclose(closing_positions(solid(box()), jaws, 0.0, X_TG), travel, atol=BLUR)
    assert (found["gap"] < BLUR).all()
    assert found["touch"].all() and found["robust"].all()
    np.testing.assert_allclose(found["push"], 1.0, atol=1e-3)
    np.testing.assert_allclose(found["table"], HEIGHT - TIPS, atol=1e-6)


def test_two_opposed_contacts_balance(jaws: Hand) -> None:
    """The jaws meet a ball at its equator, where forces and moments cancel."""
    found = closing_features(solid(ball()), jaws, 0.0, down()[None])
    travel = closing_positions(solid(ball()), jaws, 0.0, down()[None])
    np.testing.assert_allclose(travel, JAW - 0.03, atol=SPACING / 4)
    assert found["push"] > 0.98
    assert found["opposition"] > 0.9
    assert found["arm"] < SPACING
    # Beside the middle, the normals point away from it.
    beside = closing_features(solid(ball()), jaws, 0.0, down(x=0.02)[None])
    assert beside["opposition"] < 0.8 and beside["push"] < found["push"]
    assert beside["score"] < found["score"]


def test_a_jaw_that_ends_before_the_object_has_a_gap(jaws: Hand) -> None:
    """A wall 4.5 to 14.5 mm beside the middle, which one jaw meets; the other one ends at 0."""
    found = closing_features(solid(box(width=0.01, y=-0.0095)), jaws, 0.0, down()[None])
    np.testing.assert_allclose(found["gap"], 0.0045, atol=BLUR)
    assert found["touch"].tolist() == [[0.0, 1.0]]
    assert found["score"] > 0.0 and not found["robust"].any()
    # One contact balances nothing, and none does, above the wall.
    above = closing_features(solid(box(width=0.01)), jaws, 0.0, down(z=0.25)[None])
    assert not above["touch"].any()
    assert found["opposition"] == above["opposition"] == 0.0


def test_jaws_with_one_motor_stop_together(shared: Hand) -> None:
    """2 mm beside the middle: the first jaw stops after 18 mm, and the other has 4 mm to go."""
    found = closing_features(solid(box()), shared, 0.0, down(y=0.002)[None])
    np.testing.assert_allclose(found["gap"], 0.004, atol=BLUR)
    travel = closing_positions(solid(box()), shared, 0.0, down(y=0.002)[None])
    np.testing.assert_allclose(travel, 0.018, atol=BLUR)


def test_a_hand_may_begin_to_close_from_other_positions(jaws: Hand) -> None:
    """At 10 mm it still stops at the faces; at 25 mm the jaws are 5 mm within the box."""
    starts = np.array([[0.01, 0.01], [0.025, 0.025]])
    found = closing_features(solid(box()), jaws, 0.0, np.stack([down()] * 2), closing=starts)
    np.testing.assert_allclose(found["gap"][0], 0.0, atol=BLUR)
    assert (found["score"] > 0.0).tolist() == found["robust"].tolist() == [True, False]
    np.testing.assert_allclose(found["clearance"][1], -0.005, atol=BLUR)
