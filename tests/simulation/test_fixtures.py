"""Models of Drake as fixed surroundings: what is read, what stands where, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.machine import needs_egl
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.config import CameraConfig, Config
from drakegrasp.errors import ConfigError
from drakegrasp.frames import Array, make_pose, rotation_about, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.mesh.surfaces import convex_hull
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import Neighbourhood, Surroundings, surroundings_of
from drakegrasp.seeding import Stream
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.fixtures import load_surroundings
from drakegrasp.simulation.free import first_hit
from drakegrasp.simulation.pile import pile_up
from drakegrasp.vision.rendering import build_renderer, render

pytestmark = pytest.mark.sim

#: A bin of five boxes: sizes and centres [m], yaw [degree].
BIN = [
    ([0.40, 0.30, 0.01], [0.0, 0.0, -0.005], 0.0),
    ([0.02, 0.30, 0.10], [0.21, 0.0, 0.05], 0.0),
    ([0.02, 0.30, 0.10], [-0.21, 0.0, 0.05], 0.0),
    ([0.30, 0.02, 0.10], [0.0, 0.16, 0.05], 0.0),
    ([0.30, 0.02, 0.10], [0.05, -0.17, 0.05], 12.5),
]
#: Largest distance between a round shape and its hull [m].
FINE = 5e-4


def collision(name: str, geometry: str, pose: str = "0 0 0 0 0 0") -> str:
    return (
        f'<collision name="{name}"><pose degrees="true">{pose}</pose>'
        f"<geometry>{geometry}</geometry></collision>"
    )


def sdf(*collisions: str, pose: str = "0 0 0 0 0 0") -> str:
    """Return a model of one link."""
    link = f'<link name="body"><pose degrees="true">{pose}</pose>{"".join(collisions)}</link>'
    return f'<sdf version="1.9"><model name="thing">{link}</model></sdf>'


def box(size: list[float], place: list[float], yaw: float) -> str:
    numbers = " ".join(map(str, size))
    pose = f"{' '.join(map(str, place))} 0 0 {yaw}"
    return collision(f"box_{place}", f"<box><size>{numbers}</size></box>", pose)


def post(radius: float, length: float, pose: str) -> str:
    shape = f"<cylinder><radius>{radius}</radius><length>{length}</length></cylinder>"
    return collision("post", shape, pose)


def loaded(folder: Path, text: str, name: str = "own.sdf") -> Surroundings:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return load_surroundings(path)


def test_a_bin_of_boxes_gives_the_scenes_of_its_yaml(
    tmp_path: Path, cube: ObjectModel, config: Config
) -> None:
    """Equal to the last bit, also if its link is moved and its boxes are moved back."""
    boxes = [{"size": s, "position": p, "yaw_deg": yaw} for s, p, yaw in BIN]
    tree = {"extent": [0.15, 0.15], "drops": True, "boxes": boxes}
    due = loaded(tmp_path, json.dumps(tree), "own.yaml")
    for shift in (0.0, 0.1):
        moved = [box(s, [x - shift, y, z], yaw) for s, (x, y, z), yaw in BIN]
        found = loaded(tmp_path, sdf(*moved, pose=f"{shift} 0 0 0 0 0"))
        assert (found.name, found.drops, found.hulls) == ("own", True, ())
        for one, other in zip(found.boxes, due.boxes, strict=True):
            np.testing.assert_array_equal(one.X_TB, other.X_TB)
            np.testing.assert_array_equal(one.size, other.size)
    models, resting = [cube, cube], [standing(cube)] * 2
    X_TN = pile_up(models, resting, due, config, Stream(3, 0))
    np.testing.assert_array_equal(pile_up(models, resting, found, config, Stream(3, 0)), X_TN)


def test_a_file_of_models_places_them_and_joints_stay(tmp_path: Path) -> None:
    """A door that is open by default, in a model that a .dmd.yaml moves and turns."""
    door = """<robot name="rack">
      <link name="frame"/>
      <link name="door"><collision><origin xyz="0.1 0 0"/>
        <geometry><box size="0.2 0.01 0.2"/></geometry></collision></link>
      <joint name="hinge" type="revolute"><parent link="frame"/><child link="door"/>
        <origin xyz="0 0 0.2"/><axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
    </robot>"""
    (tmp_path / "rack.urdf").write_text(door)
    directives = f"""directives:
    - add_model:
        name: rack
        file: package://{tmp_path.name}/rack.urdf
        default_joint_positions: {{hinge: [0.5]}}
    - add_weld:
        parent: world
        child: rack::frame
        X_PC: {{translation: [0.1, 0.2, 0.0], rotation: !Rpy {{deg: [0, 0, 90]}}}}
    """
    (found,) = loaded(tmp_path, directives, "cell.dmd.yaml").boxes
    turn = make_pose(rotation_about([0.0, 0.0, 1.0], np.pi / 2.0 + 0.5), [0.1, 0.2, 0.2])
    np.testing.assert_allclose(found.X_TB, turn @ make_pose(np.eye(3), [0.1, 0, 0]), atol=2e-9)
    (closed,) = load_surroundings(tmp_path / "rack.urdf").boxes
    np.testing.assert_array_equal(closed.X_TB, make_pose(np.eye(3), [0.1, 0.0, 0.2]))


def test_yaml_adds_its_boxes_to_a_model_and_says_where_objects_lie(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    (tmp_path / "models" / "post.sdf").write_text(sdf(post(0.02, 0.3, "0.1 0 0.15 0 0 0")))
    own = "{size: [0.1, 0.1, 0.1], position: [0, 0, 0.05]}"
    text = f"extent: [0.3, 0.1]\ndrops: false\nboxes: [{own}]\nmodel: models/post.sdf\n"
    found = loaded(tmp_path, text, "own.yaml")
    assert (found.name, found.extent.tolist(), found.drops) == ("own", [0.3, 0.1], False)
    assert (len(found.boxes), len(found.hulls)) == (1, 1)


def ball(count: int) -> Array:
    """Return points (count, 3) all over the unit sphere."""
    points = np.random.default_rng(0).normal(size=(count, 3))
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))


def on_cylinder(radius: float, half: float) -> Array:
    points = ball(3000)
    around = points[:, :2] / np.linalg.norm(points[:, :2], axis=1, keepdims=True)
    side = np.column_stack([radius * around, half * points[:, 2]])
    return np.concatenate([side, side * [1, 1, 0] + [0, 0, half], side * [1, 1, 0] - [0, 0, half]])


@pytest.mark.parametrize(
    ("geometry", "surface"),
    [
        ("<sphere><radius>0.2</radius></sphere>", 0.2 * ball(3000)),
        (
            "<ellipsoid><radii>0.25 0.1 0.02</radii></ellipsoid>",
            np.array([0.25, 0.1, 0.02]) * ball(3000),
        ),
        (
            "<capsule><radius>0.05</radius><length>0.4</length></capsule>",
            0.05 * ball(3000) + np.sign(ball(3000)[:, 2:]) * [0.0, 0.0, 0.2],
        ),
        ("<cylinder><radius>0.15</radius><length>0.3</length></cylinder>", on_cylinder(0.15, 0.15)),
        ("<cylinder><radius>0.004</radius><length>1</length></cylinder>", on_cylinder(0.004, 0.5)),
    ],
    ids=["sphere", "ellipsoid", "capsule", "cylinder", "wire"],
)
def test_round_shapes_are_within_half_a_millimetre(
    tmp_path: Path, geometry: str, surface: Array
) -> None:
    """Of their hull, which does not exceed them."""
    (hull,) = loaded(tmp_path, sdf(collision("round", geometry))).hulls
    solid = convex_hull(hull.corners)
    mesh = trimesh.Trimesh(solid.vertices, solid.faces)
    offsets = (mesh.face_normals * mesh.triangles_center).sum(axis=1)
    above = (surface @ mesh.face_normals.T - offsets).max(axis=1)
    assert above.min() > -1e-8 and 0.0 < above.max() < FINE


def test_hulls_are_stored_to_the_bit_and_move(tmp_path: Path) -> None:
    """Shapes that are turned lie where the file says; meshes are scaled."""
    trimesh.creation.icosphere(subdivisions=1, radius=5.0).export(tmp_path / "ball.obj")
    mesh = "<mesh><uri>ball.obj</uri><scale>0.01 0.01 0.02</scale></mesh>"
    tilted = collision("ramp", "<box><size>0.2 0.1 0.02</size></box>", "0 0.2 0.1 30 0 0")
    found = loaded(tmp_path, sdf(tilted, collision("ball", mesh, "0.3 0 0.1 0 0 0")))
    again = surroundings_of("own", json.loads(json.dumps(found.tree())), "own")
    assert found.boxes == () and len(found.hulls) == 2
    for one, other in zip(found.hulls, again.hulls, strict=True):
        np.testing.assert_array_equal(one.corners, other.corners)
    ramp, ball_ = (hull.corners for hull in found.hulls)
    turn = make_pose(rotation_about([1.0, 0.0, 0.0], np.pi / 6.0), [0.0, 0.2, 0.1])
    due = transform_points(turn, np.array([[0.1, 0.05, 0.01], [-0.1, 0.05, -0.01]]))
    for point in due:
        assert np.linalg.norm(ramp - point, axis=1).min() < 2e-9
    np.testing.assert_allclose(np.ptp(ball_, axis=0), [0.1, 0.1, 0.2], rtol=0.15)
    np.testing.assert_allclose(ball_.mean(axis=0), [0.3, 0.0, 0.1], atol=1e-6)

    around = Neighbourhood(X_TN=np.zeros((0, 4, 4)), walls=found.walls)
    moved = around.moved(make_pose(rotation_about([0.0, 0.0, 1.0], np.pi / 2.0), [1.0, 0.0, 0.0]))
    np.testing.assert_allclose(moved.walls[1].corners.mean(axis=0), [1.0, 0.3, 0.1], atol=1e-6)
    assert moved.digest() != around.digest()


def test_hand_meets_a_post_and_an_object_falls_on_a_drum(
    tmp_path: Path, cube: ObjectModel, config: Config, hand: Hand
) -> None:
    X_TO, attempt = standing(cube), from_above(cube, STANDOFF)
    q = np.zeros(len(hand.joint_order))
    hits = []
    for y in (0.046, 0.6):
        place = X_TO[:3, :3] @ [0.0, y, 0.0] + [0.0, 0.0, 0.15]
        pose = " ".join(map(str, place.tolist())) + " 0 0 0"
        found = loaded(tmp_path, sdf(post(0.01, 0.3, pose)))
        around = Neighbourhood(X_TN=np.zeros((0, 4, 4)), walls=found.walls)
        scene = build_scene(cube, config.physics, hand, around=around)
        body = first_hit(scene, X_TO, attempt, q)
        hits.append("" if body is None else scene.plant.get_body(body).name())
    assert hits == ["table", ""]

    # The first cube stands beside a drum, and the second one is dropped onto it.
    drum = loaded(tmp_path, sdf(post(0.11, 0.4, "0 0 0.2 0 0 0")))
    X_TN = pile_up([cube, cube], [X_TO, X_TO], drum, config, Stream(3, 0))
    lows = [transform_points(X, cube.collision_vertices)[:, 2].min() for X in X_TN]
    np.testing.assert_allclose(lows, [0.0, 0.4], atol=5e-4)


@needs_egl
def test_a_post_hides_an_object_from_a_camera(tmp_path: Path, cube: ObjectModel) -> None:
    """In the mask and in the depth, in front of the object and not behind it."""
    X_TO, config = standing(cube), CameraConfig()
    looking = np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    X_TC = make_pose(looking, [0.6, 0.0, X_TO[2, 3]])
    views = []
    for x in (0.2, -0.2):
        found = loaded(tmp_path, sdf(post(0.01, 0.3, f"{x} 0 0.15 0 0 0")))
        around = Neighbourhood(X_TN=np.zeros((0, 4, 4)), walls=found.walls)
        views.append(render(build_renderer(cube, config, around), X_TO, X_TC))
    hidden, seen = views
    middle = hidden.mask.shape[0] // 2, hidden.mask.shape[1] // 2
    assert seen.mask[middle] == 1 and hidden.mask[middle] == 0
    assert hidden.depth[middle] == pytest.approx(0.6 - 0.2 - 0.01, abs=FINE)
    assert 0 < (hidden.mask == 1).sum() < (seen.mask == 1).sum()


def bowl() -> str:
    """Write a bowl as a mesh; its hull closes its hollow."""
    mesh = trimesh.creation.annulus(r_min=0.08, r_max=0.1, height=0.1)
    return trimesh.exchange.obj.export_obj(mesh)


MESH = "<mesh><uri>{}</uri></mesh>"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            sdf(collision("bowl", MESH.format("bowl.obj"))),
            r"own.sdf: thing::bowl must be convex, as its hull is simulated, got a mesh that "
            r"fills 3\d\.\d% of its hull: make it of convex pieces",
        ),
        (
            sdf(collision("floor", "<plane><normal>0 0 1</normal></plane>")),
            "thing::floor must be a box, a round solid or a convex mesh, got HalfSpace",
        ),
        (sdf(), "own.sdf: must have collision shapes, got none"),
        (sdf(collision("none", MESH.format("none.obj"))), "must be a model that Drake reads, got"),
        ("<sdf", "must be a model that Drake reads, got"),
        (
            sdf(collision("flat", MESH.format("flat.obj"))),
            "flat must have a mesh that can be read, got",
        ),
        (
            sdf(post(20.0, 300.0, "0 0 0 0 0 0")),
            "must be within 5 m of the table's centre, got a shape that reaches 150 m: check units",
        ),
    ],
    ids=["bowl", "half-space", "no shapes", "no mesh", "no XML", "flat", "millimetres"],
)
def test_what_cannot_be_simulated_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "bowl.obj").write_text(bowl())
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n")
    with pytest.raises(ConfigError, match=message) as raised:
        loaded(tmp_path, text)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("model: none.sdf", "none.sdf: must be a model that Drake reads, got"),
        ("model: own.yaml", "own.yaml: must be a model that Drake reads, got"),
        ("hulls: [{vertices: [[0, 0, 0]]}]", "hulls.0.vertices: must be a list of at least 4"),
        (
            "hulls: [{vertices: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]}]",
            "own.yaml: hull 0 must be a solid of which Drake can make tetrahedra, got 4 points in",
        ),
        ("walls: []", "walls: must be a known key, got an unknown one"),
    ],
)
def test_yaml_without_solids_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        loaded(tmp_path, f"extent: [0.1, 0.1]\n{text}\n", "own.yaml")


@pytest.mark.parametrize("name", ["nothing", "nothing.sdf"])
def test_what_is_no_file_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"a YAML file or a model \(.*\), got '{name}'"):
        load_surroundings(name)
