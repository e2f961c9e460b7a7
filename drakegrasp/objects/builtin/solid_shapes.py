"""Solids that are not round, one function per class: sizes in metres come in, meshes go out.

They are boxes, or sections that are moved along paths. Round solids are in `revolved_shapes`,
vessels in `hollow_shapes`. Every mesh stands or lies on the plane z = 0 as it would on a table,
z up; `drakegrasp.objects.builtin.catalog` holds the table of sizes.
"""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.interpolate import PchipInterpolator

from drakegrasp.frames import Array
from drakegrasp.objects.builtin.booleans import fuse
from drakegrasp.objects.builtin.modelling import bar, extrude, grid_box, revolve, skin, sweep
from drakegrasp.objects.builtin.profiles import (
    EDGE,
    ellipse,
    resample,
    rounded_polygon,
    rounded_rectangle,
    smooth,
    spread_evenly,
)


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
    *, width: float, depth: float, height: float, edge: float = 0.007
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


def hammer(*, length: float, head_length: float, head_thickness: float) -> trimesh.Trimesh:
    """Return a claw hammer that lies on its side, handle along -x, head along y.

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
