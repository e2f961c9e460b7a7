"""Tools and things of a yard, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. All lengths are in [m]
and all angles in [rad]; `drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.shapes.modelling.booleans import cut, fuse, stand
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
    ellipse,
    resample,
    rounded_rectangle,
    smooth,
    spread_evenly,
)
from drakegrasp.shapes.modelling.solids import bar, extrude, sweep
from drakegrasp.shapes.vessels import loop_handle, vessel


def hammer(*, length: float, head_length: float, head_thickness: float) -> trimesh.Trimesh:
    """Return a claw hammer that stands on its head, which is along y; `length` of its handle."""
    half = head_thickness / 2.0
    up = (0.0, 0.0, 1.0)
    grip = 0.013
    handle = bar(
        (-length, 0.0, half),
        (0.0, 0.0, half),
        ellipse(0.85 * grip, grip, edge=EDGE),
        normal=up,
        scale=((0.0, 1.0), (0.3, 1.0), (0.55, 0.75), (1.0, 0.75)),
    )

    # The head: a claw on one side, which bends up, and a round face on the other.
    reach = head_length / 2.0
    y = np.linspace(reach, -reach, 60)
    bend = np.clip(-(y + 0.012), 0.0, None)
    path = np.column_stack([-8.0 * bend**2, y, np.full_like(y, half)])
    path = spread_evenly(path, EDGE)
    knots = np.array(
        [
            (-1.0, 0.18, 0.8),
            (-0.35, 0.75, 0.9),
            (0.0, 1.0, 1.0),
            (0.35, 1.0, 1.0),
            (0.55, 0.72, 0.72),
            (0.75, 1.0, 1.0),
            (0.93, 1.0, 1.0),
            (1.0, 0.88, 0.88),
        ]
    )
    scale = PchipInterpolator(knots[:, 0], knots[:, 1:])(path[:, 1] / reach)
    section = rounded_rectangle(2.0 * half, 2.0 * half, 0.3 * half, edge=EDGE)
    head = sweep(path, section, normal=up, scale=scale)
    notch = block((0.1, 0.05, 0.15 * head_thickness), (0.0, 0.002 - reach, half))
    return stand(rotated(fuse(handle, cut(head, notch)), "y", 90.0))


def screwdriver(*, handle: float, radius: float, shaft: float) -> trimesh.Trimesh:
    """Return a screwdriver that stands on its fluted `handle`, of that length as its `shaft`."""
    knots = [
        (0.86, 0.0),
        (0.96, 0.03),
        (1.0, 0.12),
        (1.0, 0.60),
        (0.74, 0.78),
        (0.70, 0.88),
        (0.80, 0.96),
        (0.62, 1.0),
    ]
    side = resample([(scale * radius, z * handle) for scale, z in knots], EDGE) / [radius, 1.0]
    flat_end = [(0.86 * share, 0.0) for share in (0.0, 0.5)]
    grip = extrude(
        scalloped(radius, 0.13 * radius, 6), [*flat_end, *side, (0.3, handle), (0.0, handle)]
    )

    # The shaft, its end a flat blade.
    steel = max(0.0045, 0.24 * radius)
    low, high = handle - 0.01, handle + shaft
    blade = pillar(
        [
            (high - 0.24 * shaft, 1.5 * steel, 1.5 * steel),
            (high - 0.12 * shaft, 2.9 * steel, 1.3 * steel),
            (high, 2.5 * steel, 0.65 * steel),
        ],
        corner=0.3 * steel,
        edge=0.8 * EDGE,
    )
    return fuse(
        grip, rod((0.0, 0.0, low), (0.0, 0.0, high - 0.14 * shaft), steel, edge=0.8 * EDGE), blade
    )


def mallet(*, length: float, head_length: float, radius: float) -> trimesh.Trimesh:
    """Return a mallet that lies on its side: handle along -x, a round head along y."""
    grip = 0.4 * radius + 0.004
    half, band = head_length / 2.0, radius + 0.002
    side = smooth(
        [
            (0.88 * radius, -half),
            (radius, 0.006 - half),
            (radius, half - 0.006),
            (0.88 * radius, half),
        ],
        EDGE,
    )
    head = moved(rotated(lathe(side, edge=BROAD), "x", 90.0), (0.0, 0.0, band))
    bands = [
        moved(
            rotated(rod((0.0, 0.0, y - 0.006), (0.0, 0.0, y + 0.006), band), "x", 90.0),
            (0.0, 0.0, band),
        )
        for y in (-0.62 * half, 0.62 * half)
    ]
    # The handle leans, so that the knob at its end lies on the table as the bands do.
    handle = rod((-length, 0.0, 1.06 * grip), (0.4 * radius, 0.0, band), grip, 0.8 * grip)
    knob = ball((-length, 0.0, 1.12 * grip), (1.0 * grip, 1.15 * grip, 1.12 * grip))
    return stand(fuse(head, *bands, handle, knob))


def padlock(*, width: float, height: float, depth: float, shackle: float) -> trimesh.Trimesh:
    """Return a closed padlock: its body, and a `shackle` that reaches so far above it."""
    radius = 0.085 * width + 0.001
    body = moved(
        rotated(
            pillar(
                [(-depth / 2.0, width, height), (depth / 2.0, width, height)],
                corner=0.2 * width,
                edge=BROAD,
            ),
            "x",
            90.0,
        ),
        (0.0, 0.0, height / 2.0),
    )

    # The shackle, and a keyhole.
    reach = 0.33 * width
    s, c = sin_cos_deg(np.linspace(0.0, 180.0, 24))
    rise = shackle - radius - reach
    arch = np.column_stack([reach * c, 0.0 * c, height + rise + reach * s])
    path = np.vstack([[(reach, 0.0, height - 0.012)], arch, [(-reach, 0.0, height - 0.012)]])
    bow = tube(resample(path, EDGE), radius)
    hole = rod(
        (0.0, -depth, 0.52 * height), (0.0, 0.004 - depth / 2.0, 0.52 * height), 0.085 * width
    )
    slit = block(
        (0.075 * width, depth, 0.2 * height), (0.0, 0.004 - depth, 0.40 * height), corner=0.001
    )
    return fuse(cut(body, fuse(hole, slit)), bow)


def watering_can(*, radius: float, height: float, spout: float) -> trimesh.Trimesh:
    """Return a watering can: a long `spout` with a rose towards +x, a handle at -x."""
    side = resample([(radius, 0.0), (radius, 0.82 * height), (0.8 * radius, height)], BROAD)
    body, core = vessel(side, wall=0.005, floor=0.008, edge=BROAD)
    tip = (radius + spout, 0.0, 1.12 * height)
    start = (0.9 * radius, 0.0, 0.22 * height)
    towards = np.subtract(tip, start) / np.linalg.norm(np.subtract(tip, start))
    pipe = rod(start, tip, 0.20 * radius, 0.11 * radius)
    rose = rod(
        np.asarray(tip) - 0.008 * towards,
        np.asarray(tip) + 0.022 * towards,
        0.12 * radius,
        0.42 * radius,
    )
    handle = rotated(
        loop_handle(
            x=0.92 * radius,
            top=0.98 * height,
            bottom=0.25 * height,
            reach=0.75 * radius,
            radius=0.0055,
            edge=BROAD,
        ),
        "z",
        180.0,
    )
    # The front half of the top is covered.
    cover = cut(
        rod((0.0, 0.0, height - 0.007), (0.0, 0.0, height), 0.8 * radius - 0.001, edge=BROAD),
        block((2.0 * radius, 2.0 * radius, 0.1), (-1.05 * radius, 0.0, height)),
    )
    return fuse(body, cover, cut(fuse(pipe, rose), core), cut(handle, core))


def bucket(*, top_radius: float, bottom_radius: float, height: float) -> trimesh.Trimesh:
    """Return a bucket with its bail up, in the plane y = 0."""
    wall = 0.005
    body = vessel(
        resample([(bottom_radius, 0.0), (top_radius, height)], BROAD),
        wall=wall,
        floor=0.008,
        edge=BROAD,
    )[0]
    rim = lathe(
        [
            (top_radius - 0.002, height - 0.010),
            (top_radius + 0.003, height - 0.009),
            (top_radius + 0.003, height - 0.001),
            (top_radius - 0.002, height),
        ],
        edge=BROAD,
    )
    hole = rod(
        (0.0, 0.0, height - 0.05), (0.0, 0.0, height + 0.05), top_radius - wall + 0.0005, edge=BROAD
    )

    # The bail stands up, with a grip in its middle.
    s, c = sin_cos_deg(np.linspace(0.0, 180.0, 40))
    reach = top_radius + 0.002
    bail = np.column_stack([reach * c, 0.0 * c, height - 0.012 + 0.95 * top_radius * s])
    ears = [
        ball((side * (top_radius + 0.001), 0.0, height - 0.012), (0.006, 0.009, 0.009))
        for side in (-1.0, 1.0)
    ]
    grip = rod(
        (-0.022, 0.0, height - 0.012 + 0.95 * top_radius),
        (0.022, 0.0, height - 0.012 + 0.95 * top_radius),
        0.0085,
    )
    return fuse(fuse(body, cut(rim, hole)), *ears, tube(resample(bail, EDGE), 0.004), grip)


def traffic_cone(*, base: float, radius: float, height: float) -> trimesh.Trimesh:
    """Return a traffic cone: edge of its square `base`, `radius` of its foot."""
    tip, foot = 0.26 * radius, 0.012
    ridges = []
    for low, high in ((0.34, 0.52), (0.68, 0.82)):
        ends = [foot + share * (height - foot) for share in (low, high)]
        sizes = [radius + share * (tip - radius) + 0.0022 for share in (low, high)]
        ridges.append(rod((0.0, 0.0, ends[0]), (0.0, 0.0, ends[1]), sizes[0], sizes[1]))
    plate = pillar([(0.0, base, base), (foot, 0.96 * base, 0.96 * base)], corner=0.15 * base)
    cone = rod((0.0, 0.0, 0.004), (0.0, 0.0, height), radius, tip)
    return fuse(plate, cone, *ridges)


def barrel(*, radius: float, bulge: float, height: float) -> trimesh.Trimesh:
    """Return a barrel with four hoops: `radius` of its ends, its middle wider by `bulge`."""
    inset = 0.006
    levels = np.linspace(0.0, 1.0, max(10, round(height / BROAD)) + 1)
    reach = radius + bulge * 4.0 * levels * (1.0 - levels)
    side = np.column_stack([reach, height * levels])
    head = [(radius - 0.006, height), (radius - 0.007, height - inset), (0.0, height - inset)]
    staves = lathe(np.vstack([side, resample(head, BROAD)[:-1]]), edge=BROAD)
    hoops = []
    for low, high in ((0.03, 0.10), (0.26, 0.33), (0.67, 0.74), (0.90, 0.97)):
        sizes = [radius + bulge * 4.0 * share * (1.0 - share) + 0.0022 for share in (low, high)]
        ring = rod((0.0, 0.0, low * height), (0.0, 0.0, high * height), *sizes, edge=BROAD)
        # Only the rim: the inside of the top stays free.
        hole = rod((0.0, 0.0, -0.1), (0.0, 0.0, 2.0 * height), radius - 0.004, edge=BROAD)
        hoops.append(cut(ring, hole))
    return fuse(staves, *hoops)


def garbage_bin(*, width: float, height: float) -> trimesh.Trimesh:
    """Return a bin on two wheels, its lid closed: front towards +x, wheels and bar at -x."""
    depth, wheel = 1.08 * width, 0.16 * width
    body = pillar(
        [(0.0, 0.72 * depth, 0.74 * width, 0.05 * depth, 0.0), (height, depth, width, 0.0, 0.0)],
        corner=0.08 * width,
        edge=LARGE,
    )
    rim = block(
        (1.1 * depth, 1.1 * width, 0.010),
        (0.0, 0.0, height - 0.003),
        corner=0.09 * width,
        edge=LARGE,
    )
    lid = pillar(
        [
            (height, 1.08 * depth, 1.06 * width, 0.0, 0.0),
            (height + 0.13 * width, 0.86 * depth, 0.88 * width, -0.05 * depth, 0.0),
            (height + 0.17 * width, 0.6 * depth, 0.7 * width, -0.10 * depth, 0.0),
        ],
        corner=0.09 * width,
        edge=LARGE,
    )

    # Wheels on an axle, and the bar by which it is pulled.
    x = -0.36 * depth
    wheels = [
        rod((x, 0.34 * side * width, wheel), (x, 0.54 * side * width, wheel), wheel)
        for side in (-1.0, 1.0)
    ]
    axle = rod((x, -0.4 * width, wheel), (x, 0.4 * width, wheel), 0.35 * wheel)
    bar = rod(
        (-0.62 * depth, -0.42 * width, height - 0.008),
        (-0.62 * depth, 0.42 * width, height - 0.008),
        0.006,
    )
    arms = [
        rod(
            (-0.62 * depth, 0.38 * side * width, height - 0.008),
            (-0.45 * depth, 0.38 * side * width, height - 0.008),
            0.0055,
        )
        for side in (-1.0, 1.0)
    ]
    return fuse(body, rim, lid, *wheels, axle, bar, *arms)
