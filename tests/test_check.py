"""A sound dataset passes; one wrong value breaks the one invariant that is about it."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh

from drakegrasp.assemble import assemble
from drakegrasp.camera import (
    camera_pose_otm,
    camera_pose_oto,
    image_frame,
    intrinsics,
)
from drakegrasp.candidates import Candidates
from drakegrasp.check import check_dataset
from drakegrasp.config import CameraConfig, load_config
from drakegrasp.errors import DataError
from drakegrasp.frames import Array, invert_pose, make_pose, pack_pose, unpack_pose
from drakegrasp.manifest import (
    Manifest,
    installed_versions,
    model_path,
    plan_path,
    read_manifest,
    write_manifest,
)
from drakegrasp.meshes import MeshSource
from drakegrasp.object_model import ObjectModel, load_object, prepare_object, save_object
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.prepared import PreparedObject, save_prepared
from drakegrasp.schema import CAMERAS, LOOK_FIELDS, sizes
from drakegrasp.shards import Shard, ShardHeader, read_shard, trial_columns, write_shard

OTO, OTM, TRIALS = "grasping_oto.hdf5", "grasping_otm.hdf5", "trials.hdf5"
BOTH = (OTO, OTM)
#: Edges of the objects' boxes [m] and their classes; the last class has one object.
BOXES = {
    "1_box_a": ((0.06, 0.05, 0.10), "box"),
    "2_box_b": ((0.08, 0.04, 0.06), "box"),
    "3_brick": ((0.05, 0.07, 0.08), "brick"),
}
#: Outcomes of an object's attempts, the same for all objects; three stand-offs a candidate.
OUTCOMES = [
    *(Outcome.SUCCESS, Outcome.MISSING_FINGERTIP, Outcome.BELOW_TABLE),
    *(Outcome.SUCCESS, Outcome.SLIPPED, Outcome.DROPPED),
    *(Outcome.HAND_CONTACT, Outcome.RAY_MISS, Outcome.START_COLLISION),
    *(Outcome.TABLE_CONTACT, Outcome.TABLE_CONTACT, Outcome.SUCCESS),
]
#: Rows of /trials whose outcome is known, see OUTCOMES.
SUCCESS, MISSING, BELOW, SLIPPED, AFTER_LIFT = 0, 1, 2, 4, 10
SIZES = sizes(fingers=3, joints=4, image=32)


# A dataset of boxes, whose images are computed by hand


def ray_box(origin: Array, rays: Array, half: Array) -> Array:
    """Return how far along each ray the box begins, infinity where it is missed."""
    with np.errstate(divide="ignore"):
        a, b = (-half - origin) / rays, (half - origin) / rays
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return np.where((enter <= leave) & (enter > 0.0), enter, np.inf)


def see(
    model: ObjectModel, X_TO: Array, X_TC: Array, camera: CameraConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Return image and mask of a box on the table, exactly at the pixels' centres."""
    v, u = np.divmod(np.arange(camera.size**2), camera.size)
    K = intrinsics(camera)
    rays_C = np.column_stack([u - K[0, 2], v - K[1, 2], np.full(len(u), K[0, 0])]) / K[0, 0]
    X_OC = invert_pose(X_TO) @ X_TC
    box = ray_box(X_OC[:3, 3], rays_C @ X_OC[:3, :3].T, model.half_extents)
    table = ray_box(
        X_TC[:3, 3] - [0.0, 0.0, -0.05], rays_C @ X_TC[:3, :3].T, np.array([0.8, 0.8, 0.05])
    )
    shape = (camera.size, camera.size)
    image = np.full((4, *shape), 0.5, dtype=np.float32)
    image[3] = np.clip(np.minimum(box, table), camera.near, camera.far).reshape(shape)
    mask = (box < np.minimum(table, camera.far)).astype(np.uint8).reshape(shape)
    return image, mask


def contacts(model: ObjectModel, touching: np.ndarray) -> dict[str, Any]:
    """Return contacts of three fingertips in the middle of three sides."""
    x, y, _ = model.half_extents
    n = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    gone = ~touching[:, None]
    return {
        "touching": touching,
        "p_OQ": np.where(gone, np.nan, n * [[x], [x], [y]]),
        "nhat_Q_O": np.where(gone, np.nan, n),
        "f_Q_O": np.where(gone, 0.0, -10.0 * n),
        "area": np.where(touching, 1e-5, 0.0),
        "penetration": np.where(touching, 1e-4, 0.0),
        "q": np.full(4, 0.5),
    }


def trial_row(model: ObjectModel, number: int, X_TO: Array) -> dict[str, Any]:
    """Return what `/trials` says of an attempt, by its number among the object's."""
    outcome = OUTCOMES[number]
    # The palm is above the box, turned about the vertical and tilted.
    yaw, tilt, height = 0.5 * number, 0.25, 0.10 + model.half_extents[2]
    R_OG = (
        trimesh.transformations.rotation_matrix(yaw, [0, 0, 1])
        @ trimesh.transformations.rotation_matrix(np.pi + tilt, [1, 0, 0])
    )[:3, :3]
    row: dict[str, Any] = {
        "candidate": number // 3,
        "standoff_index": number % 3,
        "spread": 0.1,
        "seed": 7,
        "outcome": outcome,
        "X_TO": pack_pose(X_TO),
        "X_OG": pack_pose(make_pose(R_OG, -height * R_OG[:, 2])),
    }
    after_lift = number == AFTER_LIFT
    stage = Stage.LIFTED if after_lift else outcome.stage
    touch = np.array([True, True, outcome is not Outcome.MISSING_FINGERTIP])
    if stage >= Stage.CLOSED:
        row |= {f"closed_{k}": v for k, v in contacts(model, touch).items()}
        row |= {"time_close": 1.0, "closed_other_links": outcome is Outcome.HAND_CONTACT}
        row["closed_hand_on_table"] = outcome is Outcome.TABLE_CONTACT and not after_lift
        row["closed_object_on_table"] = True
    if stage >= Stage.LIFTED:
        touch = touch & (outcome is not Outcome.DROPPED)
        touch[0] &= outcome is not Outcome.SLIPPED
        row |= {f"lifted_{k}": v for k, v in contacts(model, touch).items()}
        row |= {"time_lift": 1.0, "lifted_object_on_table": after_lift, "slip": 0.0}
        row |= {"slip_angle": 0.0, "surface_distance": np.zeros(3), "X_TO_lifted": pack_pose(X_TO)}
    return row


def make_shard(model: ObjectModel, header: ShardHeader, X_TO: Array, camera: CameraConfig) -> Shard:
    numbers = range(3 * header.start, 3 * header.stop)
    rows = [trial_row(model, number, X_TO) for number in numbers]
    trials = {f.name: f.empty(len(rows), SIZES) for f in trial_columns()}
    for i, row in enumerate(rows):
        for name, value in row.items():
            trials[name][i] = value
    hits = [i for i, row in enumerate(rows) if row["outcome"] is Outcome.SUCCESS]
    looks = {f.name: f.empty(len(hits), SIZES) for f in LOOK_FIELDS}
    for k, i in enumerate(hits):
        looks["row"][k] = i
        X_TG = X_TO @ unpack_pose(trials["X_OG"][i])
        for name, pose in zip(CAMERAS, (camera_pose_oto, camera_pose_otm), strict=True):
            X_TC = pose(X_TG, camera)
            image, mask = see(model, X_TO, X_TC, camera)
            looks[f"image_{name}"][k], looks[f"mask_{name}"][k] = image, mask
            looks[f"X_TC_{name}"][k] = pack_pose(X_TC)
        looks["X_CI_otm"][k] = pack_pose(image_frame(intrinsics(camera), mask, image[3]))
    return Shard(header=header, trials=trials, looks=looks)


def resting(model: ObjectModel, X_TO: Array) -> PreparedObject:
    """An object on the table, with four palm poses that nobody looks at."""
    candidates = Candidates(
        X_OG=np.tile(np.eye(4), (4, 1, 1)),
        distance=np.full(4, np.nan),
        combinations=4,
        valid=4,
        distinct=4,
    )
    return PreparedObject(
        model=model, X_TO=X_TO, candidates=candidates, table_force=9.81, stopped=False
    )


def make_dataset(out: Path, meshes: Path, *overrides: str) -> Path:
    config = load_config(
        overrides=[
            "camera.size=32",
            "unit_candidates=2",
            "filters.min_depth_variance=0",
            "split.valid_fraction=0.34",
            *overrides,
        ]
    )
    models, entries = [], []
    (out / "objects").mkdir(parents=True)
    for name, (extents, class_name) in BOXES.items():
        path = meshes / f"{name}.stl"
        trimesh.creation.box(extents).export(path)
        model = prepare_object(MeshSource(name=name, class_name=class_name, path=path))
        X_TO = make_pose(np.eye(3), [0.0, 0.0, model.half_extents[2]])
        save_prepared(resting(model, X_TO), out, config)
        numbers = {"candidates": 4, "combinations": 4, "valid": 4, "distinct": 4}
        entry = {"name": name, "class": class_name, "mesh_sha256": model.mesh_sha256}
        entries.append({**entry, **numbers, "X_TO": pack_pose(X_TO).tolist()})
        models.append((model, X_TO))
    manifest = Manifest(config=config, objects=tuple(entries), versions=installed_versions(config))
    write_manifest(manifest, out)
    by_name = {model.name: (model, X_TO) for model, X_TO in models}
    for header in manifest.headers():
        model, X_TO = by_name[header.object_name]
        write_shard(out, make_shard(model, header, X_TO, config.camera))
    assemble(out)
    return out


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_dataset(tmp_path_factory.mktemp("sound"), tmp_path_factory.mktemp("meshes"))


@pytest.fixture
def out(sound: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "out"))


# Sound data


def test_a_sound_dataset_passes(sound: Path) -> None:
    assert check_dataset(sound) == []
    with h5py.File(sound / OTO) as file:
        assert {s: len(file[s]["grasps"]) for s in file} == {"train": 2, "valid": 1, "test": 6}


@pytest.mark.parametrize("name", [OTO, OTM, TRIALS])
def test_a_sound_file_passes_alone(sound: Path, tmp_path: Path, name: str) -> None:
    shutil.copy(sound / name, tmp_path / "renamed.h5")
    assert check_dataset(tmp_path / "renamed.h5") == []


def test_shards_after_the_last_wanted_grasp_may_be_missing(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    out = make_dataset(tmp_path / "out", tmp_path / "meshes", "max_grasps=1")
    for path in out.glob("shards/*/0000002-*.h5"):
        path.unlink()
    assert check_dataset(out) == []


def test_progress_ends_at_the_total(sound: Path) -> None:
    seen: list[tuple[int, int]] = []
    check_dataset(sound, progress=lambda done, total, **_: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1] == 36 + 2 * 9 + 6
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


# One wrong value


Edit = Callable[[np.ndarray], Any]


def change(out: Path, name: str, place: str, row: int, edit: Edit) -> None:
    """Replace a row of a dataset by what `edit` makes of it; no edit in place."""
    with h5py.File(out / name, "r+") as file:
        values = file[place][row]
        file[place][row] = edit(np.array(values) if not isinstance(values, bytes) else values)


def set_at(*index: int | slice, to: Any) -> Edit:
    def edit(values: np.ndarray) -> np.ndarray:
        values[index] = to
        return values

    return edit


def moved(*by: float) -> Edit:
    """Move a packed pose by a vector."""

    def edit(values: np.ndarray) -> np.ndarray:
        values[[3, 7, 11]] += by
        return values

    return edit


def turned(angle: float, axis: list[float]) -> Edit:
    """Turn a packed pose about an axis of its own."""
    turn = trimesh.transformations.rotation_matrix(angle, axis)
    return lambda values: pack_pose(unpack_pose(values) @ turn)


def mirrored(values: np.ndarray) -> np.ndarray:
    return pack_pose(unpack_pose(values) @ np.diag([1.0, 1.0, -1.0, 1.0]))


def found(path: Path) -> set[tuple[str, str, int | None, str]]:
    return {(v.file, v.group, v.row, v.what) for v in check_dataset(path)}


def must_find(path: Path, *expected: tuple[str, str, int | None, str]) -> None:
    """Require exactly these violations: file, group, row, and how the text begins."""
    hits = found(path)
    missing = [
        e for e in expected if not any(h[:3] == e[:3] and h[3].startswith(e[3]) for h in hits)
    ]
    extra = [h for h in hits if not any(h[:3] == e[:3] and h[3].startswith(e[3]) for e in expected)]
    assert not missing and not extra, f"missing {missing}, extra {extra}"


PROPS = "object_props/"
SAMPLE_CASES: Mapping[str, tuple[str, str, Edit, str]] = {
    # where it is, how it is broken, what is found
    "nan": (OTO, "images", set_at(1, 3, 3, to=np.nan), "images must be finite"),
    "infinite": (OTO, "grasps", set_at(0, to=np.inf), "grasps must be finite"),
    "nan frame": (
        OTM,
        PROPS + "frame_cam2img_otm",
        set_at(0, to=np.nan),
        PROPS + "frame_cam2img_otm must be finite",
    ),
    "colour": (OTO, "images", set_at(1, 3, 3, to=1.5), "colours must be within 0..1"),
    "depth": (OTM, "images", set_at(3, 3, 3, to=0.9), "depths must be within 0.01..0.75 m"),
    "mask value": (OTO, "masks", set_at(3, 3, to=2), "mask must hold 0 and 1 only"),
    "empty mask": (OTM, "masks", lambda m: 0 * m, "mask must have an object pixel"),
    "normal": (
        OTO,
        "grasps",
        lambda g: np.hstack([g[:12], 1.01 * g[12:15], g[15:]]),
        "normal of finger 2 must",
    ),
    "scaled": (OTO, PROPS + "frame_world2obj", lambda p: 1.01 * p, f"{PROPS}frame_world2obj must"),
    "mirror": (OTO, PROPS + "frame_cam2img_otm", mirrored, f"{PROPS}frame_cam2img_otm must"),
    "work": (OTO, PROPS + "frame_world2work", moved(0, 0, 0.01), "frame_world2work must be the"),
    "mass": (OTO, PROPS + "work2mass", lambda m: -m, "work2mass must be positive"),
    "inertia": (OTO, PROPS + "work2inertia", set_at(1, to=0.1), "work2inertia must be symmetric"),
    "inverse": (
        OTM,
        PROPS + "frame_work2cam_otm",
        moved(0, 0, 0.01),
        "frame_work2cam_otm times frame_cam2work_otm must be the identity",
    ),
    "image frame behind": (
        OTO,
        PROPS + "frame_cam2img_otm",
        moved(0, 0, -2.0),
        "frame_cam2img_otm must start before the camera",
    ),
    "image frame turned": (
        OTO,
        PROPS + "frame_cam2img_otm",
        turned(np.pi, [0, 0, 1]),
        "frame_cam2img_otm must have +Ix along +Cz",
    ),
    "centroid": (
        OTM,
        PROPS + "frame_cam2img_otm",
        moved(0.01, 0, 0),
        "frame_cam2img_otm must start within 0.05 px",
    ),
    "pose": (
        OTO,
        PROPS + "frame_world2obj",
        moved(0.001, 0, 0),
        "frame_world2obj must follow from its trial",
    ),
    "grasp": (OTM, "grasps", lambda g: g + np.eye(18)[2] * 1e-4, "grasp must be its trial's"),
    "beside": (
        OTO,
        "images",
        set_at(3, 0, 0, to=0.2),
        "points beside the mask must be on the table",
    ),
    "com": (OTO, PROPS + "work2com", lambda p: p + 1e-3, "work2com must be the resting object's"),
    "scaled inertia": (OTO, PROPS + "work2inertia", lambda i: 1.1 * i, "work2inertia must be the"),
    "scaled mass": (OTO, PROPS + "work2mass", lambda m: 1.1 * m, "work2mass must be the resting"),
}


@pytest.mark.parametrize("case", SAMPLE_CASES)
def test_a_wrong_value_of_a_sample_is_found(out: Path, case: str) -> None:
    name, place, edit, what = SAMPLE_CASES[case]
    change(out, name, f"train/{place}", 1, edit)
    hits = found(out)
    assert {h[:3] for h in hits} == {(name, "/train", 1)}
    assert len(hits) == 1
    assert all(h[3].startswith(what) for h in hits), hits


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
    must_find(out, (OTM, "/test", 2, what))


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


def change_contact(out: Path, edit_p: Edit, edit_n: Edit) -> tuple[str, int]:
    """Change the first contact of the first test sample, alike in all files; return its row."""
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
    return "/test", 0


def test_a_contact_inside_the_object_is_found(out: Path) -> None:
    group, row = change_contact(out, lambda p: p - [0.004, 0.0, 0.0], lambda n: n)
    what = "contact of finger 1 must be on the object's mesh within 0.002 m"
    must_find(out, *((name, group, row, what) for name in BOTH))


def test_a_normal_into_the_object_is_found(out: Path) -> None:
    group, row = change_contact(out, lambda p: p, lambda n: -n)
    what = "normal of finger 1 must point out of the object"
    must_find(out, *((name, group, row, what) for name in BOTH))


def test_object_pixels_are_checked_against_the_mesh(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        for row, by in ((0, -0.1), (1, 0.01)):
            v, u = np.nonzero(file["train/masks"][row])
            middle = np.linspace(0, len(v) - 1, 16).astype(int)[8]
            image = file["train/images"][row]
            image[3, v[middle], u[middle]] += by
            file["train/images"][row] = image
    must_find(
        out,
        (OTO, "/train", 0, "points in the mask must be in the object's box within 0.0003 m"),
        (OTO, "/train", 1, "points in the mask must be on the object's mesh within 0.0003 m"),
    )


@pytest.mark.parametrize("shift", [(0, 1), (1, 0)])
def test_images_that_are_off_by_one_pixel_are_found(out: Path, shift: tuple[int, int]) -> None:
    for place, axes in (("images", (1, 2)), ("masks", (0, 1))):
        change(out, OTO, f"test/{place}", 1, lambda a, axes=axes: np.roll(a, shift, axes))
    assert {h[:3] for h in found(out)} == {(OTO, "/test", 1)}


def test_a_sample_of_another_trial_is_found(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        number = int(file["test/trial_id"][0])
        file["test/trial_id"][0] = MISSING
    assert number != MISSING
    must_find(
        out,
        (OTO, "/test", 0, "a sample's trial must be a success"),
        (OTO, "", None, "every success that /successes of trials.hdf5 keeps must be a sample"),
        (OTO, "", None, "every sample must be a success that /successes"),
    )


def test_a_trial_id_out_of_range_is_found(out: Path) -> None:
    for name in BOTH:
        change(out, name, "test/trial_id", 0, lambda _: 10**9)
    assert {h for h in found(out) if h[1]} == {
        (name, "/test", 0, "trial_id must be a row of trials.hdf5") for name in BOTH
    }


def test_a_trial_in_two_splits_is_found(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        file["valid/trial_id"][0] = file["train/trial_id"][0]
    assert (OTO, "/valid", 0, "trial_id must be unique in all splits") in found(out / OTO)


def test_an_object_in_two_splits_is_found(out: Path) -> None:
    with h5py.File(out / OTO, "r+") as file:
        file["train/object_props/object_name"][0] = file["test/object_props/object_name"][0]
    must_find(
        out,
        (OTO, "/train", None, "an object of /test must be in no other split"),
        (OTO, "/train", 0, "object_name must be that of its trial"),
    )


def test_classes_are_checked(out: Path) -> None:
    for name in BOTH:
        change(out, name, "test/object_props/class_name", 0, lambda _: "other")
    what = "class_name of 1_box_a must be 'box'"
    with h5py.File(out / OTO) as file:
        if file["test/object_props/object_name"][0] != b"1_box_a":
            what = "class_name of 2_box_b must be 'box'"
    must_find(out, *((name, "/test", 0, what) for name in BOTH))
    with h5py.File(out / OTO, "r+") as file:
        file["train/object_props/class_name"][...] = "brick"
        file["valid/object_props/class_name"][...] = "cup"
    must_find(out / OTO, (OTO, "", None, "class cup must have one object in /test"))


def test_both_data_files_must_agree(out: Path) -> None:
    (out / TRIALS).unlink()
    change(out, OTM, "train/trial_id", 1, lambda i: i + 1000)
    change(out, OTM, "test/object_props/class_name", 0, lambda _: "box")
    change(out, OTM, "test/object_props/frame_cam2img_otm", 1, moved(0, 0, 1e-4))
    must_find(
        out,
        (TRIALS, "", None, "the file must be there and readable"),
        (OTM, "/train", 1, "trial_id must be that of grasping_oto.hdf5"),
        (OTO, "/test", 1, "object_props/frame_cam2img_otm must be equal to that of"),
    )


# Trials


TRIAL_CASES: Mapping[str, tuple[str, int, Edit, str]] = {
    "trial_id": ("trial_id", MISSING, lambda i: i + 1, "trial_id must be the row's number"),
    "outcome": ("outcome", BELOW, lambda _: 99, "outcome must be 0..12"),
    "object": ("object", BELOW, lambda _: 3, "object must be a row of /objects, 0..2"),
    "candidate": ("candidate", BELOW, lambda _: 4, "candidate must be one of"),
    "standoff": ("standoff_index", BELOW, lambda _: 3, "standoff_index must be below 3"),
    "lost value": ("closed_q", SUCCESS, set_at(1, to=np.nan), "closed_q must be finite from"),
    "infinite": ("spread", BELOW, lambda _: np.inf, "spread must be finite"),
    "early value": ("slip", MISSING, lambda _: 0.0, "slip must be finite from the stage lifted"),
    "early count": ("closed_other_links", BELOW, lambda _: 1, "closed_other_links must be 0"),
    "late value": ("slip", AFTER_LIFT, lambda _: np.nan, "slip must be finite from"),
    "no touch": ("closed_p_OQ", MISSING, set_at(2, to=0.0), "closed_p_OQ must be finite where"),
    "touch": ("lifted_p_OQ", SUCCESS, set_at(2, 0, to=np.nan), "lifted_p_OQ must be finite where"),
    "normal": (
        "closed_nhat_Q_O",
        SUCCESS,
        set_at(2, to=[0, 0.9, 0]),
        "closed_nhat_Q_O of finger 3 must have length 1",
    ),
    "pull": (
        "lifted_f_Q_O",
        SUCCESS,
        set_at(1, to=[-10, 0, 0]),
        "lifted_f_Q_O of finger 2 must push",
    ),
    "area": ("closed_area", SUCCESS, set_at(0, to=0), "closed_area of finger 1 must be positive"),
    "depth": (
        "closed_penetration",
        SUCCESS,
        set_at(1, to=-1e-3),
        "closed_penetration of finger 2 must not be negative",
    ),
    "pose": ("X_OG", BELOW, lambda p: 1.1 * p, "X_OG must have an orthonormal rotation"),
    "lifted pose": ("X_TO_lifted", SUCCESS, mirrored, "X_TO_lifted must have an orthonormal"),
    "resting": ("X_TO", SUCCESS, moved(0.001, 0, 0), "X_TO must be the object's resting pose"),
    "on table": ("lifted_object_on_table", SUCCESS, lambda _: True, "outcome must follow"),
    "verdict": ("outcome", SLIPPED, lambda _: Outcome.DROPPED, "outcome must follow from the"),
}


@pytest.mark.parametrize("case", TRIAL_CASES)
def test_a_wrong_value_of_a_trial_is_found(out: Path, case: str) -> None:
    name, row, edit, what = TRIAL_CASES[case]
    change(out, TRIALS, f"trials/{name}", row, edit)
    must_find(out, (TRIALS, "/trials", row, what))


def test_contact_that_slides_may_be_pressed_from_any_side(out: Path) -> None:
    change(out, TRIALS, "trials/lifted_f_Q_O", SLIPPED, set_at(1, to=[-10, 0, 0]))
    must_find(out)


def test_successes_and_removals_are_checked(out: Path) -> None:
    change(out, TRIALS, "successes/removal", 2, lambda _: 4)
    what = "every sample must be a success that /successes"
    must_find(out, *((name, "", None, what) for name in BOTH))
    change(out, TRIALS, "successes/removal", 2, lambda _: 77)
    must_find(
        out / TRIALS,
        (TRIALS, "/successes", 2, "removal must be 0..7"),
    )
    change(out, TRIALS, "successes/trial_id", 0, lambda i: i + 1)
    assert (TRIALS, "/successes", None, "trial_id must list the successes of /trials") in found(
        out / TRIALS
    )


def test_certificates_are_checked(out: Path) -> None:
    change(out, TRIALS, "successes/certified_share", 1, lambda _: 1.0)
    change(out, TRIALS, "successes/certified_friction", 1, lambda _: np.inf)
    must_find(out)
    change(out, TRIALS, "successes/certified_share", 1, lambda _: 1.5)
    change(out, TRIALS, "successes/certified_friction", 1, lambda _: -0.1)
    must_find(
        out,
        (TRIALS, "/successes", 1, "certified_share must be 0..1 or NaN"),
        (TRIALS, "/successes", 1, "certified_friction must be 0..inf or NaN"),
    )


def test_objects_are_those_of_the_manifest(out: Path) -> None:
    change(out, TRIALS, "objects/class_name", 1, lambda _: "ball")
    must_find(out, (TRIALS, "/objects", 1, "class_name must be that of manifest.json, 'box'"))


# Layout and attributes


def edit_file(path: Path, edit: Callable[[h5py.File], Any]) -> None:
    with h5py.File(path, "r+") as file:
        edit(file)


def retype(file: h5py.File) -> None:
    values, attrs = file["valid/masks"][:], dict(file["valid/masks"].attrs)
    del file["valid/masks"]
    file["valid/masks"] = values.astype(np.int32)
    file["valid/masks"].attrs.update(attrs)


LAYOUT_CASES: Mapping[str, tuple[str, Callable[[h5py.File], Any], str, str]] = {
    "extra group": (OTO, lambda f: f.create_group("more"), "", "groups must be those of"),
    "no group": (OTO, lambda f: f.pop("valid"), "/valid", "the group must be there"),
    "extra dataset": (
        OTO,
        lambda f: f.create_dataset("valid/object_props/x", data=[0]),
        "/valid",
        "datasets must be those of the schema",
    ),
    "no dataset": (OTM, lambda f: f.pop("valid/masks"), "/valid/masks", "the dataset must be"),
    "rows": (OTO, lambda f: f["valid/masks"].resize(2, 0), "/valid/masks", "shape must be (1, 32"),
    "type": (OTO, retype, "/valid/masks", "type must be uint8"),
    "unit": (
        OTO,
        lambda f: f["valid/grasps"].attrs.update(unit="mm"),
        "/valid/grasps",
        "attribute unit must be 'm, -'",
    ),
    "frame": (
        TRIALS,
        lambda f: f["trials/slip"].attrs.update(frame="W"),
        "/trials/slip",
        "attribute frame must be 'G'",
    ),
    "meaning": (
        TRIALS,
        lambda f: f["trials/slip"].attrs.pop("meaning"),
        "/trials/slip",
        "attribute meaning must be there",
    ),
    "schema": (OTO, lambda f: f.attrs.update(schema_version=0), "", "attribute schema_version"),
    "K": (OTO, lambda f: f.attrs.update(K=np.eye(3)), "", "attribute K must be"),
    "far": (OTO, lambda f: f.attrs.update(far=1.0), "", "attribute far must be 0.75"),
    "near": (OTO, lambda f: f.attrs.pop("near"), "", "attribute near must be 0.01"),
    "seed": (TRIALS, lambda f: f.attrs.update(seed=5), "", "attribute seed must be 0"),
    "hash": (TRIALS, lambda f: f.attrs.update(config_hash="0"), "", "attribute config_hash must"),
    "config": (OTO, lambda f: f.attrs.update(config="{"), "", "attribute config must be a conf"),
    "versions": (OTO, lambda f: f.attrs.update(versions="1"), "", "attribute versions must be a"),
    "convention": (
        OTO,
        lambda f: f.attrs.pop("convention_depth"),
        "",
        "attribute convention_depth must be there",
    ),
    "camera": (OTO, lambda f: f.attrs.update(camera="otm"), "", "attribute camera must be oto"),
}


@pytest.mark.parametrize("case", LAYOUT_CASES)
def test_a_wrong_layout_or_attribute_is_found(out: Path, case: str) -> None:
    name, edit, group, what = LAYOUT_CASES[case]
    edit_file(out / name, edit)
    must_find(out, (name, group, None, what))


# The directory


def test_a_missing_shard_is_found(out: Path) -> None:
    (out / "shards/2_box_b/0000002-0000004.h5").unlink()
    must_find(out, ("shards/2_box_b/0000002-0000004.h5", "", None, "the shard must be there"))


def test_a_damaged_shard_is_found(out: Path) -> None:
    path = out / "shards/2_box_b/0000000-0000002.h5"
    edit_file(path, lambda f: f["trials/slip"].__setitem__(0, 0.5))
    (violation,) = check_dataset(out)
    assert "damaged or cut off" in str(violation)


def test_a_shard_of_another_unit_is_found(out: Path) -> None:
    folder = out / "shards/2_box_b"
    shard = read_shard(folder / "0000000-0000002.h5")
    write_shard(out, replace(shard, header=replace(shard.header, mesh_sha256="0")))
    must_find(out, ("shards/2_box_b/0000000-0000002.h5", "", None, "the shard must be there"))


def test_a_flipped_bit_in_a_plan_is_found(out: Path) -> None:
    path = plan_path(out, "2_box_b")
    content = bytearray(path.read_bytes())
    content[-100] ^= 1
    path.write_bytes(content)
    what = "an object's file must be as it was written"
    must_find(out, ("objects/2_box_b.plan.h5", "", None, what))


def test_objects_files_are_checked(out: Path) -> None:
    model_path(out, "3_brick").unlink()
    other = load_object(model_path(out, "1_box_a"))
    save_object(replace(other, mesh_sha256="0"), model_path(out, "1_box_a"))
    must_find(
        out,
        ("objects/3_brick.npz", "", None, "the object must be readable"),
        ("objects/3_brick.npz", "", None, "an object's file must be as it was written"),
        ("objects/1_box_a.npz", "", None, "an object's file must be as it was written"),
        ("objects/1_box_a.npz", "", None, "mesh_sha256 must be that of manifest.json"),
    )


def test_files_are_of_the_manifests_configuration(out: Path) -> None:
    manifest = read_manifest(out)
    files = (OTO, OTM, TRIALS)
    overrides = ["camera.size=32", "unit_candidates=2", "split.valid_fraction=0.34"]
    write_manifest(replace(manifest, config=load_config(overrides=overrides)), out)
    what = "filters, split and limits must be those of manifest.json"
    must_find(out, *((name, "", None, what) for name in files))
    write_manifest(replace(manifest, config=load_config(overrides=[*overrides, "seed=1"])), out)
    hits = {h for h in found(out) if not h[0].startswith("shards")}
    assert {h[0] for h in hits} == set(files)
    assert all(h[3].startswith("configuration must be that of manifest.json") for h in hits)


def test_a_truncated_file_is_found_and_the_others_are_still_checked(out: Path) -> None:
    content = (out / OTM).read_bytes()
    (out / OTM).write_bytes(content[: len(content) // 2])
    change(out, OTO, "train/images", 0, set_at(0, 0, 0, to=2.0))
    must_find(
        out,
        (OTM, "", None, "the file must be there and readable"),
        (OTO, "/train", 0, "colours must be within 0..1"),
    )
    with pytest.raises(DataError, match="cannot be read"):
        check_dataset(out / OTM)


def test_rows_that_cannot_be_read_are_found(out: Path) -> None:
    with h5py.File(out / OTO) as file:
        offset = file["train/images"].id.get_chunk_info(0).byte_offset
    with open(out / OTO, "r+b") as raw:
        raw.seek(offset)
        raw.write(b"\xff" * 64)
    must_find(out, (OTO, "/train", None, "rows 0 to 1 must be readable"))


def test_what_is_no_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"without manifest\.json"):
        check_dataset(tmp_path)
    with pytest.raises(DataError, match="must be the directory"):
        check_dataset(tmp_path / "missing.hdf5")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = [1, 2]
    with pytest.raises(DataError, match="another HDF5 file"):
        check_dataset(tmp_path / "other.h5")


def test_a_broken_invariant_is_listed_for_twenty_rows_and_then_counted(out: Path) -> None:
    with h5py.File(out / TRIALS, "r+") as file:
        file["trials/spread"][...] = np.nan
    violations = check_dataset(out / TRIALS)
    assert len(violations) == 21
    assert violations[0].row == 0
    assert str(violations[0]).startswith("trials.hdf5 /trials row 0: spread must be finite from")
    assert str(violations[-1]).endswith("got 16 more rows that break it")


def test_check_needs_neither_drake_nor_dask() -> None:
    code = (
        "import sys, drakegrasp.check\n"
        "print([m for m in ('pydrake', 'dask', 'distributed') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == []
