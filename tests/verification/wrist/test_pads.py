"""Fingertips as smooth functions: against exact distances, finite differences and Drake."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from helpers.hands import PINCER_SDF, write_pincer
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlantConfig
from pydrake.systems.framework import DiagramBuilder

from drakegrasp.errors import HandError
from drakegrasp.hand import shapes
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.parsing import add_model
from drakegrasp.hand.shapes import hull_triangles, link_shapes
from drakegrasp.verification.wrist_problem import (
    ROUNDING,
    make_pads,
    nearest_on_pads,
    signed_distance,
)

#: Half edges of the box among the bodies below [m].
HALF = np.array([0.012, 0.01, 0.03])
#: Rounding of plane offsets when planes are merged [m].
MERGED = 2e-6


def bodies():
    """Return corners of a box, a tetrahedron and a Barrett fingertip: few planes and many."""
    hand = load_hand()
    tetrahedron = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.02, 0.0], [0.0, 0.0, 0.04]])
    fingertip = np.concatenate(link_shapes(hand.model)[hand.fingertip_links[0]])
    return [trimesh.creation.box(2.0 * HALF).vertices, tetrahedron, fingertip]


def whole_pads(corners):
    """Return fingertips that are pads all over."""
    return make_pads(corners, [()] * len(corners), [hull_triangles(c) for c in corners])


@pytest.fixture(scope="module")
def pads():
    return whole_pads(bodies())


@pytest.fixture(scope="module")
def hulls():
    return [trimesh.convex.convex_hull(corners) for corners in bodies()]


def points_about(hulls, seed):
    """Return one point for each hull, within its box made larger by 10 mm."""
    rng = np.random.default_rng(seed)
    low, high = np.swapaxes([hull.bounds for hull in hulls], 0, 1)
    return np.asarray(rng.uniform(low - 0.01, high + 0.01))


def highest_plane(hull, p):
    """Return the largest height of a point above a face's plane."""
    return float(np.einsum("ij,ij->i", p - hull.triangles[:, 0], hull.face_normals).max())


def hull_distance(hull, p):
    """Return trimesh's distance outside of the hull, negative inside."""
    return -float(trimesh.proximity.signed_distance(hull, p[None])[0])


@pytest.mark.parametrize("seed", range(20))
def test_smooth_distance_is_over_the_planes_by_its_rounding_at_most(pads, hulls, seed):
    p = points_about(hulls, seed)
    distance = signed_distance(pads, p).distance
    exact = np.array([highest_plane(hull, q) for hull, q in zip(hulls, p, strict=True)])
    planes = np.isfinite(pads.offsets).sum(axis=1)
    assert np.all(distance >= exact - MERGED)
    assert np.all(distance <= exact + ROUNDING * np.log(planes) + MERGED)
    # Where the planes are clear about a side, so is the smooth distance.
    clear = np.abs(exact) > ROUNDING * np.log(planes) + MERGED
    inside = [hull.contains(q[None])[0] for hull, q in zip(hulls, p, strict=True)]
    np.testing.assert_array_equal((distance < 0.0)[clear], np.array(inside)[clear])


@pytest.mark.parametrize("seed", range(10))
def test_nearest_point_is_trimeshs_own(pads, hulls, seed):
    p = points_about(hulls, 200 + seed)
    near = nearest_on_pads(pads, p)
    for hull, q, found in zip(hulls, p, near, strict=True):
        expected, distance, _ = trimesh.proximity.closest_point(hull, q[None])
        assert np.linalg.norm(found - q) == pytest.approx(distance[0], abs=1e-9)
        # Of inside a body two faces may be equally near; then only the distance is given.
        if not hull.contains(q[None])[0]:
            np.testing.assert_allclose(found, expected[0], atol=1e-9)
        assert abs(hull_distance(hull, found)) < 1e-9


# The pad region


#: A box with edges of 20, 20 and 60 mm is a pad above x = 0, and below y = 5 mm.
REGION = ((2.0, 0.0, 0.0, 0.0), (0.0, -1.0, 0.0, -0.005))


def half_box():
    """Return two boxes, the first a pad in `REGION` only."""
    corners = trimesh.creation.box([0.02, 0.02, 0.06]).vertices
    whole = hull_triangles(corners)
    half = whole
    for half_space in REGION:
        half = shapes._clip(half, half_space)
    return make_pads([corners, corners], [REGION, ()], [half, whole])


def test_pad_ends_at_its_region_without_a_face_there():
    """Area of half a box, without the cuts: an end, and parts of two ends and of two sides."""
    pads = half_box()
    area = [float(trimesh.triangles.area(triangles).sum()) for triangles in pads.triangles]
    assert area[0] == pytest.approx(0.015 * 0.06 + 2.0 * 0.01 * 0.015 + 0.01 * 0.06)
    assert area[1] == pytest.approx(4.0 * 0.02 * 0.06 + 2.0 * 0.02**2)


def test_nearest_point_of_a_pad_is_not_on_a_cut():
    """Before the middle of the removed half, the pad begins at its border."""
    inside = np.tile([0.002, 0.004, 0.0], (2, 1))
    near = nearest_on_pads(half_box(), inside)
    assert np.allclose(near, [[0.01, 0.004, 0.0], [0.002, 0.01, 0.0]])
    outside = np.tile([-0.012, 0.0, 0.0], (2, 1))
    near = nearest_on_pads(half_box(), outside)
    assert np.allclose(near[:, 0], [0.0, -0.01])
    assert abs(near[0, 1]) == pytest.approx(0.01) or abs(near[0, 2]) == pytest.approx(0.03)


def test_point_outside_the_region_is_told_by_how_much():
    p = np.tile([-0.003, 0.006, 0.0], (2, 1))
    contact = signed_distance(half_box(), p)
    assert np.allclose(contact.outside, [[0.003, 0.001], [0.0, 0.0]])
    assert np.allclose(contact.outside_gradient[0], [[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    assert not contact.outside_gradient[1].any()
    within = signed_distance(half_box(), np.tile([0.003, 0.001, 0.0], (2, 1)))
    assert not within.outside.any()
    assert not within.outside_gradient.any()


# The shapes of links


def with_shape(folder, shape):
    """Write a gripper whose left finger is one shape."""
    capsule = "<capsule><radius>0.01</radius><length>0.08</length></capsule>"
    assert capsule in PINCER_SDF
    return write_pincer(folder, PINCER_SDF.replace(capsule, shape))


SHAPES = {
    "box": "<box><size>0.02 0.03 0.08</size></box>",
    "cylinder": "<cylinder><radius>0.01</radius><length>0.08</length></cylinder>",
    "capsule": "<capsule><radius>0.01</radius><length>0.08</length></capsule>",
    "sphere": "<sphere><radius>0.02</radius></sphere>",
}


@pytest.mark.parametrize("kind", SHAPES)
def test_shapes_reach_as_far_as_drakes(tmp_path, kind):
    """In any direction each link ends where Drake's distance from a far point says."""
    hand, far, rng = load_hand(with_shape(tmp_path, SHAPES[kind])), 1e3, np.random.default_rng(0)
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(MultibodyPlantConfig(time_step=0.01), builder)
    add_model(plant, hand.model)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName(hand.palm_link))
    plant.Finalize()
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    for link, parts in link_shapes(hand.model).items():
        body = plant.GetBodyByName(link)
        own = set(plant.GetCollisionGeometriesForBody(body))
        assert len(own) == len(parts)
        if not parts:
            continue
        X_WB = body.EvalPoseInWorld(plant.GetMyContextFromRoot(context)).GetAsMatrix4()
        for direction in rng.normal(size=(12, 3)):
            d_B = direction / np.linalg.norm(direction)
            p_W = X_WB[:3, :3] @ (far * d_B) + X_WB[:3, 3]
            found = query.ComputeSignedDistanceToPoint(p_W)
            nearest = min(f.distance for f in found if f.id_G in own)
            reach = max(float((corners @ d_B).max()) for corners in parts)
            # A polygon around a circle of 1 cm is 0.2 mm farther out, a ball's corners less.
            assert reach == pytest.approx(far - nearest, abs=3e-4), (link, d_B)


@pytest.mark.parametrize(
    ("shape", "got"),
    [
        ("<ellipsoid><radii>0.01 0.02 0.03</radii></ellipsoid>", "Ellipsoid"),
        ("<plane><normal>0 0 1</normal><size>1 1</size></plane>", "HalfSpace"),
    ],
)
def test_other_shapes_are_refused(tmp_path, shape, got):
    hand = load_hand(with_shape(tmp_path, shape))
    message = rf"rod: must be a box, cylinder, capsule, sphere or convex mesh, got {got}"
    with pytest.raises(HandError, match=message) as caught:
        link_shapes(hand.model)
    assert "\n" not in str(caught.value)
