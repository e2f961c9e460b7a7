"""The sampler `above`: palms that look down on the object and close across its narrow side.

Seen from above, the object has a major and a minor axis. A palm looks at a point near the major
axis, tilted by at most `TILT` from the vertical. The closing direction in the palm frame differs
between hands, so the palm is turned from the minor axis by a random multiple of 90 degrees, and by
up to `YAW` more. Each stand-off of `candidates.standoffs` gives another height.
"""

from __future__ import annotations

import math

import numpy as np

from drakegrasp.arithmetic import Array, dot, multiply, norm, sin_cos_deg
from drakegrasp.config import CandidateConfig
from drakegrasp.mesh.surfaces import even_points, on_faces
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Stream
from drakegrasp.simulation.samplers import make_poses

#: Number of surface points from which the axes are computed.
POINTS = 2048
#: Fractions of the half extents, along the major and the minor axis, within which targets lie.
ALONG, ACROSS = 0.6, 0.2
#: Largest turn of a palm from the axes, beyond multiples of 90 degrees [degree].
YAW = 20.0
#: Smallest and largest tilt of a palm from the vertical [degree]. Straight from above, the camera
#: sees a flat image, which no sample has. With more tilt, most hands collide with the table.
TILT = 10.0, 35.0
#: Random numbers per pose: two for the target, one for the quarter, one for the turn, two for the
#: tilt.
NUMBERS = 6


class Above:
    """Poses of the palm above the object, looking down.

    Attributes:
        limit: None, because any number of poses can be drawn.
    """

    def __init__(
        self, model: ObjectModel, X_TO: Array, config: CandidateConfig, stream: Stream
    ) -> None:
        """Find the axes of the resting object; `config` is not used."""
        self._stream, self._poses = stream, np.zeros((0, 4, 4))
        self.limit: int | None = None
        self._X_TO, self._far = X_TO, 2.0 * float(norm(model.half_extents))

        # Points that cover the surface evenly, in {T}.
        faces = model.visual_faces.astype(np.int64)
        points, _ = on_faces(model.visual_vertices, faces, even_points(POINTS))
        p_TQ = dot(points[:, None], X_TO[:3, :3]) + X_TO[:3, 3]
        self._major = _major_axis(p_TQ[:, :2])
        minor = np.array([-self._major[1], self._major[0]])

        # The centre and the half extents along both axes, at half the object's height.
        axes = np.stack([self._major, minor])
        reach = dot(p_TQ[:, None, :2], axes)
        low, high = reach.min(axis=0), reach.max(axis=0)
        self._half = np.array([ALONG, ACROSS]) * (high - low) / 2.0
        self._axes, self._middle = axes, (low + high) / 2.0
        self._height = float(p_TQ[:, 2].max()) / 2.0

    def poses(self, count: int) -> Array:
        """Return the first poses (count, 4, 4)."""
        missing = count - len(self._poses)
        if missing > 0:
            numbers = self._stream.uniform(NUMBERS * missing).reshape(missing, NUMBERS)
            self._poses = np.concatenate([self._poses, self._draw(numbers)])
        return self._poses[:count]

    def counts(self, count: int) -> tuple[int, int, int]:
        """Return the number of poses three times: every draw is a valid, distinct pose."""
        return count, count, count

    def _draw(self, numbers: Array) -> Array:
        """Return the poses X_OG (n, 4, 4) of random numbers (n, NUMBERS)."""
        # Draw where the palm looks, and from where: uniform over a zone of the sphere.
        target = self._middle + (2.0 * numbers[:, :2] - 1.0) * self._half
        p_TQ = np.column_stack([multiply(target, self._axes), np.full(len(target), self._height)])
        sine, cosine = sin_cos_deg(360.0 * numbers[:, 4])
        most, least = sin_cos_deg(np.array(TILT))[1]
        down = most - numbers[:, 5] * (most - least)
        aside = np.sqrt(1.0 - down * down)
        z = np.column_stack([aside * cosine, aside * sine, -down])

        # Gx is across the minor axis or along it, in the plane perpendicular to Gz.
        quarter = np.minimum(np.floor(4.0 * numbers[:, 2]), 3.0)
        sine, cosine = sin_cos_deg(90.0 * quarter + YAW * (2.0 * numbers[:, 3] - 1.0))
        a, b = self._major
        x = np.column_stack([cosine * a - sine * b, sine * a + cosine * b, np.zeros(len(z))])
        x -= dot(x, z)[:, None] * z
        x /= norm(x)[:, None]
        X_TG = make_poses(np.stack([x, np.cross(z, x), z], axis=2), p_TQ - self._far * z)
        R_OT = self._X_TO[:3, :3].T
        p_OT = -multiply(R_OT, self._X_TO[:3, 3])
        R_OG = multiply(R_OT, X_TG[:, :3, :3])
        return make_poses(R_OG, dot(X_TG[:, None, :3, 3], R_OT) + p_OT)


def _major_axis(points: Array) -> Array:
    """Return the direction (2,) of the largest variance of points (n, 2)."""
    centred = points - np.cumsum(points, axis=0)[-1] / len(points)
    x, y = centred.T
    xx, xy, yy = (float(np.cumsum(product)[-1]) for product in (x * x, x * y, y * y))

    # The double angle of the axis has the direction (xx - yy, 2 xy); halve it with the half-angle
    # formulas.
    along, across = xx - yy, 2.0 * xy
    length = math.sqrt(along * along + across * across)
    if length == 0.0:
        return np.array([1.0, 0.0])
    cosine = math.sqrt(max(0.0, (1.0 + along / length) / 2.0))
    sine = math.copysign(math.sqrt(max(0.0, (1.0 - along / length) / 2.0)), across)
    return np.array([cosine, sine])
