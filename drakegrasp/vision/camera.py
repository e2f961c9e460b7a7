"""The poses of the two cameras and the projection of points to pixels; NumPy only.

Both cameras are 0.25 m behind the palm and look along +Gz (Veres et al., "Vision sensors"). `oto`
(one-to-one) rolls with the palm; `otm` (one-to-many) keeps world up at the top of the image. Camera
axes are those of Drake and OpenCV; pixel centres have integer coordinates, as in Drake's
`CameraInfo`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, dot, multiply, norm, sin_cos_deg
from drakegrasp.config import CameraConfig, ScenesConfig
from drakegrasp.frames import invert_pose, make_pose, transform_points

#: Sine of the angle between view and vertical below which +Ty is up in the image (0.06 degrees).
LOOKS_VERTICALLY = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """What a camera sees from its pose.

    Attributes:
        width, height: Of its images [px].
        K: Camera matrix (3, 3) [px].
        near, far: Range of its depths [m].
    """

    width: int
    height: int
    K: Array
    near: float
    far: float

    @classmethod
    def of(cls, config: CameraConfig | ScenesConfig) -> Lens:
        """Return the lens of a configuration: square pixels, centre in the image's middle.

        With the vertical field of view φ and H rows, f = H / (2 tan(φ/2)).
        """
        if isinstance(config, CameraConfig):
            width = height = config.size
        else:
            width, height = config.width, config.height
        sine, cosine = sin_cos_deg(config.fov_y_deg / 2.0)
        focal = float(height * cosine / (2.0 * sine))
        K = [[focal, 0.0, (width - 1) / 2.0], [0.0, focal, (height - 1) / 2.0], [0.0, 0.0, 1.0]]
        near, far = config.near, config.far
        return cls(width=width, height=height, K=np.array(K), near=near, far=far)


def intrinsics(config: CameraConfig) -> Array:
    """Return the camera matrix K (3, 3) [px]: square pixels, centre in the image's middle.

    For S × S pixels, whose centres have integer coordinates, and the field of view φ:

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
        X_C0C: Pose (4, 4) of the camera in that usual pose, if it is another.
    """
    X_TC = multiply(X_TG, make_pose(np.eye(3), [0.0, 0.0, -config.distance]))
    # A product with the identity may change the sign of a zero.
    return X_TC if X_C0C is None or np.array_equal(X_C0C, np.eye(4)) else multiply(X_TC, X_C0C)


def camera_pose_otm(
    X_TG: npt.ArrayLike, config: CameraConfig, X_C0C: npt.ArrayLike | None = None
) -> Array:
    """Return X_TC (4, 4) of the camera whose image up is world up; see `camera_pose_oto`.

    A camera that looks straight up or down has no such direction; its image up is +Ty.
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
    """Return X_CI (4, 4), a frame of the object that follows from one image.

    The origin is the mask's centroid, unprojected with the depth of the object pixel nearest to the
    centroid. Iz is the first principal axis of the mask's pixels, Iy the
    second, both unprojected at that depth, so they lie in a plane parallel to the image.
    Signs: Iz points to the image's right (straight down if it is vertical), and Ix = Iy x Iz
    points away from the camera (+Cz). A mask of one pixel has Iz along +Cx.

    Args:
        K: Camera matrix (3, 3), as `intrinsics` makes it.
        mask: (S, S), 1 where the object is.
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

    # Square pixels at one depth: a direction in pixels is a direction in Cx, Cy.
    Iz = np.array([first[0], first[1], 0.0])
    Ix = np.array([0.0, 0.0, 1.0])
    R_CI = np.column_stack([Ix, np.cross(Iz, Ix), Iz])
    return make_pose(R_CI, unproject(K, centroid[None], [z])[0])


def _principal_axis(centred: Array) -> Array:
    """Return the unit direction (2,) of largest variance of points (n, 2) about their mean.

    In closed form, because LAPACK's last bits depend on the CPU. With C = [[a, b], [b, d]] the
    points' scatter matrix and h = (a − d)/2, the eigenvalues are (a + d)/2 ± √(h² + b²), and the
    first eigenvector is parallel to (h + √(h² + b²), b), or to (b, √(h² + b²) − h). It is +u where
    no direction is larger than others.
    """
    (uu, vv), uv = (centred**2).sum(axis=0), (centred[:, 0] * centred[:, 1]).sum()
    half = (uu - vv) / 2.0
    length = np.sqrt(half * half + uv * uv)
    # The longer row of C minus its smallest eigenvalue is parallel to the first eigenvector.
    axis = np.array([half + length, uv] if half >= 0.0 else [uv, length - half])
    size = norm(axis)
    return np.asarray(axis / size) if size > 0.0 else np.array([1.0, 0.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """An image and the camera that took it.

    Attributes:
        image: (height, width, 3) uint8.
        K: Camera matrix (3, 3) [px].
        X_WC: Pose of the camera (4, 4).
    """

    image: npt.NDArray[np.uint8]
    K: Array
    X_WC: Array

    def pixels(self, p_WA: npt.ArrayLike) -> Array:
        """Return the pixel coordinates (n, 2) [px] of points (n, 3) of the world [m]."""
        return project(self.K, transform_points(invert_pose(self.X_WC), p_WA))
