"""How a scene looks: the colours of object and table, and the light from above.

Plain data without Drake, so that a dataset can be checked without a renderer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drakegrasp.arithmetic import Array, norm
from drakegrasp.objects.model import object_colour

#: Colour of the table (models/table.sdf).
TABLE_COLOUR = (0.55, 0.50, 0.44)
#: Way and intensity of the light from above: at a slant, because a table is black where camera and
#: light look along it.
LIGHT_WAY = np.array([0.3, 0.4, -1.0])
LIGHT_STRENGTH = 0.7


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearance:
    """How a scene looks.

    Attributes:
        object_colour, table_colour: (3,), red, green and blue in 0..1.
        light_direction: (3,), unit vector in {W} along which the light from above shines.
        light_strength: Its intensity; that of the light at the camera never changes.
    """

    object_colour: Array
    table_colour: Array
    light_direction: Array
    light_strength: float


def usual_appearance(name: str) -> Appearance:
    """Return how the scene of an object looks, by the object's name, where nothing is drawn."""
    return Appearance(
        object_colour=np.array(object_colour(name)),
        table_colour=np.array(TABLE_COLOUR),
        light_direction=LIGHT_WAY / norm(LIGHT_WAY),
        light_strength=LIGHT_STRENGTH,
    )
