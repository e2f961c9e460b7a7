"""Solid things, one function per class: sizes in metres come in, watertight meshes go out.

What is hollow is in `drakegrasp.objects.builtin.hollow_shapes`. Every mesh
stands or lies on the plane z = 0 as it would on a table, z up; `drakegrasp.objects.builtin.catalog`
holds the table of sizes.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.frames import Array
from drakegrasp.objects.builtin.modelling import (
    bar,
    extrude,
    fuse,
    grid_box,
    revolve,
    skin,
    stand,
    sweep,
)
from drakegrasp.objects.builtin.profiles import (
    COARSE,
    EDGE,
    bevelled,
    ellipse,
    resample,
    rounded_polygon,
    rounded_rectangle,
    smooth,
    spread_evenly,
)


def bottle(*, radius: float, height: float, neck_radius: float) -> trimesh.Trimesh:
    """Return a closed bottle, solid, with a shoulder, a neck and a cap.

    All lengths are in [m].
    """
    shoulder, neck, cap = 0.58 * height, 0.78 * height, 0.9 * height
    side = np.vstack(
        [
            resample([*bevelled(radius, height, 0.004)[:2], (radius, shoulder)], EDGE),
            smooth([(radius, shoulder), (0.8 * radius, 0.66 * height), (neck_radius, neck)], EDGE)[
                1:
            ],
            resample(
                [
                    (neck_radius, neck),
                    (neck_radius, cap),
                    (neck_radius + 0.003, cap),
                    (neck_radius + 0.003, height - 0.003),
                    (neck_radius, height),
                ],
                EDGE,
            )[1:],
        ]
    )
    return _lathe(side)


def can(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return a closed can: a cylinder with bevelled rims.

    All lengths are in [m].
    """
    return _lathe(resample(bevelled(radius, height, 0.002), EDGE))


def jar(*, radius: float, height: float, lid_radius: float, lid_height: float) -> trimesh.Trimesh:
    """Return a closed jar, solid: a body, a short neck and a lid.

    All lengths are in [m].
    """
    shoulder = height - lid_height - 0.018
    neck = min(lid_radius - 0.004, radius - 0.008)
    side = np.vstack(
        [
            resample([*bevelled(radius, height, 0.005)[:2], (radius, shoulder)], EDGE),
            smooth(
                [
                    (radius, shoulder),
                    (radius - 0.25 * (radius - neck), shoulder + 0.006),
                    (neck, shoulder + 0.013),
                ],
                EDGE / 2.0,
            )[1:],
            resample(
                [
                    (neck, height - lid_height),
                    (lid_radius, height - lid_height),
                    (lid_radius, height - 0.003),
                    (lid_radius - 0.003, height),
                ],
                EDGE,
            ),
        ]
    )
    return _lathe(side)


def candlestick(*, foot_radius: float, stem_radius: float, height: float) -> trimesh.Trimesh:
    """Return a candlestick with a wide foot, a knob and a drip cup with a socket.

    All lengths are in [m].
    """
    cup, socket = 2.6 * stem_radius, 0.010
    outline = [
        (foot_radius, 0.0),
        (foot_radius, 0.008),
        (0.55 * foot_radius, 0.020),
        (stem_radius, 0.3 * height),
        (stem_radius, 0.5 * height),
        (1.6 * stem_radius, 0.56 * height),
        (stem_radius, 0.62 * height),
        (stem_radius, 0.78 * height),
        (cup, height - 0.012),
        (cup, height),
    ]
    side = np.vstack([resample(outline[:2], EDGE), smooth(outline[1:], 0.8 * EDGE)[1:]])
    top = [(cup, height), (socket, height), (socket, height - 0.018), (0.0, height - 0.018)]
    foot = resample([(0.0, 0.0), side[0]], COARSE * EDGE)[:-1]
    return revolve(np.vstack([foot, side, resample(top, EDGE)[1:]]))


def flashlight(
    *, head_radius: float, body_radius: float, height: float, head_height: float
) -> trimesh.Trimesh:
    """Return a flashlight that stands on its lens, with a switch at +x.

    All lengths are in [m].
    """
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
    return fuse(_lathe(side), switch)


def box(*, width: float, depth: float, height: float, edge: float = 1.2 * EDGE) -> trimesh.Trimesh:
    """Return an upright box: `width` along x, `depth` along y.

    All lengths are in [m].
    """
    return grid_box((width, depth, height), centre=(0.0, 0.0, height / 2.0), edge=edge)


def book(*, width: float, length: float, thickness: float, edge: float = 0.011) -> trimesh.Trimesh:
    """Return a closed book that lies flat, its round spine along y at -x.

    All lengths are in [m].
    """
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


def spray_bottle(
    *, width: float, depth: float, height: float, edge: float = EDGE
) -> trimesh.Trimesh:
    """Return a spray bottle, solid: an oval body, a neck, a head and a trigger towards +x.

    All lengths are in [m].
    """
    body_height = 0.68 * height
    neck, section = 0.013, rounded_rectangle(width, depth, 0.45 * depth, edge=edge)
    foot = [(0.0, 0.0), (0.5, 0.0), (0.94, 0.0), (1.0, 0.004)]
    side = resample([(0.0, 0.004), (0.0, 0.72 * body_height)], edge)[1:]
    shoulder = smooth(
        [
            (width / 2.0, 0.72 * body_height),
            (0.42 * width, 0.85 * body_height),
            (neck, body_height),
        ],
        edge,
    )[1:] / [width / 2.0, 1.0]
    profile = [*foot, *((1.0, z) for z in side[:, 1]), *shoulder, (0.0, body_height)]
    body = extrude(section, profile)

    head_z = height - 0.014
    collar = revolve(
        resample(
            [
                (0.0, body_height - 0.01),
                (neck + 0.002, body_height - 0.01),
                (neck + 0.002, body_height + 0.014),
                (0.011, body_height + 0.018),
                (0.011, head_z),
                (0.0, head_z),
            ],
            edge,
        )
    )
    head = bar(
        (-0.028, 0.0, head_z),
        (0.048, 0.0, head_z),
        rounded_rectangle(0.028, 0.024, 0.007, edge=edge),
        normal=(0.0, 1.0, 0.0),
        scale=((0.0, 0.75), (0.35, 1.0), (0.75, 0.9), (1.0, 0.55)),
    )
    reach = np.linspace(0.0, 1.0, 50)
    trigger = sweep(
        spread_evenly(
            np.column_stack(
                [0.026 + 0.014 * np.sin(1.6 * reach), 0.0 * reach, head_z - 0.055 * reach]
            ),
            edge,
        ),
        rounded_rectangle(0.008, 0.014, 0.003, edge=edge),
        normal=(0.0, 1.0, 0.0),
        scale=1.0,
    )
    return fuse(body, collar, head, trigger)


def hammer(
    *, length: float, head_length: float, head_thickness: float, claw: bool
) -> trimesh.Trimesh:
    """Return a hammer that lies on its side, handle along -x, head along y.

    With `claw` one half of the head is a bent claw, else the head is a square mallet.
    All lengths are in [m].
    """
    half = head_thickness / 2.0
    up = (0.0, 0.0, 1.0)
    grip = min(half, 0.016)
    # The handle leans, if need be, so that its end lies on the table beside the head.
    handle = bar(
        (-length, 0.0, grip),
        (0.0, 0.0, half),
        ellipse(0.85 * grip, grip, edge=EDGE),
        normal=up,
        scale=((0.0, 1.0), (0.3, 1.0), (0.55, 0.75), (1.0, 0.75)),
    )
    reach = head_length / 2.0
    if claw:
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
        section = rounded_rectangle(2.0 * half, 2.0 * half, 0.55 * half, edge=EDGE)
        head = sweep(path, section, normal=up, scale=scale)
    else:
        section = rounded_rectangle(1.1 * head_thickness, head_thickness, 0.006, edge=EDGE)
        head = bar(
            (0.0, reach, half),
            (0.0, -reach, half),
            section,
            normal=up,
            scale=((0.0, 1.0), (1.0, 1.0)),
        )
    return fuse(handle, head)


def dumbbell(
    *, length: float, head_width: float, head_length: float, grip_radius: float
) -> trimesh.Trimesh:
    """Return a dumbbell along x with six-sided heads of `head_width` between flats.

    All lengths are in [m].
    """
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


def _lathe(side: Array) -> trimesh.Trimesh:
    """Return the solid of a side (r, z) from its foot to its head, closed at both."""
    foot = resample([(0.0, side[0, 1]), side[0]], COARSE * EDGE)[:-1]
    head = resample([side[-1], (0.0, side[-1, 1])], EDGE)[1:]
    return revolve(np.vstack([foot, side, head]))


def banana(*, bend_radius: float, angle: float, thickness: float) -> trimesh.Trimesh:
    """Return a banana that lies on its side, bent by `angle` [rad] about `bend_radius`.

    All lengths are in [m].
    """
    theta = np.linspace(-angle / 2.0, angle / 2.0, round(bend_radius * angle / EDGE) + 1)
    knots = np.array(
        [
            (0.0, 0.34),
            (0.03, 0.38),
            (0.12, 0.36),
            (0.26, 0.85),
            (0.5, 1.0),
            (0.78, 0.85),
            (0.95, 0.42),
            (1.0, 0.24),
        ]
    )
    scale = PchipInterpolator(knots[:, 0], knots[:, 1])(np.linspace(0.0, 1.0, len(theta)))
    half = thickness / 2.0
    # Five soft edges, one face down; the underside stays on the table along the whole fruit.
    turns = 2.0 * np.pi * np.arange(5) / 5.0 - np.pi / 2.0 + np.pi / 5.0
    corners = 1.18 * half * np.column_stack([np.cos(turns), np.sin(turns)])
    section = rounded_polygon(corners, 0.45 * half, edge=EDGE)
    lowest = -section[:, 1].min()
    path = np.column_stack(
        [
            bend_radius * np.sin(theta),
            bend_radius * (1.0 - np.cos(theta)),
            lowest * scale,
        ]
    )
    return sweep(path, section, normal=(0.0, 0.0, 1.0), scale=scale)


def apple(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return an apple with a stem; `height` is without the stem.

    All lengths are in [m].
    """
    side = smooth(
        [
            (0.0, 0.07 * height),
            (0.18 * radius, 0.03 * height),
            (0.36 * radius, 0.0),
            (0.72 * radius, 0.16 * height),
            (0.95 * radius, 0.42 * height),
            (radius, 0.62 * height),
            (0.88 * radius, 0.86 * height),
            (0.5 * radius, height),
            (0.2 * radius, 0.93 * height),
            (0.0, 0.82 * height),
        ],
        EDGE,
    )
    stem = bar(
        (0.0, 0.0, 0.7 * height),
        (0.004, 0.0, height + 0.010),
        ellipse(0.0025, 0.0025, edge=0.002),
        normal=(0.0, 1.0, 0.0),
    )
    return stand(fuse(revolve(side), stem))


def pear(*, radius: float, neck_radius: float, height: float) -> trimesh.Trimesh:
    """Return a pear that stands on its wide end, with a stem; `height` is without the stem.

    All lengths are in [m].
    """
    side = smooth(
        [
            (0.0, 0.04 * height),
            (0.35 * radius, 0.0),
            (0.85 * radius, 0.14 * height),
            (radius, 0.32 * height),
            (0.85 * radius, 0.5 * height),
            (neck_radius, 0.75 * height),
            (0.85 * neck_radius, 0.92 * height),
            (0.4 * neck_radius, height),
            (0.0, 0.98 * height),
        ],
        EDGE,
    )
    stem = bar(
        (0.0, 0.0, 0.85 * height),
        (-0.004, 0.0, height + 0.014),
        ellipse(0.0025, 0.0025, edge=0.002),
        normal=(0.0, 1.0, 0.0),
    )
    return stand(fuse(revolve(side), stem))
