"""Toys and a prize, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. All lengths are in [m]
and all angles in [rad]; `drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import trimesh

from drakegrasp.shapes.modelling.booleans import cut, fuse
from drakegrasp.shapes.modelling.primitives import ball, block, lathe, moved, pillar, rod, rotated
from drakegrasp.shapes.modelling.profiles import BROAD, EDGE, LARGE, resample, smooth
from drakegrasp.shapes.vessels import loop_handle, vessel


def chess_pawn(*, base: float, head: float, height: float) -> trimesh.Trimesh:
    """Return a chess pawn: radii of its `base` and its `head`."""
    neck = height - 1.75 * head
    side = np.vstack(
        [
            _plinth(base),
            smooth(
                [(0.80 * base, 0.022), (0.52 * base, 0.32 * neck), (0.42 * head, 0.86 * neck)], EDGE
            ),
            resample(
                [
                    (0.95 * head, 0.90 * neck),
                    (0.95 * head, 0.90 * neck + 0.006),
                    (0.5 * head, neck + 0.004),
                ],
                EDGE,
            ),
        ]
    )
    return fuse(lathe(side), ball((0.0, 0.0, height - head), head))


def chess_rook(*, base: float, top: float, height: float) -> trimesh.Trimesh:
    """Return a chess rook: radii of its `base` and its `top`, which has six battlements."""
    wall = 0.30 * top
    side = np.vstack(
        [
            _plinth(base),
            smooth(
                [(0.82 * base, 0.022), (0.74 * top, 0.45 * height), (0.72 * top, 0.68 * height)],
                EDGE,
            ),
            smooth([(0.78 * top, 0.71 * height), (top, 0.77 * height)], EDGE),
            resample(
                [
                    (top, 0.77 * height),
                    (top, height),
                    (top - wall, height),
                    (top - wall, 0.86 * height),
                ],
                EDGE,
            )[1:],
        ]
    )

    # Three cuts across leave six battlements.
    gaps = [
        rotated(
            block((3.0 * top, 0.34 * top, 0.1), (0.0, 0.0, 0.88 * height + 0.05)), "z", 60.0 * k
        )
        for k in range(3)
    ]
    return cut(lathe(side), *gaps)


def trophy(*, base: float, cup: float, height: float) -> trimesh.Trimesh:
    """Return a cup with two handles on a square pedestal: edge of `base`, radius of `cup`."""
    foot, stem = 0.17 * height, 0.46 * height
    plinth = pillar(
        [(0.0, base, base), (0.7 * foot, 0.94 * base, 0.94 * base)], corner=0.003, edge=LARGE
    )
    step = block(
        (0.72 * base, 0.72 * base, 0.012), (0.0, 0.0, foot - 0.004), corner=0.003, edge=LARGE
    )
    column = lathe(
        smooth(
            [
                (0.32 * base, foot),
                (0.10 * base + 0.003, 0.7 * foot + 0.3 * stem),
                (0.10 * base + 0.003, 0.88 * stem),
                (0.5 * cup, stem + 0.012),
            ],
            EDGE,
        )
    )

    # The cup and its handles.
    bowl, core = vessel(
        smooth(
            [
                (0.36 * cup, 0.0),
                (0.80 * cup, 0.16 * (height - stem)),
                (0.94 * cup, 0.5 * (height - stem)),
                (cup, height - stem),
            ],
            EDGE,
        ),
        wall=0.005,
        floor=0.012,
        edge=BROAD,
    )
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


def house(*, width: float, depth: float, wall: float, roof: float) -> trimesh.Trimesh:
    """Return a toy house: heights of `wall` and `roof`, a door towards -y, a chimney."""
    eaves = 0.012
    body = pillar([(0.0, width, depth), (wall + 0.004, width, depth)], corner=0.004, edge=LARGE)
    gable = pillar(
        [
            (wall - 0.004, width + 2.0 * eaves, depth + eaves),
            (wall, width + 2.0 * eaves, depth + eaves),
            (wall + roof, 0.010, depth + eaves),
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


def toy_car(*, length: float, width: float, wheel: float) -> trimesh.Trimesh:
    """Return a toy car that drives towards +x: `wheel` is the radius of its wheels."""
    low, belt = 0.55 * wheel, 2.35 * wheel
    roof = belt + 0.24 * length
    body = pillar(
        [
            (low, 0.97 * length, 0.90 * width),
            (low + 0.4 * (belt - low), length, 0.94 * width),
            (belt - 0.004, 0.97 * length, 0.92 * width),
            (belt, 0.93 * length, 0.88 * width),
        ],
        corner=0.14 * length,
        edge=LARGE,
    )
    cabin = pillar(
        [
            (belt - 0.004, 0.62 * length, 0.86 * width, -0.06 * length, 0.0),
            (roof - 0.010, 0.42 * length, 0.74 * width, -0.08 * length, 0.0),
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


def rocket(*, radius: float, height: float, span: float) -> trimesh.Trimesh:
    """Return a toy rocket on four fins: `radius` of its hull, `span` of its fins from the axis."""
    low = 0.10 * height
    hull = lathe(
        smooth(
            [
                (0.62 * radius, low),
                (0.88 * radius, 0.24 * height),
                (radius, 0.45 * height),
                (0.86 * radius, 0.68 * height),
                (0.5 * radius, 0.88 * height),
                (0.12 * radius, height),
            ],
            EDGE,
        )
    )
    nozzle = rod((0.0, 0.0, 0.05 * height), (0.0, 0.0, low + 0.006), 0.5 * radius, 0.36 * radius)

    # Four fins, on which it stands, and a window.
    fins = []
    for k in range(4):
        fin = pillar(
            [
                (0.0, 0.24 * span, 0.009, 0.86 * span, 0.0),
                (0.05 * height, 0.42 * span, 0.009, 0.79 * span, 0.0),
                (0.16 * height, 0.62 * span, 0.009, 0.56 * span, 0.0),
                (0.34 * height, 0.30 * span, 0.008, 0.32 * span, 0.0),
            ],
            corner=0.002,
            edge=LARGE,
        )
        fins.append(rotated(fin, "z", 45.0 + 90.0 * k))
    window = rod((0.0, 0.0, 0.62 * height), (0.0, -0.99 * radius, 0.62 * height), 0.36 * radius)
    pane = rod(
        (0.0, -0.93 * radius, 0.62 * height), (0.0, -2.0 * radius, 0.62 * height), 0.24 * radius
    )
    return fuse(hull, nozzle, *fins, cut(window, pane))


def dice(*, size: float, pip: float) -> trimesh.Trimesh:
    """Return a die with its one on top: edge of the cube, radius of a `pip`."""
    half, edge = size / 2.0, BROAD
    cube = pillar(
        [
            (0.0, 0.86 * size, 0.86 * size),
            (0.035 * size, 0.95 * size, 0.95 * size),
            (0.11 * size, size, size),
            (0.89 * size, size, size),
            (0.965 * size, 0.95 * size, 0.95 * size),
            (size, 0.86 * size, 0.86 * size),
        ],
        corner=0.12 * size,
        edge=edge,
    )

    # Where the pips of each face are, in its plane; opposite faces add up to seven.
    a = 0.25 * size
    five = [(-a, -a), (-a, a), (a, -a), (a, a)]
    faces = {
        "top": [(0.0, 0.0)],
        "front": [(-a, -a), (a, a)],
        "right": [(-a, -a), (0.0, 0.0), (a, a)],
        "left": five,
        "back": [*five, (0.0, 0.0)],
        "bottom": [(x, y) for x, y in product((-a, a), (-a, 0.0, a))],
    }
    place = {
        "top": lambda u, v: (u, v, size),
        "bottom": lambda u, v: (u, v, 0.0),
        "front": lambda u, v: (u, -half, half + v),
        "back": lambda u, v: (u, half, half + v),
        "right": lambda u, v: (half, u, half + v),
        "left": lambda u, v: (-half, u, half + v),
    }
    normals = {"top": 2, "bottom": 2, "front": 1, "back": 1, "right": 0, "left": 0}
    pips = []
    for name, spots in faces.items():
        radii = np.full(3, pip if name != "top" else 1.5 * pip)
        radii[normals[name]] = 0.45 * pip
        pips += [ball(place[name](u, v), radii, edge=0.75 * EDGE) for u, v in spots]
    return cut(cube, *pips)


def bowling_pin(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return a bowling pin: `radius` of its belly."""
    side = smooth(
        [
            (0.66 * radius, 0.0),
            (0.72 * radius, 0.03 * height),
            (radius, 0.30 * height),
            (0.72 * radius, 0.52 * height),
            (0.42 * radius, 0.68 * height),
            (0.44 * radius, 0.76 * height),
            (0.56 * radius, 0.87 * height),
            (0.42 * radius, 0.965 * height),
            (0.14 * radius, height),
        ],
        EDGE,
    )
    collars = [
        rod((0.0, 0.0, share * height), (0.0, 0.0, share * height + 0.006), reach * radius + 0.0015)
        for share, reach in ((0.63, 0.49), (0.69, 0.42))
    ]
    return fuse(lathe(side), *collars)


def _plinth(base: float) -> np.ndarray:
    """Return the side (r, z) of the foot of a chessman."""
    return resample(
        [
            (base - 0.002, 0.0),
            (base, 0.002),
            (base, 0.012),
            (0.88 * base, 0.016),
            (0.86 * base, 0.021),
        ],
        EDGE,
    )
