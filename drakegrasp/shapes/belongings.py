"""Things that people own, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. All lengths are in [m]
and all angles in [rad]; `drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.arithmetic import sin_cos_deg
from drakegrasp.frames import Array
from drakegrasp.shapes.modelling.booleans import cut, flat_base, fuse
from drakegrasp.shapes.modelling.primitives import ball, block, lathe, moved, pillar, rod, rotated
from drakegrasp.shapes.modelling.profiles import (
    BROAD,
    EDGE,
    LARGE,
    bevelled,
    ellipse,
    resample,
    rounded_polygon,
)
from drakegrasp.shapes.modelling.solids import bar, skin, sweep


def book(*, width: float, length: float, thickness: float, edge: float = 0.011) -> trimesh.Trimesh:
    """Return a closed book that lies flat, its round spine along y at -x."""
    cover, inlay, bulge = 0.004, 0.005, 0.008
    x, y, hinge = width / 2.0, length / 2.0, 0.006 - width / 2.0

    def ring(z: float, *, setback: float, scale: float = 1.0) -> Array:
        """Return the outline at height `z`, the pages `setback` behind the cover's edge."""
        level = 2.0 * z / thickness - 1.0
        back = -x - bulge * np.sqrt(1.0 - level**2)
        right, front = x - setback, y - setback
        corners = [(right, front), (hinge, front), (hinge, y), (back, y)]
        corners = [(right, -front), *corners, *((u, -v) for u, v in reversed(corners[1:]))]
        corners.append(corners[0])
        # The same number of pieces at every height, whatever their length.
        sizes = [length, width, 0.0, bulge, length, bulge, 0.0, width]
        outline = []
        for start, end, size in zip(corners[:-1], corners[1:], sizes, strict=True):
            count = max(1, round(size / edge))
            outline.append(np.linspace(start, end, count, endpoint=False))
        flat = scale * np.concatenate(outline)
        return np.column_stack([flat, np.full(len(flat), z)])

    scales = np.linspace(0.0, 1.0, max(2, round(x / edge)), endpoint=False)[1:]
    board = [ring(0.0, setback=0.0), ring(cover, setback=0.0)]
    heights = resample([[cover], [thickness - cover]], 0.7 * edge)[:, 0]
    pages = [ring(z, setback=inlay) for z in heights]
    lid = [ring(thickness - cover, setback=0.0), ring(thickness, setback=0.0)]
    under = [ring(0.0, setback=0.0, scale=scale) for scale in scales]
    over = [ring(thickness, setback=0.0, scale=scale) for scale in scales[::-1]]
    tips = [np.array([[0.0, 0.0, z]]) for z in (0.0, thickness)]
    return skin([tips[0], *under, *board, *pages, *lid, *over, tips[1]], closed=False)


def flashlight(
    *, head_radius: float, body_radius: float, height: float, head_height: float
) -> trimesh.Trimesh:
    """Return a flashlight that stands on its lens, with a switch at +x."""
    taper = head_height + 0.022
    side = resample(
        [
            *bevelled(head_radius, head_height, 0.003)[:2],
            (head_radius, head_height),
            (body_radius, taper),
            (body_radius, height - 0.024),
            (body_radius + 0.0025, height - 0.021),
            (body_radius + 0.0025, height - 0.003),
            (body_radius - 0.0005, height),
        ],
        EDGE,
    )

    z = taper + 0.022
    switch = bar(
        (0.0, 0.0, z),
        (body_radius + 0.003, 0.0, z),
        ellipse(0.010, 0.006, edge=0.5 * EDGE),
        normal=(0.0, 1.0, 0.0),
    )
    return fuse(lathe(side), switch)


def dumbbell(
    *, length: float, head_width: float, head_length: float, grip_radius: float
) -> trimesh.Trimesh:
    """Return a dumbbell along x with six-sided heads of `head_width` between flats."""
    apothem = head_width / 2.0
    turns = 2.0 * np.pi * (np.arange(6) + 0.5) / 6.0
    corners = apothem / np.cos(np.pi / 6.0) * np.column_stack([np.cos(turns), np.sin(turns)])
    hexagon = rounded_polygon(corners, 0.15 * head_width, edge=EDGE)
    across = (0.0, 1.0, 0.0)
    start, end = -length / 2.0, length / 2.0
    heads = []
    for low, high in ((start, start + head_length), (end - head_length, end)):
        stations = resample([[low], [low + 0.005], [high - 0.005], [high]], 1.4 * EDGE)[:, 0]
        path = np.column_stack([stations, 0.0 * stations, np.full_like(stations, apothem)])
        scale = np.interp(stations, [low, low + 0.005, high - 0.005, high], [0.86, 1.0, 1.0, 0.86])
        # The section's first coordinate runs along -z: two of the flats are level.
        heads.append(sweep(path, hexagon, normal=across, scale=scale))
    grip = bar(
        (start + head_length / 2.0, 0.0, apothem),
        (end - head_length / 2.0, 0.0, apothem),
        ellipse(grip_radius, grip_radius, edge=EDGE),
        normal=across,
        scale=((0.0, 0.85), (0.25, 0.85), (0.5, 1.0), (0.75, 0.85), (1.0, 0.85)),
    )
    return fuse(*heads, grip)


def camera(*, width: float, height: float, depth: float, lens: float) -> trimesh.Trimesh:
    """Return a camera that looks towards -y: its body, and `lens` the radius of its lens."""
    z = 0.46 * height
    front = -depth / 2.0
    body = block((width, depth, height), (0.0, 0.0, height / 2.0), corner=0.009, edge=LARGE)
    grip = block(
        (0.17 * width, 0.55 * depth, 0.9 * height),
        (-0.38 * width, -0.42 * depth, 0.47 * height),
        corner=0.006,
    )
    hump = pillar(
        [
            (height - 0.006, 0.40 * width, 0.86 * depth),
            (height + 0.010, 0.30 * width, 0.80 * depth),
            (height + 0.016, 0.20 * width, 0.7 * depth),
        ],
        corner=0.005,
    )

    # The lens: two rings, hollow in front, and a curved glass.
    glass = ball((0.0, front - 0.026, z), (0.62 * lens, 0.010, 0.62 * lens))
    barrel = fuse(
        rod((0.0, front + 0.008, z), (0.0, front - 0.020, z), lens),
        rod((0.0, front + 0.008, z), (0.0, front - 0.034, z), 0.88 * lens),
    )
    mouth = rod((0.0, front - 0.028, z), (0.0, front - 0.060, z), 0.70 * lens)

    # With a release button and a dial on top.
    return fuse(
        body,
        grip,
        hump,
        cut(barrel, mouth),
        glass,
        rod(
            (-0.36 * width, -0.2 * depth, height - 0.004),
            (-0.36 * width, -0.2 * depth, height + 0.007),
            0.0075,
        ),
        rod((0.34 * width, 0.0, height - 0.004), (0.34 * width, 0.0, height + 0.008), 0.012),
    )


def alarm_clock(*, radius: float, depth: float) -> trimesh.Trimesh:
    """Return an alarm clock with two bells on top, its face towards -y."""
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

    # Two bells on stalks, a hammer between them, and four feet.
    bells = [_bell_on_stalk(radius, z, side) for side in (1.0, -1.0)]
    hammer = [
        rod((0.0, 0.0, z + 0.9 * radius), (0.0, 0.0, z + 1.28 * radius), 0.0035),
        rod((-0.009, 0.0, z + 1.3 * radius), (0.009, 0.0, z + 1.3 * radius), 0.0065),
    ]
    legs = [
        rod(
            (0.5 * radius * x, 0.32 * y * depth, z - 0.7 * radius),
            (0.72 * radius * x, 0.36 * y * depth, 0.0),
            0.009,
            0.0065,
        )
        for x in (-1.0, 1.0)
        for y in (-1.0, 1.0)
    ]
    return flat_base(fuse(case, *hands, *marks, *bells, *legs, *hammer))


def _bell_on_stalk(radius: float, z: float, side: float) -> trimesh.Trimesh:
    """Return a bell of an alarm clock of a `radius`, whose middle is at height `z` [m].

    Args:
        radius: Of the clock [m].
        z: Of its middle [m].
        side: 1 for the bell at +x, -1 for that at -x.
    """
    s, c = (float(value) for value in sin_cos_deg(60.0))
    dome = cut(
        ball((0.0, 0.0, 0.0), (0.42 * radius, 0.42 * radius, 0.36 * radius)),
        block((radius, radius, radius), (0.0, 0.0, -0.5 * radius)),
    )
    leaning = rotated(dome, "y", 30.0 * side)
    stalk = rod(
        (0.9 * radius * c * side, 0.0, z + 0.9 * radius * s),
        (1.3 * radius * c * side, 0.0, z + 1.3 * radius * s),
        0.0045,
    )
    return fuse(moved(leaning, (1.18 * radius * c * side, 0.0, z + 1.18 * radius * s)), stalk)
