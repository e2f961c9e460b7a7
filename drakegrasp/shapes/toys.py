"""Toys, toy animals, which look towards +x, and a prize.

One function per class: sizes come in, a watertight mesh goes out; see `drakegrasp.shapes.catalog`.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from trimesh import Trimesh

from drakegrasp.frames import Array
from drakegrasp.shapes.curves import (
    BROAD,
    EDGE,
    LARGE,
    joined,
    resample,
    ring_angles,
    scaled,
    smooth,
)
from drakegrasp.shapes.parts import (
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
from drakegrasp.shapes.solids import cut, flat_base, fuse

#: Edge length of the animals: they have many parts [m].
COAT = 1.25 * EDGE


def chess_pawn(*, base: float, head: float, height: float) -> Trimesh:
    """Return a chess pawn: radii of its `base` and its `head`."""
    neck = height - 1.75 * head
    side = joined(
        _plinth(base),
        smooth([(0.8 * base, 0.022), (0.52 * base, 0.32 * neck), (0.42 * head, 0.86 * neck)], EDGE),
        resample(
            [
                (0.95 * head, 0.9 * neck),
                (0.95 * head, 0.9 * neck + 0.006),
                (0.5 * head, neck + 0.004),
            ],
            EDGE,
        ),
    )
    return fuse(lathe(side), ball((0.0, 0.0, height - head), head))


def chess_rook(*, base: float, top: float, height: float) -> Trimesh:
    """Return a chess rook: radii of its `base` and its `top`, which has six battlements."""
    wall = 0.30 * top
    side = joined(
        _plinth(base),
        smooth([(0.82 * base, 0.022), (0.74 * top, 0.45 * height), (0.72 * top, 0.68 * height)],
            EDGE), smooth([(0.78 * top, 0.71 * height), (top, 0.77 * height)], EDGE),
        resample([
            (top, 0.77 * height), (top, height), (top - wall, height), (top - wall, 0.86 * height),
        ], EDGE))  # fmt: skip

    # Three cuts across leave six battlements.
    gaps = [
        rotated(
            block((3.0 * top, 0.34 * top, 0.1), (0.0, 0.0, 0.88 * height + 0.05)), "z", 60.0 * k
        )
        for k in range(3)
    ]
    return cut(lathe(side), *gaps)


def trophy(*, base: float, cup: float, height: float) -> Trimesh:
    """Return a cup with two handles on a square pedestal: edge of `base`, radius of `cup`."""
    foot, stem = 0.17 * height, 0.46 * height
    plinth = pillar(
        [(0.0, base, base), (0.7 * foot, 0.94 * base, 0.94 * base)], corner=0.003, edge=LARGE
    )
    step = block(
        (0.72 * base, 0.72 * base, 0.012), (0.0, 0.0, foot - 0.004), corner=0.003, edge=LARGE
    )
    column = lathe(smooth([
        (0.32 * base, foot), (0.1 * base + 0.003, 0.7 * foot + 0.3 * stem),
        (0.1 * base + 0.003, 0.88 * stem), (0.5 * cup, stem + 0.012),
    ], EDGE))  # fmt: skip

    # The cup and its handles.
    bowl, core = vessel(smooth(scaled([(0.36, 0.0), (0.8, 0.16), (0.94, 0.5), (1.0, 1.0)], cup,
        height - stem), EDGE), wall=0.005, floor=0.012, edge=BROAD)  # fmt: skip
    ear = cut(
        loop_handle(
            x=0.86 * cup,
            top=0.86 * (height - stem),
            bottom=0.26 * (height - stem),
            reach=0.55 * cup,
            radius=0.0045,
        ),
        core,
    )
    ears = [ear, rotated(ear, "z", 180.0)]
    return fuse(plinth, step, column, *(moved(part, (0.0, 0.0, stem)) for part in (bowl, *ears)))


def house(*, width: float, depth: float, wall: float, roof: float) -> Trimesh:
    """Return a toy house: heights of `wall` and `roof`, a door towards -y, a chimney."""
    eaves = 0.012
    body = pillar([(0.0, width, depth), (wall + 0.004, width, depth)], corner=0.004, edge=LARGE)
    gable = pillar(
        [
            (wall - 0.004, width + 2.0 * eaves, depth + eaves),
            (wall, width + 2.0 * eaves, depth + eaves),
            (wall + roof, 0.01, depth + eaves),
        ],
        corner=0.004,
        edge=LARGE,
    )

    # Door, windows and a chimney.
    front = -depth / 2.0
    recesses = [
        block((0.24 * width, 0.007, 0.62 * wall), (0.0, front, 0.29 * wall), edge=LARGE),
        *(
            block(
                (0.19 * width, 0.007, 0.26 * wall),
                (0.32 * side * width, front, 0.58 * wall),
                edge=LARGE,
            )
            for side in (-1.0, 1.0)
        ),
        *(
            block(
                (0.007, 0.3 * depth, 0.3 * wall), (0.5 * side * width, 0.0, 0.56 * wall), edge=LARGE
            )
            for side in (-1.0, 1.0)
        ),
    ]
    chimney = block(
        (0.15 * width, 0.15 * width, 0.6 * roof + 0.012),
        (0.26 * width, 0.18 * depth, wall + 0.75 * roof),
        edge=LARGE,
    )
    return fuse(cut(fuse(body, gable), *recesses), chimney)


def toy_car(*, length: float, width: float, wheel: float) -> Trimesh:
    """Return a toy car that drives towards +x: `wheel` is the radius of its wheels."""
    low, belt = 0.55 * wheel, 2.35 * wheel
    roof = belt + 0.24 * length
    body = pillar([
        (low, 0.97 * length, 0.9 * width), (low + 0.4 * (belt - low), length, 0.94 * width),
        (belt - 0.004, 0.97 * length, 0.92 * width), (belt, 0.93 * length, 0.88 * width),
    ], corner=0.14 * length, edge=LARGE)  # fmt: skip
    cabin = pillar(
        [
            (belt - 0.004, 0.62 * length, 0.86 * width, -0.06 * length, 0.0),
            (roof - 0.01, 0.42 * length, 0.74 * width, -0.08 * length, 0.0),
            (roof, 0.34 * length, 0.64 * width, -0.08 * length, 0.0),
        ],
        corner=0.06 * length,
        edge=1.5 * EDGE,
    )

    # Windows, wheels with rims, and lights.
    panes = [
        block(
            (0.14 * length, 0.5 * width, 0.115 * length),
            (x * length, 0.62 * side * width, belt + 0.115 * length),
            corner=0.002,
        )
        for x in (-0.165, 0.015)
        for side in (-1.0, 1.0)
    ]
    wheels = []
    for x in (-0.30, 0.30):
        for side in (-1.0, 1.0):
            inner, outer = 0.26 * side * width, 0.50 * side * width
            rim = rod(
                (x * length, outer - 0.004 * side, wheel),
                (x * length, 2.0 * outer, wheel),
                0.55 * wheel,
                edge=0.8 * EDGE,
            )
            tyre = rod((x * length, inner, wheel), (x * length, outer, wheel), wheel)
            wheels.append(cut(tyre, rim))
    lights = [
        ball(
            (0.47 * length, 0.28 * side * width, 0.5 * (low + belt) + 0.002),
            (0.05 * length, 0.0075, 0.0075),
            edge=0.6 * EDGE,
        )
        for side in (-1.0, 1.0)
    ]
    return fuse(body, cut(cabin, *panes), *wheels, *lights)


def rocket(*, radius: float, height: float, span: float) -> Trimesh:
    """Return a toy rocket on four fins: `radius` of its hull, `span` of its fins from the axis."""
    low = 0.10 * height
    hull = lathe(smooth([
        (0.62 * radius, low), (0.88 * radius, 0.24 * height), (radius, 0.45 * height),
        (0.86 * radius, 0.68 * height), (0.5 * radius, 0.88 * height), (0.12 * radius, height),
    ], EDGE))  # fmt: skip
    nozzle = post(0.05 * height, low + 0.006, 0.5 * radius, 0.36 * radius)

    # Four fins, on which it stands, and a window.
    fins = []
    for k in range(4):
        fin = pillar([
            (0.0, 0.24 * span, 0.009, 0.86 * span, 0.0),
            (0.05 * height, 0.42 * span, 0.009, 0.79 * span, 0.0),
            (0.16 * height, 0.62 * span, 0.009, 0.56 * span, 0.0),
            (0.34 * height, 0.3 * span, 0.008, 0.32 * span, 0.0),
        ], corner=0.002, edge=LARGE)  # fmt: skip
        fins.append(rotated(fin, "z", 45.0 + 90.0 * k))
    window = rod((0.0, 0.0, 0.62 * height), (0.0, -0.99 * radius, 0.62 * height), 0.36 * radius)
    pane = rod(
        (0.0, -0.93 * radius, 0.62 * height), (0.0, -2.0 * radius, 0.62 * height), 0.24 * radius
    )
    return fuse(hull, nozzle, *fins, cut(window, pane))


def dice(*, size: float, pip: float) -> Trimesh:
    """Return a die with its one on top: edge of the cube, radius of a `pip`."""
    half, edge = size / 2.0, BROAD
    cube = pillar(scaled([
        (0.0, 0.86, 0.86), (0.035, 0.95, 0.95), (0.11, 1.0, 1.0), (0.89, 1.0, 1.0),
        (0.965, 0.95, 0.95), (1.0, 0.86, 0.86),
    ], size, size, size), corner=0.12 * size, edge=edge)  # fmt: skip

    # Where the pips of each face are, in its plane; opposite faces add up to seven.
    a = 0.25 * size
    middle, two = (0.0, 0.0), [(-a, -a), (a, a)]
    four = [(-a, -a), (-a, a), (a, -a), (a, a)]
    faces: dict[str, list[tuple[float, float]]] = {
        "top": [middle],
        "front": two,
        "right": [two[0], middle, two[1]],
        "left": four,
        "back": [*four, middle],
        "bottom": list(product((-a, a), (-a, 0.0, a))),
    }
    place = {
        "top": lambda u, v: (u, v, size),
        "bottom": lambda u, v: (u, v, 0.0),
        "front": lambda u, v: (u, -half, half + v),
        "back": lambda u, v: (u, half, half + v),
        "right": lambda u, v: (half, u, half + v),
        "left": lambda u, v: (-half, u, half + v),
    }
    across = {"top": 2, "bottom": 2, "front": 1, "back": 1, "right": 0, "left": 0}
    pips = []
    for name, spots in faces.items():
        radii = np.full(3, pip if name != "top" else 1.5 * pip)
        radii[across[name]] = 0.45 * pip
        pips += [ball(place[name](u, v), radii, edge=0.75 * EDGE) for u, v in spots]
    return cut(cube, *pips)


def bowling_pin(*, radius: float, height: float) -> Trimesh:
    """Return a bowling pin: `radius` of its belly."""
    side = smooth(scaled([
        (0.66, 0.0), (0.72, 0.03), (1.0, 0.3), (0.72, 0.52), (0.42, 0.68), (0.44, 0.76),
        (0.56, 0.87), (0.42, 0.965), (0.14, 1.0),
    ], radius, height), EDGE)  # fmt: skip
    collars = [
        post(share * height, share * height + 0.006, reach * radius + 0.0015)
        for share, reach in ((0.63, 0.49), (0.69, 0.42))
    ]
    return fuse(lathe(side), *collars)


def _plinth(base: float) -> Array:
    """Return the side (r, z) of the foot of a chessman."""
    return resample([
        (base - 0.002, 0.0), (base, 0.002), (base, 0.012), (0.88 * base, 0.016),
        (0.86 * base, 0.021),
    ], EDGE)  # fmt: skip


def bunny(*, body: float, head: float, ear: float) -> Trimesh:
    """Return a sitting bunny: `body` and `head` are radii, `ear` is the length of its ears."""
    seat = 1.02 * body
    chin = 2.0 * body + 0.45 * head
    parts = [
        ball((0.0, 0.0, seat), (0.95 * body, 0.85 * body, 1.05 * body), edge=COAT),
        ball((0.35 * body, 0.0, chin), (1.08 * head, 0.92 * head, 0.95 * head), edge=COAT),
        ball((-0.95 * body, 0.0, 0.5 * body), 0.32 * body, edge=0.8 * COAT),
    ]

    # Ears, hind feet and fore paws, on both sides.
    for side in (-1.0, 1.0):
        upright = ball(
            (0.0, 0.0, 0.5 * ear), (0.3 * head, 0.36 * head, 0.62 * ear), edge=0.8 * COAT
        )
        place = (0.28 * body, 0.38 * side * head, chin + 0.55 * head)
        parts += [
            moved(upright, place, x=-10.0 * side, y=-12.0),
            ball(
                (0.55 * body, 0.62 * side * body, 0.24 * body),
                (0.62 * body, 0.3 * body, 0.3 * body),
                edge=COAT,
            ),
            ball(
                (0.8 * body, 0.3 * side * body, 0.95 * body),
                (0.24 * body, 0.2 * body, 0.42 * body),
                edge=0.8 * COAT,
            ),
        ]
    return flat_base(fuse(*parts))


def toy_dog(*, length: float, height: float, girth: float) -> Trimesh:
    """Return a standing dog: `length` of the trunk, `height` of the back, `girth` its radius."""
    leg, front, back = 0.36 * girth, 0.36 * length, -0.36 * length
    z = height - girth
    nose = (front + 1.05 * girth, 0.0, height + 0.65 * girth)
    # Trunk, neck, head, snout, nose and tail.
    parts = [
        ball((front, 0.0, z), girth, edge=COAT),
        ball((back, 0.0, z), 0.95 * girth, edge=COAT),
        rod((back, 0.0, z), (front, 0.0, z), 0.92 * girth, 0.92 * girth, edge=COAT),
        rod((front, 0.0, z), nose, 0.72 * girth, 0.6 * girth, edge=COAT),
        ball(nose, (0.88 * girth, 0.82 * girth, 0.8 * girth), edge=COAT),
        rod(
            nose,
            (nose[0] + 1.35 * girth, 0.0, nose[2] - 0.22 * girth),
            0.5 * girth,
            0.38 * girth,
            edge=COAT,
        ),
        ball((nose[0] + 1.35 * girth, 0.0, nose[2] - 0.05 * girth), 0.2 * girth, edge=0.5 * COAT),
        rod(
            (back - 0.6 * girth, 0.0, z + 0.4 * girth),
            (back - 1.7 * girth, 0.0, z + 1.8 * girth),
            0.22 * girth,
            0.16 * girth,
            edge=0.7 * COAT,
        ),
    ]

    # Legs, paws and hanging ears.
    for side in (-1.0, 1.0):
        for x in (front, back):
            y = 0.58 * side * girth
            parts.append(post(z, 0.0, leg, 0.9 * leg, at=(x, y), edge=COAT))
            parts.append(
                ball((x + 0.4 * leg, y, 0.45 * leg), (1.4 * leg, 1.1 * leg, 0.8 * leg), edge=COAT)
            )
        ear = ball((0.0, 0.0, -0.45 * girth), (0.36 * girth, 0.17 * girth, 0.68 * girth), edge=COAT)
        place = (nose[0] - 0.3 * girth, 0.8 * side * girth, nose[2] + 0.42 * girth)
        parts.append(moved(ear, place, x=14.0 * side))
    return flat_base(fuse(*parts))


def snake(*, coil: float, thickness: float, neck: float) -> Trimesh:
    """Return a coiled snake: radius of its `coil`, `thickness` of its body, height of its head."""
    half = thickness / 2.0
    upper = 2.3 * half

    def ring(radius: float, size: float, z: float) -> Trimesh:
        angles = np.append(ring_angles(max(16, round(2.0 * np.pi * radius / COAT))), 2.0 * np.pi)
        x, y = radius * np.cos(angles), radius * np.sin(angles)
        return fuse(*hoop(np.column_stack([x, y, np.full_like(x, z)]), size, edge=COAT))

    # The tail lies beside the coil, the neck rises out of it.
    tail = smooth(scaled([
        (-0.2, -1.0, 1.0), (0.45, -1.02, 0.95), (1.05, -1.25, 0.7), (1.55, -1.1, 0.4),
    ], coil, coil, half), COAT)  # fmt: skip
    rise = smooth([
        (-0.58 * coil, 0.36 * coil, upper), (-0.56 * coil, 0.0, upper + 0.18 * neck),
        (-0.3 * coil, 0.0, upper + 0.6 * neck), (0.02 * coil, 0.0, upper + 0.88 * neck),
        (0.4 * coil, 0.0, upper + 0.94 * neck),
    ], COAT)  # fmt: skip
    head = (0.5 * coil, 0.0, upper + 0.94 * neck)
    return flat_base(
        fuse(
            ring(coil, half, 0.97 * half),
            ring(0.68 * coil, 0.95 * half, upper),
            tube(tail, np.linspace(half, 0.35 * half, len(tail)), edge=COAT),
            tube(rise, np.linspace(0.95 * half, 0.75 * half, len(rise)), edge=COAT),
            ball(head, (1.55 * half, 1.15 * half, 0.85 * half), edge=COAT),
            *(
                ball(
                    (head[0] + 0.4 * half, 0.62 * s * half, head[2] + 0.6 * half),
                    0.3 * half,
                    edge=0.5 * COAT,
                )
                for s in (-1.0, 1.0)
            ),
        )
    )


def rubber_duck(*, length: float, head: float) -> Trimesh:
    """Return a rubber duck: `length` of its trunk, `head` the radius of its head."""
    a = length / 2.0
    b, c = 0.74 * a, 0.6 * a
    poll = (0.42 * a, 0.0, 1.55 * c + 0.75 * head)
    parts = [
        ball((0.0, 0.0, 0.82 * c), (a, b, c), edge=COAT),
        ball((-0.62 * a, 0.0, 1.1 * c), (0.5 * a, 0.5 * b, 0.5 * c), edge=COAT),
        rod((-0.7 * a, 0.0, 1.1 * c), (-1.2 * a, 0.0, 1.85 * c), 0.36 * a, 0.07 * a, edge=COAT),
        rod((0.3 * a, 0.0, c), poll, 0.72 * head, 0.66 * head, edge=COAT),
        ball(poll, (head, 0.95 * head, 0.97 * head), edge=COAT),
    ]

    # The bill, wide and flat, its two halves apart at the tip; eyes and wings.
    for tilt, z in ((-10.0, 0.02), (12.0, -0.2)):
        bill = ball(
            (0.45 * head, 0.0, 0.0), (0.62 * head, 0.5 * head, 0.15 * head), edge=0.7 * COAT
        )
        parts.append(moved(bill, (poll[0] + 0.72 * head, 0.0, poll[2] + z * head), y=tilt))
    for side in (-1.0, 1.0):
        parts += [
            ball(
                (poll[0] + 0.68 * head, 0.55 * side * head, poll[2] + 0.36 * head),
                0.17 * head,
                edge=0.5 * COAT,
            ),
            moved(
                ball((0.0, 0.0, 0.0), (0.52 * a, 0.16 * a, 0.3 * a), edge=COAT),
                (-0.22 * a, 0.92 * side * b, 1.05 * c),
                y=16.0,
            ),
        ]
    return flat_base(fuse(*parts))
