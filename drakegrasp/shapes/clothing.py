"""Clothing and a comb, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. Shoes point towards +x.
All lengths are in [m] and all angles in [rad]; `drakegrasp.shapes.classes` has the table
of their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.frames import Array
from drakegrasp.shapes.modelling.booleans import cut, fuse
from drakegrasp.shapes.modelling.primitives import ball, block, moved, prism, rod, rotated, tube
from drakegrasp.shapes.modelling.profiles import EDGE, resample, smooth
from drakegrasp.shapes.modelling.solids import revolve, skin, solid

#: Edge length of a hat [m].
FELT = 1.2 * EDGE

#: Edge length of shoes [m].
LEATHER = 1.3 * EDGE


def hat(*, brim: float, crown: float, height: float) -> trimesh.Trimesh:
    """Return a top hat: radii of `brim` and `crown`; the brim is curled up at both sides."""
    wall, thick = 0.006, 0.006
    top = 1.06 * crown
    inner = smooth(
        [(0.9 * crown, height - 0.008), (0.95 * crown - wall, 0.5 * height), (crown - wall, 0.0)],
        1.6 * FELT,
    )
    under = resample([inner[-1], (brim - 0.002, 0.0)], FELT)[1:]
    over = resample([(brim, 0.5 * thick), (brim - 0.002, thick), (crown, thick)], FELT)
    band = resample(
        [(crown + 0.002, thick), (crown + 0.002, 0.26 * height), (0.97 * crown, 0.26 * height)],
        FELT,
    )[1:]
    side = smooth([band[-1], (0.95 * crown, 0.55 * height), (top - 0.002, height)], FELT)[1:]
    cap = resample([(top - 0.002, height), (0.0, height - 0.004)], FELT)[1:]
    ceiling = resample([(0.0, height - 0.010), inner[0]], 1.6 * FELT)[:-1]
    upright = revolve(np.vstack([ceiling, inner, under, over, band, side, cap]), edge=FELT)

    # The curl of the brim.
    x, y, z = upright.vertices.T
    reach = np.sqrt(x * x + y * y)
    out = np.clip((reach - crown - 0.003) / (brim - crown), 0.0, 1.0)
    share = (y / np.maximum(reach, 1e-6)) ** 2
    lift = 0.62 * (brim - crown) * out**2 * share * (z < 1.5 * thick)
    return solid(np.column_stack([x, y * (1.0 - 0.10 * out * share), z + lift]), upright.faces)


def comb(*, length: float, depth: float, spine: float, teeth: float, count: int) -> trimesh.Trimesh:
    """Return a wide comb that stands on its teeth: heights of `spine` and `teeth`."""
    height = spine + teeth
    side = smooth(
        [
            (-length / 2.0, 0.96 * teeth),
            (-0.47 * length, height - 0.005),
            (-0.3 * length, height),
            (0.3 * length, height),
            (0.47 * length, height - 0.005),
            (length / 2.0, 0.96 * teeth),
        ],
        LEATHER,
    )
    body = _slab(side, depth)

    # The gaps between the teeth; the outer teeth are wider.
    pitch = 0.88 * length / count
    gaps = [
        block(
            (0.52 * pitch, 2.0 * depth, teeth),
            (pitch * (k - (count - 1) / 2.0), 0.0, teeth / 2.0 - 0.01),
            corner=0.2 * pitch,
            edge=LEATHER,
        )
        for k in range(count)
    ]
    return cut(body, *gaps)


def shoe(*, length: float, width: float, height: float) -> trimesh.Trimesh:
    """Return a laced shoe on its heel and sole; `height` of its collar."""
    last = _last(length, width, 0.62 * height, height)

    # Where the foot goes in, and what covers the instep.
    opening = moved(
        rotated(
            ball((0.0, 0.0, 0.0), (0.24 * length, 0.29 * width, 0.5 * height), edge=LEATHER),
            "y",
            12.0,
        ),
        (-0.24 * length, 0.0, 1.18 * height),
    )
    tongue = moved(
        rotated(
            ball(
                (0.0, 0.0, 0.0), (0.15 * length, 0.22 * width, 0.05 * height + 0.002), edge=LEATHER
            ),
            "y",
            33.0,
        ),
        (0.02 * length, 0.0, 0.86 * height),
    )
    laces = [
        rod(
            (x * length, -0.24 * width, z * height),
            (x * length, 0.24 * width, z * height),
            0.0035,
            edge=0.8 * EDGE,
        )
        for x, z in ((0.01, 0.90), (0.075, 0.80), (0.14, 0.705))
    ]
    return fuse(cut(last, opening), tongue, *laces, _sole(length, width, 0.13 * height))


def boot(*, length: float, width: float, height: float) -> trimesh.Trimesh:
    """Return a rubber boot on its heel and sole, open at the top."""
    foot = _last(length, width, 0.36 * height, 0.5 * height)
    x, radius = -0.24 * length, 0.25 * length
    levels = smooth(
        [
            (0.95 * radius, 0.12 * height),
            (0.92 * radius, 0.4 * height),
            (radius, 0.75 * height),
            (1.1 * radius, height),
        ],
        LEATHER,
    )
    rings = [
        np.column_stack([r * c + x, 0.86 * min(r, 0.56 * width) / r * r * s, np.full_like(s, z)])
        for r, z in levels
        for s, c in (sin_cos_deg(np.arange(24) * 15.0),)
    ]
    tips = [rings[0].mean(axis=0)[None], rings[-1].mean(axis=0)[None]]
    shaft = skin([tips[0], *rings, tips[1]], closed=False)

    # A thick rim, and the hollow inside.
    rim = np.vstack([rings[-1], rings[-1][:1]]) - [0.0, 0.0, 0.004]
    half = len(rim) // 2
    cuff = [tube(part, 0.0042, edge=0.9 * EDGE) for part in (rim[: half + 2], rim[half - 1 :])]
    hole = ball((x - 0.002, 0.0, height), (0.82 * radius, 0.40 * width, 0.5 * height), edge=LEATHER)
    return fuse(cut(fuse(foot, shaft, *cuff), hole), _sole(length, width, 0.085 * height))


def _last(length: float, width: float, instep: float, collar: float) -> trimesh.Trimesh:
    """Return the closed upper of a shoe: heights at the `instep` and at the `collar` [m]."""
    # Along the foot: half widths and heights.
    knots = np.array(
        [
            (-0.49, 0.24, 0.55),
            (-0.45, 0.34, 0.92),
            (-0.30, 0.38, 1.0),
            (-0.12, 0.38, 1.0),
            (0.02, 0.41, 0.86),
            (0.20, 0.48, 0.60),
            (0.36, 0.45, 0.47),
            (0.45, 0.33, 0.38),
            (0.49, 0.18, 0.26),
        ]
    )
    along = np.linspace(-0.49, 0.49, round(length / LEATHER) + 1)
    halves = width * PchipInterpolator(knots[:, 0], knots[:, 1])(along)
    rise = PchipInterpolator(knots[:, 0], knots[:, 2])(along)
    heights = np.where(along > 0.2, np.minimum(collar * rise, instep), collar * rise)

    # Across it: a flat base, a rounded top.
    s, c = sin_cos_deg(np.linspace(0.0, 180.0, 15))
    roof = np.column_stack([np.sign(c) * np.abs(c) ** 0.6, 0.3 + 0.7 * s])
    across = np.vstack([[(0.0, 0.0), (0.5, 0.0), (0.96, 0.0)], roof, [(-0.96, 0.0), (-0.5, 0.0)]])
    rings = [
        np.column_stack(
            [
                np.full(len(across), x * length),
                half * across[:, 0],
                0.004 + (high - 0.004) * across[:, 1],
            ]
        )
        for x, half, high in zip(along, halves, heights, strict=True)
    ]
    tips = [ring.mean(axis=0)[None] for ring in (rings[0], rings[-1])]
    return skin([tips[0], *rings, tips[1]], closed=False)


def _sole(length: float, width: float, thick: float) -> trimesh.Trimesh:
    """Return the sole of a shoe, `thick` [m], its heel apart from it by an arch."""
    knots = np.array(
        [
            (-0.505, 0.0),
            (-0.49, 0.24),
            (-0.42, 0.38),
            (-0.28, 0.42),
            (-0.05, 0.38),
            (0.20, 0.50),
            (0.36, 0.46),
            (0.46, 0.30),
            (0.50, 0.16),
            (0.505, 0.0),
        ]
    )
    along = np.linspace(-0.505, 0.505, round(length / LEATHER) + 1)
    halves = PchipInterpolator(knots[:, 0], knots[:, 1])(along)
    right = np.column_stack([along * length, -halves * width])
    outline = np.vstack([right, right[-2:0:-1] * [1.0, -1.0]])

    slab = prism(outline, 0.0, 1.25 * thick, edge=LEATHER)
    arch = block((0.2 * length, 2.0 * width, thick), (-0.06 * length, 0.0, 0.0), edge=LEATHER)
    return cut(slab, arch)


def _slab(side: Array, depth: float) -> trimesh.Trimesh:
    """Return the space below a curve (n, 2) of points (x, z), down to z = 0, as a slab across y."""
    counts = max(2, round(depth / LEATHER))
    y = np.linspace(-depth / 2.0, depth / 2.0, counts + 1)
    rings = []
    for x, high in side:
        z = np.linspace(0.0, high, max(2, round(float(side[:, 1].max()) / LEATHER)) + 1)
        ring = [
            *((x, v, 0.0) for v in y[:-1]),
            *((x, y[-1], w) for w in z[:-1]),
            *((x, v, high) for v in y[:0:-1]),
            *((x, y[0], w) for w in z[:0:-1]),
        ]
        rings.append(np.array(ring))
    tips = [ring.mean(axis=0)[None] for ring in (rings[0], rings[-1])]
    return skin([tips[0], *rings, tips[1]], closed=False)
