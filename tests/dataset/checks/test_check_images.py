"""Rules of cameras, contacts and images."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.datasets import (
    BOTH,
    LAST_SHARD,
    LOST,
    OTM,
    OTO,
    TRIALS,
    Edit,
    change,
    found,
    moved,
    must_find,
    must_find_without_shards,
    set_at,
    turned,
)
from scipy import ndimage

from drakegrasp.dataset.checks import samples as image_rules
from drakegrasp.dataset.checks.rows import Findings, look_at
from drakegrasp.dataset.paths import model_path
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.frames import invert_pose, pack_pose, unpack_pose
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import load_object


@pytest.mark.parametrize(
    ("edit", "what"),
    [
        (moved(0.0, 0.0, 0.01), "both cameras must have the same place and view"),
        (turned(0.3, [0, 0, 1]), "the otm camera must have world up"),
        (turned(np.pi, [0, 0, 1]), "the otm camera must have world up"),
    ],
)
def test_a_moved_or_rolled_camera_is_found(out: Path, edit: Edit, what: str) -> None:
    with h5py.File(out / OTM, "r+") as file:
        props = file["test/object_props"]
        packed = edit(props["frame_work2cam_otm"][2])
        props["frame_work2cam_otm"][2] = packed
        props["frame_cam2work_otm"][2] = pack_pose(invert_pose(unpack_pose(packed)))
    must_find_without_shards(out, (OTM, "/test", 2, what))


def nearer(by: float) -> Edit:
    """Move the first contact along its line of sight."""

    def edit(grasp: np.ndarray) -> np.ndarray:
        grasp[:3] *= 1.0 - by / grasp[2]
        return grasp

    return edit


@pytest.mark.parametrize(
    ("edit", "what"),
    [
        (set_at(0, to=0.1), "contact of finger 1 must project within 2 px of the mask"),
        (nearer(0.15), "contact of finger 1 must not lie more than 0.005 m before the surface"),
        (set_at(2, to=-0.1), "contact of finger 1 must be before the camera"),
    ],
)
def test_a_contact_off_the_image_of_the_object_is_found(out: Path, edit: Edit, what: str) -> None:
    change(out, OTO, "test/grasps", 3, edit)
    must_find(out / OTO, (OTO, "/test", 3, what))


def change_contact(out: Path, edit_p: Edit, edit_n: Edit) -> None:
    """Change the first contact of the first test sample, alike in all files."""
    with h5py.File(out / TRIALS, "r+") as trials, h5py.File(out / OTO) as data:
        number = int(data["test/trial_id"][0])
        p = trials["trials/closed_p_OQ"][number]
        n = trials["trials/closed_nhat_Q_O"][number]
        f = trials["trials/closed_f_Q_O"][number]
        p[0], turned_n = edit_p(p[0]), edit_n(n[0])
        f[0] *= n[0] @ turned_n
        n[0] = turned_n
        trials["trials/closed_p_OQ"][number] = p
        trials["trials/closed_nhat_Q_O"][number] = n
        trials["trials/closed_f_Q_O"][number] = f
        X_TO = unpack_pose(trials["trials/X_TO"][number])
    for name, camera in zip(BOTH, CAMERAS, strict=True):
        with h5py.File(out / name, "r+") as file:
            X_CT = unpack_pose(file[f"test/object_props/frame_cam2work_{camera}"][0])
            X_CO = X_CT @ X_TO
            file["test/grasps"][0] = np.concatenate(
                [(p @ X_CO[:3, :3].T + X_CO[:3, 3]).ravel(), (n @ X_CO[:3, :3].T).ravel()]
            )
            file["test/grasp_props/f_Q_C"][0] = f @ X_CO[:3, :3].T


@pytest.mark.parametrize(
    ("inward", "sign", "what"),
    [
        (0.004, 1.0, "contact of finger 1 must be on the object's mesh within 0.002 m"),
        (0.0, -1.0, "normal of finger 1 must point out of the object"),
    ],
)
def test_a_contact_inside_the_object_or_a_normal_into_it_is_found(
    out: Path, inward: float, sign: float, what: str
) -> None:
    change_contact(out, lambda p: p - [inward, 0.0, 0.0], lambda n: sign * n)
    must_find_without_shards(out, *((name, "/test", 0, what) for name in BOTH))


def test_object_pixels_are_checked_against_the_mesh(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        for row, by in ((0, -0.1), (1, 0.01)):
            # The rule measures 16 pixels inside the border.
            mask = file["train/masks"][row] == 1
            v, u = np.nonzero(ndimage.binary_erosion(mask, np.ones((3, 3)), border_value=1))
            middle = np.linspace(0, len(v) - 1, 16).astype(int)[8]
            image = file["train/images"][row]
            image[3, v[middle], u[middle]] += by
            file["train/images"][row] = image
    must_find_without_shards(
        out,
        (OTO, "/train", 0, "points in the mask must be in the object's box within 0.0003 m"),
        (OTO, "/train", 1, "points in the mask must be on the object's mesh within 0.0003 m"),
    )


@pytest.mark.parametrize(
    ("inside", "by", "passes"),
    [(True, -0.001, False), (False, -0.03, False), (False, -0.001, True)],
)
def test_pixels_are_checked_against_the_box(
    out: Path, inside: bool, by: float, passes: bool
) -> None:
    """At the border of the mask a depth may be off by a pixel's width, but not by more."""
    with h5py.File(out / OTO, "r+") as file:
        mask, image = file["train/masks"][0], file["train/images"][0]
        erosion = ndimage.binary_erosion(mask, np.ones((3, 3)))
        v, u = np.nonzero(erosion if inside else (mask == 1) & ~erosion)
        nearest = np.argmin(image[3, v, u])
        image[3, v[nearest], u[nearest]] += by
        file["train/images"][0] = image
    what = (OTO, "/train", 0, "points in the mask must be in the object's box")
    must_find_without_shards(out, *([] if passes else [what]))


@pytest.mark.parametrize("shift", [(0, 1), (1, 0)])
def test_images_that_are_off_by_one_pixel_are_found(out: Path, shift: tuple[int, int]) -> None:
    for place, axes in (("images", (1, 2)), ("masks", (0, 1))):
        change(out, OTO, f"test/{place}", 1, lambda a, axes=axes: np.roll(a, shift, axes))
    assert {h[:3] for h in found(out)} == {(OTO, "/test", 1)}
    (out / LAST_SHARD).unlink()
    assert {h[:3] for h in found(out)} == {(OTO, "/test", 1), LOST[:3]}


@pytest.mark.parametrize("inside", [True, False])
def test_mesh_is_measured_inside_the_border_of_the_mask(out: Path, inside: bool) -> None:
    """Pixels that are 0.6 mm behind the mesh, in its box: all inside, or all at the border.

    At the border a pixel may show a face nearly from its edge.
    """
    with h5py.File(out / OTO, "r+") as file:
        mask, image = file["train/masks"][0], file["train/images"][0]
        border = (mask == 1) & ~ndimage.binary_erosion(mask, np.ones((3, 3)))
        image[3, (mask == 1) & (border != inside)] += 6e-4
        file["train/images"][0] = image
    what = "points in the mask must be on the object's mesh within"
    must_find_without_shards(out, *([(OTO, "/train", 0, what)] if inside else []))


def test_image_without_a_depth_hides_no_other(sound: Path) -> None:
    """A sensor may lose all depths of an object; the object of the next image is still found."""
    with h5py.File(sound / OTO) as file:
        data = look_at(OTO, file, "oto", Findings())
        names = file["test/object_props/object_name"].asstr()[:]
        batch = data.read(file, "test", np.flatnonzero(names == names[0]))
    config = override_config(batch.config, ["randomize.depth_baseline=0.02"])
    batch = replace(batch, of=replace(data, config=config))
    model = load_object(model_path(sound, names[0]))
    assert len(batch) > 1
    batch["images"][0, 3] = config.camera.far
    assert list(image_rules.object_pixels(batch, model)) == []
    batch["images"][1, 3][batch["masks"][1] == 1] -= 0.02
    (violation,) = image_rules.object_pixels(batch, model)
    assert violation.row == batch.rows[1]


def test_nearest_depth_is_the_least_within_two_pixels() -> None:
    """Lost pixels have none, where errors are drawn; beside the image its nearest pixel counts."""
    loses, shows = load_config(overrides=["randomize.depth_noise=[0.001,0.002]"]), load_config()
    depth = np.full((33, 33), 0.6)
    depth[10, 20], depth[10, 25], depth[0, 0] = 0.3, 0.75, 0.2
    for pixel, expected in (
        *(([20.0, 10.0], 0.3), ([22.4, 12.4], 0.3), ([17.6, 8.0], 0.3)),
        *(([22.6, 10.0], 0.6), ([20.0, 12.6], 0.6), ([17.4, 10.0], 0.6)),
        *(([-5.0, -9.0], 0.2), ([40.0, 40.0], 0.6)),
    ):
        assert image_rules.nearest_depth(depth, loses, np.array(pixel)) == expected
    lost, middle = np.full((33, 33), 0.75), np.array([5.0, 5.0])
    assert np.isinf(image_rules.nearest_depth(lost, loses, middle))
    assert image_rules.nearest_depth(lost, shows, middle) == 0.75
