"""Objects from a kitchen and a shop: vessels, machines, packed goods.

One function per class: sizes come in, a watertight mesh goes out; see `drakegrasp.shapes.catalog`.
"""

from __future__ import annotations

import numpy as np
from trimesh import Trimesh

from drakegrasp.shapes.parts import (
    CORNERS,
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
    trimmed,
    tube,
    vessel,
)
from drakegrasp.shapes.solids import (
    BROAD,
    COARSE,
    EDGE,
    LARGE,
    bar,
    bevelled,
    cut,
    ellipse,
    extrude,
    foot_and_wall,
    fuse,
    grid_box,
    inset,
    joined,
    resample,
    revolve,
    rounded_rectangle,
    scaled,
    smooth,
    solid,
    spaced,
    spread_evenly,
    sweep,
)

#: Thicknesses of a usual wall and of a thin wall [m].
WALL, THIN = 0.005, 0.0045


def mug(*, radius: float, height: float, handle_reach: float, handle_radius: float) -> Trimesh:
    """Return a hollow straight mug with a handle at +x that extends by `handle_reach`."""
    side = resample(foot_and_wall(radius, height, 0.004), EDGE)
    shell, core = vessel(side, wall=WALL, floor=0.007)
    reach = handle_reach - handle_radius + WALL / 2.0
    handle = loop_handle(radius - WALL / 2.0, 0.2 * height, 0.84 * height, reach, handle_radius)
    return fuse(shell, trimmed(handle, core))


def cup(*, top_radius: float, bottom_radius: float, height: float) -> Trimesh:
    """Return a hollow tapered cup without a handle."""
    side = resample([(bottom_radius, 0.0), (top_radius, height)], EDGE)
    return vessel(side, wall=THIN, floor=0.006)[0]


def bowl(*, radius: float, height: float, foot_radius: float) -> Trimesh:
    """Return a hollow bowl on a ring foot."""
    side = smooth([
        (foot_radius, 0.0), (foot_radius + 0.001, 0.005), (0.72 * radius, 0.22 * height),
        (0.92 * radius, 0.58 * height), (radius, height),
    ], EDGE)  # fmt: skip
    return vessel(side, wall=WALL, floor=0.008)[0]


def vase(
    *, foot_radius: float, belly_radius: float, neck_radius: float, lip_radius: float, height: float
) -> Trimesh:
    """Return a hollow vase with a belly, a neck and a lip."""
    radii = (foot_radius, belly_radius, neck_radius, lip_radius)
    levels = scaled([0.0, 0.4, 0.82, 1.0], height)
    side = smooth(np.column_stack([radii, levels]), 0.007)
    return vessel(side, wall=WALL, floor=0.008, edge=0.007)[0]


def wineglass(
    *,
    foot_radius: float,
    stem_radius: float,
    belly_radius: float,
    rim_radius: float,
    height: float,
    stem_height: float,
) -> Trimesh:
    """Return a wineglass: a solid foot and stem, a hollow cup."""
    # The cup, outside and inside.
    cup_height = height - stem_height
    outer = smooth([
        (stem_radius, stem_height), (0.75 * belly_radius, stem_height + 0.14 * cup_height),
        (belly_radius, stem_height + 0.42 * cup_height), (rim_radius, height),
    ], EDGE)  # fmt: skip
    floor = stem_height + 0.012
    inner = spread_evenly(inset(outer, THIN, floor=floor), COARSE * EDGE)[::-1]

    # Foot and stem.
    foot = resample([(0.0, 0.0), (foot_radius, 0.0), (foot_radius, 0.005)], EDGE)
    stem = smooth([
        (foot_radius, 0.005), (0.4 * foot_radius, 0.009), (stem_radius, 0.3 * stem_height),
        (stem_radius, stem_height),
    ], EDGE)  # fmt: skip

    # The outline of both, with longer edges inside.
    bottom = resample([inner[-1], (0.0, floor)], COARSE * EDGE)[1:]
    outside, inside = np.vstack([foot, stem[1:], outer[1:]]), np.vstack([inner, bottom])
    edges = np.repeat([EDGE, COARSE * EDGE], [len(outside), len(inside)])
    return revolve(np.vstack([outside, inside]), edge=edges)


def pitcher(
    *,
    foot_radius: float,
    belly_radius: float,
    neck_radius: float,
    rim_radius: float,
    height: float,
    handle_reach: float,
    handle_radius: float,
    lip: float,
) -> Trimesh:
    """Return a hollow pitcher with a handle at +x and a lip pulled out by `lip` at -x."""
    edge, radii = 0.008, (foot_radius, belly_radius, neck_radius, rim_radius)
    side = smooth(np.column_stack([radii, scaled([0.0, 0.35, 0.8, 1.0], height)]), edge)
    shell, core = vessel(side, wall=WALL, floor=0.008, edge=edge)
    x, reach = neck_radius - WALL / 2.0, belly_radius - neck_radius + handle_reach
    handle = loop_handle(x, 0.3 * height, 0.85 * height, reach, handle_radius, edge=edge)
    body = fuse(shell, trimmed(handle, core))

    # The lip: points near the rim on the far side move outwards together with the wall.
    x, y, z = body.vertices.T
    rise = np.clip((z / height - 0.7) / 0.3, 0.0, 1.0)
    pull = lip * rise**2 * np.exp(-((np.arctan2(y, -x) / 0.4) ** 2))
    return solid(np.column_stack([x - pull, y, z]), body.faces)


def saucepan(*, radius: float, height: float, handle_length: float) -> Trimesh:
    """Return a hollow saucepan with a straight handle along +x."""
    edge, z = 1.2 * EDGE, 0.78 * height
    side = resample(foot_and_wall(radius, height, 0.005), edge)
    shell, core = vessel(side, wall=WALL, floor=0.007, edge=edge)
    start, end = (radius - WALL, 0.0, z), (radius + handle_length, 0.0, z)
    scale = ((0.0, 0.9), (0.4, 0.8), (1.0, 1.0))
    handle = bar(start, end, ellipse(0.008, 0.011, edge=edge), scale=scale, edge=edge)
    return fuse(shell, trimmed(handle, core))


def funnel(*, radius: float, spout_radius: float, cone_height: float, height: float) -> Trimesh:
    """Return a funnel that is open at both ends and stands on its wide end."""
    neck = (spout_radius + 0.002, cone_height)
    outer = resample([(radius, 0.0), (radius, 0.008), neck, (spout_radius, height)], EDGE)
    # On a sloping wall the thickness is measured along r: wall / sin(slope).
    slope = np.arctan2(cone_height - 0.008, radius - spout_radius)
    step = THIN / np.sin(slope)
    inner = resample([
        (spout_radius - THIN, height), (spout_radius + 0.002 - THIN, cone_height),
        (radius - step, 0.008), (radius - step, 0.0),
    ], COARSE * EDGE)  # fmt: skip
    edges = np.repeat([EDGE, COARSE * EDGE], [len(outer), len(inner)])
    return revolve(np.vstack([outer, inner]), edge=edges, closed=True)


def toaster(*, length: float, width: float, height: float) -> Trimesh:
    """Return a toaster with two slots along x and a lever at +x."""
    foot, half = 0.006, length / 2.0
    across = rounded_rectangle(height - foot, width, 0.2 * width, edge=LARGE)
    stations = spaced(LARGE, -half, 0.004 - half, half - 0.004, half)
    middle = (height + foot) / 2.0
    path = np.column_stack([stations, 0.0 * stations, np.full_like(stations, middle)])
    scale = np.ones(len(stations))
    scale[[0, -1]] = 0.94
    body = sweep(path, across, scale=scale)
    size = (0.014, 0.014, 2.0 * foot + 0.016)
    feet = [
        block(size, (0.36 * x * length, 0.24 * y * width, foot + 0.008), edge=LARGE)
        for x, y in CORNERS
    ]

    size, z = (0.78 * length, 0.17 * width, 0.11), 0.42 * height + 0.055
    slots = [block(size, (0.0, 0.19 * side * width, z), edge=LARGE) for side in SIDES]
    groove = block((0.02, 0.009, 0.5 * height), (half + 0.005, 0.0, 0.56 * height))
    lever = block((0.03, 0.30 * width, 0.011), (half + 0.004, 0.0, 0.72 * height))
    y, z = 0.3 * width, 0.3 * height
    dial = rod((half - 0.01, y, z), (half + 0.008, y, z), 0.0085, edge=0.7 * EDGE)
    return fuse(cut(fuse(body, *feet), *slots, groove), lever, dial)


def coffeemaker(*, width: float, depth: float, height: float) -> Trimesh:
    """Return a coffee machine with its tank at -x and its jug in front, at +x."""
    tank = 0.36 * depth
    jug, floor, head = 0.36 * width, 0.020, 0.24 * height
    x, edge = 0.5 * depth - 0.42 * width, 2.0 * BROAD
    # Base, tank, head, and the filter under it.
    back, roof = ((tank - depth) / 2.0, 0.0, height / 2.0), height - head
    levels = [(roof, 0.86 * depth, 0.94 * width), (height, depth, width)]
    cone = lathe(resample([(0.45 * jug, 0.0), (0.8 * jug, 0.02)], BROAD), edge=LARGE)
    parts = [
        block((depth, width, floor), (0.0, 0.0, floor / 2.0), corner=0.01, edge=edge),
        block((tank, width, height), back, corner=0.01, edge=edge),
        pillar(levels, corner=0.012, edge=edge),
        moved(cone, (x, 0.0, height - head - 0.014)),
    ]

    # The jug on its plate, with a handle.
    top = 0.52 * height
    knots = [(0.8, 0.0), (1.0, 0.3), (0.9, 0.65), (0.62, 0.9), (0.68, 1.0)]
    side = smooth(scaled(knots, jug, top - floor), LARGE)
    body = moved(lathe(side, edge=LARGE), (x, 0.0, floor - 0.002))
    low, reach = floor + 0.22 * (top - floor), 0.78 * jug
    handle = loop_handle(x + 0.6 * jug, low, 0.92 * top, reach, 0.0045, edge=LARGE)
    lamp = ball((0.5 * depth, 0.25 * width, height - 0.5 * head), 0.006, edge=0.6 * EDGE)
    return fuse(*parts, body, handle, lamp)


def teapot(*, radius: float, height: float, spout: float) -> Trimesh:
    """Return a teapot with a lid, a spout that extends by `spout` to +x, and a handle at -x."""
    knots = [(0.58, 0.0), (0.62, 0.03), (1.0, 0.42), (0.78, 0.76), (0.46, 0.86)]
    body = lathe(smooth(scaled(knots, radius, height), BROAD), edge=BROAD)
    rim = resample([(0.5 * radius, 0.84 * height), (0.5 * radius, 0.88 * height)], BROAD)
    dome = smooth([(0.4 * radius, 0.93 * height), (0.12 * radius, height)], BROAD)
    lid = lathe([*rim, *dome], edge=BROAD)
    button = ball((0.0, 0.0, 1.06 * height), (0.17 * radius, 0.17 * radius, 0.09 * height))

    # An S-shaped spout that narrows, and a round handle.
    path = smooth([
        (0.7 * radius, 0.0, 0.3 * height), (radius + 0.35 * spout, 0.0, 0.4 * height),
        (radius + 0.65 * spout, 0.0, 0.66 * height), (radius + spout, 0.0, 0.86 * height),
    ], EDGE)  # fmt: skip
    pipe = tube(path, np.linspace(0.24 * radius, 0.11 * radius, len(path)), edge=0.9 * EDGE)
    x, low, top, reach = 0.72 * radius, 0.24 * height, 0.76 * height, 0.78 * radius
    handle = loop_handle(x, low, top, reach, 0.11 * radius, edge=BROAD)
    return fuse(body, lid, button, pipe, rotated(handle, "z", 180.0))


def juicer(*, radius: float, rim: float, cone: float) -> Trimesh:
    """Return a citrus juicer: a dish with a rim of height `rim` and a ribbed `cone` in it."""
    side = smooth(scaled([(0.7, 0.0), (0.92, 0.3), (1.0, 1.0)], radius, rim), BROAD)
    hollow = [(radius - WALL, rim), (0.86 * radius, 0.5 * rim), (0.62 * radius, 0.32 * rim)]
    inner = smooth(hollow, BROAD)
    under = resample([(0.0, 0.0), side[0]], 1.5 * BROAD)
    bottom = resample([inner[-1], (0.0, 0.3 * rim)], 1.5 * BROAD)
    dish = revolve(joined(under, side, inner, bottom), edge=BROAD)
    ribs = scalloped(0.5 * radius, 0.07 * radius, 10, edge=BROAD)
    h = np.linspace(0.0, 1.0, max(5, round(cone / BROAD)) + 1)
    low = 0.2 * rim
    dome = np.column_stack([np.sqrt(np.maximum(0.0, 1.0 - h**1.6)), low + h * (cone - low)])
    cone_body = extrude(ribs, [(0.0, low), (0.9 * 0.5, low), *dome])

    size, place = (0.5 * radius, 0.36 * radius, 0.008), (-1.15 * radius, 0.0, rim - 0.006)
    handle = block(size, place, corner=0.12 * radius)
    lip = pillar([
        (rim - 0.015, 0.1 * radius, 0.12 * radius, 0.93 * radius, 0.0),
        (rim, 0.3 * radius, 0.3 * radius, 1.03 * radius, 0.0),
    ], corner=0.04 * radius)  # fmt: skip
    return fuse(dish, cone_body, handle, lip)


def pepper_mill(*, radius: float, waist: float, height: float) -> Trimesh:
    """Return a turned pepper mill; `radius` is that of its foot, `waist` its smallest radius."""
    side = smooth([
        (radius, 0.0), (radius, 0.1 * height), (0.82 * radius, 0.15 * height),
        (waist, 0.38 * height), (0.92 * radius, 0.6 * height), (0.8 * radius, 0.66 * height),
        (0.52 * radius, 0.69 * height), (0.86 * radius, 0.74 * height),
        (0.92 * radius, 0.8 * height), (0.66 * radius, 0.89 * height),
        (0.16 * radius, 0.915 * height),
    ], 0.8 * EDGE)  # fmt: skip
    return fuse(lathe(side), ball((0.0, 0.0, 0.945 * height), 0.055 * height))


def box(*, width: float, depth: float, height: float) -> Trimesh:
    """Return an upright box: `width` along x, `depth` along y."""
    return grid_box((width, depth, height), centre=(0.0, 0.0, height / 2.0), edge=1.2 * EDGE)


def can(*, radius: float, height: float) -> Trimesh:
    """Return a closed can: a cylinder with bevelled rims."""
    return lathe(resample(bevelled(radius, height, 0.002), EDGE))


def bottle(*, radius: float, height: float, neck_radius: float) -> Trimesh:
    """Return a closed solid bottle with a shoulder, a neck and a cap."""
    low, neck, cap = 0.58 * height, 0.78 * height, 0.9 * height
    wide = neck_radius + 0.003

    # From the bottom up: body, shoulder, neck and cap.
    body = resample(foot_and_wall(radius, low, 0.004), BROAD)
    shoulder = smooth([(radius, low), (0.8 * radius, 0.66 * height), (neck_radius, neck)], BROAD)
    head = resample([
        (neck_radius, neck), (neck_radius, cap), (wide, cap), (wide, height - 0.003),
        (neck_radius, height),
    ], BROAD)  # fmt: skip
    return lathe(joined(body, shoulder, head))


def jar(*, radius: float, height: float, lid_radius: float, lid_height: float) -> Trimesh:
    """Return a closed solid jar with a body, a short neck and a lid."""
    low, under = height - lid_height - 0.018, height - lid_height
    neck = min(lid_radius - 0.004, radius - 0.008)

    # From the bottom up: body, shoulder, lid.
    body = resample(foot_and_wall(radius, low, 0.005), EDGE)
    middle = (radius - 0.25 * (radius - neck), low + 0.006)
    shoulder = smooth([(radius, low), middle, (neck, low + 0.013)], EDGE / 2.0)
    lid = resample([
        (neck, under), (lid_radius, under), (lid_radius, height - 0.003),
        (lid_radius - 0.003, height),
    ], EDGE)  # fmt: skip
    return lathe(joined(body, shoulder, lid))


def carton(*, width: float, height: float, roof: float) -> Trimesh:
    """Return a milk carton with a gable of height `roof` and a screw cap at -y."""
    fin = 0.014
    shell = pillar([
        (0.0, width, width), (height, width, width), (height + roof, width, 0.008),
        (height + roof + fin, width, 0.008),
    ], corner=0.003, edge=LARGE)  # fmt: skip
    # The ends of the gable are folded inwards.
    fold = pillar([(height + 0.004, 0.0105, 0.86 * width), (height + 0.86 * roof, 0.024, 0.005)])
    folds = [moved(fold, (0.5 * side * width, 0.0, 0.0)) for side in SIDES]
    slope = np.degrees(np.arctan2(roof, 0.5 * width - 0.004))
    cap = post(-0.006, 0.011, 0.15 * width + 0.003)
    place = (0.0, -0.27 * width, height + 0.48 * roof)
    return fuse(cut(shell, *folds), moved(cap, place, x=slope))


def spray_bottle(*, width: float, depth: float, height: float) -> Trimesh:
    """Return a solid spray bottle with an oval body, a neck, a head and a trigger at +x."""
    edge, top, half = 0.007, 0.68 * height, width / 2.0
    neck, section = 0.013, rounded_rectangle(width, depth, 0.45 * depth, edge=edge)
    foot = [(0.0, 0.0), (0.5, 0.0), (0.94, 0.0), (1.0, 0.004)]
    heights = spaced(edge, 0.004, 0.72 * top)[1:]
    shoulder = smooth([(half, 0.72 * top), (0.42 * width, 0.85 * top), (neck, top)], edge)[1:]
    profile = [*foot, *((1.0, z) for z in heights), *(shoulder / [half, 1.0]), (0.0, top)]
    body = extrude(section, profile)

    z = height - 0.014
    collar = revolve(resample([
        (0.0, top - 0.01), (neck + 0.002, top - 0.01), (neck + 0.002, top + 0.014),
        (0.011, top + 0.018), (0.011, z), (0.0, z),
    ], edge))  # fmt: skip
    scale = ((0.0, 0.75), (0.35, 1.0), (0.75, 0.9), (1.0, 0.55))
    section = rounded_rectangle(0.028, 0.024, 0.007, edge=edge)
    head = bar((-0.028, 0.0, z), (0.048, 0.0, z), section, scale=scale)
    reach = np.linspace(0.0, 1.0, 50)
    bend = np.column_stack([0.026 + 0.014 * np.sin(1.6 * reach), 0.0 * reach, z - 0.055 * reach])
    section = rounded_rectangle(0.008, 0.014, 0.003, edge=edge)
    return fuse(body, collar, head, sweep(spread_evenly(bend, edge), section))


def soap_dispenser(*, width: float, depth: float, height: float) -> Trimesh:
    """Return a soap dispenser: an oval bottle with a pump whose spout points to +x."""
    body = 0.64 * height
    bottle = pillar(scaled([
        (0.0, 0.94, 0.94), (0.3, 1.0, 1.0), (0.75, 1.0, 1.0), (0.93, 0.72, 0.76), (1.0, 0.42, 0.52),
    ], body, width, depth), corner=0.48 * depth, edge=BROAD)  # fmt: skip

    # The pump: collar, stem, head and spout.
    z = height - 0.012
    spout = tube(smooth([
        (-0.012, 0.0, z), (0.2 * width, 0.0, z), (0.46 * width, 0.0, z - 0.001),
        (0.56 * width, 0.0, z - 0.011),
    ], EDGE), 0.0062)  # fmt: skip
    collar = post(body - 0.006, body + 0.016, 0.25 * depth + 0.004)
    head = post(z - 0.01, height, 0.013, 0.0125)
    return fuse(bottle, collar, post(body, z, 0.006), head, spout)


def towel_roll(*, radius: float, height: float, core: float) -> Trimesh:
    """Return a standing paper towel roll with an open `core` and a loose sheet at +y."""
    outside = resample(bevelled(radius, height, 0.002), BROAD)
    inside = resample([(core, height), (core, 0.0)], 1.5 * BROAD)
    bottom = resample([(core, 0.0), (radius - 0.002, 0.0)], 2.0 * BROAD)[:-1]
    paper = revolve(joined(outside, inside, bottom), edge=BROAD, closed=True)
    size, place = (0.62 * radius, 0.005, height - 0.004), (0.36 * radius, radius - 0.0035)
    sheet = block(size, (*place, height / 2.0), corner=0.0015, edge=BROAD)
    return fuse(paper, sheet)
