"""Things that are bought packed, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. All lengths are in [m]
and all angles in [rad]; `drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

import numpy as np
import trimesh

from drakegrasp.shapes.modelling.booleans import cut, fuse
from drakegrasp.shapes.modelling.primitives import block, lathe, moved, pillar, rod, rotated, tube
from drakegrasp.shapes.modelling.profiles import (
    BROAD,
    EDGE,
    LARGE,
    bevelled,
    resample,
    rounded_rectangle,
    smooth,
    spread_evenly,
)
from drakegrasp.shapes.modelling.solids import bar, extrude, grid_box, revolve, sweep


def box(*, width: float, depth: float, height: float, edge: float = 1.2 * EDGE) -> trimesh.Trimesh:
    """Return an upright box: `width` along x, `depth` along y."""
    return grid_box((width, depth, height), centre=(0.0, 0.0, height / 2.0), edge=edge)


def can(*, radius: float, height: float) -> trimesh.Trimesh:
    """Return a closed can: a cylinder with bevelled rims."""
    return lathe(resample(bevelled(radius, height, 0.002), EDGE))


def bottle(*, radius: float, height: float, neck_radius: float) -> trimesh.Trimesh:
    """Return a closed bottle, solid, with a shoulder, a neck and a cap."""
    shoulder, neck, cap = 0.58 * height, 0.78 * height, 0.9 * height

    # From the bottom up: body, shoulder, neck and cap.
    side = np.vstack(
        [
            resample([*bevelled(radius, height, 0.004)[:2], (radius, shoulder)], BROAD),
            smooth([(radius, shoulder), (0.8 * radius, 0.66 * height), (neck_radius, neck)], BROAD)[
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
                BROAD,
            )[1:],
        ]
    )
    return lathe(side)


def jar(*, radius: float, height: float, lid_radius: float, lid_height: float) -> trimesh.Trimesh:
    """Return a closed jar, solid: a body, a short neck and a lid."""
    shoulder = height - lid_height - 0.018
    neck = min(lid_radius - 0.004, radius - 0.008)

    # From the bottom up: body, shoulder, lid.
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
    return lathe(side)


def carton(*, width: float, height: float, roof: float) -> trimesh.Trimesh:
    """Return a milk carton with a gable of height `roof` and a screw cap at -y."""
    fin = 0.014
    shell = pillar(
        [
            (0.0, width, width),
            (height, width, width),
            (height + roof, width, 0.008),
            (height + roof + fin, width, 0.008),
        ],
        corner=0.003,
        edge=LARGE,
    )
    # The gable's ends are folded inwards.
    folds = []
    for side in (-1.0, 1.0):
        fold = pillar(
            [(height + 0.004, 0.0105, 0.86 * width), (height + 0.86 * roof, 0.024, 0.005)]
        )
        folds.append(moved(fold, (0.5 * side * width, 0.0, 0.0)))
    slope = np.degrees(np.arctan2(roof, 0.5 * width - 0.004))
    cap = rotated(rod((0.0, 0.0, -0.006), (0.0, 0.0, 0.011), 0.15 * width + 0.003), "x", slope)
    return fuse(cut(shell, *folds), moved(cap, (0.0, -0.27 * width, height + 0.48 * roof)))


def spray_bottle(
    *, width: float, depth: float, height: float, edge: float = 0.007
) -> trimesh.Trimesh:
    """Return a spray bottle, solid: an oval body, a neck, a head and a trigger towards +x."""
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


def soap_dispenser(*, width: float, depth: float, height: float) -> trimesh.Trimesh:
    """Return a soap dispenser: an oval bottle and a pump whose spout points towards +x."""
    body = 0.64 * height
    bottle = pillar(
        [
            (0.0, 0.94 * width, 0.94 * depth),
            (0.3 * body, width, depth),
            (0.75 * body, width, depth),
            (0.93 * body, 0.72 * width, 0.76 * depth),
            (body, 0.42 * width, 0.52 * depth),
        ],
        corner=0.48 * depth,
        edge=BROAD,
    )

    # The pump: collar, stem and spout.
    collar, stem = 0.25 * depth + 0.004, 0.006
    z = height - 0.012
    spout = tube(
        smooth(
            [
                (-0.012, 0.0, z),
                (0.2 * width, 0.0, z),
                (0.46 * width, 0.0, z - 0.001),
                (0.56 * width, 0.0, z - 0.011),
            ],
            EDGE,
        ),
        0.0062,
    )
    return fuse(
        bottle,
        rod((0.0, 0.0, body - 0.006), (0.0, 0.0, body + 0.016), collar),
        rod((0.0, 0.0, body), (0.0, 0.0, z), stem),
        rod((0.0, 0.0, z - 0.010), (0.0, 0.0, height), 0.013, 0.0125),
        spout,
    )


def towel_roll(*, radius: float, height: float, core: float) -> trimesh.Trimesh:
    """Return a paper towel roll that stands, with an open `core` and a loose sheet at +y."""
    paper = revolve(
        np.vstack(
            [
                resample(bevelled(radius, height, 0.002), BROAD),
                resample([(core, height), (core, 0.0)], 1.5 * BROAD),
                resample([(core, 0.0), (radius - 0.002, 0.0)], 2.0 * BROAD)[1:-1],
            ]
        ),
        edge=BROAD,
        closed=True,
    )
    sheet = block(
        (0.62 * radius, 0.005, height - 0.004),
        (0.36 * radius, radius - 0.0035, height / 2.0),
        corner=0.0015,
        edge=BROAD,
    )
    return fuse(paper, sheet)
