"""Plants, one function per class: sizes in metres come in, watertight meshes go out.

Every mesh stands on the plane z = 0 as it would on a table, z up. All lengths are in [m];
`drakegrasp.objects.builtin.catalog` holds the table of sizes.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.objects.builtin.booleans import flat_base, fuse
from drakegrasp.objects.builtin.modelling import extrude
from drakegrasp.objects.builtin.primitives import ball, lathe, moved, scalloped, tube
from drakegrasp.objects.builtin.profiles import EDGE, resample, smooth


def mushroom(*, cap: float, stalk: float, height: float) -> trimesh.Trimesh:
    """Return a mushroom: radii of its `cap` and its `stalk`."""
    low = 0.56 * height
    side = np.vstack(
        [
            smooth([(1.15 * stalk, 0.0), (1.25 * stalk, 0.10 * height), (0.88 * stalk, 0.34 * height),
                    (0.85 * stalk, low + 0.004)], EDGE),
            smooth([(0.9 * stalk, low + 0.004), (0.9 * cap, low - 0.006), (cap, low + 0.004),
                    (0.90 * cap, 0.78 * height), (0.55 * cap, 0.95 * height),
                    (0.12 * cap, height)], EDGE)[1:],
        ]
    )  # fmt: skip
    return lathe(side)


def pumpkin(*, radius: float, height: float, ribs: int) -> trimesh.Trimesh:
    """Return a ribbed pumpkin with its stem; `height` is without the stem."""
    section = scalloped(radius, 0.13 * radius, ribs)
    s, c = sin_cos_deg(np.linspace(-90.0, 90.0, max(8, round(1.6 * height / EDGE)) + 1))
    # Squarer than an ellipsoid, and dented at the top.
    scales, heights = np.maximum(c, 0.0) ** 0.72, height * (0.5 + 0.5 * np.sign(s) * np.abs(s) ** 1.1)
    heights = np.where(s > 0.0, heights - 0.12 * height * (1.0 - scales) ** 2, heights)
    fruit = extrude(section, np.column_stack([np.where(c < 1e-9, 0.0, scales), heights]))
    path = smooth(
        [(0.0, 0.0, 0.75 * height), (0.0, 0.0, 0.98 * height), (0.16 * radius, 0.0, 1.16 * height),
         (0.36 * radius, 0.0, 1.24 * height)], EDGE,
    )  # fmt: skip
    stem = tube(path, np.linspace(0.2 * radius, 0.11 * radius, len(path)))
    sunk = moved(fuse(fruit, stem), (0.0, 0.0, -0.02 * height))
    return flat_base(sunk)


def cactus(*, pot: float, radius: float, height: float) -> trimesh.Trimesh:
    """Return a cactus with two arms in a `pot` of that radius at its rim."""
    rim = 0.95 * pot
    vessel = lathe(
        resample([(0.72 * pot, 0.0), (0.9 * pot, rim - 0.016), (pot, rim - 0.015), (pot, rim),
                  (pot - 0.006, rim), (pot - 0.007, rim - 0.006)], EDGE)
    )  # fmt: skip
    section = scalloped(radius, 0.16 * radius, 8, edge=EDGE)
    s, c = sin_cos_deg(np.linspace(15.0, 90.0, 6))
    top = height - radius
    profile = [
        *((share, rim - 0.02) for share in (0.0, 0.5)),
        *((1.0, float(z)) for z in np.linspace(rim - 0.02, top, max(4, round((top - rim) / EDGE)))),
        *((float(x) if x > 1e-9 else 0.0, float(top + radius * z)) for x, z in zip(c, s, strict=True)),
    ]
    parts = [vessel, extrude(section, profile)]
    for side, low, high in ((1.0, 0.36, 0.70), (-1.0, 0.50, 0.84)):
        z, up = (rim + share * (height - rim) for share in (low, high))
        reach = 1.95 * radius
        path = smooth([(0.3 * radius * side, 0.0, z), (0.86 * reach * side, 0.0, z + 0.004),
                       (reach * side, 0.0, z + 0.5 * radius), (reach * side, 0.0, up)], EDGE)  # fmt: skip
        arm = 0.46 * radius
        parts += [tube(path, arm), ball((reach * side, 0.0, up), arm)]
    return fuse(*parts)
