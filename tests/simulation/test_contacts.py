"""A contact is a fingertip's on its pad alone; what the rest of the link touches is another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import CUBE, STANDOFF, from_above, standing

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, invert_pose, make_pose, transform_points
from drakegrasp.hand.description import Hand
from drakegrasp.hand.file_format import PAD_BAND, HalfSpace
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation import contacts as contacts_module
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.contacts import Contacts, bodies_on_object, read_contacts
from drakegrasp.simulation.scene import Scene, advance, release, reset_attempt
from drakegrasp.simulation.trial import judge_closed

pytestmark = pytest.mark.sim

#: Beyond the end of every link [m].
NOWHERE = ((1.0, 0.0, 0.0, 0.5),)
EVERYWHERE: tuple[HalfSpace, ...] = ()


@pytest.fixture(scope="module")
def closed(cube: ObjectModel, config: Config, hand: Hand) -> Scene:
    """A scene of its own, which no test changes: the hand closed on the cube, which is yawed."""
    scene, X_WO = build_scene(cube, config.physics, hand), X_WT @ standing(cube)
    reset_attempt(scene, X_WO, X_WO @ from_above(cube, STANDOFF).X_OG, spread=0.0)
    advance(scene, 2.4)
    return scene


def with_pads(scene: Scene, *regions: tuple[HalfSpace, ...]) -> Contacts:
    """Return the contacts as they are with other pad regions of the three fingers."""
    hand = scene.hand
    fingers = tuple(
        replace(finger, pad_region=region, pad_point=_inside(region, finger.pad_point))
        for finger, region in zip(hand.fingers, regions, strict=True)
    )
    return read_contacts(replace(scene, hand=replace(hand, fingers=fingers)))


def _inside(region: tuple[HalfSpace, ...], usual: tuple[float, ...]) -> tuple[float, ...]:
    """Return a point of a region: a hand must have its usual contact point there."""
    if len(region) != 1:
        return usual
    ((x, y, z, d),) = region
    length = x**2 + y**2 + z**2
    return tuple(1.01 * d * n / length + 0.01 * n for n in (x, y, z))


def test_contact_off_the_pad_is_one_of_another_link(closed):
    pads = [finger.pad_region for finger in closed.hand.fingers]
    contacts = with_pads(closed, NOWHERE, *pads[1:])
    assert contacts.touching.tolist() == [False, True, True]
    assert contacts.other_links == 1
    assert np.isnan(contacts.p_OQ[0]).all()
    assert not contacts.f_Q_O[0].any()
    assert contacts.area[0] == contacts.penetration[0] == 0.0
    assert judge_closed(contacts.touching, contacts.other_links, False) is not Outcome.SUCCESS


def test_patch_over_the_border_is_the_fingertips(closed):
    """As a whole, where most of it is on the pad or its band: nothing of it changes."""
    whole = with_pads(closed, EVERYWHERE, EVERYWHERE, EVERYWHERE)
    x = _contact_in_link(closed, whole)
    part = with_pads(closed, ((1.0, 0.0, 0.0, x + 0.5 * PAD_BAND),), EVERYWHERE, EVERYWHERE)
    assert part.other_links == 0
    assert np.array_equal(part.f_Q_O, whole.f_Q_O)
    assert np.array_equal(part.p_OQ, whole.p_OQ)
    assert np.array_equal(part.area, whole.area)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_patch_mostly_beside_the_pad_is_split(closed, scale):
    """The pad's part is a fingertip's contact, and the rest is one of another link."""
    whole = with_pads(closed, EVERYWHERE, EVERYWHERE, EVERYWHERE)
    x = _contact_in_link(closed, whole)
    beyond = (scale, 0.0, 0.0, scale * (x + PAD_BAND + 1e-3))
    part = with_pads(closed, (beyond,), EVERYWHERE, EVERYWHERE)
    assert part.touching.all()
    assert part.other_links == 1
    assert np.array_equal(part.f_Q_O[1:], whole.f_Q_O[1:])
    assert 0.05 * whole.area[0] < part.area[0] < 0.6 * whole.area[0]
    assert part.penetration[0] <= whole.penetration[0]
    assert _contact_in_link(closed, part) > x + 1e-3

    # It carries what the pressure on its faces says, and pushes along its own normal.
    share = np.linalg.norm(part.f_Q_O[0]) / np.linalg.norm(whole.f_Q_O[0])
    assert 0.05 < share < 0.5
    # Its friction is a part of the whole patch's.
    along = np.eye(3) - np.outer(whole.nhat_Q_O[0], whole.nhat_Q_O[0])
    friction, of_whole = along @ part.f_Q_O[0], along @ whole.f_Q_O[0]
    assert np.linalg.norm(of_whole) > 0.01
    np.testing.assert_allclose(friction, share * of_whole, atol=1e-4)
    cosine = -(part.f_Q_O[0] * part.nhat_Q_O[0]).sum() / np.linalg.norm(part.f_Q_O[0])
    assert cosine > np.cos(np.arctan(0.71)) - 1e-3

    # The rest counts by its own force: it carries what the pad does not.
    rest = float(np.linalg.norm(whole.f_Q_O[0] - part.f_Q_O[0]))
    for factor, count in ((0.99, 1), (1.01, 0)):
        physics = closed.physics.model_copy(update={"contact_force": factor * rest})
        strict = replace(closed, physics=physics)
        assert with_pads(strict, (beyond,), EVERYWHERE, EVERYWHERE).other_links == count


def _contact_in_link(scene: Scene, contacts: Contacts) -> float:
    """Return how far along its link finger 1 touches [m]."""
    tip = scene.fingertips[0]
    X_FO = invert_pose(scene.pose(tip)) @ scene.pose(scene.object)
    return float(transform_points(X_FO, contacts.p_OQ[:1])[0, 0])


def test_weak_contacts_do_not_count(closed: Scene) -> None:
    """Fingertips press with some 10 N: a limit above that leaves nothing that touches."""
    forces = np.linalg.norm(read_contacts(closed).f_Q_O, axis=1)
    tips = {body.index() for body in closed.fingertips}
    for limit in (0.9 * forces.min(), 1.1 * forces.max()):
        strict = replace(closed, physics=closed.physics.model_copy(update={"contact_force": limit}))
        expected = [limit < forces.min()] * 3
        assert read_contacts(strict).touching.tolist() == expected
        assert bodies_on_object(strict) == (tips if expected[0] else set())


#: Two faces of a patch over an edge of the cube: the smaller one carries more.
AREAS, PRESSURES = np.array([1e-6, 3e-6]), np.array([5e6, 1e6])
POINTS = np.array([[0.03, 0.0, 0.0], [0.035, 0.01, 0.002]])
NORMALS = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


def test_point_and_normal_are_weighted_by_pressure(
    closed: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The faces carry 5 and 3 N, whatever their areas are."""
    X_WO = closed.pose(closed.object)
    places = transform_points(X_WO, POINTS), NORMALS @ X_WO[:3, :3].T
    faces = AREAS, *places, PRESSURES, np.array([1e-4, 3e-4])
    monkeypatch.setattr(contacts_module, "_read_faces", lambda *_: faces)
    found = with_pads(closed, EVERYWHERE, EVERYWHERE, EVERYWHERE)
    assert found.touching.all()
    np.testing.assert_allclose(found.p_OQ[0], (5.0 * POINTS[0] + 3.0 * POINTS[1]) / 8.0, atol=1e-12)
    np.testing.assert_allclose(found.nhat_Q_O[0], np.array([3.0, 5.0, 0.0]) / np.sqrt(34.0))
    assert found.area[0] == pytest.approx(4e-6)
    assert found.penetration[0] == pytest.approx(3e-4)


def test_contact_point_is_where_drakes_force_acts(closed: Scene) -> None:
    """On a plane, force and moment about the patch's centroid tell the centre of pressure.

    The force is told in {O}, which is turned against {W}.
    """
    results = closed.plant.get_contact_results_output_port().Eval(closed.context)
    tips, found = [body.index() for body in closed.fingertips], read_contacts(closed)
    X_OW = invert_pose(closed.pose(closed.object))
    seen, forces = set(), np.zeros((3, 3))
    for i in range(results.num_hydroelastic_contacts()):
        info = results.hydroelastic_contact_info(i)
        surface = info.contact_surface()
        body = {contacts_module._body_of(closed, g) for g in (surface.id_M(), surface.id_N())}
        (tip,) = body & set(tips)
        k = tips.index(tip)
        n_O = np.array([0.0, np.sign(found.p_OQ[k, 1]), 0.0])
        f_O, tau_O = (
            X_OW[:3, :3] @ part
            for part in (info.F_Ac_W().translational(), info.F_Ac_W().rotational())
        )
        centroid_O = transform_points(X_OW, surface.centroid()[None])[0]
        point = centroid_O + np.cross(n_O, tau_O) / (n_O @ f_O)
        np.testing.assert_allclose(found.p_OQ[k], point, atol=2e-5)
        seen.add(k)
        on_M = contacts_module._body_of(closed, surface.id_M()) == closed.object.index()
        forces[k] += f_O if on_M else -f_O
    assert seen == {0, 1, 2}
    np.testing.assert_allclose(found.f_Q_O, forces, atol=1e-9)


def test_depth_of_a_fingertip_is_how_far_it_is_in_the_cube(closed: Scene) -> None:
    """A convex shape is deepest at a corner. Drake's field of pressure is not quite a distance."""
    found, hand = read_contacts(closed), closed.hand
    for k, tip in enumerate(closed.fingertips):
        corners = np.concatenate(link_shapes(hand.model)[hand.fingers[k].fingertip])
        X_OF = invert_pose(closed.pose(closed.object)) @ closed.pose(tip)
        y = np.abs(transform_points(X_OF, corners)[:, 1])
        assert found.penetration[k] == pytest.approx(CUBE / 2.0 - y.min(), rel=0.3)


def test_hand_and_object_on_the_table_are_told_apart(scene: Scene, cube: ObjectModel) -> None:
    """A cube that stands there, then a hand that presses on the table beside it."""
    X_WO = X_WT @ standing(cube)
    reset_attempt(scene, X_WO, X_WO @ from_above(cube, 0.3).X_OG, spread=0.0)
    release(scene)
    advance(scene, 0.3)
    stands = read_contacts(scene)
    assert (stands.object_on_table, stands.hand_on_table) == (True, False)
    np.testing.assert_allclose(stands.table_force, [0.0, 0.0, 9.81 * cube.mass], atol=0.1)
    assert stands.other_links == 0 and not stands.touching.any()

    # Open fingers point down: with the palm this low their ends are in the table.
    X_TG = make_pose(np.diag([1.0, -1.0, -1.0]), [0.3, 0.0, 0.05])
    reset_attempt(scene, X_WO, X_WT @ X_TG, spread=0.0, closing=np.full(3, 1.3))
    presses = read_contacts(scene)
    assert (presses.object_on_table, presses.hand_on_table) == (False, True)


def test_point_contacts_are_counted(closed: Scene) -> None:
    """Those of the object; one of hand and table means that they touch."""
    reader = contacts_module._Reader(closed)
    grasped, table = closed.object.index(), closed.table.index()
    tip, *_ = (body.index() for body in closed.fingertips)
    for pair, count, on_table in (
        ({tip, grasped}, 1, False),
        ({grasped, table}, 2, False),
        ({tip, table}, 2, True),
    ):
        reader.add_point_pair(pair)
        found = reader.contacts()
        assert (found.point_contacts, found.hand_on_table) == (count, on_table)


def test_palm_on_the_object_is_another_link(scene: Scene, cube: ObjectModel) -> None:
    """Open fingers, and the pad of the palm less than half of its thickness in the top."""
    X_WO = X_WT @ standing(cube)
    reset_attempt(scene, X_WO, X_WO @ from_above(cube, 0.001).X_OG, spread=0.0)
    found = read_contacts(scene)
    assert not found.touching.any()
    assert found.other_links == 1
    palm = scene.plant.GetBodyByName(scene.hand.palm_link)
    assert bodies_on_object(scene) == {palm.index()}
