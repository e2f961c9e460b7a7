"""Household objects and personal belongings. Shoes point to +x.

One function per class: sizes come in, a watertight mesh goes out; see `drakegrasp.shapes.catalog`.
"""

from __future__ import annotations

import numpy as np
from trimesh import Trimesh

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.frames import Array
from drakegrasp.shapes.parts import (
    CORNERS,
    ball,
    block,
    hoop,
    lathe,
    moved,
    pillar,
    post,
    prism,
    rod,
    tube,
)
from drakegrasp.shapes.solids import (
    BROAD,
    COARSE,
    EDGE,
    LARGE,
    arch,
    bar,
    between,
    capped,
    cut,
    ellipse,
    flat_base,
    foot_and_wall,
    fuse,
    joined,
    resample,
    revolve,
    rounded_polygon,
    scaled,
    skin,
    smooth,
    solid,
    spaced,
    spread_evenly,
    sweep,
)

#: Edge length of a hat [m].
FELT = 1.2 * EDGE
#: Edge length of shoes [m].
LEATHER = 1.3 * EDGE


def watertap(*, base: float, pipe: float, height: float, reach: float) -> Trimesh:
    """Return a tap with a spout of length `reach` to +x; `base` and `pipe` are radii."""
    bend = reach / 2.0
    top = height - bend - pipe
    bow = arch(bend, bend, x=bend, z=top, degrees=(180.0, 0.0), count=24)
    path = joined([(0.0, 0.0, 0.004)], bow, [(reach, 0.0, top - 0.022)])
    column = 0.52 * top
    # The valve: a cross on the side of the column.
    z, y = 0.72 * column, -1.3 * pipe - 0.026
    wings = [
        rod((-0.026 * a, y, z - 0.026 * b), (0.026 * a, y, z + 0.026 * b), 0.0055)
        for a, b in ((1.0, 0.0), (0.0, 1.0))
    ]
    rose = [(base, 0.0), (base, 0.008), (0.75 * base, 0.014), (1.3 * pipe, 0.018)]
    return fuse(
        lathe(smooth(rose, EDGE)),
        post(0.002, column, 1.45 * pipe, 1.3 * pipe),
        tube(resample(path, EDGE), pipe),
        post(top - 0.026, top - 0.012, 1.2 * pipe, at=(reach, 0.0)),
        rod((0.0, 0.0, z), (0.0, y, z), 0.75 * pipe),
        ball((0.0, y, z), 0.9 * pipe),
        *wings,
    )


def knob(*, rose: float, neck: float, radius: float, height: float) -> Trimesh:
    """Return a door knob on its `rose`; all parameters except the height are radii."""
    rim = resample([(rose, 0.0), (rose, 0.007)], EDGE)
    side = smooth([
        (0.86 * rose, 0.011), (1.15 * neck, 0.016), (neck, 0.36 * height),
        (1.15 * neck, 0.5 * height), (0.8 * radius, 0.58 * height), (radius, 0.74 * height),
        (0.86 * radius, 0.92 * height), (0.5 * radius, height), (0.25 * radius, 0.995 * height),
    ], 0.8 * EDGE)  # fmt: skip
    return lathe([*rim, *side])


def lamp(*, base: float, shade: float, height: float) -> Trimesh:
    """Return a table lamp; `base` and `shade` are the radii of the base and of the shade's rim."""
    low, top, wall = 0.54 * height, 0.58 * shade, 0.005
    outer = resample([(shade, low), (top, height)], BROAD)
    inner = resample([(top - wall, height - 0.006), (shade - wall, low)], 1.5 * BROAD)
    cap = resample([(top, height), (0.0, height)], BROAD)
    ceiling = resample([(0.0, height - 0.006), inner[0]], 1.5 * BROAD)
    # From the axis under the cap, down the inside, up the outside, to the axis.
    screen = revolve(joined(ceiling, inner, outer, cap), edge=BROAD)
    side = smooth([
        (0.86 * base, 0.013), (0.3 * base, 0.024), (0.15 * base + 0.003, 0.034),
        (0.38 * base, 0.26 * height), (0.4 * base, 0.33 * height),
        (0.15 * base + 0.002, 0.46 * height), (0.14 * base, 0.55 * height),
    ], EDGE)  # fmt: skip
    foot = lathe([*resample([(base, 0.0), (base, 0.008)], EDGE), *side])
    stem = post(0.5 * height, height - 0.002, 0.14 * base)
    finial = ball((0.0, 0.0, height + 0.005), 0.007, edge=0.7 * EDGE)
    return fuse(screen, foot, stem, finial)


def iron(*, length: float, width: float, height: float) -> Trimesh:
    """Return a clothes iron that stands on its sole, with its tip at +x and a closed handle."""
    t = np.linspace(0.0, 1.0, 200)
    nose = 0.5 * width * np.sqrt(1.0 - t**2.2)
    flank = smooth(scaled([(-0.4, 0.47), (-0.2, 0.5), (-0.05, 0.5)], length, width), EDGE / 4.0)
    side = np.vstack([flank[:-1], np.column_stack([-0.05 * length + 0.6 * length * t, nose])])
    outline = resample(np.vstack([side, side[-2::-1] * [1.0, -1.0], side[:1]]), 1.0)
    section = spread_evenly(outline, BROAD)[:-1]
    low = 0.085 * height
    sole = prism(section, 0.0, low)
    body = prism(0.94 * section, low - 0.003, 0.50 * height, top=0.72)

    # The handle: two posts and a grip.
    z = height - 0.012
    path = smooth([
        (-0.24 * length, 0.0, 0.42 * height), (-0.27 * length, 0.0, 0.72 * height),
        (-0.18 * length, 0.0, z), (0.05 * length, 0.0, z), (0.19 * length, 0.0, 0.8 * height),
        (0.2 * length, 0.0, 0.42 * height),
    ], EDGE)  # fmt: skip
    dial = post(0.46 * height, 0.5 * height + 0.006, 0.19 * width)
    return fuse(sole, body, tube(path, 0.0105), dial)


def hourglass(*, radius: float, waist: float, height: float) -> Trimesh:
    """Return an hourglass between two discs of `radius`, with three posts."""
    plate, bulb = 0.009, 0.70 * radius
    half = [
        (0.8 * bulb, plate - 0.002), (bulb, 0.1 * height + plate), (0.92 * bulb, 0.24 * height),
        (0.4 * bulb + 0.5 * waist, 0.4 * height), (waist, 0.5 * height),
    ]  # fmt: skip
    glass = lathe(smooth([*half, *((r, height - z) for r, z in half[-2::-1])], BROAD), edge=BROAD)

    # Three posts around it.
    low, high = plate / 2.0, height - plate / 2.0
    places = 0.86 * radius * np.column_stack(sin_cos_deg([30.0, 150.0, 270.0])[::-1])
    posts = [post(low, high, 0.0042, at=(x, y)) for x, y in places]
    ends = [post(z, z + plate, radius, edge=BROAD) for z in (0.0, height - plate)]
    return fuse(glass, *posts, *ends)


def bell(*, radius: float, body: float, handle: float) -> Trimesh:
    """Return a hand bell that stands on its mouth; `body` and `handle` are heights."""
    wall, neck = 0.006, 0.14 * radius + 0.003
    outer = smooth([
        (radius, 0.0), (0.9 * radius, 0.09 * body), (0.7 * radius, 0.3 * body),
        (0.58 * radius, 0.65 * body), (0.48 * radius, 0.86 * body), (0.25 * radius, 0.98 * body),
        (neck, body),
    ], EDGE)  # fmt: skip
    grip = smooth([
        (neck, body), (0.22 * radius + 0.003, body + 0.12 * handle), (neck, body + 0.26 * handle),
        (0.27 * radius + 0.003, body + 0.62 * handle), (0.22 * radius, body + 0.9 * handle),
        (0.1 * radius, body + handle),
    ], EDGE)  # fmt: skip

    # The bell is hollow from below.
    inner = smooth([
        (0.0, 0.86 * body), (0.3 * radius, 0.82 * body), (0.58 * radius - wall, 0.55 * body),
        (0.7 * radius - wall, 0.28 * body), (radius - wall, 0.0),
    ], 1.5 * EDGE)  # fmt: skip
    head = resample([grip[-1], (0.0, body + handle)], EDGE)
    return revolve(joined(inner, outer, grip, head))


def candlestick(*, foot_radius: float, stem_radius: float, height: float) -> Trimesh:
    """Return a candlestick with a wide foot, a knob and a drip cup with a socket."""
    cup, socket = 2.6 * stem_radius, 0.010
    outline = [
        (foot_radius, 0.0), (foot_radius, 0.008), (0.55 * foot_radius, 0.02),
        (stem_radius, 0.3 * height), (stem_radius, 0.5 * height),
        (1.6 * stem_radius, 0.56 * height), (stem_radius, 0.62 * height),
        (stem_radius, 0.78 * height), (cup, height - 0.012), (cup, height),
    ]  # fmt: skip
    side = joined(resample(outline[:2], EDGE), smooth(outline[1:], 0.8 * EDGE))
    top = [(cup, height), (socket, height), (socket, height - 0.018), (0.0, height - 0.018)]
    foot = resample([(0.0, 0.0), side[0]], COARSE * EDGE)
    return revolve(joined(foot, side, resample(top, EDGE)))


def book(*, width: float, length: float, thickness: float) -> Trimesh:
    """Return a closed book that lies flat, with its round spine along y at -x."""
    cover, inlay, bulge, edge = 0.004, 0.005, 0.008, 0.011
    x, y, hinge = width / 2.0, length / 2.0, 0.006 - width / 2.0
    # All outlines have the same number of points, whatever their length.
    sizes = [length, width, 0.0, bulge, length, bulge, 0.0, width]
    counts = [max(1, round(size / edge)) for size in sizes]

    def ring(z: float, *, setback: float = 0.0, scale: float = 1.0) -> Array:
        """Return the outline at height `z`, with the pages `setback` behind the cover's edge."""
        level = 2.0 * z / thickness - 1.0
        back = -x - bulge * np.sqrt(1.0 - level**2)
        right, front = x - setback, y - setback
        half = [(right, front), (hinge, front), (hinge, y), (back, y)]
        corners = [(right, -front), *half, *((u, -v) for u, v in half[:0:-1]), (right, -front)]
        pieces = zip(corners[:-1], corners[1:], counts, strict=True)
        outline = [np.linspace(a, b, count, endpoint=False) for a, b, count in pieces]
        flat = scale * np.concatenate(outline)
        return np.column_stack([flat, np.full(len(flat), z)])

    scales = np.linspace(0.0, 1.0, max(2, round(x / edge)), endpoint=False)[1:]
    under = [ring(0.0, scale=scale) for scale in scales]
    over = [ring(thickness, scale=scale) for scale in scales[::-1]]
    pages = [ring(z, setback=inlay) for z in spaced(0.7 * edge, cover, thickness - cover)]
    board = [ring(0.0), ring(cover)]
    lid = [ring(thickness - cover), ring(thickness)]
    low, high = (np.array([[0.0, 0.0, z]]) for z in (0.0, thickness))
    return skin([low, *under, *board, *pages, *lid, *over, high])


def flashlight(
    *, head_radius: float, body_radius: float, height: float, head_height: float
) -> Trimesh:
    """Return a flashlight that stands on its lens, with a switch at +x."""
    taper, wide = head_height + 0.022, body_radius + 0.0025
    head = foot_and_wall(head_radius, head_height, 0.003)
    side = [
        *head, (body_radius, taper), (body_radius, height - 0.024), (wide, height - 0.021),
        (wide, height - 0.003), (body_radius - 0.0005, height),
    ]  # fmt: skip

    z, section = taper + 0.022, ellipse(0.01, 0.006, edge=0.5 * EDGE)
    switch = bar((0.0, 0.0, z), (body_radius + 0.003, 0.0, z), section)
    return fuse(lathe(resample(side, EDGE)), switch)


def dumbbell(
    *, length: float, head_width: float, head_length: float, grip_radius: float
) -> Trimesh:
    """Return a dumbbell along x with hexagonal heads, `head_width` wide across their flats."""
    apothem = head_width / 2.0
    turns = 2.0 * np.pi * (np.arange(6) + 0.5) / 6.0
    corners = apothem / np.cos(np.pi / 6.0) * np.column_stack([np.cos(turns), np.sin(turns)])
    hexagon = rounded_polygon(corners, 0.15 * head_width, edge=EDGE)
    end = length / 2.0
    heads = []
    for low, high in ((-end, head_length - end), (end - head_length, end)):
        knots = (low, low + 0.005, high - 0.005, high)
        stations = spaced(1.4 * EDGE, *knots)
        path = np.column_stack([stations, 0.0 * stations, np.full_like(stations, apothem)])
        # The section's first coordinate runs along -z: two of the flats are level.
        heads.append(sweep(path, hexagon, scale=np.interp(stations, knots, [0.86, 1.0, 1.0, 0.86])))
    x, section = end - head_length / 2.0, ellipse(grip_radius, grip_radius, edge=EDGE)
    scale = ((0.0, 0.85), (0.25, 0.85), (0.5, 1.0), (0.75, 0.85), (1.0, 0.85))
    return fuse(*heads, bar((-x, 0.0, apothem), (x, 0.0, apothem), section, scale=scale))


def camera(*, width: float, height: float, depth: float, lens: float) -> Trimesh:
    """Return a camera that looks to -y; `lens` is the radius of its lens."""
    z, front = 0.46 * height, -depth / 2.0
    body = block((width, depth, height), (0.0, 0.0, height / 2.0), corner=0.009, edge=LARGE)
    place = (-0.38 * width, -0.42 * depth, 0.47 * height)
    grip = block((0.17 * width, 0.55 * depth, 0.9 * height), place, corner=0.006)
    hump = pillar([
        (height - 0.006, 0.4 * width, 0.86 * depth), (height + 0.01, 0.3 * width, 0.8 * depth),
        (height + 0.016, 0.2 * width, 0.7 * depth),
    ], corner=0.005)  # fmt: skip

    # The lens: two rings, hollow in front, and a curved glass.
    glass = ball((0.0, front - 0.026, z), (0.62 * lens, 0.010, 0.62 * lens))
    back = (0.0, front + 0.008, z)
    rings = [
        rod(back, (0.0, front - 0.02, z), lens),
        rod(back, (0.0, front - 0.034, z), 0.88 * lens),
    ]
    mouth = rod((0.0, front - 0.028, z), (0.0, front - 0.060, z), 0.70 * lens)

    # A release button and a dial on top.
    low = height - 0.004
    button = post(low, height + 0.007, 0.0075, at=(-0.36 * width, -0.2 * depth))
    dial = post(low, height + 0.008, 0.012, at=(0.34 * width, 0.0))
    return fuse(body, grip, hump, cut(fuse(*rings), mouth), glass, button, dial)


def alarm_clock(*, radius: float, depth: float) -> Trimesh:
    """Return an alarm clock with two bells on top and its face at -y."""
    z, face = 0.016 + radius, -depth / 2.0
    case = cut(
        rod((0.0, -face, z), (0.0, face, z), radius, edge=BROAD),
        rod((0.0, face + 0.004, z), (0.0, -depth, z), 0.86 * radius, edge=BROAD),
    )
    hands = [
        block((0.006, 0.009, 0.62 * radius), (0.0, face + 0.004, z + 0.27 * radius), corner=0.0015),
        block((0.44 * radius, 0.009, 0.007), (0.18 * radius, face + 0.004, z), corner=0.0015),
        rod((0.0, face + 0.006, z), (0.0, face - 0.002, z), 0.006, edge=0.6 * EDGE),
    ]
    marks = [
        block((0.006, 0.007, 0.006), (0.72 * radius * x, face + 0.005, z + 0.72 * radius * y))
        for x, y in ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
    ]

    # Two bells on stalks, with a hammer between them, and four feet.
    bells = [_bell_on_stalk(radius, z, side) for side in (1.0, -1.0)]
    top = z + 1.3 * radius
    hammer = [
        post(z + 0.9 * radius, z + 1.28 * radius, 0.0035),
        rod((-0.009, 0.0, top), (0.009, 0.0, top), 0.0065),
    ]
    legs = []
    for x, y in CORNERS:
        hip = (0.5 * radius * x, 0.32 * y * depth, z - 0.7 * radius)
        legs.append(rod(hip, (0.72 * radius * x, 0.36 * y * depth, 0.0), 0.009, 0.0065))
    return flat_base(fuse(case, *hands, *marks, *bells, *legs, *hammer))


def _bell_on_stalk(radius: float, z: float, side: float) -> Trimesh:
    """Return a bell of an alarm clock.

    Args:
        radius: Radius of the clock [m].
        z: Height of the clock's centre [m].
        side: 1 for the bell at +x, -1 for the bell at -x.
    """
    s, c = map(float, sin_cos_deg(60.0))
    ball_radii, below = scaled((0.42, 0.42, 0.36), radius), (0.0, 0.0, -0.5 * radius)
    dome = cut(ball((0.0, 0.0, 0.0), ball_radii), block((radius, radius, radius), below))
    foot, place, head = (
        (share * radius * c * side, 0.0, z + share * radius * s) for share in (0.9, 1.18, 1.3)
    )
    return fuse(moved(dome, place, y=30.0 * side), rod(foot, head, 0.0045))


def hat(*, brim: float, crown: float, height: float) -> Trimesh:
    """Return a top hat with its brim curled up at both sides; `brim` and `crown` are radii."""
    wall = thick = 0.006
    top, wide = 1.06 * crown, crown + 0.002
    middle = (0.95 * crown - wall, 0.5 * height)
    inner = smooth([(0.9 * crown, height - 0.008), middle, (crown - wall, 0.0)], 1.6 * FELT)
    under = resample([inner[-1], (brim - 0.002, 0.0)], FELT)
    over = resample([(brim, 0.5 * thick), (brim - 0.002, thick), (crown, thick)], FELT)
    band = resample([(wide, thick), (wide, 0.26 * height), (0.97 * crown, 0.26 * height)], FELT)
    side = smooth([band[-1], (0.95 * crown, 0.55 * height), (top - 0.002, height)], FELT)
    cap = resample([(top - 0.002, height), (0.0, height - 0.004)], FELT)
    ceiling = resample([(0.0, height - 0.010), inner[0]], 1.6 * FELT)
    upright = revolve(joined(ceiling, inner, under, over, band[1:], side, cap), edge=FELT)

    # The curl of the brim.
    x, y, z = upright.vertices.T
    reach = np.sqrt(x * x + y * y)
    out = np.clip((reach - crown - 0.003) / (brim - crown), 0.0, 1.0)
    share = (y / np.maximum(reach, 1e-6)) ** 2
    lift = 0.62 * (brim - crown) * out**2 * share * (z < 1.5 * thick)
    return solid(np.column_stack([x, y * (1.0 - 0.10 * out * share), z + lift]), upright.faces)


def comb(*, length: float, depth: float, spine: float, teeth: float, count: int) -> Trimesh:
    """Return a wide comb that stands on its teeth; `spine` and `teeth` are heights."""
    height = spine + teeth
    side = smooth([
        (-length / 2.0, 0.96 * teeth), (-0.47 * length, height - 0.005), (-0.3 * length, height),
        (0.3 * length, height), (0.47 * length, height - 0.005), (length / 2.0, 0.96 * teeth),
    ], LEATHER)  # fmt: skip

    # The gaps between the teeth; the outer teeth are wider.
    pitch = 0.88 * length / count
    size, z, corner = (0.52 * pitch, 2.0 * depth, teeth), teeth / 2.0 - 0.01, 0.2 * pitch
    places = [(pitch * (k - (count - 1) / 2.0), 0.0, z) for k in range(count)]
    gaps = [block(size, place, corner=corner, edge=LEATHER) for place in places]
    return cut(_slab(side, depth), *gaps)


def shoe(*, length: float, width: float, height: float) -> Trimesh:
    """Return a laced shoe on its heel and sole; `height` is that of its collar."""
    last = _last(length, width, 0.62 * height, height)

    # The opening for the foot, and the cover of the instep.
    middle = (0.0, 0.0, 0.0)
    hole = ball(middle, (0.24 * length, 0.29 * width, 0.5 * height), edge=LEATHER)
    opening = moved(hole, (-0.24 * length, 0.0, 1.18 * height), y=12.0)
    flap = ball(middle, (0.15 * length, 0.22 * width, 0.05 * height + 0.002), edge=LEATHER)
    tongue = moved(flap, (0.02 * length, 0.0, 0.86 * height), y=33.0)
    laces = []
    for x, z in scaled([(0.01, 0.9), (0.075, 0.8), (0.14, 0.705)], length, height):
        y = 0.24 * width
        laces.append(rod((x, -y, z), (x, y, z), 0.0035, edge=0.8 * EDGE))
    return fuse(cut(last, opening), tongue, *laces, _sole(length, width, 0.13 * height))


def boot(*, length: float, width: float, height: float) -> Trimesh:
    """Return a rubber boot on its heel and sole, open at the top."""
    foot = _last(length, width, 0.36 * height, 0.5 * height)
    x, radius = -0.24 * length, 0.25 * length
    knots = [(0.95, 0.12), (0.92, 0.4), (1.0, 0.75), (1.1, 1.0)]
    s, c = sin_cos_deg(np.arange(24) * 15.0)
    rings = [
        np.column_stack([r * c + x, 0.86 * min(r, 0.56 * width) / r * r * s, np.full_like(s, z)])
        for r, z in smooth(scaled(knots, radius, height), LEATHER)
    ]

    # A thick rim, and the hollow inside.
    rim = np.vstack([rings[-1], rings[-1][:1]]) - [0.0, 0.0, 0.004]
    cuff = hoop(rim, 0.0042, edge=0.9 * EDGE)
    hole = ball((x - 0.002, 0.0, height), (0.82 * radius, 0.40 * width, 0.5 * height), edge=LEATHER)
    upper = cut(fuse(foot, capped(rings), *cuff), hole)
    return fuse(upper, _sole(length, width, 0.085 * height))


def _last(length: float, width: float, instep: float, collar: float) -> Trimesh:
    """Return the closed upper of a shoe; `instep` and `collar` are heights [m]."""
    # Half widths and heights along the foot.
    along = np.linspace(-0.49, 0.49, round(length / LEATHER) + 1)
    half, rise = between([
        (-0.49, 0.24, 0.55), (-0.45, 0.34, 0.92), (-0.3, 0.38, 1.0), (-0.12, 0.38, 1.0),
        (0.02, 0.41, 0.86), (0.2, 0.48, 0.6), (0.36, 0.45, 0.47), (0.45, 0.33, 0.38),
        (0.49, 0.18, 0.26),
    ], along).T  # fmt: skip
    heights = np.where(along > 0.2, np.minimum(collar * rise, instep), collar * rise)

    # The cross section has a flat base and a rounded top.
    s, c = sin_cos_deg(np.linspace(0.0, 180.0, 15))
    roof = np.column_stack([np.sign(c) * np.abs(c) ** 0.6, 0.3 + 0.7 * s])
    across = np.vstack([[(0.0, 0.0), (0.5, 0.0), (0.96, 0.0)], roof, [(-0.96, 0.0), (-0.5, 0.0)]])
    y, z = across.T
    rings = [
        np.column_stack([np.full_like(y, x * length), side * y, 0.004 + (high - 0.004) * z])
        for x, side, high in zip(along, width * half, heights, strict=True)
    ]
    return capped(rings)


def _sole(length: float, width: float, thick: float) -> Trimesh:
    """Return the sole of a shoe, `thick` [m] thick, with an arch between heel and sole."""
    along = np.linspace(-0.505, 0.505, round(length / LEATHER) + 1)
    halves = between([
        (-0.505, 0.0), (-0.49, 0.24), (-0.42, 0.38), (-0.28, 0.42), (-0.05, 0.38), (0.2, 0.5),
        (0.36, 0.46), (0.46, 0.3), (0.5, 0.16), (0.505, 0.0),
    ], along)  # fmt: skip
    right = np.column_stack([along * length, -halves * width])
    outline = np.vstack([right, right[-2:0:-1] * [1.0, -1.0]])

    slab = prism(outline, 0.0, 1.25 * thick, edge=LEATHER)
    gap = block((0.2 * length, 2.0 * width, thick), (-0.06 * length, 0.0, 0.0), edge=LEATHER)
    return cut(slab, gap)


def _slab(side: Array, depth: float) -> Trimesh:
    """Return the space between a curve (n, 2) of points (x, z) and z = 0, as a slab across y."""
    y = np.linspace(-depth / 2.0, depth / 2.0, max(2, round(depth / LEATHER)) + 1)
    levels = max(2, round(float(side[:, 1].max()) / LEATHER)) + 1
    rings = []
    for x, high in side:
        z = np.linspace(0.0, high, levels)
        bottom, front = [(x, v, 0.0) for v in y[:-1]], [(x, y[-1], w) for w in z[:-1]]
        top, back = [(x, v, high) for v in y[:0:-1]], [(x, y[0], w) for w in z[:0:-1]]
        rings.append(np.array([*bottom, *front, *top, *back]))
    return capped(rings)
