"""Fruit and plants, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. All lengths are in [m]
and all angles in [rad]; `drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.shapes.modelling.booleans import flat_base, fuse, stand
from drakegrasp.shapes.modelling.primitives import ball, lathe, moved, scalloped, tube
from drakegrasp.shapes.modelling.profiles import (
    EDGE,
    LARGE,
    ellipse,
    resample,
    rounded_polygon,
    smooth,
)
from drakegrasp.shapes.modelling.solids import bar, extrude, revolve, sweep


def apple(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return an apple with a stem; `height` is without the stem."""
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
    """Return a pear that stands on its wide end, with a stem; `height` is without the stem."""
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


def banana(*, bend_radius: float, angle: float, thickness: float) -> trimesh.Trimesh:
    """Return a bunch of three bananas, bent by `angle` about `bend_radius`, one on the others."""
    # Side by side and halfway above, a little into each other; their stalks meet in a crown.
    half = thickness / 2.0
    low = _single_banana(bend_radius, angle, thickness)
    side = _single_banana(bend_radius + 0.82 * thickness, angle, thickness)
    top = _single_banana(bend_radius + 0.41 * thickness, angle, thickness)
    middle = -0.41 * thickness
    s, c = (float(value) for value in sin_cos_deg(np.degrees(-angle / 2.0)))
    reach = bend_radius + 0.41 * thickness
    crown = ball(
        (reach * s, reach * (c - 1.0), 0.5 * thickness),
        (0.26 * thickness, 0.52 * thickness, 0.5 * thickness),
    )
    return flat_base(
        fuse(
            moved(low, (0.0, middle, 0.0)),
            moved(side, (0.0, -middle, 0.0)),
            moved(top, (0.0, 0.0, 1.45 * half)),
            crown,
        )
    )


def _single_banana(bend_radius: float, angle: float, thickness: float) -> trimesh.Trimesh:
    """Return a banana that lies on its side."""
    theta = np.linspace(-angle / 2.0, angle / 2.0, round(bend_radius * angle / LARGE) + 1)
    knots = np.array(
        [
            (0.0, 0.30),
            (0.03, 0.36),
            (0.10, 0.36),
            (0.24, 0.85),
            (0.5, 1.0),
            (0.78, 0.85),
            (0.95, 0.42),
            (1.0, 0.24),
        ]
    )
    scale = PchipInterpolator(knots[:, 0], knots[:, 1])(np.linspace(0.0, 1.0, len(theta)))

    # Five soft edges, one face down; the underside stays on the table along the whole fruit.
    half = thickness / 2.0
    turns = 2.0 * np.pi * np.arange(5) / 5.0 - np.pi / 2.0 + np.pi / 5.0
    corners = 1.18 * half * np.column_stack([np.cos(turns), np.sin(turns)])
    section = rounded_polygon(corners, 0.45 * half, edge=LARGE)
    lowest = -section[:, 1].min()
    path = np.column_stack(
        [
            bend_radius * np.sin(theta),
            bend_radius * (np.cos(theta) - 1.0),
            lowest * (0.35 + 0.65 * scale),
        ]
    )
    return sweep(path, section, normal=(0.0, 0.0, 1.0), scale=scale)


def mushroom(*, cap: float, stalk: float, height: float) -> trimesh.Trimesh:
    """Return a mushroom: radii of its `cap` and its `stalk`."""
    low = 0.56 * height
    foot = smooth(
        [
            (1.15 * stalk, 0.0),
            (1.25 * stalk, 0.10 * height),
            (0.88 * stalk, 0.34 * height),
            (0.85 * stalk, low + 0.004),
        ],
        EDGE,
    )

    # The cap bulges a little below its rim.
    head = smooth(
        [
            (0.9 * stalk, low + 0.004),
            (0.9 * cap, low - 0.006),
            (cap, low + 0.004),
            (0.90 * cap, 0.78 * height),
            (0.55 * cap, 0.95 * height),
            (0.12 * cap, height),
        ],
        EDGE,
    )
    return lathe(np.vstack([foot, head[1:]]))


def pumpkin(*, radius: float, height: float, ribs: int) -> trimesh.Trimesh:
    """Return a ribbed pumpkin with its stem; `height` is without the stem."""
    section = scalloped(radius, 0.13 * radius, ribs)
    s, c = sin_cos_deg(np.linspace(-90.0, 90.0, max(8, round(1.6 * height / EDGE)) + 1))
    # Squarer than an ellipsoid, and dented at the top.
    scales, heights = (
        np.maximum(c, 0.0) ** 0.72,
        height * (0.5 + 0.5 * np.sign(s) * np.abs(s) ** 1.1),
    )
    heights = np.where(s > 0.0, heights - 0.12 * height * (1.0 - scales) ** 2, heights)
    fruit = extrude(section, np.column_stack([np.where(c < 1e-9, 0.0, scales), heights]))
    path = smooth(
        [
            (0.0, 0.0, 0.75 * height),
            (0.0, 0.0, 0.98 * height),
            (0.16 * radius, 0.0, 1.16 * height),
            (0.36 * radius, 0.0, 1.24 * height),
        ],
        EDGE,
    )
    stem = tube(path, np.linspace(0.2 * radius, 0.11 * radius, len(path)))
    sunk = moved(fuse(fruit, stem), (0.0, 0.0, -0.02 * height))
    return flat_base(sunk)


def cactus(*, pot: float, radius: float, height: float) -> trimesh.Trimesh:
    """Return a cactus with two arms in a `pot` of that radius at its rim."""
    rim = 0.95 * pot
    vessel = lathe(
        resample(
            [
                (0.72 * pot, 0.0),
                (0.9 * pot, rim - 0.016),
                (pot, rim - 0.015),
                (pot, rim),
                (pot - 0.006, rim),
                (pot - 0.007, rim - 0.006),
            ],
            EDGE,
        )
    )

    # The ribbed trunk, round at its top.
    section = scalloped(radius, 0.16 * radius, 8, edge=EDGE)
    s, c = sin_cos_deg(np.linspace(15.0, 90.0, 6))
    top = height - radius
    profile = [
        *((share, rim - 0.02) for share in (0.0, 0.5)),
        *((1.0, float(z)) for z in np.linspace(rim - 0.02, top, max(4, round((top - rim) / EDGE)))),
        *(
            (float(x) if x > 1e-9 else 0.0, float(top + radius * z))
            for x, z in zip(c, s, strict=True)
        ),
    ]
    parts = [vessel, extrude(section, profile)]
    for side, low, high in ((1.0, 0.36, 0.70), (-1.0, 0.50, 0.84)):
        z, up = (rim + share * (height - rim) for share in (low, high))
        reach = 1.95 * radius
        path = smooth(
            [
                (0.3 * radius * side, 0.0, z),
                (0.86 * reach * side, 0.0, z + 0.004),
                (reach * side, 0.0, z + 0.5 * radius),
                (reach * side, 0.0, up),
            ],
            EDGE,
        )
        arm = 0.46 * radius
        parts += [tube(path, arm), ball((reach * side, 0.0, up), arm)]
    return fuse(*parts)
