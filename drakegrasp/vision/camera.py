"""Cameras: lenses, poses, visibility of contacts, appearance, errors of depth. Uses NumPy only.

Both cameras of a grasp are 0.25 m behind the palm and look along +Gz (Veres et al., "Vision
sensors"). `oto` (one-to-one) rolls with the palm; `otm` (one-to-many) keeps world up at the top of
the image. Cameras of a scene do not depend on a grasp. For training, viewpoints are drawn around
the object. For testing, they are fixed, published poses in {T} that depend neither on the object
nor on the seed, so that equal grasps in the camera's frame are equal grasps on the table, wherever
the object is. Camera axes are those of Drake and OpenCV. Pixel centres have integer coordinates, as
in Drake's `CameraInfo`.

The depth of a camera may have errors. The model is a camera that triangulates. It sees a pattern
that a projector beside it throws on the scene, and computes the depth z from the shift of the
pattern, d = f b / z, with focal length f and baseline b.

* **Noise.** A constant uncertainty of the shift causes an uncertainty of the depth of sigma = c
  z^2. For a Kinect, whose shift is certain to half a pixel, c = 1.425e-3 / m (Khoshelham and Oude
  Elberink, 2012). The error of each pixel is independent and normally distributed.
* **Shadow.** Points that the camera sees and the projector does not light have no depth. They are
  stripes beside near edges, on the side away from the projector. Such a pixel has the value `far`,
  like a pixel with nothing before the far plane.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, multiply, norm, sin_cos, sin_cos_deg
from drakegrasp.frames import invert_pose, make_pose, rotation_about, transform_points
from drakegrasp.seeding import Stream, object_key

if TYPE_CHECKING:
    # Readers of data use this module, and need no pydantic.
    from drakegrasp.config import CameraConfig, ScenesConfig

#: If the sine of the angle between view and vertical is below this, +Ty is up in the image (0.06
#: degrees).
LOOKS_VERTICALLY = 1e-3
#: A surface that is closer to the camera than a contact by more than this hides the contact [m].
BEFORE = 3e-3
#: A contact that is farther than this from the object's pixels is not on the object [px].
BESIDE = 2.0
#: Fixed viewpoints: azimuth and elevation [deg], distance [m] from the point `FIXED_AIM` in {T}.
RING = tuple((azimuth, 45.0, 0.65) for azimuth in (0.0, 90.0, 180.0, 270.0))
SINGLE = (45.0, 60.0, 0.7)
FIXED_AIM = np.array([0.0, 0.0, 0.05])
#: Colour of the table (models/table.urdf).
TABLE_COLOUR = (0.55, 0.50, 0.44)
#: Direction and intensity of the light from above. It is slanted, because a table is black if
#: camera and light look along it.
LIGHT_WAY = np.array([0.3, 0.4, -1.0])
LIGHT_STRENGTH = 0.7
#: A pixel is in the shadow if a nearer pixel covers it by more than this [px]: far above rounding.
COVERED = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """The image size, camera matrix and depth range of a camera.

    Attributes:
        width, height: Size of the images [px].
        K: Camera matrix (3, 3) [px].
        near, far: Range of the depths [m].
    """

    width: int
    height: int
    K: Array
    near: float
    far: float

    @classmethod
    def of(cls, config: CameraConfig | ScenesConfig) -> Lens:
        """Return the lens of a configuration, with square pixels and the image's centre as centre.

        With the vertical field of view φ and H rows, f = H / (2 tan(φ/2)).
        """
        width, height, near, far = config.width, config.height, config.near, config.far
        sine, cosine = sin_cos_deg(config.fov_y_deg / 2.0)
        focal = float(height * cosine / (2.0 * sine))
        K = [[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]]
        return cls(width=width, height=height, K=np.array(K), near=near, far=far)


def intrinsics(config: CameraConfig) -> Array:
    """Return the camera matrix K (3, 3) [px], for square pixels and the image's centre as centre.

    With S × S pixels, whose centres have integer coordinates, and the field of view φ:

        f = S / (2 tan(φ/2)),   c = (S − 1) / 2,   K = [[f, 0, c], [0, f, c], [0, 0, 1]]
    """
    return Lens.of(config).K


def camera_pose_oto(
    X_TG: npt.ArrayLike, config: CameraConfig, X_C0C: npt.ArrayLike | None = None
) -> Array:
    """Return X_TC (4, 4) of the camera that rolls with the palm: R_GC is the identity.

    Args:
        X_TG: Pose of the palm (4, 4).
        config: The camera's distance.
        X_C0C: Pose (4, 4) of the camera relative to its usual pose; None for the usual pose.
    """
    X_TC = multiply(X_TG, make_pose(np.eye(3), [0.0, 0.0, -config.distance]))
    # A product with the identity may change the sign of a zero.
    return X_TC if X_C0C is None or np.array_equal(X_C0C, np.eye(4)) else multiply(X_TC, X_C0C)


def camera_pose_otm(
    X_TG: npt.ArrayLike, config: CameraConfig, X_C0C: npt.ArrayLike | None = None
) -> Array:
    """Return X_TC (4, 4) of the camera whose image up is world up; see `camera_pose_oto`.

    If the camera looks straight up or down, its image up is +Ty instead.
    """
    X_TC = camera_pose_oto(X_TG, config, X_C0C)
    z = X_TC[:3, 2]
    up = np.array([0.0, 0.0, 1.0])
    if norm(np.cross(z, up)) < LOOKS_VERTICALLY:
        up = np.array([0.0, 1.0, 0.0])
    y = -(up - dot(up, z) * z)
    y /= norm(y)
    X_TC[:3, 0], X_TC[:3, 1] = np.cross(y, z), y
    return X_TC


def project(K: npt.ArrayLike, p_CQ: npt.ArrayLike) -> Array:
    """Return pixel coordinates (n, 2), (u to the right, v down), of points (n, 3) [m].

    (u, v) = (f x/z + c, f y/z + c) for p_CQ = (x, y, z).
    """
    points = multiply(p_CQ, np.asarray(K, dtype=float).T)
    return points[:, :2] / points[:, 2:]


def unproject(K: npt.ArrayLike, pixels: npt.ArrayLike, depth: npt.ArrayLike) -> Array:
    """Return points p_CQ (n, 3) [m] of pixels (n, 2) at depths (n,) [m].

    p_CQ = z ((u − c)/f, (v − c)/f, 1), the inverse of `project` at the depth z.
    """
    uv, lens = np.asarray(pixels, dtype=float), np.asarray(K, dtype=float)
    at_one = (uv - lens[:2, 2]) / lens[[0, 1], [0, 1]]
    return np.column_stack([at_one, np.ones(len(uv))]) * np.asarray(depth, dtype=float)[:, None]


def image_frame(K: npt.ArrayLike, mask: npt.ArrayLike, depth: npt.ArrayLike) -> Array:
    """Return X_CI (4, 4), a frame of the object that is computed from one image.

    The origin is the mask's centroid, unprojected with the depth of the object pixel that is
    closest to the centroid. Iz is the first principal axis of the mask's pixels, Iy the second.
    Both are unprojected at that depth, so they lie in a plane parallel to the image. Iz points to
    the image's right (straight down if it is vertical), and Ix = Iy x Iz points away from the
    camera (+Cz). For a mask of one pixel, Iz is along +Cx.

    Args:
        K: Camera matrix (3, 3), as returned by `intrinsics`.
        mask: (S, S), 1 on the object.
        depth: (S, S) [m].

    Raises:
        ValueError: If the mask is empty.
    """
    rows, columns = np.nonzero(np.asarray(mask))
    if len(rows) == 0:
        raise ValueError("the mask must have at least one object pixel, got none")

    # The mask's centroid and its depth.
    pixels = np.column_stack([columns, rows]).astype(float)
    centroid = pixels.mean(axis=0)
    nearest = np.argmin(np.sum((pixels - centroid) ** 2, axis=1))
    z = float(np.asarray(depth)[rows[nearest], columns[nearest]])

    # The first principal axis, pointing right.
    first = _principal_axis(pixels - centroid)
    if first[0] < -1e-9 or (abs(first[0]) <= 1e-9 and first[1] < 0.0):
        first = -first

    # With square pixels at one depth, a direction in pixels is a direction in Cx, Cy.
    Iz = np.array([first[0], first[1], 0.0])
    Ix = np.array([0.0, 0.0, 1.0])
    R_CI = np.column_stack([Ix, np.cross(Iz, Ix), Iz])
    return make_pose(R_CI, unproject(K, centroid[None], [z])[0])


def _principal_axis(centred: Array) -> Array:
    """Return the unit direction (2,) of largest variance of points (n, 2) about their mean.

    It is computed in closed form, because LAPACK's last bits depend on the CPU. With the points'
    scatter matrix C = [[a, b], [b, d]] and h = (a − d)/2, the eigenvalues are
    (a + d)/2 ± √(h² + b²). The first eigenvector is parallel to (h + √(h² + b²), b), or to
    (b, √(h² + b²) − h). It is +u if the variance is the same in all directions.
    """
    (uu, vv), uv = (centred**2).sum(axis=0), (centred[:, 0] * centred[:, 1]).sum()
    half = (uu - vv) / 2.0
    length = np.sqrt(half * half + uv * uv)
    # The longer row of C minus its smallest eigenvalue is parallel to the first eigenvector.
    axis = np.array([half + length, uv] if half >= 0.0 else [uv, length - half])
    size = norm(axis)
    return np.asarray(axis / size) if size > 0.0 else np.array([1.0, 0.0])


# Visibility of contacts, cameras of scenes, and appearance of a scene


def visible_contacts(
    p_TQ: Array,
    nhat_Q_T: Array,
    X_TC: Array,
    K: Array,
    depth: npt.NDArray[np.floating],
    mask: npt.NDArray[np.uint8],
) -> npt.NDArray[np.bool_]:
    """Return whether (...,) a camera sees contacts; False for contacts that are NaN.

    A contact is hidden if its normal points away from the camera, or if the ray from the contact to
    the camera meets the object or the table first. A contact is the centre of a pressed patch, so
    it may lie a little inside the object, and the depth of a slanted surface changes much from one
    pixel to the next. The test therefore uses the farthest of the four pixels around the contact,
    and allows `BEFORE`. If a patch spans an edge, which is possible for grasps that are not
    samples, its centre may be off the object. So a centre that is farther than `BESIDE` from the
    object in the image is also hidden.

    Args:
        p_TQ: Contact points (..., 3) [m].
        nhat_Q_T: Unit normals out of the object (..., 3).
        X_TC: Pose of the camera (4, 4).
        K: Camera matrix (3, 3) [px].
        depth: Clean depth image (h, w) [m], 0 where there is nothing.
        mask: Mask of the objects (h, w), 0 beside the objects.
    """
    p = p_TQ.reshape(-1, 3)
    # A comparison with NaN is false.
    rows = np.flatnonzero(dot(nhat_Q_T.reshape(-1, 3), X_TC[:3, 3] - p) > 0.0)
    p_CQ = transform_points(invert_pose(X_TC), p[rows])
    rows, p_CQ = rows[p_CQ[:, 2] > 0.0], p_CQ[p_CQ[:, 2] > 0.0]

    # The four pixels around each contact that is in the image.
    height, width = depth.shape
    pixels = project(K, p_CQ)
    u, v = np.floor(pixels).astype(np.int64).T
    within = (u >= 0) & (v >= 0) & (u < width - 1) & (v < height - 1)
    u, v, rows, z, pixels = u[within], v[within], rows[within], p_CQ[within, 2], pixels[within]
    around = depth[np.array([v, v, v + 1, v + 1]), np.array([u, u + 1, u, u + 1])]
    farthest = np.where(around == 0, np.inf, around).max(axis=0)

    # Few contacts are not on a pixel of the object; measure the distance of these.
    beside = mask[v, u] == 0
    own = np.argwhere(mask > 0)[:, ::-1]
    apart = [np.linalg.norm(own - pixel, axis=1).min(initial=np.inf) for pixel in pixels[beside]]
    beside[beside] = np.array(apart) > BESIDE

    visible = np.zeros(len(p), dtype=np.bool_)
    visible[rows] = (farthest >= z - BEFORE) & ~beside
    return visible.reshape(p_TQ.shape[:-1])


def look_at(p_TA: Array, distance: float, azimuth: float, sine: float, roll: float = 0.0) -> Array:
    """Return X_TC (4, 4) of a camera that looks at a point from above the horizon.

    Args:
        p_TA: The point (3,) [m], in the centre of the image.
        distance: Distance of the camera from the point [m].
        azimuth: Azimuth of the camera about the vertical, from +Tx [rad].
        sine: Sine of the camera's elevation above the point.
        roll: Roll about the line of sight [rad]; at 0 the image's rows are horizontal.
    """
    s, c = sin_cos(azimuth)
    cosine = np.sqrt(1.0 - sine * sine)
    z = -np.array([cosine * c, cosine * s, sine])
    x = np.array([-s, c, 0.0])
    R = np.column_stack([x, np.cross(z, x), z])
    return make_pose(multiply(R, rotation_about([0.0, 0.0, 1.0], roll)), p_TA - distance * z)


def fixed_viewpoints() -> Array:
    """Return X_TC (5, 4, 4) of the test cameras of scenes: the ring of four, then `SINGLE`."""
    return np.array(
        [
            look_at(FIXED_AIM, distance, np.deg2rad(azimuth), float(sin_cos_deg(elevation)[0]))
            for azimuth, elevation, distance in (*RING, SINGLE)
        ]
    )


def draw_viewpoint(stream: Stream, p_TO: Array, config: ScenesConfig) -> Array:
    """Return X_TC (4, 4) of a camera that looks at an object from anywhere above the table.

    Azimuth, distance, roll, the point that the camera looks at, and the sine of the elevation are
    uniform. So the camera's directions are uniform over their part of the sphere.

    Args:
        stream: Stream from which seven numbers are drawn.
        p_TO: Position of the object, (3,) [m].
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Appearance:
    """How a scene looks.

    Attributes:
        object_colour, table_colour: (3,), red, green and blue in 0..1.
        light_direction: (3,), unit vector in {W} along which the light from above shines.
        light_strength: Intensity of this light; the light at the camera never changes.
    """

    object_colour: Array
    table_colour: Array
    light_direction: Array
    light_strength: float


def object_colour(name: str) -> tuple[float, float, float]:
    """Return the RGB colour of an object, 0 to 1; its hue depends only on its name."""
    hue = (object_key(name) % 997) / 997.0
    return colorsys.hsv_to_rgb(hue, 0.65, 0.85)


def usual_appearance(name: str) -> Appearance:
    """Return the appearance of an object's scene if nothing is drawn, by the object's name."""
    return Appearance(
        object_colour=np.array(object_colour(name)),
        table_colour=np.array(TABLE_COLOUR),
        light_direction=LIGHT_WAY / norm(LIGHT_WAY),
        light_strength=LIGHT_STRENGTH,
    )


# Errors of a depth camera


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
