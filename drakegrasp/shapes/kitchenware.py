"""Things of a kitchen, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. All lengths are in [m]
and all angles in [rad]; `drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.shapes.modelling.booleans import cut, fuse
from drakegrasp.shapes.modelling.primitives import (
    ball,
    block,
    lathe,
    moved,
    pillar,
    rod,
    rotated,
    scalloped,
    tube,
)
from drakegrasp.shapes.modelling.profiles import (
    BROAD,
    EDGE,
    LARGE,
    resample,
    rounded_rectangle,
    smooth,
)
from drakegrasp.shapes.modelling.solids import extrude, revolve, sweep
from drakegrasp.shapes.vessels import loop_handle


def toaster(*, length: float, width: float, height: float) -> trimesh.Trimesh:
    """Return a toaster with two slots along x and a lever at +x."""
    foot = 0.006
    across = rounded_rectangle(height - foot, width, 0.2 * width, edge=LARGE)
    stations = resample(
        [[-length / 2.0], [0.004 - length / 2.0], [length / 2.0 - 0.004], [length / 2.0]], LARGE
    )[:, 0]
    middle = (height + foot) / 2.0
    path = np.column_stack([stations, 0.0 * stations, np.full_like(stations, middle)])
    scale = np.ones(len(stations))
    scale[[0, -1]] = 0.94
    body = sweep(path, across, normal=(0.0, 1.0, 0.0), scale=scale)
    feet = [
        block(
            (0.014, 0.014, 2.0 * foot + 0.016),
            (0.36 * x * length, 0.24 * y * width, foot + 0.008),
            edge=LARGE,
        )
        for x in (-1.0, 1.0)
        for y in (-1.0, 1.0)
    ]

    slots = [
        block(
            (0.78 * length, 0.17 * width, 0.11),
            (0.0, 0.19 * side * width, 0.42 * height + 0.055),
            edge=LARGE,
        )
        for side in (-1.0, 1.0)
    ]
    groove = block((0.02, 0.009, 0.5 * height), (length / 2.0 + 0.005, 0.0, 0.56 * height))
    lever = block((0.03, 0.30 * width, 0.011), (length / 2.0 + 0.004, 0.0, 0.72 * height))
    dial = rod(
        (length / 2.0 - 0.01, 0.3 * width, 0.3 * height),
        (length / 2.0 + 0.008, 0.3 * width, 0.3 * height),
        0.0085,
        edge=0.7 * EDGE,
    )
    return fuse(cut(fuse(body, *feet), *slots, groove), lever, dial)


def coffeemaker(*, width: float, depth: float, height: float) -> trimesh.Trimesh:
    """Return a coffee machine with its tank at -x and its jug in front, towards +x."""
    tank = 0.36 * depth
    jug, floor, head = 0.36 * width, 0.020, 0.24 * height
    x = 0.5 * depth - 0.42 * width
    parts = [
        block((depth, width, floor), (0.0, 0.0, floor / 2.0), corner=0.01, edge=2.0 * BROAD),
        block(
            (tank, width, height),
            ((tank - depth) / 2.0, 0.0, height / 2.0),
            corner=0.01,
            edge=2.0 * BROAD,
        ),
        pillar(
            [(height - head, 0.86 * depth, 0.94 * width), (height, depth, width)],
            corner=0.012,
            edge=2.0 * BROAD,
        ),
        # The filter under the head.
        moved(
            lathe(resample([(0.45 * jug, 0.0), (0.8 * jug, 0.02)], BROAD), edge=LARGE),
            (x, 0.0, height - head - 0.014),
        ),
    ]

    # The jug on its plate, with a handle.
    top = 0.52 * height
    side = smooth(
        [
            (0.8 * jug, 0.0),
            (jug, 0.3 * (top - floor)),
            (0.9 * jug, 0.65 * (top - floor)),
            (0.62 * jug, 0.9 * (top - floor)),
            (0.68 * jug, top - floor),
        ],
        LARGE,
    )
    parts.append(moved(lathe(side, edge=LARGE), (x, 0.0, floor - 0.002)))
    handle = loop_handle(
        x=x + 0.6 * jug,
        top=0.92 * top,
        bottom=floor + 0.22 * (top - floor),
        reach=0.78 * jug,
        radius=0.0045,
        edge=LARGE,
    )
    parts.append(handle)
    lamp = ball((0.5 * depth, 0.25 * width, height - 0.5 * head), 0.006, edge=0.6 * EDGE)
    return fuse(*parts, lamp)


def teapot(*, radius: float, height: float, spout: float) -> trimesh.Trimesh:
    """Return a teapot with its lid on: spout towards +x by `spout`, handle at -x."""
    body = lathe(
        smooth(
            [
                (0.58 * radius, 0.0),
                (0.62 * radius, 0.03 * height),
                (radius, 0.42 * height),
                (0.78 * radius, 0.76 * height),
                (0.46 * radius, 0.86 * height),
            ],
            BROAD,
        ),
        edge=BROAD,
    )
    lid = lathe(
        [
            *resample([(0.5 * radius, 0.84 * height), (0.5 * radius, 0.88 * height)], BROAD),
            *smooth([(0.4 * radius, 0.93 * height), (0.12 * radius, height)], BROAD),
        ],
        edge=BROAD,
    )
    button = ball((0.0, 0.0, 1.06 * height), (0.17 * radius, 0.17 * radius, 0.09 * height))

    # An S-shaped spout that narrows, and a round handle.
    path = smooth(
        [
            (0.7 * radius, 0.0, 0.30 * height),
            (radius + 0.35 * spout, 0.0, 0.40 * height),
            (radius + 0.65 * spout, 0.0, 0.66 * height),
            (radius + spout, 0.0, 0.86 * height),
        ],
        EDGE,
    )
    size = np.linspace(0.24 * radius, 0.11 * radius, len(path))
    handle = loop_handle(
        x=0.72 * radius,
        top=0.76 * height,
        bottom=0.24 * height,
        reach=0.78 * radius,
        radius=0.11 * radius,
        edge=BROAD,
    )
    pipe = tube(path, size, edge=0.9 * EDGE)
    return fuse(body, lid, button, pipe, rotated(handle, "z", 180.0))


def juicer(*, radius: float, rim: float, cone: float) -> trimesh.Trimesh:
    """Return a citrus juicer: a dish with a rim of height `rim`, and in it a ribbed `cone`."""
    wall = 0.005
    side = smooth([(0.7 * radius, 0.0), (0.92 * radius, 0.3 * rim), (radius, rim)], BROAD)
    inner = smooth(
        [(radius - wall, rim), (0.86 * radius, 0.5 * rim), (0.62 * radius, 0.32 * rim)], BROAD
    )
    dish = revolve(
        np.vstack(
            [
                resample([(0.0, 0.0), side[0]], 1.5 * BROAD)[:-1],
                side,
                inner,
                resample([inner[-1], (0.0, 0.3 * rim)], 1.5 * BROAD)[1:],
            ]
        ),
        edge=BROAD,
    )
    ribs = scalloped(0.5 * radius, 0.07 * radius, 10, edge=BROAD)
    heights = np.linspace(0.0, 1.0, max(5, round(cone / BROAD)) + 1)
    profile = [
        *((0.9 * share, 0.2 * rim) for share in (0.0, 0.5)),
        *(
            (float(np.sqrt(max(0.0, 1.0 - h**1.6))), 0.2 * rim + h * (cone - 0.2 * rim))
            for h in heights
        ),
    ]

    handle = block(
        (0.5 * radius, 0.36 * radius, 0.008),
        (-1.15 * radius, 0.0, rim - 0.006),
        corner=0.12 * radius,
    )
    lip = pillar(
        [
            (rim - 0.015, 0.10 * radius, 0.12 * radius, 0.93 * radius, 0.0),
            (rim, 0.3 * radius, 0.3 * radius, 1.03 * radius, 0.0),
        ],
        corner=0.04 * radius,
    )
    return fuse(dish, extrude(ribs, profile), handle, lip)


def pepper_mill(*, radius: float, waist: float, height: float) -> trimesh.Trimesh:
    """Return a turned pepper mill: `radius` of its foot, `waist` the radius at its narrowest."""
    side = smooth(
        [
            (radius, 0.0),
            (radius, 0.10 * height),
            (0.82 * radius, 0.15 * height),
            (waist, 0.38 * height),
            (0.92 * radius, 0.60 * height),
            (0.80 * radius, 0.66 * height),
            (0.52 * radius, 0.69 * height),
            (0.86 * radius, 0.74 * height),
            (0.92 * radius, 0.80 * height),
            (0.66 * radius, 0.89 * height),
            (0.16 * radius, 0.915 * height),
        ],
        0.8 * EDGE,
    )
    button = ball((0.0, 0.0, 0.945 * height), 0.055 * height)
    return fuse(lathe(side), button)
