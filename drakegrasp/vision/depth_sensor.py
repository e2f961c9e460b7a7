"""A depth camera's errors: noise that grows with distance, and pixels without a depth.

The model is a camera that triangulates. It sees a pattern that a projector beside it throws on the
scene, and computes the depth z from the shift of the pattern, d = f b / z, with focal length f and
baseline b.

* **Noise.** A constant uncertainty of the shift causes an uncertainty of the depth of sigma = c
  z^2. For a Kinect, whose shift is certain to half a pixel, c = 1.425e-3 / m (Khoshelham and Oude
  Elberink, 2012). The error of each pixel is independent and normally distributed.
* **Shadow.** Points that the camera sees and the projector does not light have no depth. They are
  stripes beside near edges, on the side away from the projector. Such a pixel has the value `far`,
  like a pixel with nothing before the far plane.

Input: the clean depth image. Output: the image with errors, or clean depths recovered from it. Uses
NumPy only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array
from drakegrasp.seeding import Stream

#: A pixel is in the shadow if a nearer pixel covers it by more than this [px]: far above rounding.
COVERED = 1e-3


class DepthRange(Protocol):
    """Near and far plane of a depth image [m], as in a configuration, a lens or a file."""

    @property
    def near(self) -> float: ...  # noqa: D102

    @property
    def far(self) -> float: ...  # noqa: D102


@dataclass(frozen=True, kw_only=True)
class DepthSensor:
    """The errors of one depth camera; all are zero for a camera without errors.

    Attributes:
        noise: Standard deviation of a depth divided by the square of the depth, c [1/m].
        baseline: Distance from the camera to the projector along +Cx, b [m].
        seed: Seed of the noise; each camera of an attempt uses its own random stream.
    """

    noise: float = 0.0
    baseline: float = 0.0
    seed: int = 0


def spoil_depth(
    depth: npt.NDArray[np.float32],
    K: Array,
    sensor: DepthSensor,
    camera: int,
    config: DepthRange,
) -> npt.NDArray[np.float32]:
    """Return a depth image (S, S) [m] with the errors of a sensor.

    Args:
        depth: Clean depths (S, S) [m], `near` to `far`.
        K: Camera matrix (3, 3) [px].
        sensor: The errors.
        camera: Index of the camera among the cameras of its attempt.
        config: Near and far plane; a depth that the noise moves beyond `far` is lost.
    """
    spoilt = depth
    if sensor.noise:
        clean = depth.astype(float)
        noisy = clean + sensor.noise * _normal(depth, sensor, camera) * clean * clean
        noisy = np.clip(noisy.astype(np.float32), config.near, config.far)
        spoilt = np.where(_measured(depth, config), noisy, depth)
    if sensor.baseline:
        hidden = shadow(depth, K, sensor.baseline)
        spoilt = np.where(hidden, np.float32(config.far), spoilt)
    return spoilt


def shadow(depth: npt.NDArray[np.float32], K: Array, baseline: float) -> npt.NDArray[np.bool_]:
    """Return the pixels (S, S) of a depth image that the projector at +Cx does not light.

    The projector sees a point of column u and depth z in its own column u - f b / z. Along a row
    from left to right, this column rises as long as the projector also sees the surface. If a pixel
    further right has a smaller column, something nearer is between the projector and the point.
    """
    columns = np.arange(depth.shape[1]) - K[0, 0] * baseline / depth.astype(float)
    # The smallest column of all pixels to the right; the last pixel has none to its right.
    least = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    covered = np.zeros(depth.shape, dtype=np.bool_)
    covered[:, :-1] = least[:, 1:] < columns[:, :-1] - COVERED
    return covered


def _measured(depth: npt.NDArray[np.float32], config: DepthRange) -> npt.NDArray[np.bool_]:
    """Return the pixels (S, S) that have a depth; pixels at a clipping plane have none."""
    return (depth > np.float32(config.near)) & (depth < np.float32(config.far))


def _normal(depth: npt.NDArray[np.float32], sensor: DepthSensor, camera: int) -> Array:
    """Return a normal random number for each pixel (S, S), row by row."""
    return Stream(sensor.seed, camera).normal(depth.size).reshape(depth.shape)
