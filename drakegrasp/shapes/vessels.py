"""Vessels, one function per class: sizes come in, watertight meshes go out.

Every mesh stands or lies on the plane z = 0 as it would on a table, z up. `vessel` and
`loop_handle` are for other families too. All lengths are in [m] and all angles in [rad];
`drakegrasp.shapes.classes` has the table of their ranges.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh

from drakegrasp.shapes.modelling.booleans import cut, fuse
from drakegrasp.shapes.modelling.profiles import (
    COARSE,
    EDGE,
    bevelled,
    ellipse,
    inset,
    resample,
    smooth,
    spread_evenly,
)
from drakegrasp.shapes.modelling.solids import bar, revolve, solid, sweep


def mug(
    *, radius: float, height: float, handle_reach: float, handle_radius: float, wall: float = 0.005
) -> trimesh.Trimesh:
    """Return a hollow straight mug with a handle at +x; `handle_reach` is how far it stands out."""
    shell, core = vessel(
        resample([*bevelled(radius, height, 0.004)[:2], (radius, height)], EDGE),
        wall=wall,
        floor=0.007,
    )
    handle = loop_handle(
        x=radius - wall / 2.0,
        top=0.84 * height,
        bottom=0.2 * height,
        reach=handle_reach - handle_radius + wall / 2.0,
        radius=handle_radius,
    )
    return fuse(shell, _trimmed(handle, core))


def cup(
    *, top_radius: float, bottom_radius: float, height: float, wall: float = 0.0045
) -> trimesh.Trimesh:
    """Return a hollow tapered cup without a handle."""
    side = resample([(bottom_radius, 0.0), (top_radius, height)], EDGE)
    return vessel(side, wall=wall, floor=0.006)[0]


def bowl(
    *, radius: float, height: float, foot_radius: float, wall: float = 0.005
) -> trimesh.Trimesh:
    """Return a hollow bowl on a ring foot."""
    side = smooth(
        [
            (foot_radius, 0.0),
            (foot_radius + 0.001, 0.005),
            (0.72 * radius, 0.22 * height),
            (0.92 * radius, 0.58 * height),
            (radius, height),
        ],
        EDGE,
    )
    return vessel(side, wall=wall, floor=0.008)[0]


def vase(
    *,
    foot_radius: float,
    belly_radius: float,
    neck_radius: float,
    lip_radius: float,
    height: float,
    wall: float = 0.005,
    edge: float = 0.007,
) -> trimesh.Trimesh:
    """Return a hollow vase with a belly, a neck and a lip."""
    side = smooth(
        [
            (foot_radius, 0.0),
            (belly_radius, 0.4 * height),
            (neck_radius, 0.82 * height),
            (lip_radius, height),
        ],
        edge,
    )
    return vessel(side, wall=wall, floor=0.008, edge=edge)[0]


def wineglass(
    *,
    foot_radius: float,
    stem_radius: float,
    belly_radius: float,
    rim_radius: float,
    height: float,
    stem_height: float,
    wall: float = 0.0045,
) -> trimesh.Trimesh:
    """Return a wineglass: a solid foot and stem, a hollow cup."""
    # The cup, outside and inside.
    cup_height = height - stem_height
    outer = smooth(
        [
            (stem_radius, stem_height),
            (0.75 * belly_radius, stem_height + 0.14 * cup_height),
            (belly_radius, stem_height + 0.42 * cup_height),
            (rim_radius, height),
        ],
        EDGE,
    )
    floor = stem_height + 0.012
    inner = spread_evenly(inset(outer, wall, floor=floor), COARSE * EDGE)[::-1]

    # Foot and stem.
    foot = resample([(0.0, 0.0), (foot_radius, 0.0), (foot_radius, 0.005)], EDGE)
    stem = smooth(
        [
            (foot_radius, 0.005),
            (0.4 * foot_radius, 0.009),
            (stem_radius, 0.3 * stem_height),
            (stem_radius, stem_height),
        ],
        EDGE,
    )

    # One outline, with longer edges inside.
    bottom = resample([inner[-1], (0.0, floor)], COARSE * EDGE)[1:]
    profile = np.vstack([foot, stem[1:], outer[1:], inner, bottom])
    edges = np.full(len(profile), EDGE)
    edges[len(profile) - len(inner) - len(bottom) :] *= COARSE
    return revolve(profile, edge=edges)


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
    wall: float = 0.005,
    edge: float = 0.008,
) -> trimesh.Trimesh:
    """Return a hollow pitcher with a handle at +x and a lip pulled out by `lip` at -x."""
    side = smooth(
        [
            (foot_radius, 0.0),
            (belly_radius, 0.35 * height),
            (neck_radius, 0.8 * height),
            (rim_radius, height),
        ],
        edge,
    )
    shell, core = vessel(side, wall=wall, floor=0.008, edge=edge)
    handle = loop_handle(
        x=neck_radius - wall / 2.0,
        top=0.85 * height,
        bottom=0.3 * height,
        reach=belly_radius - neck_radius + handle_reach,
        radius=handle_radius,
        edge=edge,
    )
    body = fuse(shell, _trimmed(handle, core))

    # The lip: points near the rim on the far side move outwards, the wall with them.
    x, y, z = body.vertices.T
    rise = np.clip((z / height - 0.7) / 0.3, 0.0, 1.0)
    pull = lip * rise**2 * np.exp(-((np.arctan2(y, -x) / 0.4) ** 2))
    return solid(np.column_stack([x - pull, y, z]), body.faces)


def saucepan(
    *, radius: float, height: float, handle_length: float, wall: float = 0.005
) -> trimesh.Trimesh:
    """Return a hollow saucepan with a straight handle along +x."""
    edge = 1.2 * EDGE
    shell, core = vessel(
        resample([*bevelled(radius, height, 0.005)[:2], (radius, height)], edge),
        wall=wall,
        floor=0.007,
        edge=edge,
    )
    z = 0.78 * height
    handle = bar(
        (radius - wall, 0.0, z),
        (radius + handle_length, 0.0, z),
        ellipse(0.008, 0.011, edge=edge),
        normal=(0.0, 1.0, 0.0),
        scale=((0.0, 0.9), (0.4, 0.8), (1.0, 1.0)),
        edge=edge,
    )
    return fuse(shell, _trimmed(handle, core))


def funnel(
    *, radius: float, spout_radius: float, cone_height: float, height: float, wall: float = 0.0045
) -> trimesh.Trimesh:
    """Return a funnel, open at both ends, that stands on its wide end."""
    outer = resample(
        [
            (radius, 0.0),
            (radius, 0.008),
            (spout_radius + 0.002, cone_height),
            (spout_radius, height),
        ],
        EDGE,
    )
    # Across a sloping wall the thickness is measured along r: wall / sin(slope).
    slope = np.arctan2(cone_height - 0.008, radius - spout_radius)
    step = wall / np.sin(slope)
    inner = resample(
        [
            (spout_radius - wall, height),
            (spout_radius + 0.002 - wall, cone_height),
            (radius - step, 0.008),
            (radius - step, 0.0),
        ],
        COARSE * EDGE,
    )
    profile = np.vstack([outer, inner])
    edges = np.r_[np.full(len(outer), EDGE), np.full(len(inner), COARSE * EDGE)]
    return revolve(profile, edge=edges, closed=True)


def vessel(
    side: npt.ArrayLike, *, wall: float, floor: float, edge: float = EDGE
) -> tuple[trimesh.Trimesh, trimesh.Trimesh]:
    """Return an open vessel and the core that its handles must keep clear of.

    The core fills the cavity and half of the wall: what is cut by it ends inside the wall.

    Args:
        side: Outer profile (r, z) [m] from the foot, z = 0, to the rim.
        wall: Thickness of the wall, across it [m].
        floor: Thickness of the floor [m].
        edge: Edge length outside [m].
    """
    outer = np.asarray(side, dtype=float)
    coarse = COARSE * edge
    inner = spread_evenly(inset(outer, wall, floor=floor), coarse)[::-1]
    foot = resample([(0.0, 0.0), outer[0]], coarse)[:-1]
    bottom = resample([inner[-1], (0.0, floor)], coarse)[1:]
    profile = np.vstack([foot, outer, inner, bottom])
    edges = np.full(len(profile), coarse)
    edges[len(foot) : len(foot) + len(outer)] = edge

    middle = spread_evenly(inset(outer, wall / 2.0, floor=floor / 2.0), coarse)
    top = middle[-1] + [0.0, 0.1]
    core = np.vstack([(0.0, middle[0, 1]), middle, top, (0.0, top[1])])
    return revolve(profile, edge=edges), revolve(core, edge=coarse)


def loop_handle(
    *, x: float, top: float, bottom: float, reach: float, radius: float, edge: float = EDGE
) -> trimesh.Trimesh:
    """Return a D-shaped handle in the plane y = 0, open towards -x.

    Args:
        x: Where both ends lie, inside the body's wall [m].
        top: Height of the upper end's centre line [m].
        bottom: Height of the lower end's centre line [m].
        reach: How far the centre line goes beyond `x` [m].
        radius: Half the thickness in the plane; the handle is 1.3 times as wide [m].
        edge: Edge length [m].
    """
    angles = np.linspace(0.0, np.pi, 200)
    middle, half = (top + bottom) / 2.0, (top - bottom) / 2.0
    # A power below one makes the half ellipse squarer, like a real handle.
    curve = np.column_stack(
        [
            x + reach * np.sin(angles) ** 0.7,
            np.zeros_like(angles),
            middle + half * np.sign(np.cos(angles)) * np.abs(np.cos(angles)) ** 0.85,
        ]
    )
    section = ellipse(radius, 1.3 * radius, edge=edge * 0.7)
    return sweep(spread_evenly(curve, edge), section, normal=(0.0, 1.0, 0.0), scale=1.0)


def _trimmed(part: trimesh.Trimesh, core: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the piece of a handle that lies outside the core, without crumbs."""
    pieces = cut(part, core).split(only_watertight=True)
    return max(pieces, key=lambda piece: piece.volume)
