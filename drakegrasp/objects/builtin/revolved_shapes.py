"""Solids of revolution, one function per class: sizes in metres come in, watertight meshes go out.

A profile is turned about z; a switch or a stem is added where there is one. Every mesh stands on
the plane z = 0 as it would on a table, z up; `drakegrasp.objects.builtin.catalog` holds the table
of sizes.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.frames import Array
from drakegrasp.objects.builtin.booleans import fuse, stand
from drakegrasp.objects.builtin.modelling import bar, revolve
from drakegrasp.objects.builtin.profiles import COARSE, EDGE, bevelled, ellipse, resample, smooth


def bottle(*, radius: float, height: float, neck_radius: float) -> trimesh.Trimesh:
    """Return a closed bottle, solid, with a shoulder, a neck and a cap.

    All lengths are in [m].
    """
    shoulder, neck, cap = 0.58 * height, 0.78 * height, 0.9 * height

    # From the bottom up: body, shoulder, neck and cap.
    side = np.vstack(
        [
            resample([*bevelled(radius, height, 0.004)[:2], (radius, shoulder)], EDGE),
            smooth([(radius, shoulder), (0.8 * radius, 0.66 * height), (neck_radius, neck)], EDGE)[
                1:
            ],
            resample(
                [
                    (neck_radius, neck),
                    (neck_radius, cap),
                    (neck_radius + 0.003, cap),
                    (neck_radius + 0.003, height - 0.003),
                    (neck_radius, height),
                ],
                EDGE,
            )[1:],
        ]
    )
    return _lathe(side)


def can(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return a closed can: a cylinder with bevelled rims.

    All lengths are in [m].
    """
    return _lathe(resample(bevelled(radius, height, 0.002), EDGE))


def jar(*, radius: float, height: float, lid_radius: float, lid_height: float) -> trimesh.Trimesh:
    """Return a closed jar, solid: a body, a short neck and a lid.

    All lengths are in [m].
    """
    shoulder = height - lid_height - 0.018
    neck = min(lid_radius - 0.004, radius - 0.008)

    # From the bottom up: body, shoulder, lid.
    side = np.vstack(
        [
            resample([*bevelled(radius, height, 0.005)[:2], (radius, shoulder)], EDGE),
            smooth(
                [
                    (radius, shoulder),
                    (radius - 0.25 * (radius - neck), shoulder + 0.006),
                    (neck, shoulder + 0.013),
                ],
                EDGE / 2.0,
            )[1:],
            resample(
                [
                    (neck, height - lid_height),
                    (lid_radius, height - lid_height),
                    (lid_radius, height - 0.003),
                    (lid_radius - 0.003, height),
                ],
                EDGE,
            ),
        ]
    )
    return _lathe(side)


def candlestick(*, foot_radius: float, stem_radius: float, height: float) -> trimesh.Trimesh:
    """Return a candlestick with a wide foot, a knob and a drip cup with a socket.

    All lengths are in [m].
    """
    cup, socket = 2.6 * stem_radius, 0.010
    outline = [
        (foot_radius, 0.0),
        (foot_radius, 0.008),
        (0.55 * foot_radius, 0.020),
        (stem_radius, 0.3 * height),
        (stem_radius, 0.5 * height),
        (1.6 * stem_radius, 0.56 * height),
        (stem_radius, 0.62 * height),
        (stem_radius, 0.78 * height),
        (cup, height - 0.012),
        (cup, height),
    ]
    side = np.vstack([resample(outline[:2], EDGE), smooth(outline[1:], 0.8 * EDGE)[1:]])
    top = [(cup, height), (socket, height), (socket, height - 0.018), (0.0, height - 0.018)]
    foot = resample([(0.0, 0.0), side[0]], COARSE * EDGE)[:-1]
    return revolve(np.vstack([foot, side, resample(top, EDGE)[1:]]))


def flashlight(
    *, head_radius: float, body_radius: float, height: float, head_height: float
) -> trimesh.Trimesh:
    """Return a flashlight that stands on its lens, with a switch at +x.

    All lengths are in [m].
    """
    taper = head_height + 0.022
    side = resample(
        [
            *bevelled(head_radius, head_height, 0.003)[:2],
            (head_radius, head_height),
            (body_radius, taper),
            (body_radius, height - 0.024),
            (body_radius + 0.0025, height - 0.021),
            (body_radius + 0.0025, height - 0.003),
            (body_radius - 0.0005, height),
        ],
        EDGE,
    )

    z = taper + 0.022
    switch = bar(
        (0.0, 0.0, z),
        (body_radius + 0.003, 0.0, z),
        ellipse(0.010, 0.006, edge=0.5 * EDGE),
        normal=(0.0, 1.0, 0.0),
    )
    return fuse(_lathe(side), switch)


def apple(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return an apple with a stem; `height` is without the stem.

    All lengths are in [m].
    """
    side = smooth(
        [
            (0.0, 0.07 * height),
            (0.18 * radius, 0.03 * height),
            (0.36 * radius, 0.0),
            (0.72 * radius, 0.16 * height),
            (0.95 * radius, 0.42 * height),
            (radius, 0.62 * height),
            (0.88 * radius, 0.86 * height),
            (0.5 * radius, height),
            (0.2 * radius, 0.93 * height),
            (0.0, 0.82 * height),
        ],
        EDGE,
    )

    stem = bar(
        (0.0, 0.0, 0.7 * height),
        (0.004, 0.0, height + 0.010),
        ellipse(0.0025, 0.0025, edge=0.002),
        normal=(0.0, 1.0, 0.0),
    )
    return stand(fuse(revolve(side), stem))


def pear(*, radius: float, neck_radius: float, height: float) -> trimesh.Trimesh:
    """Return a pear that stands on its wide end, with a stem; `height` is without the stem.

    All lengths are in [m].
    """
    side = smooth(
        [
            (0.0, 0.04 * height),
            (0.35 * radius, 0.0),
            (0.85 * radius, 0.14 * height),
            (radius, 0.32 * height),
            (0.85 * radius, 0.5 * height),
            (neck_radius, 0.75 * height),
            (0.85 * neck_radius, 0.92 * height),
            (0.4 * neck_radius, height),
            (0.0, 0.98 * height),
        ],
        EDGE,
    )

    stem = bar(
        (0.0, 0.0, 0.85 * height),
        (-0.004, 0.0, height + 0.014),
        ellipse(0.0025, 0.0025, edge=0.002),
        normal=(0.0, 1.0, 0.0),
    )
    return stand(fuse(revolve(side), stem))


def _lathe(side: Array) -> trimesh.Trimesh:
    """Return the solid of a side (r, z) from its foot to its head, closed at both."""
    foot = resample([(0.0, side[0, 1]), side[0]], COARSE * EDGE)[:-1]
    head = resample([side[-1], (0.0, side[-1, 1])], EDGE)[1:]
    return revolve(np.vstack([foot, side, head]))
