"""Mass properties of rigid links."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from drakegrasp.frames import Array, transform_points

#: Mean density of links whose model gives no mass [kg/m^3]: own choice, that of solid plastic.
DENSITY = 1200.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Inertia:
    """Mass [kg], centre of mass p_LLcm (3,) [m], and inertia I_LLcm_L (3, 3) about it [kg m^2]."""

    mass: float
    p_LLcm: Array
    I_LLcm: Array

    def is_possible(self) -> bool:
        """Return whether a body can have it: principal moments obey the triangle inequality."""
        if not (self.mass > 0.0 and np.isfinite(self.I_LLcm).all()):
            return False
        moments = np.linalg.eigvalsh(self.I_LLcm)
        return bool(moments[0] > 0.0 and moments[0] + moments[1] >= 0.999 * moments[2])


def moved(inertia: Inertia, X_AL: Array) -> Inertia:
    """Return the inertia of a link in another frame A."""
    R = X_AL[:3, :3]
    return Inertia(
        mass=inertia.mass,
        p_LLcm=transform_points(X_AL, inertia.p_LLcm[None])[0],
        I_LLcm=R @ inertia.I_LLcm @ R.T,
    )


def combine(parts: Sequence[Inertia]) -> Inertia | None:
    """Return the inertia of several bodies in one frame; None if they have no mass."""
    mass = sum(part.mass for part in parts)
    if not mass > 0.0:
        return None
    centre = sum((part.mass * part.p_LLcm for part in parts), np.zeros(3)) / mass
    total = np.zeros((3, 3))
    for part in parts:
        # Huygens and Steiner.
        r = part.p_LLcm - centre
        total += part.I_LLcm + part.mass * (r @ r * np.eye(3) - np.outer(r, r))
    return Inertia(mass=mass, p_LLcm=centre, I_LLcm=total)


def solid_inertia(hulls: Sequence[Array], mass: float | None) -> Inertia:
    """Return the inertia of a uniform solid: convex hulls of points (n, 3), which may overlap.

    Args:
        hulls: The points.
        mass: Of the whole [kg]; that of `DENSITY` if None.
    """
    parts = []
    for points in hulls:
        # Flat shapes have no volume: half a millimetre around makes one.
        corners = np.concatenate([points - 5e-4, points + 5e-4])
        solid = trimesh.convex.convex_hull(corners)
        solid.density = DENSITY
        parts.append(
            Inertia(mass=solid.mass, p_LLcm=solid.center_mass, I_LLcm=solid.moment_inertia)
        )
    whole = combine(parts)
    assert whole is not None
    share = 1.0 if mass is None else mass / whole.mass
    return Inertia(mass=share * whole.mass, p_LLcm=whole.p_LLcm, I_LLcm=share * whole.I_LLcm)
