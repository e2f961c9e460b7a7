"""Closing the hand by geometry: jaws on a box and a ball, whose features have closed forms.

The jaws are 80 mm apart and slide by up to 40 mm each along Gy; their tips are 100 mm ahead. The
sampler `closing`: which palms it draws, and that they repeat themselves to the bit.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.builds import build
from helpers.hands import slider_fingers, write_linked, write_slider
from helpers.objects import model_of

from drakegrasp.config import Config
from drakegrasp.errors import HandError
from drakegrasp.frames import Array, make_pose, rotation_about
from drakegrasp.grasp import NEAR_SHIFT, NEAR_TURN
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.mesh.cloud import Solid
from drakegrasp.mesh.distance_field import make_distance_field
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.executor import run_here
from drakegrasp.shapes import kitchen
from drakegrasp.simulation.attempt import Source
from drakegrasp.simulation.candidates import Candidates, Drawing
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


#: Full extents of a tall box, which leaves all sides free [m].
TALL = (0.05, 0.06, 0.16)


def meshes() -> dict[str, trimesh.Trimesh]:
    return {
        "tall": trimesh.creation.box(TALL),
        "low": trimesh.creation.box([0.05, 0.06, 0.04]),
        "ball": trimesh.creation.icosphere(3, 0.03),
        "mug": kitchen.mug(radius=0.04, height=0.10, handle_reach=0.03, handle_radius=0.006),
        "plate": trimesh.creation.box([0.3, 0.3, 0.004]),
    }


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], ObjectModel]:
    """Returns the object of a name."""
    folder = tmp_path_factory.mktemp("meshes")
    made = {name: model_of(mesh, folder, f"1_{name}_a") for name, mesh in meshes().items()}
    return made.__getitem__


def closing(hand: str | Path = "barrett", **values: object) -> Config:
    return load_config(overrides=["candidates.method=closing", f"hand={hand}"], **values)


def standing(model: ObjectModel) -> Array:
    return make_pose(np.eye(3), [0.0, 0.0, model.half_extents[2]])


def draw(model: ObjectModel, most: int, config: Config | None = None) -> Candidates:
    return Drawing(model, standing(model), config or closing()).candidates(most)


def assert_equal(one: Candidates, two: Candidates) -> None:
    for name in ("X_OG", "distance", "spread", "preshape_index", "resting", "source"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_rounding_of_the_resting_pose_changes_no_bit(model: Callable[[str], ObjectModel]) -> None:
    """The pose is simulated; nor do its place and its turn about the vertical matter."""
    first = draw(model("tall"), 60)
    for axis, turn in (([1.0, 0.0, 0.0], 0.0), ([0.6, -0.8, 0.0], 1.0)):
        tilt = make_pose(rotation_about(axis, 1e-9), [0.3 * turn, -turn, 1e-9])
        yaw = make_pose(rotation_about([0.0, 0.0, 1.0], turn), np.zeros(3))
        X_TO = tilt @ yaw @ standing(model("tall"))
        assert (standing(model("tall")) != X_TO).any()
        assert_equal(Drawing(model("tall"), X_TO, closing()).candidates(60), first)
    # An object on its side has other palms.
    lying = make_pose([[0, 0, 1], [1, 0, 0], [0, 1, 0]], [0.0, 0.0, TALL[1] / 2])
    other = Drawing(model("tall"), lying, closing()).candidates(60)
    assert (other.X_OG[:5] != first.X_OG[:5]).any()


@pytest.mark.parametrize("hand", ["barrett", "allegro_four"])
def test_a_palm_has_a_spread_and_a_preshape_of_the_hand(
    model: Callable[[str], ObjectModel], hand: str
) -> None:
    config, described = closing(hand), load_hand(hand)
    drawn = draw(model("low"), 40, config)
    assert (drawn.source == Source.CLOSING).all()
    assert set(drawn.spread) <= set(np.deg2rad(described.spreads_deg))
    assert len(set(drawn.spread)) == min(2, len(described.spreads_deg))
    preshapes = range(len(described.preshapes)) if described.preshapes else [-1]
    assert set(drawn.preshape_index) <= set(preshapes)


def test_first_palms_are_distinct(model: Callable[[str], ObjectModel]) -> None:
    X = draw(model("tall"), 24).X_OG
    shift = np.linalg.norm(X[:, None, :3, 3] - X[None, :, :3, 3], axis=2)
    cosine = (np.einsum("aij,bij->ab", X[:, :3, :3], X[:, :3, :3]) - 1.0) / 2.0
    turn = np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))
    near = (shift < NEAR_SHIFT) & (turn < NEAR_TURN)
    assert near.sum() == len(X)


@pytest.mark.parametrize("name", ["ball", "mug"])
@pytest.mark.parametrize("hand", ["barrett", "allegro", "leap", "franka"])
def test_palms_close_on_small_and_hollow_things(
    model: Callable[[str], ObjectModel], hand: str, name: str
) -> None:
    drawn = draw(model(name), 20, closing(hand))
    assert len(drawn) == 20
    p_TG = (standing(model(name)) @ drawn.X_OG)[:, :3, 3]
    assert (p_TG[:, 2] > 0.0).all()
    # A hand that closes on something this small is beside it.
    assert np.linalg.norm(drawn.X_OG[:, :3, 3], axis=1).max() < 0.25


def test_where_nothing_closes_there_is_no_palm(model: Callable[[str], ObjectModel]) -> None:
    drawn = draw(model("plate"), 1000)
    assert len(drawn) == 0
    # The other sampler goes on.
    config = load_config(overrides=["candidates.method=[closing, normals]"])
    assert set(draw(model("plate"), 5, config).source) == {Source.NORMALS}


def test_a_hand_whose_fingers_share_a_link_is_refused_before_a_build(tmp_path: Path) -> None:
    config = closing(write_linked(tmp_path))
    with pytest.raises(HandError) as caught:
        build([], tmp_path / "out", config, run_here, show=False)
    must = "hand must be one whose fingers share no link for the sampler closing, got pincer"
    assert str(caught.value).startswith(must) and "\n" not in str(caught.value)
    assert not (tmp_path / "out").exists()
