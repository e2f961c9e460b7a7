"""A small dataset of boxes that is sound by construction, and ways to spoil it.

Nothing in it agrees by coincidence: the boxes lie on their side, turned about the vertical, and no
quantity of the closed hand is that of the lifted one.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

import h5py
import numpy as np
import trimesh

from drakegrasp.config import MOST_PALMS, CameraConfig, Config
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import (
    DIGEST,
    Manifest,
    installed_versions,
    manifest_digest,
    write_manifest,
)
from drakegrasp.dataset.paths import MANIFEST_FILE
from drakegrasp.dataset.prepared_objects import PreparedObject, save_prepared
from drakegrasp.dataset.schema import LOOK_FIELDS, sizes
from drakegrasp.dataset.shards import Shard, ShardHeader, trial_columns, write_shard
from drakegrasp.frames import Array, invert_pose, make_pose, pack_pose, rotation_about, unpack_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel, prepare_object
from drakegrasp.objects.sources import MeshSource
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.runtime.files import SEAL_SIZE, seal
from drakegrasp.simulation.attempt import draw_conditions
from drakegrasp.simulation.candidates import Candidates
from drakegrasp.vision.camera import (
    camera_pose_otm,
    camera_pose_oto,
    image_frame,
    intrinsics,
    spoil_depth,
)

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
SUCCESS, MISSING, BELOW, SLIPPED, HAND, AFTER_LIFT = 0, 1, 2, 4, 6, 10


#: By how much every lifted object moved in the hand [m].
SLIP = 2e-3
#: Of the hand above the table on its way [m].
CLEARANCE = 5e-3


SIZES = sizes(fingers=3, joints=8, image=32)


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


def lying(model: ObjectModel) -> Array:
    """Return the pose X_TO of a box on its side, yawed by 30 degrees: its y axis points up."""
    R_TO = rotation_about([0, 0, 1], np.pi / 6.0) @ rotation_about([1, 0, 0], np.pi / 2.0)
    return make_pose(R_TO, [0.0, 0.0, model.half_extents[1]])


def contacts(
    model: ObjectModel, touching: np.ndarray, z: float = 0.0, load: float = 1.0
) -> dict[str, Any]:
    """Return contacts of three fingertips in the middle of three sides, or above it [m].

    `load` scales forces, areas and depths.
    """
    x, y, _ = model.half_extents
    n = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0]])
    gone = ~touching[:, None]
    return {
        "touching": touching,
        "p_OQ": np.where(gone, np.nan, n * [[x], [x], [y]] + [0.0, 0.0, z]),
        "nhat_Q_O": np.where(gone, np.nan, n),
        "f_Q_O": np.where(gone, 0.0, -10.0 * load * n),
        "area": np.where(touching, 1e-5 * load, 0.0),
        "penetration": np.where(touching, 1e-4 * load, 0.0),
        "q": np.full(SIZES["j"], 0.5),
    }


def hold(row: dict[str, Any]) -> dict[str, Any]:
    """Return how an attempt holds: the object slides along the palm and turns about its axis."""
    turn = make_pose(rotation_about([0, 0, 1], np.deg2rad(1.0)), [0.0, 0.0, SLIP])
    success = row["outcome"] is Outcome.SUCCESS
    return {
        "X_OG_lifted": pack_pose(unpack_pose(row["X_OG"]) @ invert_pose(turn)),
        "slip": SLIP,
        "turn": np.deg2rad(1.0),
        "slip_released": SLIP / 2,
        "turn_released": np.deg2rad(0.5),
        "precision": success,
        "stable": success,
    }


def trial_row(model: ObjectModel, number: int, X_TO: Array, config: Config) -> dict[str, Any]:
    """Return what `/trials` says of an attempt, by its number among the object's."""
    outcome = OUTCOMES[number]
    # The palm is above the box, turned about the vertical and tilted.
    yaw, tilt, height = 0.5 * number, 0.25, 0.10 + X_TO[2, 3]
    R_TG = (
        trimesh.transformations.rotation_matrix(yaw, [0, 0, 1])
        @ trimesh.transformations.rotation_matrix(np.pi + tilt, [1, 0, 0])
    )[:3, :3]
    X_TG = make_pose(R_TG, X_TO[:3, 3] - height * R_TG[:, 2])
    row: dict[str, Any] = {
        "candidate": number // 3,
        "standoff_index": number % 3,
        "spread": 0.1,
        "seed": 7,
        "outcome": outcome,
        "X_TO": pack_pose(X_TO),
        "X_OG": pack_pose(invert_pose(X_TO) @ X_TG),
        **draw_conditions(model, config, number // 3, number % 3).values(),
    }
    after_lift = number == AFTER_LIFT
    stage = Stage.TRIED if after_lift else outcome.stage
    touch = np.array([True, True, outcome is not Outcome.MISSING_FINGERTIP])
    clearance = np.nan if config.close.scrape_depth is None else CLEARANCE
    if stage >= Stage.CLOSED:
        row |= {f"closed_{k}": v for k, v in contacts(model, touch).items()}
        row |= {"time_close": 1.0, "clearance_close": clearance}
        row |= {"closed_other_links": outcome is Outcome.HAND_CONTACT}
        row["closed_hand_on_table"] = outcome is Outcome.TABLE_CONTACT and not after_lift
    if stage >= Stage.TRIED:
        touch = touch & (outcome is not Outcome.DROPPED)
        touch[0] &= outcome is not Outcome.SLIPPED
        row |= {f"lifted_{k}": v for k, v in contacts(model, touch, SLIP, 1.25).items()}
        row["lifted_q"] = np.full(SIZES["j"], 0.6)
        row |= {"time_lift": 1.0, "clearance_lift": clearance}
        # A grasp that slipped holds nothing; in the air it would be partly held.
        row["lifted_object_on_table"] = after_lift or outcome is Outcome.SLIPPED
        row |= {"surface_distance": np.zeros(3), "normal_angle": np.zeros(3), **hold(row)}
        raised = make_pose(np.eye(3), [0.0, 0.0, 0.25]) @ X_TG
        row["X_TO_lifted"] = pack_pose(raised @ invert_pose(unpack_pose(row["X_OG_lifted"])))
    if outcome is Outcome.SUCCESS and config.robustness.repeats:
        row |= {"robust_tried": config.robustness.repeats, "robust_kept": 3}
    # A quantity that has no story here is 1, from its stage on.
    told = {
        f.name: 1.0
        for f in trial_columns()
        if f.dtype == "float64" and f.stage <= stage and not f.some
    }
    return {**told, **row} if stage > Stage.PLACED else row


def make_shard(model: ObjectModel, header: ShardHeader, X_TO: Array, config: Config) -> Shard:
    camera = config.camera
    numbers = range(3 * header.start, 3 * header.stop)
    rows = [trial_row(model, number, X_TO, config) for number in numbers]
    trials = {f.name: f.empty(len(rows), SIZES) for f in trial_columns()}
    for i, row in enumerate(rows):
        for name, value in row.items():
            trials[name][i] = value
    hits = [i for i, row in enumerate(rows) if row["outcome"] is Outcome.SUCCESS]
    looks = {f.name: f.empty(len(hits), SIZES) for f in LOOK_FIELDS}
    for k, i in enumerate(hits):
        looks["row"][k] = i
        X_TG = X_TO @ unpack_pose(trials["X_OG"][i])
        drawn, K = draw_conditions(model, config, *divmod(numbers[i], 3)), intrinsics(camera)
        poses = {"oto": camera_pose_oto, "otm": camera_pose_otm}
        for c, (name, pose) in enumerate(poses.items()):
            X_TC = pose(X_TG, camera, drawn.X_C0C)
            image, mask = see(model, X_TO, X_TC, camera)
            if name == "otm":
                looks["X_CI_otm"][k] = pack_pose(image_frame(K, mask, image[3]))
            image[3] = spoil_depth(image[3], K, drawn.sensor, c, camera)
            looks[f"image_{name}"][k], looks[f"mask_{name}"][k] = image, mask
            looks[f"X_TC_{name}"][k] = pack_pose(X_TC)
    return Shard(header=header, trials=trials, looks=looks)


def resting(model: ObjectModel, X_TO: Array) -> PreparedObject:
    """An object on the table, with four palm poses that nobody looks at."""
    candidates = Candidates(
        X_OG=np.tile(np.eye(4), (4, 1, 1)),
        distance=np.full(4, np.nan),
        resting=np.zeros(4, dtype=np.int64),
        source=np.zeros(4, dtype=np.int64),
        spread=np.full(4, np.nan),
        preshape_index=np.full(4, -1),
    )
    return PreparedObject(
        model=model,
        resting_poses=X_TO[None],
        probability=np.ones(1),
        table_force=np.full(1, 9.81),
        stopped=np.zeros(1, dtype=bool),
        candidates=candidates,
        asked=MOST_PALMS,
    )


#: Datasets that this process has made, with their meshes, and where: a copy takes milliseconds.
_KEPT = TemporaryDirectory(prefix="datasets-")


#: With these values all columns are there.
REPEATED = ("robustness.repeats=4",)


def make_dataset(out: Path, meshes: Path, *, overrides: Iterable[str] = ()) -> Path:
    """Write the small dataset, with some values of the configuration, and its meshes."""
    kept_out, kept_meshes = _made(tuple(overrides), tuple(BOXES))
    shutil.copytree(kept_out, out, dirs_exist_ok=True)
    shutil.copytree(kept_meshes, meshes, dirs_exist_ok=True)
    return out


@cache
def _made(overrides: tuple[str, ...], names: tuple[str, ...]) -> tuple[Path, Path]:
    folder = Path(mkdtemp(dir=_KEPT.name))
    (folder / "meshes").mkdir()
    return _make(folder / "out", folder / "meshes", overrides), folder / "meshes"


def _make(out: Path, meshes: Path, overrides: tuple[str, ...]) -> Path:
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
        X_TO = lying(model)
        prepared = resting(model, X_TO)
        save_prepared(prepared, out, config)
        entries.append(prepared.entry())
        models.append((model, X_TO))
    manifest = Manifest(config=config, objects=tuple(entries), versions=installed_versions(config))
    write_manifest(manifest, out)
    by_name = {model.name: (model, X_TO) for model, X_TO in models}
    for header in manifest.headers():
        model, X_TO = by_name[header.object_name]
        write_shard(out, make_shard(model, header, X_TO, config))
    assemble(out)
    return out


def end_lift(out: Path, row: int, slip: float) -> None:
    """Let the lift of a row of /trials be one that was ended, after the object slid so far."""
    with h5py.File(out / TRIALS, "r+") as file:
        trials = file["trials"]
        turn = make_pose(rotation_about([0, 0, 1], np.deg2rad(1.0)), [0.0, 0.0, slip])
        X_OG = unpack_pose(trials["X_OG"][row])
        trials["X_OG_lifted"][row] = pack_pose(X_OG @ invert_pose(turn))
        trials["slip"][row], trials["outcome"][row] = slip, Outcome.MOVED


Edit = Callable[[np.ndarray], Any]


def change(out: Path, name: str, dataset: str, row: int, edit: Edit) -> None:
    """Replace a row of a dataset by what `edit` makes of it; no edit in place."""

    def replace(file: h5py.File) -> None:
        values = file[dataset][row]
        file[dataset][row] = edit(np.array(values) if not isinstance(values, bytes) else values)

    edit_file(out / name, replace)


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


def mirrored(values: np.ndarray) -> np.ndarray:
    return pack_pose(unpack_pose(values) @ np.diag([1.0, 1.0, -1.0, 1.0]))


def found(out: Path) -> set[tuple[str, str, int | None, str]]:
    return {(v.file, v.group, v.row, v.what) for v in check_dataset(out)}


def must_find(out: Path, *expected: tuple[str, str, int | None, str], of: str = "") -> None:
    """Require exactly these violations: file, group, row, and how the text begins.

    With `of`, those of this file alone: what follows from them in others is not looked at.
    """
    hits = {hit for hit in found(out) if of in ("", hit[0])}
    missing = [
        e for e in expected if not any(h[:3] == e[:3] and h[3].startswith(e[3]) for h in hits)
    ]
    extra = [h for h in hits if not any(h[:3] == e[:3] and h[3].startswith(e[3]) for e in expected)]
    assert not missing and not extra, f"missing {missing}, extra {extra}"


def edit_manifest(out: Path, edit: Callable[[dict[str, Any]], Any]) -> None:
    """Change what a manifest says, as if it had been written so."""
    tree = json.loads((out / MANIFEST_FILE).read_bytes())
    edit(tree)
    tree[DIGEST] = manifest_digest(tree)
    (out / MANIFEST_FILE).write_text(json.dumps(tree))


def edit_file(path: Path, edit: Callable[[h5py.File], Any]) -> None:
    """Edit a file, and seal it again if it was sealed: its writer is wrong, not its disk."""
    with h5py.File(path, "r+") as file:
        edit(file)
        sealed = file.userblock_size == SEAL_SIZE
    if sealed:
        seal(path)
