"""Depth images of a user's own camera: the points of an object, its table, its surface.

Input: a depth image in metres, the camera matrix, and a mask of the object. Output: points in {T},
for the room `scoring`. The pose of the camera over the table is known, or it follows from the plane
on which the object stands. Pixels without a depth (0, NaN or infinite) are left out. Image files
and camera files are read here too.

`complete` closes what an image shows of an object to a surface that can be simulated. It takes a
solid that was guessed from the visible points (`mesh.cloud`), and cuts away the space that the
image, a `View`, shows to be free: what is in front of the object's pixels, and what is beside them
in front of the table.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from warnings import catch_warnings

import manifold3d
import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, map_coordinates

from drakegrasp.arithmetic import Array, dot, multiply, norm
from drakegrasp.errors import GraspError, TooLittleSeenError, listed, one_line
from drakegrasp.foreign_files import read_content, read_json
from drakegrasp.frames import as_numbers, invert_pose, make_pose, read_pose, transform_points
from drakegrasp.mesh.distance_field import DistanceField
from drakegrasp.mesh.surfaces import Solid, from_manifold
from drakegrasp.seeding import Stream
from drakegrasp.vision.camera import unproject

#: The median depth of an image is in this range [m]; a depth in another unit is not.
DEPTHS = 0.03, 30.0
#: Minimum number of object pixels with a depth.
FEWEST = 10
#: The largest depth may mean that a depth is unknown if it is larger than the median of the others
#: by this factor.
FAR_OFF = 2.0
#: A pixel is on a plane if it is closer to it than this fraction of its depth: the error of depth
#: cameras grows with the depth.
ON_PLANE = 0.01
#: Fraction of the pixels beside the object that must be on the table's plane.
LEAST_SHARE = 0.15
#: The same for a pose that is known, since less of the table may be visible then.
LEAST_KNOWN_SHARE = LEAST_SHARE / 3.0
#: Maximum fraction of an image that is on the object, and the part of an image, along either side,
#: in which its principal point is.
LARGEST_MASK, CENTRAL = 0.99, (0.35, 0.65)
#: Planes through three random pixels that are tried, and number of pixels that judge them.
PLANES, JUDGES = 1000, 4000
#: The object stands on a plane if almost none of its points is deeper than this below it, and its
#: lowest point is not higher than the second limit above it; it touches the plane if this is not
#: higher than the first limit [m].
BELOW, ABOVE = 0.02, (0.025, 0.3)
#: A plane that the object touches is preferred if it has at least this fraction of the pixels of
#: the best plane.
TOUCHED = 0.6
#: Fraction of the object's points that may be outliers.
OUTLIERS = 0.02
#: Rounds of least squares after the choice of a plane. They use the pixels that are closer to the
#: plane than this multiple of the median distance (three standard deviations), or than this [m].
ROUNDS, SIGMAS, CLOSE = 5, 4.45, 1e-4
#: Edges of the lattice in which the surface is found [m].
EDGE = 0.006
#: Error that the simplified surface may have [m].
TOLERANCE = 0.0008
#: The depth of a pixel of the object also holds for pixels of unknown depth this close to it [px].
AROUND = 2.0
#: A point hides behind what is seen beside the object if it is farther away by this fraction.
BEHIND = 0.02


def cloud_from_depth(
    depth: npt.ArrayLike, K: npt.ArrayLike, mask: npt.ArrayLike, X_TC: npt.ArrayLike
) -> Array:
    """Return what a depth image shows of an object, as points (n, 3) in {T} [m].

    The table is z = 0 in {T}, and +z is up. The axes of the camera are those of OpenCV: x to the
    right of the image, y down, z forwards. Pixel centres have integer coordinates.

    Args:
        depth: (h, w), along the camera's z axis [m]; 0, NaN or infinite where it is unknown.
        K: Camera matrix (3, 3) [px].
        mask: (h, w), 0 beside the object, and one other value on it.
        X_TC: Pose of the camera over the table (4, 4), known or from `fit_table`.

    Raises:
        GraspError: If an argument is invalid, the depth is not in metres, the mask has fewer than
            10 pixels with a depth, the camera matrix is of another resolution, or less than 5 % of
            what the image shows beside the object is on the table.
    """
    own, others = _points(depth, K, mask)
    pose = _one_pose(X_TC)
    _share_on_table(others, pose)
    return transform_points(pose, own)


def table_share(
    depth: npt.ArrayLike, K: npt.ArrayLike, mask: npt.ArrayLike, X_TC: npt.ArrayLike
) -> float:
    """Return the fraction of the pixels beside an object that are on the table.

    A pixel is on the table if its distance from z = 0 is less than 1 % of its depth. The arguments
    are those of `cloud_from_depth`; an image without pixels beside the object has NaN.

    Raises:
        GraspError: See `cloud_from_depth`.
    """
    _, others = _points(depth, K, mask)
    return _share_on_table(others, _one_pose(X_TC))


def _share_on_table(others: Array, pose: Array) -> float:
    """Return the fraction of points (n, 3) in {C} that are on the table, see `table_share`."""
    if not len(others):
        return np.nan
    share = float(np.mean(_on_plane(others, pose[2, :3], -pose[2, 3])))
    if share < LEAST_KNOWN_SHARE:
        raise GraspError(
            f"X_TC must place {LEAST_KNOWN_SHARE:.0%} of the pixels beside the object on the table "
            f"(z = 0), got {share:.1%}: is it inverted (X_CT), or in another unit?"
            f"{_mark_of_unknown(others)}"
        )
    return share


def _one_pose(X_TC: npt.ArrayLike) -> Array:
    pose = read_pose(X_TC, "X_TC")
    if pose.ndim != 2:
        raise GraspError(f"X_TC must be one pose (4, 4), got {len(pose)} poses")
    return pose


def fit_table(
    depth: npt.ArrayLike, K: npt.ArrayLike, mask: npt.ArrayLike
) -> tuple[Array, float, float]:
    """Return the pose of a camera over the table on which an object stands.

    Of the planes on which the object stands, the one with most pixels is the table (RANSAC), and is
    fitted to its pixels by least squares. The draws are seeded. The origin of {T} is on the plane
    below the object, +Tz points to the side of the camera, and +Tx to the right of the image.

    Args:
        depth: (h, w), see `cloud_from_depth`.
        K: Camera matrix (3, 3) [px].
        mask: (h, w), 0 beside the object, and one other value on it.

    Returns:
        X_TC (4, 4); the root mean square of the distances from the plane, of the pixels to which it
        was fitted [m]; and the fraction of the pixels beside the object that are on it, within 1 %
        of their depth.

    Raises:
        GraspError: See `cloud_from_depth`; or if fewer than 15 % of the pixels beside the object
            are on such a plane.
    """
    own, others = _points(depth, K, mask)
    few = "give the pose of the camera (X_TC)"
    if len(others) < 3:
        raise GraspError(f"depth must show the table beside the object, got none of it: {few}")
    normal, offset = _table_plane(own, others)

    # Least squares on the pixels that are on the plane, without those of what lies on the table.
    for _ in range(ROUNDS):
        on_plane = others[_on_plane(others, normal, offset)]
        if (share := len(on_plane) / len(others)) < LEAST_SHARE:
            raise GraspError(
                f"depth must show the table on at least {LEAST_SHARE:.0%} of the pixels beside the "
                f"object, got {share:.0%} on the best plane below it: {few}"
                f"{_mark_of_unknown(own, others)}"
            )
        apart = np.abs(dot(on_plane, normal) - offset)
        inner = on_plane[apart <= max(CLOSE, SIGMAS * float(np.median(apart)))]
        middle = inner.mean(axis=0)
        normal = np.linalg.eigh((inner - middle).T @ (inner - middle))[1][:, 0]
        normal *= -np.sign(dot(normal, middle))
        offset = float(dot(normal, middle))
    residual = float(np.sqrt(((dot(inner, normal) - offset) ** 2).mean()))

    # +Tx is the right of the image, or its top if the image's right is along +Tz.
    right = next(axis for axis in ([1.0, 0, 0], [0, -1.0, 0]) if abs(dot(axis, normal)) < 0.9)
    x = right - dot(right, normal) * normal
    x /= norm(x)
    below = own.mean(axis=0)
    below = below - (dot(below, normal) - offset) * normal
    X_CT = make_pose(np.column_stack([x, np.cross(normal, x), normal]), below)
    return invert_pose(X_CT), residual, share


def _points(depth: npt.ArrayLike, K: npt.ArrayLike, mask: npt.ArrayLike) -> tuple[Array, Array]:
    """Return the points p_CQ (n, 3) and (m, 3) of the object and beside it [m], after all checks.

    Raises:
        GraspError: See `cloud_from_depth`.
    """
    z = as_numbers(depth, "depth must be an image (h, w) in metres")
    if z.ndim != 2:
        raise GraspError(f"depth must be an image (h, w), got an array of shape {z.shape}")
    own = _chosen(mask)
    if own.shape != z.shape:
        raise GraspError(f"mask must be {z.shape}, as the depth image, got {own.shape}")
    known = np.isfinite(z) & (z > 0.0)
    if (count := int((own & known).sum())) < FEWEST:
        raise TooLittleSeenError(
            f"mask must have at least {FEWEST} pixels with a depth, got {count} "
            f"of {int(own.sum()):,} pixels"
        )
    if own.mean() > LARGEST_MASK:
        raise GraspError(
            f"mask must be 0 beside the object, got {own.mean():.1%} of the image on the object"
        )

    lens = read_lens(K)
    middle, size = lens[:2, 2], np.array(z.shape[::-1])
    if not ((middle > CENTRAL[0] * size) & (middle < CENTRAL[1] * size)).all():
        raise GraspError(
            f"camera must have (cx, cy) near the centre of the image of {size[0]} x {size[1]} "
            f"pixels, got ({middle[0]:g}, {middle[1]:g}): is it for another resolution?"
        )
    parts = (np.nonzero(known & chosen) for chosen in (own, ~own))
    own_points, others = (unproject(lens, np.column_stack([u, v]), z[v, u]) for v, u in parts)
    if mark := _mark_of_unknown(own_points):
        raise GraspError(f"depth must be that of the object, or 0, where the mask is not 0{mark}")
    median = float(np.median(z[known]))
    if not DEPTHS[0] <= median <= DEPTHS[1]:
        raise GraspError(
            f"depth must be in metres, with a median of {DEPTHS[0]} to {DEPTHS[1]:g}, got "
            f"{median:.3g}: is it in another unit?{_mark_of_unknown(own_points, others)}"
        )
    return own_points, others


def _mark_of_unknown(*points: Array) -> str:
    """Return advice on a depth of points p_CQ (n, 3) [m] that seems to mean that it is unknown.

    It is empty if there is no such depth.
    """
    depths = np.concatenate(points)[:, 2]
    far = float(depths.max())
    count, others = np.count_nonzero(depths == far), depths[depths < far]
    if count < FEWEST or not others.size or far < FAR_OFF * np.median(others):
        return ""
    return f"; {count:,} pixels have the depth {far:g} m: if it means unknown, replace it by 0"


def _chosen(mask: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return where a mask (h, w), or (h, w, channels), is not 0.

    Raises:
        GraspError: If it is no array of numbers or truth values, has NaN, or several values that
            are not 0.
    """
    must = "mask must be numbers (h, w), 0 beside the object and one other value on it"
    is_bool = getattr(mask, "dtype", None) == np.bool_
    values = np.asarray(mask) if is_bool else as_numbers(mask, must)
    if unknown := np.count_nonzero(np.isnan(values)):
        raise GraspError(f"{must}, got {unknown:,} that are NaN")
    own = np.asarray(values.any(axis=2) if values.ndim == 3 else values != 0)
    found = values[own]
    if (found != found[:1]).any():
        raise GraspError(
            f"{must}, got several: is it a lossy file (JPEG, WebP), or of several objects "
            "(--object-label)? Write the mask of one as PNG or .npy"
        )
    return own


def _table_plane(own: Array, others: Array) -> tuple[Array, float]:
    """Return normal (3,) and offset [m] of the plane with most points, on which the object stands.

    The camera is on the positive side of the plane.
    """
    stream = Stream(0, PLANES, JUDGES)
    judges = others[stream.permutation(len(others))[:JUDGES]]
    a, b, c = judges[stream.integers(len(judges), 3 * PLANES)].reshape(3, PLANES, 3)
    normals = np.cross(b - a, c - a)
    length = norm(normals)
    normals, a = normals[length > 0.0] / length[length > 0.0, None], a[length > 0.0]
    normals *= -np.sign(dot(normals, a))[:, None]
    offsets = dot(normals, a)

    # An object that is seen from the side touches the table, and not the wall behind it. Seen from
    # above it shows only its top.
    heights = multiply(own[:: -(-len(own) // JUDGES)], normals.T) - offsets
    low = np.quantile(heights, OUTLIERS, axis=0)
    planes = zip(normals, offsets, strict=True)
    counts = np.array([np.count_nonzero(_on_plane(judges, *plane)) for plane in planes])
    touches, stands = ((low > -BELOW) & (low < above) for above in ABOVE)
    if counts[touches].max(initial=0) >= TOUCHED * counts[stands].max(initial=1):
        stands = touches
    if not stands.any():
        raise GraspError(
            "depth must show the table on which the object stands, got no plane below the object: "
            f"give the pose of the camera (X_TC){_mark_of_unknown(own, others)}"
        )
    best = int(np.argmax(np.where(stands, counts, -1)))
    return normals[best], float(offsets[best])


def _on_plane(points: Array, normal: Array, offset: float) -> npt.NDArray[np.bool_]:
    """Return which points p_CQ (n, 3) [m] are on a plane."""
    return np.abs(dot(points, normal) - offset) < ON_PLANE * points[:, 2]


def read_lens(K: npt.ArrayLike) -> Array:
    """Return a camera matrix (3, 3) [px], given as (3, 3) or (9,), after checking it.

    Raises:
        GraspError: If it is not the matrix of a camera.
    """
    must = "camera must be a matrix (3, 3) with fx 0 cx, 0 fy cy, 0 0 1 in pixels"
    lens = as_numbers(K, must)
    lens = lens.reshape(3, 3) if lens.shape == (9,) else lens
    if lens.shape != (3, 3):
        raise GraspError(f"{must}, got an array of shape {lens.shape}")
    zeros = lens[[0, 1, 2, 2], [1, 0, 0, 1]]
    if (
        not np.isfinite(lens).all()
        or zeros.any()
        or lens[2, 2] != 1.0
        or min(lens[0, 0], lens[1, 1]) <= 0
    ):
        raise GraspError(f"{must}, got {' '.join(f'{value:g}' for value in lens.ravel())}")
    return lens


# Files

#: Maximum number of pixels of an image file, which may unpack to thousands of times its size.
MOST_PIXELS = 2**25
#: Kinds of image whose pixels are brightnesses and opacities; others have e.g. rows of a palette.
_PLAIN_MODES = ("1", "L", "LA", "I", "I;16", "I;16B", "F", "RGB", "RGBA")
#: Names of a camera matrix, and of coefficients of distortion, in camera files.
_MATRICES = ("K", "k", "camera_matrix", "intrinsic_matrix")
_DISTORTION = re.compile(r"d|coeffs|[kps][1-6]|dist|dist(ort|_?coef).*", re.IGNORECASE)


def read_camera(text: str, shape: tuple[int, ...]) -> Array:
    """Return the camera matrix (3, 3) [px] of the text "fx fy cx cy", or of a JSON file.

    The file has a matrix, or an object with `K`, `k` or `camera_matrix`, with `intrinsic_matrix` as
    Open3D writes it, with `fx`, `fy`, `cx` and `cy`, or with `ppx` and `ppy` of RealSense. If it
    also states the `width` and `height` of its images, they must be those of the depth image, whose
    shape is (h, w).

    Raises:
        GraspError: If it is neither, for images of another size, or states a distortion.
    """
    # Four numbers.
    must = "camera must be fx,fy,cx,cy in pixels, or a JSON file with K"
    numbers = text.replace(",", " ").split()
    try:
        f_u, f_v, c_u, c_v = map(float, numbers)
    except ValueError:
        path = Path(text)
        if not path.is_file():
            raise GraspError(f"{must}, got {text!r}") from None
    else:
        return read_lens(_pinhole(f_u, f_v, c_u, c_v))

    # A file.
    try:
        content = read_json(path)
    except (OSError, ValueError) as error:
        raise GraspError(f"{path}: {must}, got: {one_line(error)}") from None
    if isinstance(content, dict):
        high, wide = (content.get(name) for name in ("height", "width"))
        if (wide or shape[-1], high or shape[0]) != (shape[-1], shape[0]):
            raise GraspError(
                f"{path}: camera must be for {shape[-1]} x {shape[0]} pixels, as the depth image, "
                f"got {wide} x {high}"
            )
        _validate_distortion(content, path)
        content = _lens_in(content)
    try:
        return read_lens(as_numbers(content, must))
    except GraspError as error:
        raise GraspError(f"{path}: {one_line(error)}") from None


def _validate_distortion(content: dict[str, Any], path: Path) -> None:
    """Reject a camera file that states a distortion: points would be up to centimetres off.

    Raises:
        GraspError: If a coefficient is not zero, or is no number.
    """
    must = f"{path}: camera must have no distortion"
    for key, value in content.items():
        # Names of models are texts; ROS writes the coefficients as rows, cols and data.
        value = value.get("data") if isinstance(value, dict) else value
        if not _DISTORTION.fullmatch(key) or value is None or isinstance(value, str):
            continue
        if as_numbers(value, f"{must}, and {key} must be numbers").any():
            raise GraspError(
                f"{must}, got {key} {value}: undistort depth and mask (cv2.remap, INTER_NEAREST), "
                "and give the camera of the new images"
            )


def _lens_in(content: dict[str, Any]) -> Any:
    """Return what a camera file has as its camera matrix; None if it has none."""
    real_sense = {f"c{axis}": content[f"pp{axis}"] for axis in "xy" if f"pp{axis}" in content}
    known = real_sense | content
    if {"fx", "fy", "cx", "cy"} <= known.keys():
        return _pinhole(*(known[name] for name in ("fx", "fy", "cx", "cy")))
    name = next((name for name in _MATRICES if name in content), "")
    found = content.get(name)
    if isinstance(found, dict):
        found = found.get("data")
    if name == "intrinsic_matrix" and isinstance(found, list) and len(found) == 9:
        return [found[i::3] for i in range(3)]  # Open3D writes the columns one after another
    return found


def _pinhole(f_u: Any, f_v: Any, c_u: Any, c_v: Any) -> list[list[Any]]:
    """Return the rows of a camera matrix [px]."""
    return [[f_u, 0.0, c_u], [0.0, f_v, c_v], [0.0, 0.0, 1.0]]


def read_depth_png(path: Path, scale: float) -> Array:
    """Return the depths (h, w) [m] of a PNG with one channel of 16 bits.

    Args:
        path: The file.
        scale: Metres per unit of the file.

    Raises:
        GraspError: If it is another file.
    """
    pixels = _pixels(path)
    if pixels.ndim != 2 or pixels.dtype.itemsize < 2:
        raise GraspError(
            f"{path}: must be a depth image of 16 bits and one channel, "
            f"got {pixels.dtype} of shape {pixels.shape}"
        )
    return np.asarray(scale * pixels.astype(float))


def read_mask(path: Path) -> npt.NDArray[np.bool_]:
    """Return the mask (h, w) of an image file or a .npy file: where any channel is not 0.

    Raises:
        GraspError: If the file is neither, is 0 everywhere, or has NaN or several other values.
    """
    pixels = _pixels(path)
    if pixels.ndim == 3 and pixels.shape[2] in (2, 4):
        pixels = pixels[:, :, :-1]  # without the opacity
    try:
        own = _chosen(pixels)
    except GraspError as error:
        raise GraspError(f"{path}: {one_line(error)}") from None
    if own.ndim != 2:
        raise GraspError(f"{path}: must be an image, got an array of shape {pixels.shape}")
    if not own.any():
        raise GraspError(f"{path}: mask is 0 everywhere")
    return own


def read_labels(path: Path, label: int) -> npt.NDArray[np.int64]:
    """Return the mask (h, w) of several objects in an image file or a .npy file, 0 beside all.

    Args:
        path: The file; it has another whole number above 0 on each object.
        label: The number on one of them.

    Raises:
        GraspError: If the file is neither, has several channels, or lacks the label.
    """
    pixels = _pixels(path)
    must = f"{path}: mask must be whole numbers (h, w), with {label} on the object"
    if pixels.ndim != 2 or pixels.dtype.kind not in "iu":
        raise GraspError(f"{must}, got {pixels.dtype} of shape {pixels.shape}")
    if not (pixels == label).any():
        raise GraspError(f"{must}, got {listed([str(each) for each in np.unique(pixels)])}")
    return np.maximum(pixels.astype(np.int64), 0)


def _pixels(path: Path) -> npt.NDArray[Any]:
    """Return the pixels of an image, (h, w) or (h, w, channels)."""
    from PIL import Image, UnidentifiedImageError

    # Pillow raises all kinds of exceptions for damaged files.
    try:
        content = io.BytesIO(read_content(path))
        if path.suffix.lower() == ".npy":
            return np.asarray(np.lib.format.read_array(content, allow_pickle=False))
        with catch_warnings(action="ignore"), Image.open(content) as image:
            if (count := image.width * image.height) > MOST_PIXELS:
                raise ValueError(f"{count:,} pixels, more than {MOST_PIXELS:,}")
            return np.asarray(image if image.mode in _PLAIN_MODES else image.convert("RGB"))
    except UnidentifiedImageError:  # its message has the address of `content`
        raise GraspError(f"{path}: must be an image, got no image file") from None
    except Exception as error:
        raise GraspError(f"{path}: must be an image, got: {one_line(error)}") from None


# Completion


class View(NamedTuple):
    """A depth image of an object on the table, and the camera that took it.

    Attributes:
        depth: (h, w), along the camera's z axis [m]; 0, NaN or infinite where it is unknown.
        mask: (h, w), 0 beside the object, and one other value on it.
        K: Camera matrix (3, 3) [px].
        X_TC: Pose of the camera in {T} (4, 4).
    """

    depth: npt.ArrayLike
    mask: npt.ArrayLike
    K: npt.ArrayLike
    X_TC: npt.ArrayLike


def complete(field: DistanceField, view: View | None = None) -> Solid:
    """Return the closed surface in {T} of a guessed solid, without what a view shows to be free.

    Of several parts the largest is returned. The surface stands on the table.

    Args:
        field: Distances from the solid in {T}, whose table is z = 0.
        view: An image, valid for `cloud_from_depth`; None if it is not known.

    Raises:
        TooLittleSeenError: If no solid is left.
    """
    values = np.asarray(field.values, dtype=float)
    if view is not None:
        axes = [
            start + field.spacing * np.arange(n)
            for start, n in zip(field.origin, values.shape, strict=True)
        ]
        p_TQ = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        values = np.maximum(values, _in_free_space(p_TQ, view).reshape(values.shape))

    # Outside is negative for manifold3d.
    bounds = (*field.origin, *(field.origin + field.spacing * (np.array(values.shape) - 1)))
    inside = _interpolation(-values, field)
    whole = manifold3d.Manifold.level_set(inside, bounds, EDGE).trim_by_plane((0.0, 0.0, 1.0), 0.0)
    if whole.is_empty():
        raise TooLittleSeenError("cloud must show a solid, got one that the view shows to be free")
    largest = max(whole.decompose(), key=lambda part: float(part.volume()))
    vertices, faces = from_manifold(largest.simplify(TOLERANCE))
    return Solid(vertices=vertices, faces=faces)


def _in_free_space(p_TQ: Array, view: View) -> Array:
    """Return how far points (m, 3) are in what a view shows to be free [m], negative beyond it."""
    depth, mask = np.asarray(view.depth, dtype=float), np.asarray(view.mask)
    known = np.isfinite(depth) & (depth > 0.0)
    own = known & (mask.any(axis=2) if mask.ndim == 3 else mask != 0)
    beside = known & ~own

    # The pixels of the points.
    K, p_CQ = np.reshape(view.K, (3, 3)), transform_points(invert_pose(np.asarray(view.X_TC)), p_TQ)
    z = np.where(p_CQ[:, 2] > 0.0, p_CQ[:, 2], np.nan)
    u, v = (K[i, i] * p_CQ[:, i] / z + K[i, 2] for i in range(2))
    height, width = depth.shape
    in_image = (u >= 0.0) & (u <= width - 1) & (v >= 0.0) & (v <= height - 1)
    z, u, v = (np.where(in_image, each, 0.0) for each in (z, u, v))

    # In front of the object, whose depth is continued to the pixels around it.
    apart, near = distance_transform_edt(~own, return_indices=True)
    row, column = np.rint(v).astype(int), np.rint(u).astype(int)
    ahead = map_coordinates(depth[tuple(near)], [v, u], order=1) - z
    ahead = np.where(apart[row, column] <= AROUND, ahead, -np.inf)

    # Beside the object, in front of what is seen there; an unknown pixel shows nothing free.
    pixels = distance_transform_edt(beside) - distance_transform_edt(~beside)
    aside = map_coordinates(pixels - 0.5 * np.sign(pixels), [v, u], order=1) * z / K[0, 0]
    hidden = beside[row, column] & (z > (1.0 + BEHIND) * depth[row, column])
    free = np.maximum(ahead, np.where(hidden, -np.inf, aside))
    return np.where(in_image, free, -np.inf)


def _interpolation(values: Array, field: DistanceField) -> Callable[[float, float, float], float]:
    """Return the trilinear interpolation of values (nx, ny, nz) at one point of a field's grid.

    manifold3d asks for one point at a time, for which lists are faster than arrays.
    """
    far = 4.0 * EDGE
    rows, last = np.clip(values, -far, far).tolist(), [n - 2 for n in values.shape]
    (x0, y0, z0), scale = field.origin.tolist(), 1.0 / field.spacing

    def at(x: float, y: float, z: float) -> float:
        x, y, z = scale * (x - x0), scale * (y - y0), scale * (z - z0)
        i, j, k = (min(max(int(each), 0), n) for each, n in zip((x, y, z), last, strict=True))
        x, y, z = x - i, y - j, z - k
        corners = rows[i][j], rows[i][j + 1], rows[i + 1][j], rows[i + 1][j + 1]
        a, b, c, d = (edge[k] + (edge[k + 1] - edge[k]) * z for edge in corners)
        a, c = a + (b - a) * y, c + (d - c) * y
        return float(a + (c - a) * x)

    return at
