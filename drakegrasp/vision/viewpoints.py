"""Where cameras stand that look at a scene and know no grasp; NumPy only.

To train, viewpoints are drawn about the object. To test they are fixed: published poses in {T} that
neither object nor seed moves, so that a grasp that is the same in the camera's frame is the same on
the table, wherever the object lies.
"""

from __future__ import annotations

import numpy as np

from drakegrasp.arithmetic import Array, multiply, sin_cos, sin_cos_deg
from drakegrasp.config import ScenesConfig
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.seeding import Stream

#: Fixed viewpoints: azimuth and elevation [deg], distance [m] from the point `FIXED_AIM` in {T}.
RING = tuple((azimuth, 45.0, 0.65) for azimuth in (0.0, 90.0, 180.0, 270.0))
SINGLE = (45.0, 60.0, 0.7)
FIXED_AIM = np.array([0.0, 0.0, 0.05])


def look_at(p_TA: Array, distance: float, azimuth: float, sine: float, roll: float = 0.0) -> Array:
    """Return X_TC (4, 4) of a camera that looks at a point from above the horizon.

    Args:
        p_TA: The point (3,) [m], in the middle of the image.
        distance: Of the camera from it [m].
        azimuth: Of the camera about the vertical, from +Tx [rad].
        sine: Of the camera's elevation above the point.
        roll: About the line of sight; without it the image's rows are horizontal [rad].
    """
    s, c = sin_cos(azimuth)
    cosine = np.sqrt(1.0 - sine * sine)
    z = -np.array([cosine * c, cosine * s, sine])
    x = np.array([-s, c, 0.0])
    R = np.column_stack([x, np.cross(z, x), z])
    return make_pose(multiply(R, rotation_about([0.0, 0.0, 1.0], roll)), p_TA - distance * z)


def fixed_viewpoints() -> Array:
    """Return X_TC (5, 4, 4) of the cameras of scenes to test: the ring of four, then the single."""
    return np.array(
        [
            look_at(FIXED_AIM, distance, np.deg2rad(azimuth), float(sin_cos_deg(elevation)[0]))
            for azimuth, elevation, distance in (*RING, SINGLE)
        ]
    )


def draw_viewpoint(stream: Stream, p_TO: Array, config: ScenesConfig) -> Array:
    """Return X_TC (4, 4) of a camera that looks at an object from anywhere above the table.

    Azimuth, distance, roll, the point that it looks at, and the sine of the elevation are uniform:
    so are the camera's directions over the part of the sphere.

    Args:
        stream: Gives seven numbers.
        p_TO: Where the object is, (3,) [m].
        config: The ranges.
    """
    u = stream.uniform(7)
    low, high = sin_cos_deg(config.elevation_deg)[0]
    near, far = config.distance
    return look_at(
        p_TO + config.aim * (2.0 * u[4:] - 1.0),
        near + (far - near) * float(u[0]),
        2.0 * np.pi * float(u[2]),
        float(low + (high - low) * u[1]),
        np.deg2rad(config.roll_deg) * (2.0 * float(u[3]) - 1.0),
    )
