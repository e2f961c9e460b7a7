"""Fruit and plants, tools, and objects of a yard.

One function per class: sizes come in, a watertight mesh goes out; see `drakegrasp.shapes.catalog`.
"""

from __future__ import annotations

import numpy as np
from trimesh import Trimesh

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.frames import Array
from drakegrasp.shapes.parts import (
    SIDES,
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
from drakegrasp.shapes.solids import (
    BROAD,
    EDGE,
    LARGE,
    arch,
    bar,
    between,
    cut,
    ellipse,
    extrude,
    flat_base,
    fuse,
    joined,
    resample,
    revolve,
    rounded_polygon,
    rounded_rectangle,
    scaled,
    smooth,
    spread_evenly,
    stand,
    sweep,
)


def apple(*, radius: float, height: float) -> Trimesh:
    """Return an apple with a stem; `height` does not include the stem."""
    side = smooth(scaled([
        (0.0, 0.07), (0.18, 0.03), (0.36, 0.0), (0.72, 0.16), (0.95, 0.42), (1.0, 0.62),
        (0.88, 0.86), (0.5, 1.0), (0.2, 0.93), (0.0, 0.82),
    ], radius, height), EDGE)  # fmt: skip
    return _with_stem(side, (0.0, 0.0, 0.7 * height), (0.004, 0.0, height + 0.010))


def pear(*, radius: float, neck_radius: float, height: float) -> Trimesh:
    """Return a pear with a stem that stands on its wide end; `height` excludes the stem."""
    side = smooth([
        (0.0, 0.04 * height), (0.35 * radius, 0.0), (0.85 * radius, 0.14 * height),
        (radius, 0.32 * height), (0.85 * radius, 0.5 * height), (neck_radius, 0.75 * height),
        (0.85 * neck_radius, 0.92 * height), (0.4 * neck_radius, height), (0.0, 0.98 * height),
    ], EDGE)  # fmt: skip
    return _with_stem(side, (0.0, 0.0, 0.85 * height), (-0.004, 0.0, height + 0.014))


def _with_stem(side: Array, low: tuple[float, ...], high: tuple[float, ...]) -> Trimesh:
    """Return a fruit with a profile (r, z) and a stem between two points (3,) [m]."""
    stem = bar(low, high, ellipse(0.0025, 0.0025, edge=0.002))
    return stand(fuse(revolve(side), stem))


def banana(*, bend_radius: float, angle: float, thickness: float) -> Trimesh:
    """Return a bunch of three bananas, bent by `angle` around `bend_radius`, one on two others."""
    # Two bananas side by side and one on top, overlapping a little; their stalks meet in a crown.
    aside = 0.41 * thickness
    bunch = [
        moved(_single_banana(bend_radius + wider * thickness, angle, thickness), (0.0, y, z))
        for wider, y, z in (
            (0.0, -aside, 0.0),
            (0.82, aside, 0.0),
            (0.41, 0.0, 1.45 * (thickness / 2.0)),
        )
    ]
    s, c = (float(value) for value in sin_cos_deg(np.degrees(-angle / 2.0)))
    reach = bend_radius + aside
    place = (reach * s, reach * (c - 1.0), 0.5 * thickness)
    return flat_base(fuse(*bunch, ball(place, scaled((0.26, 0.52, 0.5), thickness))))


def _single_banana(bend_radius: float, angle: float, thickness: float) -> Trimesh:
    """Return a banana that lies on its side."""
    theta = np.linspace(-angle / 2.0, angle / 2.0, round(bend_radius * angle / LARGE) + 1)
    scale = between([
        (0.0, 0.3), (0.03, 0.36), (0.1, 0.36), (0.24, 0.85), (0.5, 1.0), (0.78, 0.85), (0.95, 0.42),
        (1.0, 0.24),
    ], np.linspace(0.0, 1.0, len(theta)))  # fmt: skip

    # Five soft edges, with one face down; the underside is on the table along the whole fruit.
    half = thickness / 2.0
    turns = 2.0 * np.pi * np.arange(5) / 5.0 - np.pi / 2.0 + np.pi / 5.0
    corners = 1.18 * half * np.column_stack([np.cos(turns), np.sin(turns)])
    section = rounded_polygon(corners, 0.45 * half, edge=LARGE)
    x, y = bend_radius * np.sin(theta), bend_radius * (np.cos(theta) - 1.0)
    path = np.column_stack([x, y, -section[:, 1].min() * (0.35 + 0.65 * scale)])
    return sweep(path, section, normal=(0.0, 0.0, 1.0), scale=scale)


def mushroom(*, cap: float, stalk: float, height: float) -> Trimesh:
    """Return a mushroom; `cap` and `stalk` are radii."""
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
    """Return a ribbed pumpkin with a stem; `height` does not include the stem."""
    section = scalloped(radius, 0.13 * radius, ribs)
    s, c = sin_cos_deg(np.linspace(-90.0, 90.0, max(8, round(1.6 * height / EDGE)) + 1))
    # It is squarer than an ellipsoid, and dented at the top.
    scales = np.maximum(c, 0.0) ** 0.72
    heights = height * (0.5 + 0.5 * np.sign(s) * np.abs(s) ** 1.1)
    heights = np.where(s > 0.0, heights - 0.12 * height * (1.0 - scales) ** 2, heights)
    fruit = extrude(section, np.column_stack([np.where(c < 1e-9, 0.0, scales), heights]))
    knots = [(0.0, 0.0, 0.75), (0.0, 0.0, 0.98), (0.16, 0.0, 1.16), (0.36, 0.0, 1.24)]
    path = smooth(scaled(knots, radius, 1.0, height), EDGE)
    stem = tube(path, np.linspace(0.2 * radius, 0.11 * radius, len(path)))
    return flat_base(moved(fuse(fruit, stem), (0.0, 0.0, -0.02 * height)))


def cactus(*, pot: float, radius: float, height: float) -> Trimesh:
    """Return a cactus with two arms in a pot; `pot` is the radius of the pot's rim."""
    rim, inside = 0.95 * pot, pot - 0.006
    bowl = lathe(resample([
        (0.72 * pot, 0.0), (0.9 * pot, rim - 0.016), (pot, rim - 0.015), (pot, rim),
        (inside, rim), (pot - 0.007, rim - 0.006),
    ], EDGE))  # fmt: skip

    # The ribbed trunk, with a round top.
    section = scalloped(radius, 0.16 * radius, 8)
    s, c = sin_cos_deg(np.linspace(15.0, 90.0, 6))
    low, top = rim - 0.02, height - radius
    straight = np.linspace(low, top, max(4, round((top - rim) / EDGE)))
    dome = np.column_stack([np.where(c > 1e-9, c, 0.0), top + radius * s])
    parts = [bowl, extrude(section, [(0.0, low), (0.5, low), *((1.0, z) for z in straight), *dome])]
    reach, arm = 1.95 * radius, 0.46 * radius
    for side, *shares in ((1.0, 0.36, 0.70), (-1.0, 0.50, 0.84)):
        x, (z, up) = reach * side, (rim + share * (height - rim) for share in shares)
        path = smooth([
            (0.3 * radius * side, 0.0, z), (0.86 * reach * side, 0.0, z + 0.004),
            (x, 0.0, z + 0.5 * radius), (x, 0.0, up),
        ], EDGE)  # fmt: skip
        parts += [tube(path, arm), ball((x, 0.0, up), arm)]
    return fuse(*parts)


def hammer(*, length: float, head_length: float, head_thickness: float) -> Trimesh:
    """Return a claw hammer that stands on its head along y; `length` is that of the handle."""
    half, up = head_thickness / 2.0, (0.0, 0.0, 1.0)
    grip, scale = 0.013, ((0.0, 1.0), (0.3, 1.0), (0.55, 0.75), (1.0, 0.75))
    section = ellipse(0.85 * grip, grip, edge=EDGE)
    handle = bar((-length, 0.0, half), (0.0, 0.0, half), section, normal=up, scale=scale)

    # The head: a claw that bends up on one side, and a round face on the other.
    reach = head_length / 2.0
    y = np.linspace(reach, -reach, 60)
    bend = np.clip(-(y + 0.012), 0.0, None)
    path = spread_evenly(np.column_stack([-8.0 * bend**2, y, np.full_like(y, half)]), EDGE)
    factors = between([
        (-1.0, 0.18, 0.8), (-0.35, 0.75, 0.9), (0.0, 1.0, 1.0), (0.35, 1.0, 1.0),
        (0.55, 0.72, 0.72), (0.75, 1.0, 1.0), (0.93, 1.0, 1.0), (1.0, 0.88, 0.88),
    ], path[:, 1] / reach)  # fmt: skip
    section = rounded_rectangle(2.0 * half, 2.0 * half, 0.3 * half, edge=EDGE)
    head = sweep(path, section, normal=up, scale=factors)
    notch = block((0.1, 0.05, 0.15 * head_thickness), (0.0, 0.002 - reach, half))
    return stand(rotated(fuse(handle, cut(head, notch)), "y", 90.0))


def screwdriver(*, handle: float, radius: float, shaft: float) -> Trimesh:
    """Return a screwdriver on its fluted `handle`; `handle` and `shaft` are lengths."""
    side = resample(scaled([
        (0.86, 0.0), (0.96, 0.03), (1.0, 0.12), (1.0, 0.6), (0.74, 0.78), (0.7, 0.88), (0.8, 0.96),
        (0.62, 1.0),
    ], radius, handle), EDGE) / [radius, 1.0]  # fmt: skip
    profile = [(0.0, 0.0), (0.86 * 0.5, 0.0), *side, (0.3, handle), (0.0, handle)]
    grip = extrude(scalloped(radius, 0.13 * radius, 6), profile)

    # The shaft, which ends in a flat blade.
    steel = max(0.0045, 0.24 * radius)
    low, high, edge = handle - 0.01, handle + shaft, 0.8 * EDGE
    blade = pillar([
        (high - 0.24 * shaft, 1.5 * steel, 1.5 * steel),
        (high - 0.12 * shaft, 2.9 * steel, 1.3 * steel), (high, 2.5 * steel, 0.65 * steel),
    ], corner=0.3 * steel, edge=edge)  # fmt: skip
    return fuse(grip, post(low, high - 0.14 * shaft, steel, edge=edge), blade)


def mallet(*, length: float, head_length: float, radius: float) -> Trimesh:
    """Return a mallet that lies on its side, with its handle along -x and a round head along y."""
    grip, thin = 0.4 * radius + 0.004, 0.88 * radius
    half, band = head_length / 2.0, radius + 0.002
    side = smooth(
        [(thin, -half), (radius, 0.006 - half), (radius, half - 0.006), (thin, half)], EDGE
    )
    head = [lathe(side, edge=BROAD)]
    head += [post(y - 0.006, y + 0.006, band) for y in (-0.62 * half, 0.62 * half)]
    # The handle is inclined, so that the knob at its end touches the table like the bands do.
    handle = rod((-length, 0.0, 1.06 * grip), (0.4 * radius, 0.0, band), grip, 0.8 * grip)
    knob = ball((-length, 0.0, 1.12 * grip), scaled((1.0, 1.15, 1.12), grip))
    return stand(fuse(*(moved(part, (0.0, 0.0, band), x=90.0) for part in head), handle, knob))


def padlock(*, width: float, height: float, depth: float, shackle: float) -> Trimesh:
    """Return a closed padlock; `shackle` is the height of its shackle above the body."""
    radius = 0.085 * width + 0.001
    levels = [(-depth / 2.0, width, height), (depth / 2.0, width, height)]
    upright = pillar(levels, corner=0.2 * width, edge=BROAD)
    body = moved(upright, (0.0, 0.0, height / 2.0), x=90.0)

    # The shackle, and a keyhole.
    reach, low, z = 0.33 * width, height - 0.012, 0.52 * height
    top = height + (shackle - radius - reach)
    bend = arch(reach, reach, z=top, degrees=(0.0, 180.0), count=24)
    path = joined([(reach, 0.0, low)], bend, [(-reach, 0.0, low)])
    hole = rod((0.0, -depth, z), (0.0, 0.004 - depth / 2.0, z), 0.085 * width)
    size, place = (0.075 * width, depth, 0.2 * height), (0.0, 0.004 - depth, 0.4 * height)
    slit = block(size, place, corner=0.001)
    return fuse(cut(body, fuse(hole, slit)), tube(resample(path, EDGE), radius))


def watering_can(*, radius: float, height: float, spout: float) -> Trimesh:
    """Return a watering can with a long `spout` and a rose at +x, and a handle at -x."""
    side = resample(scaled([(1.0, 0.0), (1.0, 0.82), (0.8, 1.0)], radius, height), BROAD)
    body, core = vessel(side, wall=0.005, floor=0.008, edge=BROAD)
    start = np.array([0.9 * radius, 0.0, 0.22 * height])
    tip = np.array([radius + spout, 0.0, 1.12 * height])
    towards = (tip - start) / np.linalg.norm(tip - start)
    pipe = rod(start, tip, 0.20 * radius, 0.11 * radius)
    rose = rod(tip - 0.008 * towards, tip + 0.022 * towards, 0.12 * radius, 0.42 * radius)
    low, top, reach = 0.25 * height, 0.98 * height, 0.75 * radius
    handle = loop_handle(0.92 * radius, low, top, reach, 0.0055, edge=BROAD)
    # The front half of the top is covered.
    cover = cut(
        post(height - 0.007, height, 0.8 * radius - 0.001, edge=BROAD),
        block((2.0 * radius, 2.0 * radius, 0.1), (-1.05 * radius, 0.0, height)),
    )
    grip = cut(rotated(handle, "z", 180.0), core)
    return fuse(body, cover, cut(fuse(pipe, rose), core), grip)


def bucket(*, top_radius: float, bottom_radius: float, height: float) -> Trimesh:
    """Return a bucket with its bail up in the plane y = 0."""
    side = resample([(bottom_radius, 0.0), (top_radius, height)], BROAD)
    body = vessel(side, wall=0.005, floor=0.008, edge=BROAD)[0]
    inner, outer = top_radius - 0.002, top_radius + 0.003
    rim = lathe([
        (inner, height - 0.01), (outer, height - 0.009), (outer, height - 0.001), (inner, height),
    ], edge=BROAD)  # fmt: skip
    hole = post(height - 0.05, height + 0.05, top_radius - 0.005 + 0.0005, edge=BROAD)

    # The bail is up, with a grip at its centre.
    low, reach = height - 0.012, 0.95 * top_radius
    bail = arch(top_radius + 0.002, reach, z=low, degrees=(0.0, 180.0), count=40)
    x, top = top_radius + 0.001, low + reach
    ears = [ball((side * x, 0.0, low), (0.006, 0.009, 0.009)) for side in SIDES]
    grip = rod((-0.022, 0.0, top), (0.022, 0.0, top), 0.0085)
    return fuse(fuse(body, cut(rim, hole)), *ears, tube(resample(bail, EDGE), 0.004), grip)


def traffic_cone(*, base: float, radius: float, height: float) -> Trimesh:
    """Return a traffic cone; `base` is the edge of its square base, `radius` that of its foot."""
    tip, foot = 0.26 * radius, 0.012
    ridges = []
    for shares in ((0.34, 0.52), (0.68, 0.82)):
        ends = [foot + share * (height - foot) for share in shares]
        ridges.append(post(*ends, *(radius + share * (tip - radius) + 0.0022 for share in shares)))
    plate = pillar([(0.0, base, base), (foot, 0.96 * base, 0.96 * base)], corner=0.15 * base)
    return fuse(plate, post(0.004, height, radius, tip), *ridges)


def barrel(*, radius: float, bulge: float, height: float) -> Trimesh:
    """Return a barrel with four hoops, `radius` at its ends and wider by `bulge` at its centre."""
    levels = np.linspace(0.0, 1.0, max(10, round(height / BROAD)) + 1)
    side = np.column_stack([radius + bulge * 4.0 * levels * (1.0 - levels), height * levels])
    low = height - 0.006
    head = resample([(radius - 0.006, height), (radius - 0.007, low), (0.0, low)], BROAD)[:-1]
    staves = lathe(np.vstack([side, head]), edge=BROAD)
    # Only the rims of the hoops: the inside of the top stays free.
    hole = post(-0.1, 2.0 * height, radius - 0.004, edge=BROAD)
    hoops = []
    for shares in ((0.03, 0.10), (0.26, 0.33), (0.67, 0.74), (0.90, 0.97)):
        sizes = [radius + bulge * 4.0 * share * (1.0 - share) + 0.0022 for share in shares]
        ring = post(*(share * height for share in shares), *sizes, edge=BROAD)
        hoops.append(cut(ring, hole))
    return fuse(staves, *hoops)


def garbage_bin(*, width: float, height: float) -> Trimesh:
    """Return a closed bin on two wheels, with its front at +x and wheels and bar at -x."""
    depth, wheel, round_corner = 1.08 * width, 0.16 * width, 0.09 * width
    body = pillar([
        (0.0, 0.72 * depth, 0.74 * width, 0.05 * depth, 0.0), (height, depth, width, 0.0, 0.0),
    ], corner=0.08 * width, edge=LARGE)  # fmt: skip
    size = (1.1 * depth, 1.1 * width, 0.01)
    rim = block(size, (0.0, 0.0, height - 0.003), corner=round_corner, edge=LARGE)
    lid = pillar([
        (height, 1.08 * depth, 1.06 * width, 0.0, 0.0),
        (height + 0.13 * width, 0.86 * depth, 0.88 * width, -0.05 * depth, 0.0),
        (height + 0.17 * width, 0.6 * depth, 0.7 * width, -0.1 * depth, 0.0),
    ], corner=round_corner, edge=LARGE)  # fmt: skip

    # Wheels on an axle, and the bar by which it is pulled.
    x, back, z = -0.36 * depth, -0.62 * depth, height - 0.008
    pull = rod((back, -0.42 * width, z), (back, 0.42 * width, z), 0.006)
    axle = rod((x, -0.4 * width, wheel), (x, 0.4 * width, wheel), 0.35 * wheel)
    wheels, arms = [], []
    for side in SIDES:
        inner, outer, y = (share * side * width for share in (0.34, 0.54, 0.38))
        wheels.append(rod((x, inner, wheel), (x, outer, wheel), wheel))
        arms.append(rod((back, y, z), (-0.45 * depth, y, z), 0.0055))
    return fuse(body, rim, lid, *wheels, axle, pull, *arms)
