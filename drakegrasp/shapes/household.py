"""Things of a household, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. All lengths are in [m]
and all angles in [rad]; `drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.shapes.modelling.booleans import fuse
from drakegrasp.shapes.modelling.primitives import ball, lathe, prism, rod, tube
from drakegrasp.shapes.modelling.profiles import (
    BROAD,
    COARSE,
    EDGE,
    resample,
    smooth,
    spread_evenly,
)
from drakegrasp.shapes.modelling.solids import revolve


def watertap(*, base: float, pipe: float, height: float, reach: float) -> trimesh.Trimesh:
    """Return a tap on its base: radii of `base` and `pipe`, a spout that reaches towards +x."""
    bend = reach / 2.0
    s, c = sin_cos_deg(np.linspace(180.0, 0.0, 24))
    top = height - bend - pipe
    arch = np.column_stack([bend + bend * c, 0.0 * c, top + bend * s])
    path = np.vstack([[(0.0, 0.0, 0.004)], arch, [(reach, 0.0, top - 0.022)]])
    column = 0.52 * top
    # The valve: a cross on the side of the column.
    z, y = 0.72 * column, -1.3 * pipe - 0.026
    wings = [
        rod((-0.026 * a, y, z - 0.026 * b), (0.026 * a, y, z + 0.026 * b), 0.0055)
        for a, b in ((1.0, 0.0), (0.0, 1.0))
    ]
    return fuse(
        lathe(
            smooth([(base, 0.0), (base, 0.008), (0.75 * base, 0.014), (1.3 * pipe, 0.018)], EDGE)
        ),
        rod((0.0, 0.0, 0.002), (0.0, 0.0, column), 1.45 * pipe, 1.3 * pipe),
        tube(resample(path, EDGE), pipe),
        rod((reach, 0.0, top - 0.026), (reach, 0.0, top - 0.012), 1.2 * pipe),
        rod((0.0, 0.0, z), (0.0, y, z), 0.75 * pipe),
        ball((0.0, y, z), 0.9 * pipe),
        *wings,
    )


def knob(*, rose: float, neck: float, radius: float, height: float) -> trimesh.Trimesh:
    """Return a door knob on its `rose`; all but the height are radii."""
    side = [
        *resample([(rose, 0.0), (rose, 0.007)], EDGE),
        *smooth(
            [
                (0.86 * rose, 0.011),
                (1.15 * neck, 0.016),
                (neck, 0.36 * height),
                (1.15 * neck, 0.50 * height),
                (0.80 * radius, 0.58 * height),
                (radius, 0.74 * height),
                (0.86 * radius, 0.92 * height),
                (0.5 * radius, height),
                (0.25 * radius, 0.995 * height),
            ],
            0.8 * EDGE,
        ),
    ]
    return lathe(side)


def lamp(*, base: float, shade: float, height: float) -> trimesh.Trimesh:
    """Return a table lamp: radii of its `base` and of the rim of its `shade`."""
    low, top = 0.54 * height, 0.58 * shade
    wall = 0.005
    outer = resample([(shade, low), (top, height)], BROAD)
    inner = resample([(top - wall, height - 0.006), (shade - wall, low)], 1.5 * BROAD)
    cap = resample([(top, height), (0.0, height)], BROAD)[1:]
    ceiling = resample([(0.0, height - 0.006), inner[0]], 1.5 * BROAD)
    # From the axis under the cap, down inside, up outside, to the axis.
    screen = revolve(np.vstack([ceiling[:-1], inner, outer, cap]), edge=BROAD)
    foot = lathe(
        [
            *resample([(base, 0.0), (base, 0.008)], EDGE),
            *smooth(
                [
                    (0.86 * base, 0.013),
                    (0.30 * base, 0.024),
                    (0.15 * base + 0.003, 0.034),
                    (0.38 * base, 0.26 * height),
                    (0.40 * base, 0.33 * height),
                    (0.15 * base + 0.002, 0.46 * height),
                    (0.14 * base, 0.55 * height),
                ],
                EDGE,
            ),
        ]
    )
    stem = rod((0.0, 0.0, 0.5 * height), (0.0, 0.0, height - 0.002), 0.14 * base)
    finial = ball((0.0, 0.0, height + 0.005), 0.007, edge=0.7 * EDGE)
    return fuse(screen, foot, stem, finial)


def iron(*, length: float, width: float, height: float) -> trimesh.Trimesh:
    """Return a clothes iron on its sole, its tip towards +x, with a closed handle."""
    t = np.linspace(0.0, 1.0, 200)
    nose = 0.5 * width * np.sqrt(1.0 - t**2.2)
    side = np.vstack(
        [
            smooth(
                [
                    (-0.40 * length, 0.47 * width),
                    (-0.2 * length, 0.5 * width),
                    (-0.05 * length, 0.5 * width),
                ],
                EDGE / 4.0,
            )[:-1],
            np.column_stack([-0.05 * length + 0.6 * length * t, nose]),
        ]
    )
    outline = resample(np.vstack([side, side[-2::-1] * [1.0, -1.0], side[:1]]), 1.0)
    spaced = spread_evenly(outline, BROAD)[:-1]
    low = 0.085 * height
    sole = prism(spaced, 0.0, low)
    body = prism(0.94 * spaced, low - 0.003, 0.50 * height, top=0.72)

    # The handle: two posts and a grip.
    z, thick = height - 0.012, 0.0105
    path = smooth(
        [
            (-0.24 * length, 0.0, 0.42 * height),
            (-0.27 * length, 0.0, 0.72 * height),
            (-0.18 * length, 0.0, z),
            (0.05 * length, 0.0, z),
            (0.19 * length, 0.0, 0.80 * height),
            (0.20 * length, 0.0, 0.42 * height),
        ],
        EDGE,
    )
    dial = rod((0.0, 0.0, 0.46 * height), (0.0, 0.0, 0.50 * height + 0.006), 0.19 * width)
    return fuse(sole, body, tube(path, thick), dial)


def hourglass(*, radius: float, waist: float, height: float) -> trimesh.Trimesh:
    """Return an hourglass between two discs of `radius`, with three posts."""
    plate = 0.009
    bulb = 0.70 * radius
    half = [
        (0.80 * bulb, plate - 0.002),
        (bulb, 0.10 * height + plate),
        (0.92 * bulb, 0.24 * height),
        (0.4 * bulb + 0.5 * waist, 0.40 * height),
        (waist, 0.5 * height),
    ]
    glass = lathe(smooth([*half, *((r, height - z) for r, z in half[-2::-1])], BROAD), edge=BROAD)

    # Three posts around it.
    s, c = sin_cos_deg(np.array([30.0, 150.0, 270.0]))
    posts = [
        rod(
            (0.86 * radius * x, 0.86 * radius * y, plate / 2.0),
            (0.86 * radius * x, 0.86 * radius * y, height - plate / 2.0),
            0.0042,
            edge=EDGE,
        )
        for x, y in zip(c, s, strict=True)
    ]
    return fuse(
        glass,
        *posts,
        rod((0.0, 0.0, 0.0), (0.0, 0.0, plate), radius, edge=BROAD),
        rod((0.0, 0.0, height - plate), (0.0, 0.0, height), radius, edge=BROAD),
    )


def bell(*, radius: float, body: float, handle: float) -> trimesh.Trimesh:
    """Return a hand bell that stands on its mouth: heights of its `body` and its `handle`."""
    wall = 0.006
    outer = smooth(
        [
            (radius, 0.0),
            (0.90 * radius, 0.09 * body),
            (0.70 * radius, 0.30 * body),
            (0.58 * radius, 0.65 * body),
            (0.48 * radius, 0.86 * body),
            (0.25 * radius, 0.98 * body),
            (0.14 * radius + 0.003, body),
        ],
        EDGE,
    )
    grip = smooth(
        [
            (0.14 * radius + 0.003, body),
            (0.22 * radius + 0.003, body + 0.12 * handle),
            (0.14 * radius + 0.003, body + 0.26 * handle),
            (0.27 * radius + 0.003, body + 0.62 * handle),
            (0.22 * radius, body + 0.90 * handle),
            (0.1 * radius, body + handle),
        ],
        EDGE,
    )[1:]

    # Hollow from below.
    inner = smooth(
        [
            (0.0, 0.86 * body),
            (0.30 * radius, 0.82 * body),
            (0.58 * radius - wall, 0.55 * body),
            (0.70 * radius - wall, 0.28 * body),
            (radius - wall, 0.0),
        ],
        1.5 * EDGE,
    )
    head = resample([grip[-1], (0.0, body + handle)], EDGE)[1:]
    return revolve(np.vstack([inner, outer, grip, head]))


def candlestick(*, foot_radius: float, stem_radius: float, height: float) -> trimesh.Trimesh:
    """Return a candlestick with a wide foot, a knob and a drip cup with a socket."""
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
