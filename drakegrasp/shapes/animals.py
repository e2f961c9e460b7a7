"""Toy animals, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. They look towards +x. All
lengths are in [m] and all angles in [rad]; `drakegrasp.shapes.classes` has the table of
their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.shapes.modelling.booleans import flat_base, fuse
from drakegrasp.shapes.modelling.primitives import ball, moved, rod, rotated, tube
from drakegrasp.shapes.modelling.profiles import EDGE, ring_angles, smooth

#: Edge length of the animals: they have many parts [m].
COAT = 1.25 * EDGE


def bunny(*, body: float, head: float, ear: float) -> trimesh.Trimesh:
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
            (0.0, 0.0, 0.5 * ear), (0.30 * head, 0.36 * head, 0.62 * ear), edge=0.8 * COAT
        )
        leaning = rotated(rotated(upright, "x", -10.0 * side), "y", -12.0)
        parts += [
            moved(leaning, (0.28 * body, 0.38 * side * head, chin + 0.55 * head)),
            ball(
                (0.55 * body, 0.62 * side * body, 0.24 * body),
                (0.62 * body, 0.30 * body, 0.30 * body),
                edge=COAT,
            ),
            ball(
                (0.80 * body, 0.30 * side * body, 0.95 * body),
                (0.24 * body, 0.20 * body, 0.42 * body),
                edge=0.8 * COAT,
            ),
        ]
    return flat_base(fuse(*parts))


def toy_dog(*, length: float, height: float, girth: float) -> trimesh.Trimesh:
    """Return a standing dog: `length` of the trunk, `height` of the back, `girth` its radius."""
    leg, front, back = 0.36 * girth, 0.36 * length, -0.36 * length
    z = height - girth
    nose = (front + 1.05 * girth, 0.0, height + 0.65 * girth)
    parts = [
        ball((front, 0.0, z), girth, edge=COAT),
        ball((back, 0.0, z), 0.95 * girth, edge=COAT),
        rod((back, 0.0, z), (front, 0.0, z), 0.92 * girth, 0.92 * girth, edge=COAT),
        # Neck, head, snout and nose.
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
            parts.append(rod((x, y, z), (x, y, 0.0), leg, 0.9 * leg, edge=COAT))
            parts.append(
                ball((x + 0.4 * leg, y, 0.45 * leg), (1.4 * leg, 1.1 * leg, 0.8 * leg), edge=COAT)
            )
        ear = ball((0.0, 0.0, -0.45 * girth), (0.36 * girth, 0.17 * girth, 0.68 * girth), edge=COAT)
        leaning = rotated(ear, "x", 14.0 * side)
        parts.append(
            moved(leaning, (nose[0] - 0.3 * girth, 0.8 * side * girth, nose[2] + 0.42 * girth))
        )
    return flat_base(fuse(*parts))


def snake(*, coil: float, thickness: float, neck: float) -> trimesh.Trimesh:
    """Return a coiled snake: radius of its `coil`, `thickness` of its body, height of its head."""
    half = thickness / 2.0
    upper = 2.3 * half

    def ring(radius: float, size: float, z: float) -> trimesh.Trimesh:
        angles = np.append(ring_angles(max(16, round(2.0 * np.pi * radius / COAT))), 2.0 * np.pi)
        halves = []
        for part in (angles[: len(angles) // 2 + 2], angles[len(angles) // 2 - 1 :]):
            path = np.column_stack(
                [radius * np.cos(part), radius * np.sin(part), np.full_like(part, z)]
            )
            halves.append(tube(path, size, edge=COAT))
        return fuse(*halves)

    # The tail lies beside the coil, the neck rises out of it.
    tail = smooth(
        [
            (-0.2 * coil, -coil, half),
            (0.45 * coil, -1.02 * coil, 0.95 * half),
            (1.05 * coil, -1.25 * coil, 0.7 * half),
            (1.55 * coil, -1.1 * coil, 0.4 * half),
        ],
        COAT,
    )
    rise = smooth(
        [
            (-0.58 * coil, 0.36 * coil, upper),
            (-0.56 * coil, 0.0, upper + 0.18 * neck),
            (-0.30 * coil, 0.0, upper + 0.6 * neck),
            (0.02 * coil, 0.0, upper + 0.88 * neck),
            (0.40 * coil, 0.0, upper + 0.94 * neck),
        ],
        COAT,
    )
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


def rubber_duck(*, length: float, head: float) -> trimesh.Trimesh:
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
        parts.append(
            moved(rotated(bill, "y", tilt), (poll[0] + 0.72 * head, 0.0, poll[2] + z * head))
        )
    for side in (-1.0, 1.0):
        parts += [
            ball(
                (poll[0] + 0.68 * head, 0.55 * side * head, poll[2] + 0.36 * head),
                0.17 * head,
                edge=0.5 * COAT,
            ),
            moved(
                rotated(ball((0.0, 0.0, 0.0), (0.52 * a, 0.16 * a, 0.3 * a), edge=COAT), "y", 16.0),
                (-0.22 * a, 0.92 * side * b, 1.05 * c),
            ),
        ]
    return flat_base(fuse(*parts))
