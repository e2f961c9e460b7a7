"""Depth images of a user's own camera: the object's points, the table below it, and bad images.

What a view shows of an object becomes a closed surface, less what is seen to be free.
"""

from __future__ import annotations

import json
import zlib

import numpy as np
import pytest
import trimesh
from helpers.depth_images import BOX, HIGH, WIDE, X_TC, K, box_view, cloud_of, image
from PIL import Image

import drakegrasp as dg
from drakegrasp.errors import TooLittleSeenError
from drakegrasp.frames import invert_pose, make_pose, rotation_about, transform_points
from drakegrasp.mesh.cloud import column_solid, hull_solid, read_cloud
from drakegrasp.mesh.surfaces import is_solid_surface
from drakegrasp.vision.depth_image import complete, read_camera, read_depth_png, read_mask


def off(fitted):
    """Return how far a fitted table is from the true one: distance [m] and angle [degree]."""
    normal = X_TC[:3, :3].T[:, 2]
    angle = np.rad2deg(np.arccos(np.clip(fitted[:3, :3].T[:, 2] @ normal, -1.0, 1.0)))
    # Of the points of the true table around the object.
    points = np.array([[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)])
    heights = transform_points(fitted, transform_points(invert_pose(X_TC), points))[:, 2]
    return np.abs(heights).max(), angle


@pytest.mark.parametrize(("noise", "near"), [(0.0, 2e-5), (0.002, 1e-3)])
def test_the_table_is_the_plane_on_which_the_object_stands(noise, near):
    """Not the wall behind it, which has more pixels."""
    depth, mask = image(noise)
    fitted, residual, share = dg.fit_table(depth, K, mask)
    distance, angle = off(fitted)
    assert distance < near and angle < 0.5
    assert residual < 2.0 * noise + 2e-5 and 0.15 < share < 0.5

    # +z is up, x is horizontal in the image, and the origin is below what is seen of the object.
    cloud = dg.cloud_from_depth(depth, K, mask, fitted)
    np.testing.assert_allclose(cloud[:, :2].mean(axis=0), 0.0, atol=1e-6)
    assert np.median(cloud[:, 2]) > 0.02 and cloud[:, 2].max() == pytest.approx(0.1, abs=5e-3)
    assert fitted[:3, :3].T[0, 0] > 0.5 and np.linalg.det(fitted[:3, :3]) == pytest.approx(1.0)
    again = dg.fit_table(depth, K, mask)
    assert fitted.tobytes() == again[0].tobytes()


def test_an_object_on_another_is_over_the_table():
    """What lies below it has few pixels; its top, alone in the mask, is still over the table."""
    depth, mask = image(offset=-0.5)
    cloud = dg.cloud_from_depth(depth, K, mask, X_TC)
    top = mask.copy()
    top[mask & (depth > 0.0)] = cloud[:, 2] > 0.06
    distance, angle = off(dg.fit_table(depth, K, top)[0])
    assert distance < 2e-4 and angle < 0.05


def test_points_of_the_object_are_on_it():
    depth, mask = image()
    cloud = dg.cloud_from_depth(depth, K, mask, X_TC)
    assert len(cloud) == (mask & np.isfinite(depth) & (depth > 0.0)).sum()
    outward = np.maximum(np.abs(cloud[:, :2]) - BOX[:2], 0.0)
    assert outward.max() < 1e-9 and cloud[:, 2].min() > -1e-9 and cloud[:, 2].max() < 0.1 + 1e-9
    # At least one coordinate of each is that of a face.
    faces = np.abs(np.column_stack([np.abs(cloud[:, :2]) - BOX[:2], cloud[:, 2] - 0.1]))
    assert faces.min(axis=1).max() < 1e-9


def scattered(depth, mask):
    """Return an image without a plane."""
    drawn = np.random.default_rng(0).uniform(0.7, 1.2, depth.shape)
    return np.where(mask, depth, depth * drawn)


def bad(**changes):
    depth, mask = image()
    return {"depth": depth, "K": K, "mask": mask} | {k: f(depth, mask) for k, f in changes.items()}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (bad(depth=lambda z, m: 1000.0 * z), "depth must be in metres.*another unit"),
        (bad(depth=lambda z, m: 0.001 * z), "depth must be in metres.*another unit"),
        (bad(depth=lambda z, m: np.stack([z, z])), r"an image \(h, w\), got an array of shape"),
        (bad(mask=lambda z, m: np.zeros_like(m)), "at least 10 pixels with a depth, got 0 of 0"),
        (bad(depth=lambda z, m: np.where(m, np.nan, z)), "with a depth, got 0 of "),
        (bad(mask=lambda z, m: m[:-1]), r"mask must be \(120, 160\), as the depth .*\(119, 160\)"),
        (bad(K=lambda z, m: K[:2]), r"camera must be a matrix \(3, 3\)"),
        (bad(K=lambda z, m: K * [[1], [-1], [1]]), "camera must be a matrix"),
        (bad(mask=lambda z, m: np.ones_like(m)), "mask must be 0 beside the object, got 100.0%"),
        (bad(depth=lambda z, m: np.where(m, z, 0.0)), "the table beside the object, got none"),
        (bad(mask=lambda z, m: np.where(m, 1.0, np.nan)), "mask must be numbers .* that are NaN"),
        (bad(mask=lambda z, m: [[1], [1, 2]]), "mask must be numbers .* cannot be read"),
        (bad(mask=lambda z, m: m * np.arange(1, WIDE + 1)), "one other value on it, got several"),
        (bad(K=lambda z, m: [*K[:2].tolist(), [0.0, 0.0, True]]), "camera must .*truth values"),
        (bad(K=lambda z, m: K * [[0.5], [0.5], [1.0]]), "for another resolution"),
        (bad(K=lambda z, m: K * [[2.0], [2.0], [1.0]]), "for another resolution"),
        (bad(depth=lambda z, m: image(table=False, offset=-1.0)[0]), "no plane below the object"),
        (bad(depth=scattered), "at least 15%"),
    ],
)
def test_bad_images_are_refused_with_one_line(changed, said):
    with pytest.raises(dg.GraspError, match=f"^[^\n]*{said}[^\n]*$"):
        dg.fit_table(**changed)


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (np.stack([X_TC, X_TC]), "one pose .*got 2 poses"),
        (2.0 * X_TC, "X_TC must have 0 0 0 1"),
        (invert_pose(X_TC), "on the table .*got 0.0%: is it inverted"),
        (make_pose(X_TC[:3, :3], 1000.0 * X_TC[:3, 3]), "on the table .*got 0.0%: is it inverted"),
    ],
)
def test_a_camera_has_one_pose_over_the_table(pose, said):
    depth, mask = image()
    with pytest.raises(dg.GraspError, match=said):
        dg.cloud_from_depth(depth, K, mask, pose)


def test_files_of_a_camera(tmp_path):
    depth, mask = image()
    units = np.rint(np.nan_to_num(depth) / 0.00025).astype(np.uint16)
    Image.fromarray(units).save(tmp_path / "depth.png")
    np.testing.assert_array_equal(read_depth_png(tmp_path / "depth.png", 0.00025), units * 0.00025)

    # A mask in any form.
    Image.fromarray(mask).save(tmp_path / "bits.png")
    Image.fromarray(200 * mask.astype(np.uint8)).save(tmp_path / "grey.png")
    colours = np.dstack([0 * mask, 9 * mask, 0 * mask, 255 + 0 * mask]).astype(np.uint8)
    Image.fromarray(colours).save(tmp_path / "colours.png")
    np.save(tmp_path / "mask.npy", mask)
    grey = np.dstack([9 * mask, 255 + 0 * mask]).astype(np.uint8)
    Image.fromarray(grey).save(tmp_path / "opaque.png")
    Image.fromarray(mask.astype(np.uint16) * 60000).save(tmp_path / "deep.png")
    Image.fromarray(200 * mask.astype(np.uint8)).save(tmp_path / "exact.webp", lossless=True)
    # With a palette the pixels are its rows, here 0 on the object.
    for name in ("palette.png", "palette.gif"):
        rows = Image.fromarray((~mask).astype(np.uint8), mode="P")
        rows.putpalette([255, 255, 255, 0, 0, 0])
        rows.save(tmp_path / name)
    found = [path for path in tmp_path.iterdir() if path.name != "depth.png"]
    assert len(found) == 9
    for path in found:
        np.testing.assert_array_equal(read_mask(path), mask, str(path))

    # A camera in any form.
    path = tmp_path / "K.json"
    flat = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": WIDE}
    no_distortion = {"D": [0.0] * 5, "distortion_model": "plumb_bob", "k1": 0, "dist": None}
    real_sense = {"ppx": K[0, 2], "ppy": K[1, 2], "fx": K[0, 0], "fy": K[1, 1], "coeffs": [0, 0]}
    ros = {"camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()}}
    open_3d = {"intrinsic_matrix": K.T.ravel().tolist(), "height": HIGH}
    for content in (
        *(K.tolist(), {"K": K.ravel().tolist()}, {"camera_matrix": K.tolist()}, flat),
        *(flat | no_distortion, real_sense, ros, open_3d, {"intrinsic_matrix": K.tolist()}),
    ):
        path.write_text(json.dumps(content))
        np.testing.assert_array_equal(read_camera(str(path), (HIGH, WIDE)), K)
    np.testing.assert_array_equal(read_camera("150,152, 80 58", (HIGH, WIDE)), K)


@pytest.mark.parametrize("name", ["m.jpg", "m.webp", "resaved.png", "parts.png", "colours.png"])
def test_a_mask_has_one_value_on_the_object(tmp_path, name):
    """Lossy files have values of their own at its edge, and masks of parts one for each part."""
    _, mask = image()
    grey = Image.fromarray(255 * mask.astype(np.uint8))
    if name == "resaved.png":
        grey.save(tmp_path / "m.jpg", quality=95)
        grey = Image.open(tmp_path / "m.jpg")
    if name == "parts.png":
        grey = Image.fromarray(mask * np.uint8(1 + np.arange(WIDE) // 80))
    if name == "colours.png":
        sides = np.arange(WIDE) % 2 == 0
        channels = np.dstack([mask & sides, mask & ~sides, 0 * mask])
        grey = Image.fromarray(200 * channels.astype(np.uint8))
    grey.save(tmp_path / name)
    with pytest.raises(dg.GraspError, match=f"{name}: mask must .*, got several: is it a lossy"):
        read_mask(tmp_path / name)


def test_a_picture_is_refused_by_its_size_before_it_is_decoded(tmp_path):
    """The header of a picture may promise any size; only its first bytes are here."""
    for side in (6_000, 12_000, 40_000):
        Image.new("1", (8, 8)).save(tmp_path / "m.png")
        content = (tmp_path / "m.png").read_bytes()
        header = b"IHDR" + 2 * side.to_bytes(4, "big") + content[24:29]
        (tmp_path / "m.png").write_bytes(
            content[:12] + header + zlib.crc32(header).to_bytes(4, "big") + content[33:]
        )
        with pytest.raises(
            dg.GraspError, match=r"m.png: must be an image, got: .*(limit|more than)"
        ):
            read_mask(tmp_path / "m.png")


@pytest.mark.parametrize("mark", [65.535, 10.0])
def test_a_depth_that_means_unknown_is_named_where_it_spoils_the_table(mark):
    """It may be on the object, beside it, or on most of the image."""
    depth, mask = image()
    said = f"pixels have the depth {mark:g} m: if it means unknown, replace it by 0"
    part = (np.arange(WIDE) % 5 == 0)[None].repeat(HIGH, axis=0)
    with pytest.raises(dg.GraspError, match=f"that of the object, or 0, .*; 120 {said}"):
        dg.fit_table(np.where(part, mark, depth), K, mask)
    with pytest.raises(dg.GraspError, match=f"depth must show the table .*; 608 {said}"):
        dg.fit_table(np.where(mask, mark, depth), K, mask)
    most = (np.arange(HIGH) % 40 > 0)[:, None] & ~mask
    for given in ({}, {"X_TC": X_TC}):
        made = dg.cloud_from_depth if given else dg.fit_table
        with pytest.raises(dg.GraspError, match=f"^[^;]*; [0-9,]* {said}"):
            made(np.where(most, mark, depth), K, mask, **given)
    # What does not spoil it is of no interest.
    some = (np.arange(HIGH) % 10 == 0)[:, None] & ~mask
    assert off(dg.fit_table(np.where(some, mark, depth), K, mask)[0])[0] < 1e-4


def camera_of(path):
    return read_camera(str(path), (HIGH, WIDE))


DISTORTIONS = [
    {"D": [-0.15, 0, 0, 0, 0], "distortion_model": "plumb_bob"},
    {"d": [0, 0, 1e-3, 0, 0]},
    {"k1": -0.1, "k2": 0.0},
    {"coeffs": [0.1, 0, 0, 0, 0], "model": "distortion.inverse_brown_conrady"},
    {"distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.2, 0, 0, 0, 0]}},
    {"distCoeffs": [[0.0, 0.0, 0.0, 0.0, 0.3]]},
    {"P2": 0.01},
]


@pytest.mark.parametrize(
    ("read", "content", "said"),
    [
        *(
            (
                camera_of,
                json.dumps({"K": K.ravel().tolist()} | stated).encode(),
                f"camera must have no distortion, got {next(iter(stated))} .*undistort depth",
            )
            for stated in DISTORTIONS
        ),
        (read_mask, b"no image", "must be an image, got no image"),
        (lambda path: read_depth_png(path, 0.001), 8, "16 bits and one channel, got uint8"),
        (camera_of, b"[1, 2]", r"camera must be .*got an array of shape"),
        (camera_of, b'{"f": 1}', r"camera must be .*got None"),
        (camera_of, b"{", "a JSON file with K, got: "),
        (camera_of, b'{"fx": true, "fy": 300, "cx": 80, "cy": 60}', "camera .*, got truth values"),
        (camera_of, b'{"K": [1, 0, 80, 0, 1, 60, 0, 0, 1], "d": ["0"]}', "d must be numbers, got"),
    ],
)
def test_bad_files_are_refused_with_their_name(tmp_path, read, content, said):
    path = tmp_path / "file.png"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        Image.fromarray(np.full((4, 4), content, np.uint8)).save(path)
    with pytest.raises(dg.GraspError, match=f"^{path}: .*{said}[^\n]*$"):
        read(path)


def test_a_camera_that_lies_on_its_side_has_a_table():
    """The image's right may be up."""
    depth, mask = image()
    turned, mask = np.rot90(depth), np.rot90(mask)
    # A turn by 90 degrees: u' = v, v' = w - 1 - u.
    lens = np.array([[K[1, 1], 0, K[1, 2]], [0, K[0, 0], WIDE - 1 - K[0, 2]], [0, 0, 1]])
    fitted, _, _ = dg.fit_table(turned, lens, mask)
    X_CD = make_pose(rotation_about([0.0, 0.0, 1.0], np.pi / 2), np.zeros(3))
    distance, angle = off(fitted @ invert_pose(X_CD))
    assert distance < 2e-5 and angle < 0.01


@pytest.fixture(scope="module")
def view():
    """A box of 80 x 60 x 100 mm, with unknown pixels on it and beside it."""
    return box_view()


@pytest.fixture(scope="module")
def cloud(view):
    return read_cloud(cloud_of(view))


def mesh_of(solid):
    assert is_solid_surface(solid.faces)
    return trimesh.Trimesh(solid.vertices, solid.faces, process=False)


@pytest.mark.parametrize("guess", [hull_solid, column_solid])
@pytest.mark.parametrize("seen", [True, False])
def test_a_box_becomes_about_itself_on_the_table(view, cloud, guess, seen):
    mesh = mesh_of(complete(guess(cloud).field, view if seen else None))
    low, high = mesh.bounds
    assert low[2] == pytest.approx(0.0, abs=1e-4)
    np.testing.assert_allclose(high, BOX, atol=4e-3)
    # Nothing of the back is seen; its edges are those of the top.
    np.testing.assert_allclose(low[:2], -BOX[:2], atol=5e-3)
    # The columns are hollow, since few points of the top are seen from so low a camera.
    full = float(np.prod(2.0 * BOX * [1.0, 1.0, 0.5]))
    assert mesh.volume == pytest.approx(full if guess is hull_solid else 0.5 * full, rel=0.12)


def test_free_space_of_a_view_is_cut_from_a_hull(view, cloud):
    """A point far beside the box widens the hull; the view shows table there."""
    wide = np.concatenate([cloud, [[0.0, 0.12, 0.0]]])
    hull, cut = (mesh_of(complete(hull_solid(wide).field, v)) for v in (None, view))
    assert hull.bounds[1][1] > 0.1
    assert cut.bounds[1][1] == pytest.approx(BOX[1], abs=6e-3)
    # An image without depth beside the box shows nothing free there.
    blind = view._replace(depth=np.where(view.mask, view.depth, np.nan))
    assert mesh_of(complete(hull_solid(wide).field, blind)).bounds[1][1] > 0.1
    # What stands between camera and table hides what is behind it.
    before = view._replace(depth=np.where(view.mask, view.depth, 0.2))
    assert mesh_of(complete(hull_solid(wide).field, before)).bounds[1][1] > 0.1


def test_a_solid_that_is_free_everywhere_is_told(view, cloud):
    behind = view._replace(depth=np.full_like(view.depth, 5.0))
    with pytest.raises(TooLittleSeenError, match="cloud must show a solid, got one"):
        complete(hull_solid(cloud).field, behind)
