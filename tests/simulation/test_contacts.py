"""A contact is a fingertip's on its pad alone; what the rest of the link touches is another's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.frames import X_WT, invert_pose, transform_points
from drakegrasp.hand.file_format import HalfSpace
from drakegrasp.objects.model import ObjectModel
from drakegrasp.simulation.contacts import Contacts, read_contacts
from drakegrasp.simulation.scene import Scene, advance, reset_attempt
from drakegrasp.simulation.verdict import judge_closed

pytestmark = pytest.mark.sim

#: Beyond the end of every link [m].
NOWHERE = ((1.0, 0.0, 0.0, 0.5),)
EVERYWHERE: tuple[HalfSpace, ...] = ()


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
        replace(finger, pad_region=region, pad_point=_inside(region, finger.pad_point))
        for finger, region in zip(hand.fingers, regions, strict=True)
    )
    handles = replace(scene.handles, hand=replace(hand, fingers=fingers))
    return read_contacts(replace(scene, handles=handles))


def _inside(region: tuple[HalfSpace, ...], usual: tuple[float, ...]) -> tuple[float, ...]:
    """Return a point of a region: a hand must have its usual contact point there."""
    if len(region) != 1:
        return usual
    ((x, y, z, d),) = region
    length = x**2 + y**2 + z**2
    return tuple(1.01 * d * n / length + 0.01 * n for n in (x, y, z))


def test_contact_off_the_pad_is_one_of_another_link(closed):
    pads = [finger.pad_region for finger in closed.handles.hand.fingers]
    contacts = with_pads(closed, NOWHERE, *pads[1:])
    assert contacts.touching.tolist() == [False, True, True]
    assert contacts.other_links == 1
    assert np.isnan(contacts.p_OQ[0]).all()
    assert not contacts.f_Q_O[0].any()
    assert contacts.area[0] == contacts.penetration[0] == 0.0
    assert judge_closed(contacts.touching, contacts.other_links, False).item()


def test_patch_over_the_border_is_the_fingertips(closed):
    """As a whole, where most of it is on the pad: its force, area and point do not change."""
    whole = with_pads(closed, EVERYWHERE, EVERYWHERE, EVERYWHERE)
    x = _contact_in_link(closed, whole)
    part = with_pads(closed, ((1.0, 0.0, 0.0, x - 1e-3),), EVERYWHERE, EVERYWHERE)
    assert part.other_links == 0
    assert np.array_equal(part.f_Q_O, whole.f_Q_O)
    assert np.array_equal(part.p_OQ, whole.p_OQ)
    assert np.array_equal(part.area, whole.area)


@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_patch_mostly_beside_the_pad_is_split(closed, scale):
    """The pad's part is a fingertip's contact, and the rest is one of another link."""
    whole = with_pads(closed, EVERYWHERE, EVERYWHERE, EVERYWHERE)
    x = _contact_in_link(closed, whole)
    beyond = (scale, 0.0, 0.0, scale * (x + 1e-3))
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
    cosine = -(part.f_Q_O[0] * part.nhat_Q_O[0]).sum() / np.linalg.norm(part.f_Q_O[0])
    assert cosine > np.cos(np.arctan(0.71)) - 1e-3


def _contact_in_link(scene: Scene, contacts: Contacts) -> float:
    """Return how far along its link finger 1 touches [m]."""
    tip = scene.handles.fingertips[0]
    X_FO = invert_pose(scene.pose(tip)) @ scene.pose(scene.object)
    return float(transform_points(X_FO, contacts.p_OQ[:1])[0, 0])


def test_barretts_pad_is_the_front_of_its_fingertip(closed):
    """It begins 18 mm along the link and has the round tip, but neither back nor sides."""
    (finger, *_) = closed.handles.hand.fingers
    on = np.array([[0.04, 0.011, 0.0], [0.0183, 0.0, 0.01], [0.0589, -0.003, 0.0]])
    off = np.array([[0.0179, 0.01, 0.0], [0.03, -0.002, 0.011], [0.059, -0.004, 0.0]])
    assert finger.on_pad(on).all()
    assert not finger.on_pad(off).any()
