"""Fruit, one function per class: sizes in metres come in, watertight meshes go out.

Every mesh lies or stands on the plane z = 0 as it would on a table, z up;
`drakegrasp.builtin` holds the table of sizes.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.curves import EDGE, ellipse, rounded_polygon, smooth
from drakegrasp.solids import bar, fuse, revolve, stand, sweep


def banana(*, bend_radius: float, angle: float, thickness: float) -> trimesh.Trimesh:
    """Return a banana that lies on its side, bent by `angle` [rad] about `bend_radius`.

    All lengths are in [m].
    """
    theta = np.linspace(-angle / 2.0, angle / 2.0, round(bend_radius * angle / EDGE) + 1)
    knots = np.array(
        [
            (0.0, 0.34),
            (0.03, 0.38),
            (0.12, 0.36),
            (0.26, 0.85),
            (0.5, 1.0),
            (0.78, 0.85),
            (0.95, 0.42),
            (1.0, 0.24),
        ]
    )
    scale = PchipInterpolator(knots[:, 0], knots[:, 1])(np.linspace(0.0, 1.0, len(theta)))
    half = thickness / 2.0
    # Five soft edges, one face down; the underside stays on the table along the whole fruit.
    turns = 2.0 * np.pi * np.arange(5) / 5.0 - np.pi / 2.0 + np.pi / 5.0
    corners = 1.18 * half * np.column_stack([np.cos(turns), np.sin(turns)])
    section = rounded_polygon(corners, 0.45 * half, edge=EDGE)
    lowest = -section[:, 1].min()
    path = np.column_stack(
        [
            bend_radius * np.sin(theta),
            bend_radius * (1.0 - np.cos(theta)),
            lowest * scale,
        ]
    )
    return sweep(path, section, normal=(0.0, 0.0, 1.0), scale=scale)


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
