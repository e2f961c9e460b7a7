"""A contact is a fingertip's on its pad alone; what the rest of the link touches is another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.frames import X_WT, invert_pose, transform_points
from drakegrasp.hand.description import HalfSpace
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.contacts import Contacts, read_contacts
from drakegrasp.simulation.scene import Scene, advance, reset_attempt
from drakegrasp.simulation.verdict import judge_closed

pytestmark = pytest.mark.sim

#: Beyond the end of every link [m].
NOWHERE = ((1.0, 0.0, 0.0, 0.5),)


@pytest.fixture(scope="module")
def closed(scene: Scene, cube: ObjectModel) -> Scene:
    X_WO = X_WT @ standing(cube)
    reset_attempt(scene, X_WO, X_WO @ from_above(cube, STANDOFF).X_OG, spread=0.0)
    advance(scene, 2.4)
    return scene


def with_pads(scene: Scene, *regions: tuple[HalfSpace, ...]) -> Contacts:
    """Return the contacts as they are with other pad regions of the three fingers."""
    hand = scene.handles.hand
    fingers = tuple(
        replace(finger, pad_region=region)
        for finger, region in zip(hand.fingers, regions, strict=True)
    )
    handles = replace(scene.handles, hand=replace(hand, fingers=fingers))
    return read_contacts(replace(scene, handles=handles))


def test_contact_off_the_pad_is_one_of_another_link(closed):
    pads = [finger.pad_region for finger in closed.handles.hand.fingers]
    contacts = with_pads(closed, NOWHERE, *pads[1:])
    assert contacts.touching.tolist() == [False, True, True]
    assert contacts.other_links == 1
    assert np.isnan(contacts.p_OQ[0]).all()
    assert not contacts.f_Q_O[0].any()
    assert contacts.area[0] == contacts.penetration[0] == 0.0
    assert judge_closed(contacts.touching, contacts.other_links, False).item()


def test_patch_on_the_edge_of_the_pad_is_split(closed, cube):
    """Force and area of both parts are those of the whole; the point is the pad's."""
    whole = with_pads(closed, (), (), ())
    assert whole.other_links == 0

    # A cut through the middle of the patch of finger 1, whose two sides are read in turn.
    tip = closed.handles.fingertips[0]
    X_FO = invert_pose(closed.pose(tip)) @ closed.pose(closed.object)
    x = float(transform_points(X_FO, whole.p_OQ[:1])[0, 0])
    outer = with_pads(closed, ((1.0, 0.0, 0.0, x),), (), ())
    inner = with_pads(closed, ((-2.0, 0.0, 0.0, -2.0 * x),), (), ())
    for part in (outer, inner):
        assert part.touching.all()
        assert part.other_links == 1
        assert 0.1 * whole.area[0] < part.area[0] < 0.9 * whole.area[0]
        assert np.array_equal(part.f_Q_O[1:], whole.f_Q_O[1:])
    assert outer.area[0] + inner.area[0] == pytest.approx(whole.area[0])
    assert np.allclose(outer.f_Q_O[0] + inner.f_Q_O[0], whole.f_Q_O[0], atol=1e-9)
    assert transform_points(X_FO, outer.p_OQ[:1])[0, 0] > x + 1e-4
    assert transform_points(X_FO, inner.p_OQ[:1])[0, 0] < x - 1e-4


def test_force_of_a_part_pushes_along_its_own_normal(closed):
    """Where the pad carries half of a patch, it carries about half of its force."""
    whole = with_pads(closed, (), (), ())
    tip = closed.handles.fingertips[0]
    X_FO = invert_pose(closed.pose(tip)) @ closed.pose(closed.object)
    x = float(transform_points(X_FO, whole.p_OQ[:1])[0, 0])
    part = with_pads(closed, ((1.0, 0.0, 0.0, x),), (), ())
    share = np.linalg.norm(part.f_Q_O[0]) / np.linalg.norm(whole.f_Q_O[0])
    assert 0.3 < share < 0.7
    assert (part.f_Q_O[0] * part.nhat_Q_O[0]).sum() < 0.0


def test_barretts_pad_is_the_front_of_its_fingertip(closed):
    """Both bounds count: the pad begins 18 mm along the link and faces its palm side."""
    (finger, *_) = closed.handles.hand.fingers
    points = np.array([[0.04, 0.01, 0.0], [0.04, -0.001, 0.0], [0.0179, 0.01, 0.0]])
    assert finger.on_pad(points).tolist() == [True, False, False]
