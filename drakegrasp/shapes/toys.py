"""Toys, toy animals that look to +x, and a trophy.

One function per class: sizes come in, a watertight mesh goes out; see `drakegrasp.shapes.catalog`.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from trimesh import Trimesh

from drakegrasp.frames import Array
from drakegrasp.shapes.parts import (
    SIDES,
    ball,
    block,
    hoop,
    lathe,
    loop_handle,
    moved,
    pillar,
    post,
    rod,
    rotated,
    tube,
    vessel,
)
from drakegrasp.shapes.solids import (
    BROAD,
    EDGE,
    LARGE,
    at_height,
    cut,
    flat_base,
    fuse,
    joined,
    resample,
    ring_angles,
    scaled,
    smooth,
)

#: Edge length of the animals, which have many parts [m].
COAT = 1.25 * EDGE


def chess_pawn(*, base: float, head: float, height: float) -> Trimesh:
    """Return a chess pawn; `base` and `head` are radii."""
    neck = height - 1.75 * head
    waist = [(0.8 * base, 0.022), (0.52 * base, 0.32 * neck), (0.42 * head, 0.86 * neck)]
    low, rim = 0.9 * neck, 0.95 * head
    collar = resample([(rim, low), (rim, low + 0.006), (0.5 * head, neck + 0.004)], EDGE)
    side = joined(_plinth(base), smooth(waist, EDGE), collar)
    return fuse(lathe(side), ball((0.0, 0.0, height - head), head))


def chess_rook(*, base: float, top: float, height: float) -> Trimesh:
    """Return a chess rook with six battlements; `base` and `top` are radii."""
    low, inside = 0.77 * height, top - 0.30 * top
    waist = [(0.82 * base, 0.022), (0.74 * top, 0.45 * height), (0.72 * top, 0.68 * height)]
    neck = smooth([(0.78 * top, 0.71 * height), (top, low)], EDGE)
    crown = resample([(top, low), (top, height), (inside, height), (inside, 0.86 * height)], EDGE)
    side = joined(_plinth(base), smooth(waist, EDGE), neck, crown)

    # Three cuts across the top leave six battlements.
    gap = block((3.0 * top, 0.34 * top, 0.1), (0.0, 0.0, 0.88 * height + 0.05))
    return cut(lathe(side), *(rotated(gap, "z", 60.0 * k) for k in range(3)))


def trophy(*, base: float, cup: float, height: float) -> Trimesh:
    """Return a cup with two handles on a square pedestal of edge `base`; `cup` is its radius."""
    foot, stem = 0.17 * height, 0.46 * height
    levels = [(0.0, base, base), (0.7 * foot, 0.94 * base, 0.94 * base)]
    plinth = pillar(levels, corner=0.003, edge=LARGE)
    size = (0.72 * base, 0.72 * base, 0.012)
    step = block(size, (0.0, 0.0, foot - 0.004), corner=0.003, edge=LARGE)
    column = lathe(smooth([
        (0.32 * base, foot), (0.1 * base + 0.003, 0.7 * foot + 0.3 * stem),
        (0.1 * base + 0.003, 0.88 * stem), (0.5 * cup, stem + 0.012),
    ], EDGE))  # fmt: skip

    # The cup and its handles.
    deep = height - stem
    side = smooth(scaled([(0.36, 0.0), (0.8, 0.16), (0.94, 0.5), (1.0, 1.0)], cup, deep), EDGE)
    bowl, core = vessel(side, wall=0.005, floor=0.012, edge=BROAD)
    ear = cut(loop_handle(0.86 * cup, 0.26 * deep, 0.86 * deep, 0.55 * cup, 0.0045), core)
    upper = [moved(part, (0.0, 0.0, stem)) for part in (bowl, ear, rotated(ear, "z", 180.0))]
    return fuse(plinth, step, column, *upper)


def house(*, width: float, depth: float, wall: float, roof: float) -> Trimesh:
    """Return a toy house with a door at -y and a chimney; `wall` and `roof` are heights."""
    eaves, front = 0.012, -depth / 2.0
    wide, deep = width + 2.0 * eaves, depth + eaves
    body = pillar([(0.0, width, depth), (wall + 0.004, width, depth)], corner=0.004, edge=LARGE)
    levels = [(wall - 0.004, wide, deep), (wall, wide, deep), (wall + roof, 0.01, deep)]
    gable = pillar(levels, corner=0.004, edge=LARGE)

    # Door, windows and a chimney.
    sizes = [(0.24 * width, 0.007, 0.62 * wall)]
    sizes += 2 * [(0.19 * width, 0.007, 0.26 * wall)] + 2 * [(0.007, 0.3 * depth, 0.3 * wall)]
    places = [(0.0, front, 0.29 * wall)]
    places += [(0.32 * side * width, front, 0.58 * wall) for side in SIDES]
    places += [(0.5 * side * width, 0.0, 0.56 * wall) for side in SIDES]
    recesses = [block(*one, edge=LARGE) for one in zip(sizes, places, strict=True)]
    size = (0.15 * width, 0.15 * width, 0.6 * roof + 0.012)
    chimney = block(size, (0.26 * width, 0.18 * depth, wall + 0.75 * roof), edge=LARGE)
    return fuse(cut(fuse(body, gable), *recesses), chimney)


def toy_car(*, length: float, width: float, wheel: float) -> Trimesh:
    """Return a toy car that drives to +x; `wheel` is the radius of its wheels."""
    low, belt = 0.55 * wheel, 2.35 * wheel
    roof = belt + 0.24 * length
    body = pillar([
        (low, 0.97 * length, 0.9 * width), (low + 0.4 * (belt - low), length, 0.94 * width),
        (belt - 0.004, 0.97 * length, 0.92 * width), (belt, 0.93 * length, 0.88 * width),
    ], corner=0.14 * length, edge=LARGE)  # fmt: skip
    cabin = pillar([
        (belt - 0.004, 0.62 * length, 0.86 * width, -0.06 * length, 0.0),
        (roof - 0.01, 0.42 * length, 0.74 * width, -0.08 * length, 0.0),
        (roof, 0.34 * length, 0.64 * width, -0.08 * length, 0.0),
    ], corner=0.06 * length, edge=1.5 * EDGE)  # fmt: skip

    # Windows, wheels with rims, and lights.
    pane = (0.14 * length, 0.5 * width, 0.115 * length)
    panes = [
        block(pane, (x * length, 0.62 * side * width, belt + 0.115 * length))
        for x, side in product((-0.165, 0.015), SIDES)
    ]
    wheels = []
    for x, side in product((-0.30 * length, 0.30 * length), SIDES):
        inner, outer = 0.26 * side * width, 0.50 * side * width
        deep, beyond = (x, outer - 0.004 * side, wheel), (x, 2.0 * outer, wheel)
        rim = rod(deep, beyond, 0.55 * wheel, edge=0.8 * EDGE)
        wheels.append(cut(rod((x, inner, wheel), (x, outer, wheel), wheel), rim))
    x, z, radii = 0.47 * length, 0.5 * (low + belt) + 0.002, (0.05 * length, 0.0075, 0.0075)
    lights = [ball((x, 0.28 * side * width, z), radii, edge=0.6 * EDGE) for side in SIDES]
    return fuse(body, cut(cabin, *panes), *wheels, *lights)


def rocket(*, radius: float, height: float, span: float) -> Trimesh:
    """Return a toy rocket of `radius` on four fins; `span` is their reach from the axis."""
    low = 0.10 * height
    hull = lathe(smooth([
        (0.62 * radius, low), (0.88 * radius, 0.24 * height), (radius, 0.45 * height),
        (0.86 * radius, 0.68 * height), (0.5 * radius, 0.88 * height), (0.12 * radius, height),
    ], EDGE))  # fmt: skip
    nozzle = post(0.05 * height, low + 0.006, 0.5 * radius, 0.36 * radius)

    # Four fins on which it stands, and a window.
    fin = pillar([
        (0.0, 0.24 * span, 0.009, 0.86 * span, 0.0),
        (0.05 * height, 0.42 * span, 0.009, 0.79 * span, 0.0),
        (0.16 * height, 0.62 * span, 0.009, 0.56 * span, 0.0),
        (0.34 * height, 0.3 * span, 0.008, 0.32 * span, 0.0),
    ], edge=LARGE)  # fmt: skip
    fins = [rotated(fin, "z", 45.0 + 90.0 * k) for k in range(4)]
    z = 0.62 * height
    window = rod((0.0, 0.0, z), (0.0, -0.99 * radius, z), 0.36 * radius)
    pane = rod((0.0, -0.93 * radius, z), (0.0, -2.0 * radius, z), 0.24 * radius)
    return fuse(hull, nozzle, *fins, cut(window, pane))


def dice(*, size: float, pip: float) -> Trimesh:
    """Return a die with the one on top; `size` is the cube's edge, `pip` the radius of a pip."""
    cube = pillar(scaled([
        (0.0, 0.86, 0.86), (0.035, 0.95, 0.95), (0.11, 1.0, 1.0), (0.89, 1.0, 1.0),
        (0.965, 0.95, 0.95), (1.0, 0.86, 0.86),
    ], size, size, size), corner=0.12 * size, edge=BROAD)  # fmt: skip

    # Positions of the pips of each face, in its plane; opposite faces add up to seven.
    half, a = size / 2.0, 0.25 * size
    middle, two = (0.0, 0.0), [(-a, -a), (a, a)]
    four, six = list(product((-a, a), repeat=2)), product((-a, a), (-a, 0.0, a))
    spots = [
        *((u, v, size) for u, v in [middle]),
        *((u, -half, half + v) for u, v in two),
        *((half, u, half + v) for u, v in (two[0], middle, two[1])),
        *((-half, u, half + v) for u, v in four),
        *((u, half, half + v) for u, v in (*four, middle)),
        *((u, v, 0.0) for u, v in six),
    ]
    # The pips are flat, and the one is larger.
    across = np.repeat([2, 1, 0, 0, 1, 2], [1, 2, 3, 4, 5, 6])
    radii = np.full((len(spots), 3), pip)
    radii[0] = 1.5 * pip
    radii[np.arange(len(spots)), across] = 0.45 * pip
    return cut(cube, *(ball(*one, edge=0.75 * EDGE) for one in zip(spots, radii, strict=True)))


def bowling_pin(*, radius: float, height: float) -> Trimesh:
    """Return a bowling pin; `radius` is that of its belly."""
    side = smooth(scaled([
        (0.66, 0.0), (0.72, 0.03), (1.0, 0.3), (0.72, 0.52), (0.42, 0.68), (0.44, 0.76),
        (0.56, 0.87), (0.42, 0.965), (0.14, 1.0),
    ], radius, height), EDGE)  # fmt: skip
    collars = [
        post(z, z + 0.006, reach + 0.0015)
        for reach, z in scaled([(0.49, 0.63), (0.42, 0.69)], radius, height)
    ]
    return fuse(lathe(side), *collars)


def _plinth(base: float) -> Array:
    """Return the profile (r, z) of the foot of a chess piece."""
    return resample([
        (base - 0.002, 0.0), (base, 0.002), (base, 0.012), (0.88 * base, 0.016),
        (0.86 * base, 0.021),
    ], EDGE)  # fmt: skip


def bunny(*, body: float, head: float, ear: float) -> Trimesh:
    """Return a sitting bunny; `body` and `head` are radii, `ear` is the length of its ears."""
    chin = 2.0 * body + 0.45 * head
    parts = [
        ball((0.0, 0.0, 1.02 * body), scaled((0.95, 0.85, 1.05), body), edge=COAT),
        ball((0.35 * body, 0.0, chin), scaled((1.08, 0.92, 0.95), head), edge=COAT),
        ball((-0.95 * body, 0.0, 0.5 * body), 0.32 * body, edge=0.8 * COAT),
    ]

    # Ears, hind feet and fore paws, on both sides.
    upright = ball((0.0, 0.0, 0.5 * ear), (0.3 * head, 0.36 * head, 0.62 * ear), edge=0.8 * COAT)
    for side in SIDES:
        place = (0.28 * body, 0.38 * side * head, chin + 0.55 * head)
        foot, paw = scaled([(0.55, 0.62 * side, 0.24), (0.8, 0.3 * side, 0.95)], body)
        parts += [
            moved(upright, place, x=-10.0 * side, y=-12.0),
            ball(foot, scaled((0.62, 0.3, 0.3), body), edge=COAT),
            ball(paw, scaled((0.24, 0.2, 0.42), body), edge=0.8 * COAT),
        ]
    return flat_base(fuse(*parts))


def toy_dog(*, length: float, height: float, girth: float) -> Trimesh:
    """Return a standing dog of trunk `length` and back `height`; `girth` is the trunk's radius."""
    leg, x, z = 0.36 * girth, 0.36 * length, height - girth
    front, back = (x, 0.0, z), (-x, 0.0, z)
    nose = (x + 1.05 * girth, 0.0, height + 0.65 * girth)
    snout = nose[0] + 1.35 * girth
    root = (-x - 0.6 * girth, 0.0, z + 0.4 * girth)
    tip = (-x - 1.7 * girth, 0.0, z + 1.8 * girth)
    # Trunk, neck, head, snout, nose and tail.
    parts = [
        ball(front, girth, edge=COAT),
        ball(back, 0.95 * girth, edge=COAT),
        rod(back, front, 0.92 * girth, edge=COAT),
        rod(front, nose, 0.72 * girth, 0.6 * girth, edge=COAT),
        ball(nose, scaled((0.88, 0.82, 0.8), girth), edge=COAT),
        rod(nose, (snout, 0.0, nose[2] - 0.22 * girth), 0.5 * girth, 0.38 * girth, edge=COAT),
        ball((snout, 0.0, nose[2] - 0.05 * girth), 0.2 * girth, edge=0.5 * COAT),
        rod(root, tip, 0.22 * girth, 0.16 * girth, edge=0.7 * COAT),
    ]

    # Legs, paws and hanging ears.
    ear = ball((0.0, 0.0, -0.45 * girth), scaled((0.36, 0.17, 0.68), girth), edge=COAT)
    for side in SIDES:
        y = 0.58 * side * girth
        for hip in (x, -x):
            parts.append(post(z, 0.0, leg, 0.9 * leg, at=(hip, y), edge=COAT))
            paw = scaled((1.4, 1.1, 0.8), leg)
            parts.append(ball((hip + 0.4 * leg, y, 0.45 * leg), paw, edge=COAT))
        place = (nose[0] - 0.3 * girth, 0.8 * side * girth, nose[2] + 0.42 * girth)
        parts.append(moved(ear, place, x=14.0 * side))
    return flat_base(fuse(*parts))


def snake(*, coil: float, thickness: float, neck: float) -> Trimesh:
    """Return a coiled snake; `coil` is the coil's radius, `neck` the height of its head."""
    half = thickness / 2.0
    upper = 2.3 * half

    def ring(radius: float, size: float, z: float) -> Trimesh:
        angles = np.append(ring_angles(max(16, round(2.0 * np.pi * radius / COAT))), 2.0 * np.pi)
        circle = radius * np.column_stack([np.cos(angles), np.sin(angles)])
        return fuse(*hoop(at_height(circle, z), size, edge=COAT))

    # The tail is beside the coil; the neck rises out of the coil.
    knots = [(-0.2, -1.0, 1.0), (0.45, -1.02, 0.95), (1.05, -1.25, 0.7), (1.55, -1.1, 0.4)]
    tail = smooth(scaled(knots, coil, coil, half), COAT)
    rise = smooth([
        (-0.58 * coil, 0.36 * coil, upper), (-0.56 * coil, 0.0, upper + 0.18 * neck),
        (-0.3 * coil, 0.0, upper + 0.6 * neck), (0.02 * coil, 0.0, upper + 0.88 * neck),
        (0.4 * coil, 0.0, upper + 0.94 * neck),
    ], COAT)  # fmt: skip
    x, z = 0.5 * coil, upper + 0.94 * neck
    eyes = [(x + 0.4 * half, 0.62 * side * half, z + 0.6 * half) for side in SIDES]
    return flat_base(
        fuse(
            ring(coil, half, 0.97 * half),
            ring(0.68 * coil, 0.95 * half, upper),
            tube(tail, np.linspace(half, 0.35 * half, len(tail)), edge=COAT),
            tube(rise, np.linspace(0.95 * half, 0.75 * half, len(rise)), edge=COAT),
            ball((x, 0.0, z), scaled((1.55, 1.15, 0.85), half), edge=COAT),
            *(ball(eye, 0.3 * half, edge=0.5 * COAT) for eye in eyes),
        )
    )


def rubber_duck(*, length: float, head: float) -> Trimesh:
    """Return a rubber duck; `length` is that of its trunk, `head` the radius of its head."""
    a = length / 2.0
    b, c = 0.74 * a, 0.6 * a
    poll = (0.42 * a, 0.0, 1.55 * c + 0.75 * head)
    parts = [
        ball((0.0, 0.0, 0.82 * c), (a, b, c), edge=COAT),
        ball((-0.62 * a, 0.0, 1.1 * c), (0.5 * a, 0.5 * b, 0.5 * c), edge=COAT),
        rod((-0.7 * a, 0.0, 1.1 * c), (-1.2 * a, 0.0, 1.85 * c), 0.36 * a, 0.07 * a, edge=COAT),
        rod((0.3 * a, 0.0, c), poll, 0.72 * head, 0.66 * head, edge=COAT),
        ball(poll, scaled((1.0, 0.95, 0.97), head), edge=COAT),
    ]

    # The bill is wide and flat, with its halves apart at the tip; then eyes and wings.
    bill = ball((0.45 * head, 0.0, 0.0), scaled((0.62, 0.5, 0.15), head), edge=0.7 * COAT)
    for tilt, z in ((-10.0, 0.02), (12.0, -0.2)):
        parts.append(moved(bill, (poll[0] + 0.72 * head, 0.0, poll[2] + z * head), y=tilt))
    wing = ball((0.0, 0.0, 0.0), scaled((0.52, 0.16, 0.3), a), edge=COAT)
    for side in SIDES:
        eye = (poll[0] + 0.68 * head, 0.55 * side * head, poll[2] + 0.36 * head)
        parts.append(ball(eye, 0.17 * head, edge=0.5 * COAT))
        parts.append(moved(wing, (-0.22 * a, 0.92 * side * b, 1.05 * c), y=16.0))
    return flat_base(fuse(*parts))
