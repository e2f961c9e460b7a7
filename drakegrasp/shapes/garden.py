"""Fruit and plants, tools and things of a yard.

One function per class: sizes come in, a watertight mesh goes out; see `drakegrasp.shapes.catalog`.
"""

from __future__ import annotations

import numpy as np
from trimesh import Trimesh

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.frames import Array
from drakegrasp.shapes.curves import (
    BROAD,
    EDGE,
    LARGE,
    arch,
    between,
    ellipse,
    joined,
    resample,
    rounded_polygon,
    rounded_rectangle,
    scaled,
    smooth,
    spread_evenly,
)
from drakegrasp.shapes.parts import (
    ball,
    block,
    lathe,
    loop_handle,
    moved,
    pillar,
    post,
    rod,
    rotated,
    scalloped,
    tube,
    vessel,
)
from drakegrasp.shapes.solids import bar, cut, extrude, flat_base, fuse, revolve, stand, sweep


def apple(*, radius: float, height: float) -> Trimesh:
    """Return an apple with a stem; `height` is without the stem."""
    side = smooth(scaled([
        (0.0, 0.07), (0.18, 0.03), (0.36, 0.0), (0.72, 0.16), (0.95, 0.42), (1.0, 0.62),
        (0.88, 0.86), (0.5, 1.0), (0.2, 0.93), (0.0, 0.82),
    ], radius, height), EDGE)  # fmt: skip
    return _with_stem(side, (0.0, 0.0, 0.7 * height), (0.004, 0.0, height + 0.010))


def pear(*, radius: float, neck_radius: float, height: float) -> Trimesh:
    """Return a pear that stands on its wide end, with a stem; `height` is without the stem."""
    side = smooth([
        (0.0, 0.04 * height), (0.35 * radius, 0.0), (0.85 * radius, 0.14 * height),
        (radius, 0.32 * height), (0.85 * radius, 0.5 * height), (neck_radius, 0.75 * height),
        (0.85 * neck_radius, 0.92 * height), (0.4 * neck_radius, height), (0.0, 0.98 * height),
    ], EDGE)  # fmt: skip
    return _with_stem(side, (0.0, 0.0, 0.85 * height), (-0.004, 0.0, height + 0.014))


def _with_stem(side: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Trimesh:
    """Return a fruit of a side (r, z) with a stem between two points (3,) [m]."""
    stem = bar(low, high, ellipse(0.0025, 0.0025, edge=0.002), normal=(0.0, 1.0, 0.0))
    return stand(fuse(revolve(side), stem))


def banana(*, bend_radius: float, angle: float, thickness: float) -> Trimesh:
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


def _single_banana(bend_radius: float, angle: float, thickness: float) -> Trimesh:
    """Return a banana that lies on its side."""
    theta = np.linspace(-angle / 2.0, angle / 2.0, round(bend_radius * angle / LARGE) + 1)
    scale = between([
        (0.0, 0.3), (0.03, 0.36), (0.1, 0.36), (0.24, 0.85), (0.5, 1.0), (0.78, 0.85), (0.95, 0.42),
        (1.0, 0.24),
    ], np.linspace(0.0, 1.0, len(theta)))  # fmt: skip

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


def mushroom(*, cap: float, stalk: float, height: float) -> Trimesh:
    """Return a mushroom: radii of its `cap` and its `stalk`."""
    low = 0.56 * height
    foot = smooth([
        (1.15 * stalk, 0.0), (1.25 * stalk, 0.1 * height), (0.88 * stalk, 0.34 * height),
        (0.85 * stalk, low + 0.004),
    ], EDGE)  # fmt: skip

    # The cap bulges a little below its rim.
    head = smooth([
        (0.9 * stalk, low + 0.004), (0.9 * cap, low - 0.006), (cap, low + 0.004),
        (0.9 * cap, 0.78 * height), (0.55 * cap, 0.95 * height), (0.12 * cap, height),
    ], EDGE)  # fmt: skip
    return lathe(joined(foot, head[1:]))


def pumpkin(*, radius: float, height: float, ribs: int) -> Trimesh:
    """Return a ribbed pumpkin with its stem; `height` is without the stem."""
    section = scalloped(radius, 0.13 * radius, ribs)
    s, c = sin_cos_deg(np.linspace(-90.0, 90.0, max(8, round(1.6 * height / EDGE)) + 1))
    # Squarer than an ellipsoid, and dented at the top.
    scales = np.maximum(c, 0.0) ** 0.72
    heights = height * (0.5 + 0.5 * np.sign(s) * np.abs(s) ** 1.1)
    heights = np.where(s > 0.0, heights - 0.12 * height * (1.0 - scales) ** 2, heights)
    fruit = extrude(section, np.column_stack([np.where(c < 1e-9, 0.0, scales), heights]))
    path = smooth(scaled([(0.0, 0.0, 0.75), (0.0, 0.0, 0.98), (0.16, 0.0, 1.16), (0.36, 0.0, 1.24)],
        radius, 1.0, height), EDGE)  # fmt: skip
    stem = tube(path, np.linspace(0.2 * radius, 0.11 * radius, len(path)))
    sunk = moved(fuse(fruit, stem), (0.0, 0.0, -0.02 * height))
    return flat_base(sunk)


def cactus(*, pot: float, radius: float, height: float) -> Trimesh:
    """Return a cactus with two arms in a `pot` of that radius at its rim."""
    rim = 0.95 * pot
    bowl = lathe(resample([
        (0.72 * pot, 0.0), (0.9 * pot, rim - 0.016), (pot, rim - 0.015), (pot, rim),
        (pot - 0.006, rim), (pot - 0.007, rim - 0.006),
    ], EDGE))  # fmt: skip

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
    parts = [bowl, extrude(section, profile)]
    for side, low, high in ((1.0, 0.36, 0.70), (-1.0, 0.50, 0.84)):
        z, up = (rim + share * (height - rim) for share in (low, high))
        reach = 1.95 * radius
        path = smooth([
            (0.3 * radius * side, 0.0, z), (0.86 * reach * side, 0.0, z + 0.004),
            (reach * side, 0.0, z + 0.5 * radius), (reach * side, 0.0, up),
        ], EDGE)  # fmt: skip
        arm = 0.46 * radius
        parts += [tube(path, arm), ball((reach * side, 0.0, up), arm)]
    return fuse(*parts)


def hammer(*, length: float, head_length: float, head_thickness: float) -> Trimesh:
    """Return a claw hammer that stands on its head, which is along y; `length` of its handle."""
    half = head_thickness / 2.0
    up = (0.0, 0.0, 1.0)
    grip = 0.013
    handle = bar((-length, 0.0, half), (0.0, 0.0, half), ellipse(0.85 * grip, grip, edge=EDGE),
        normal=up, scale=((0.0, 1.0), (0.3, 1.0), (0.55, 0.75), (1.0, 0.75)))  # fmt: skip

    # The head: a claw on one side, which bends up, and a round face on the other.
    reach = head_length / 2.0
    y = np.linspace(reach, -reach, 60)
    bend = np.clip(-(y + 0.012), 0.0, None)
    path = np.column_stack([-8.0 * bend**2, y, np.full_like(y, half)])
    path = spread_evenly(path, EDGE)
    scale = between([
        (-1.0, 0.18, 0.8), (-0.35, 0.75, 0.9), (0.0, 1.0, 1.0), (0.35, 1.0, 1.0),
        (0.55, 0.72, 0.72), (0.75, 1.0, 1.0), (0.93, 1.0, 1.0), (1.0, 0.88, 0.88),
    ], path[:, 1] / reach)  # fmt: skip
    section = rounded_rectangle(2.0 * half, 2.0 * half, 0.3 * half, edge=EDGE)
    head = sweep(path, section, normal=up, scale=scale)
    notch = block((0.1, 0.05, 0.15 * head_thickness), (0.0, 0.002 - reach, half))
    return stand(rotated(fuse(handle, cut(head, notch)), "y", 90.0))


def screwdriver(*, handle: float, radius: float, shaft: float) -> Trimesh:
    """Return a screwdriver that stands on its fluted `handle`, of that length as its `shaft`."""
    knots = [
        (0.86, 0.0), (0.96, 0.03), (1.0, 0.12), (1.0, 0.6), (0.74, 0.78), (0.7, 0.88), (0.8, 0.96),
        (0.62, 1.0),
    ]  # fmt: skip
    side = resample(scaled(knots, radius, handle), EDGE) / [radius, 1.0]
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
    return fuse(grip, post(low, high - 0.14 * shaft, steel, edge=0.8 * EDGE), blade)


def mallet(*, length: float, head_length: float, radius: float) -> Trimesh:
    """Return a mallet that lies on its side: handle along -x, a round head along y."""
    grip = 0.4 * radius + 0.004
    half, band = head_length / 2.0, radius + 0.002
    side = smooth([
        (0.88 * radius, -half), (radius, 0.006 - half), (radius, half - 0.006),
        (0.88 * radius, half),
    ], EDGE)  # fmt: skip
    head = moved(lathe(side, edge=BROAD), (0.0, 0.0, band), x=90.0)
    bands = [
        moved(post(y - 0.006, y + 0.006, band), (0.0, 0.0, band), x=90.0)
        for y in (-0.62 * half, 0.62 * half)
    ]
    # The handle leans, so that the knob at its end lies on the table as the bands do.
    handle = rod((-length, 0.0, 1.06 * grip), (0.4 * radius, 0.0, band), grip, 0.8 * grip)
    knob = ball((-length, 0.0, 1.12 * grip), (1.0 * grip, 1.15 * grip, 1.12 * grip))
    return stand(fuse(head, *bands, handle, knob))


def padlock(*, width: float, height: float, depth: float, shackle: float) -> Trimesh:
    """Return a closed padlock: its body, and a `shackle` that reaches so far above it."""
    radius = 0.085 * width + 0.001
    body = moved(
        pillar(
            [(-depth / 2.0, width, height), (depth / 2.0, width, height)],
            corner=0.2 * width,
            edge=BROAD,
        ),
        (0.0, 0.0, height / 2.0),
        x=90.0,
    )

    # The shackle, and a keyhole.
    reach = 0.33 * width
    top = height + (shackle - radius - reach)
    bend = arch(reach, reach, z=top, degrees=(0.0, 180.0), count=24)
    path = joined([(reach, 0.0, height - 0.012)], bend, [(-reach, 0.0, height - 0.012)])
    bow = tube(resample(path, EDGE), radius)
    hole = rod(
        (0.0, -depth, 0.52 * height), (0.0, 0.004 - depth / 2.0, 0.52 * height), 0.085 * width
    )
    slit = block(
        (0.075 * width, depth, 0.2 * height), (0.0, 0.004 - depth, 0.4 * height), corner=0.001
    )
    return fuse(cut(body, fuse(hole, slit)), bow)


def watering_can(*, radius: float, height: float, spout: float) -> Trimesh:
    """Return a watering can: a long `spout` with a rose towards +x, a handle at -x."""
    side = resample(scaled([(1.0, 0.0), (1.0, 0.82), (0.8, 1.0)], radius, height), BROAD)
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
        post(height - 0.007, height, 0.8 * radius - 0.001, edge=BROAD),
        block((2.0 * radius, 2.0 * radius, 0.1), (-1.05 * radius, 0.0, height)),
    )
    return fuse(body, cover, cut(fuse(pipe, rose), core), cut(handle, core))


def bucket(*, top_radius: float, bottom_radius: float, height: float) -> Trimesh:
    """Return a bucket with its bail up, in the plane y = 0."""
    wall = 0.005
    body = vessel(
        resample([(bottom_radius, 0.0), (top_radius, height)], BROAD),
        wall=wall,
        floor=0.008,
        edge=BROAD,
    )[0]
    rim = lathe([
        (top_radius - 0.002, height - 0.01), (top_radius + 0.003, height - 0.009),
        (top_radius + 0.003, height - 0.001), (top_radius - 0.002, height),
    ], edge=BROAD)  # fmt: skip
    hole = post(height - 0.05, height + 0.05, top_radius - wall + 0.0005, edge=BROAD)

    # The bail stands up, with a grip in its middle.
    bail = arch(
        top_radius + 0.002, 0.95 * top_radius, z=height - 0.012, degrees=(0.0, 180.0), count=40
    )
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


def traffic_cone(*, base: float, radius: float, height: float) -> Trimesh:
    """Return a traffic cone: edge of its square `base`, `radius` of its foot."""
    tip, foot = 0.26 * radius, 0.012
    ridges = []
    for low, high in ((0.34, 0.52), (0.68, 0.82)):
        ends = [foot + share * (height - foot) for share in (low, high)]
        sizes = [radius + share * (tip - radius) + 0.0022 for share in (low, high)]
        ridges.append(post(*ends, *sizes))
    plate = pillar([(0.0, base, base), (foot, 0.96 * base, 0.96 * base)], corner=0.15 * base)
    cone = post(0.004, height, radius, tip)
    return fuse(plate, cone, *ridges)


def barrel(*, radius: float, bulge: float, height: float) -> Trimesh:
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
        ring = post(low * height, high * height, *sizes, edge=BROAD)
        # Only the rim: the inside of the top stays free.
        hole = post(-0.1, 2.0 * height, radius - 0.004, edge=BROAD)
        hoops.append(cut(ring, hole))
    return fuse(staves, *hoops)


def garbage_bin(*, width: float, height: float) -> Trimesh:
    """Return a bin on two wheels, its lid closed: front towards +x, wheels and bar at -x."""
    depth, wheel = 1.08 * width, 0.16 * width
    body = pillar(
        [(0.0, 0.72 * depth, 0.74 * width, 0.05 * depth, 0.0), (height, depth, width, 0.0, 0.0)],
        corner=0.08 * width,
        edge=LARGE,
    )
    rim = block(
        (1.1 * depth, 1.1 * width, 0.01),
        (0.0, 0.0, height - 0.003),
        corner=0.09 * width,
        edge=LARGE,
    )
    lid = pillar(
        [
            (height, 1.08 * depth, 1.06 * width, 0.0, 0.0),
            (height + 0.13 * width, 0.86 * depth, 0.88 * width, -0.05 * depth, 0.0),
            (height + 0.17 * width, 0.6 * depth, 0.7 * width, -0.1 * depth, 0.0),
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
