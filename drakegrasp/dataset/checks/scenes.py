"""Rules of scenes.hdf5: what lies on the table, what the cameras see, and the closed hands.

In: the file, and the dataset around it if there is one. Out: tasks that judge a scene each. How a
value was made is not asked: grasps are compared with their trials, pictures with the mesh and the
table, and contacts that a camera is said to see with its images.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_erosion

from drakegrasp.dataset.checks.attempts import Dataset
from drakegrasp.dataset.checks.findings import Findings, Violation, of_file
from drakegrasp.dataset.checks.images import DEPTH_TOLERANCE, MASK_TOLERANCE, P_TTABLE, TABLE_HALF
from drakegrasp.dataset.checks.layout import SCENES
from drakegrasp.dataset.checks.rows import (
    POSITION_TOLERANCE,
    AnyArray,
    Batch,
    CheckedFile,
    Rule,
    rotation,
    unit_length,
)
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.dataset.schema import DEPTH_UNIT, HOLD_FIELDS, SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import Array, invert_pose, transform_points, unpack_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.vision.camera import project, unproject

#: float32 rounds forces of some hundred newtons by 1e-5.
FORCE_TOLERANCE = 1e-3  # [N]
#: Half a step of the stored depths comes on top.
PICTURE_TOLERANCE = DEPTH_TOLERANCE + DEPTH_UNIT / 2.0  # [m]
#: Object pixels per picture whose distance from the mesh is measured.
MEASURED_PIXELS = 16
#: A contact that is seen is not so far behind all that is seen within SILHOUETTE pixels of it.
BEHIND, SILHOUETTE = 5e-3, 2  # [m], [px]
#: By how much less than the 3 mm of a hidden contact something is before it, for rounding [m].
HIDDEN = 2.5e-3
#: Outcomes after which it is unknown whether the hand holds; `table_contact` may be one of them.
UNKNOWN = (Outcome.MISSING_FINGERTIP, Outcome.HAND_CONTACT, Outcome.NOT_LIFTED, Outcome.MOVED)


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneTask:
    """A scene to judge, with its views and grasps.

    Attributes:
        files: The file, by SCENES.
        scene: Row of /scenes.
        dataset: The dataset around the file, if there is one of the same state.
    """

    files: Mapping[str, CheckedFile]
    scene: int
    dataset: Dataset | None

    @property
    def size(self) -> int:
        """Number of scenes."""
        return 1

    def judge(self, findings: Findings) -> None:
        """Apply the rules of the scene: of its place, its grasps, then of each of its views."""
        data = self.files[SCENES]
        with data.opened() as file:
            rows = {
                group: np.flatnonzero(file[group]["scene"][:] == self.scene)
                for group in ("views", "grasps")
            }
            scene = data.read(file, "scenes", np.array([self.scene]))
            grasps = data.read(file, "grasps", rows["grasps"]) if len(rows["grasps"]) else None
            model, of_grasps = None, list[Rule]([grasp_values])
            if self.dataset is not None:
                name = file["objects/name"].asstr()[int(scene["object"][0, 0])]
                model, trials = self.dataset.loader()(name), Trials(self.dataset.out)
                rule = partial(resting_scene, dataset=self.dataset, name=name)
                data.judge(scene, findings, rule)
                of_grasps.append(partial(grasps_of_trials, scene=scene, trials=trials))
            if grasps is not None:
                data.judge(grasps, findings, *of_grasps)

            views = data.batches(file, "views", rows["views"], len(rows["views"]) or 1, findings)
            for batch in views:
                seen = file["visible/view"][:]
                visible = {
                    view: data.read(file, "visible", np.flatnonzero(seen == view))
                    for view in batch.rows.tolist()
                    if (seen == view).any()
                }
                self._judge_views(batch, scene, grasps, visible, model, findings)

    def _judge_views(
        self,
        views: Batch,
        scene: Batch,
        grasps: Batch | None,
        visible: Mapping[int, Batch],
        model: ObjectModel | None,
        findings: Findings,
    ) -> None:
        """Apply the rules of the views of a scene."""
        data = self.files[SCENES]
        assert data.config is not None
        lens = data.config.scenes
        rules: list[Rule] = [
            partial(rotation, name="X_TC"),
            partial(image_values, near=lens.near, far=lens.far, objects=scene["object"].shape[1]),
        ]
        sound = data.judge(views, findings, *rules)
        pictures: list[Rule] = [table_pixels]
        if model is not None:
            pictures.append(partial(object_pixels, X_TO=scene.pose("X_TO")[0, 0], model=model))
        data.judge(sound, findings, *pictures, partial(seen_contacts, of=visible, grasps=grasps))


def scene_tasks(data: CheckedFile, dataset: Dataset | None) -> Iterator[SceneTask]:
    """Yield the tasks that judge all scenes; none if a group cannot be read."""
    if data.config is not None and len(data.counts) == len(data.fields):
        for scene in range(data.counts["scenes"]):
            yield SceneTask(files={SCENES: data.for_task()}, scene=scene, dataset=dataset)


def other_state(data: CheckedFile, out: Path) -> Iterator[Violation]:
    """The file is of the trials that are there."""
    of = Trials(out).attributes
    for key in ("shards", "signature"):
        if str(data.attributes.get(key)) != str(of.get(key)):
            what = f"attribute {key} must be that of {TRIALS_FILE}"
            yield of_file(data.name, what, "another; run `drakegrasp scenes` again")
            return


def tables(data: CheckedFile, groups: Mapping[str, str]) -> Iterator[Violation]:
    """No object is in two splits; each view has a row for each grasp of its scene, in order.

    Args:
        data: The file, with all of its groups.
        groups: Of each object what it shares with others of its mesh.
    """
    with data.opened() as file:
        columns = {
            (group, name): file[group][name][:]
            for group, names in {
                "scenes": ("split", "object"),
                "views": ("scene",),
                "grasps": ("scene",),
                "visible": ("view", "grasp"),
            }.items()
            for name in names
        }
        names = file["objects/name"].asstr()[:].tolist()

    # Numbers of rows that exist.
    for (group, name), of in {
        ("scenes", "object"): "objects",
        ("views", "scene"): "scenes",
        ("grasps", "scene"): "scenes",
    }.items():
        values = columns[group, name]
        if ((values < 0) | (values >= data.counts[of])).any():
            yield of_file(data.name, f"{name} must be rows of /{of}", "others", f"/{group}")
            return
    split, objects = columns["scenes", "split"], columns["scenes", "object"]
    if (split >= len(SPLITS)).any():
        yield of_file(data.name, "split must be 0, 1 or 2", split.max(), "/scenes")

    # Splits, by the groups of the objects.
    home: dict[str, int] = {}
    for own, number in zip(objects.tolist(), split.tolist(), strict=True):
        for name in (names[i] for i in own):
            if home.setdefault(groups.get(name, name), number) != number:
                what = "an object and its group must be in one split"
                yield of_file(data.name, what, f"{name} in two", "/scenes")

    # /visible.
    due = [
        np.column_stack([np.full(len(own), view), own])
        for view, scene in enumerate(columns["views", "scene"].tolist())
        if len(own := np.flatnonzero(columns["grasps", "scene"] == scene))
    ]
    got = np.column_stack([columns["visible", "view"], columns["visible", "grasp"]])
    if not np.array_equal(got, np.concatenate([*due, np.zeros((0, 2), dtype=np.int64)])):
        what = "rows must be each view with each grasp of its scene, in order"
        yield of_file(data.name, what, "others", "/visible")


# Scenes and grasps


def resting_scene(scene: Batch, dataset: Dataset, name: str) -> Iterator[Violation]:
    """The object rests as the manifest says, but for a turn about Tz and a place on the table."""
    entry = next(entry for entry in dataset.manifest.objects if entry.name == name)
    resting = int(scene["resting"][0, 0])
    known = resting < len(entry.resting)
    yield from scene.broken(
        "resting must be one of its object's", np.array([not known]), scene["resting"][:, 0]
    )
    if known:
        # Upright direction and height stay.
        due = np.array(entry.resting[resting].X_TO)[8:]
        off = np.abs(scene["X_TO"][:, 0, 8:] - due).max(axis=1)
        what = "X_TO must be the object's resting pose, turned about Tz and moved on the table"
        yield from scene.broken(what, off > POSITION_TOLERANCE, off)
    off = np.abs(scene["mass"][:, 0] - entry.mass)
    yield from scene.broken("mass must be the object's [kg]", off > 0.0, scene["mass"][:, 0])


def grasp_values(grasps: Batch) -> Iterator[Violation]:
    """Normals have length one; labels follow from the outcome."""
    for name in ("nhat_Q_T", "nhat_Q_T_held"):
        lengths = np.linalg.norm(grasps[name].astype(float), axis=2)
        yield from unit_length(grasps, np.where(np.isnan(lengths), 1.0, lengths), f"{name} of")
    held, outcome = grasps["held"], grasps["outcome"]
    wrong = held != (outcome == Outcome.SUCCESS)
    yield from grasps.broken("held must be that of a success", wrong, outcome)
    wrong = grasps["tested"] & np.isin(outcome, UNKNOWN)
    wrong |= held & ~grasps["tested"]
    yield from grasps.broken("tested must be that of a lift to a verdict", wrong, outcome)
    for name in ("precision", "stable", "sample"):
        what = f"{name} must be that of a grasp that holds"
        yield from grasps.broken(what, grasps[name] & ~held, grasps[name])


def grasps_of_trials(grasps: Batch, scene: Batch, trials: Trials) -> Iterator[Violation]:
    """Palms, joints, contacts, forces and labels are those of the trials, put into the scene."""
    ids = grasps["trial_id"]
    unknown = (ids < 0) | (ids >= len(trials))
    yield from grasps.broken("trial_id must be a row of trials.hdf5", unknown, ids)
    grasps = grasps.where(~unknown)
    if not len(grasps):
        return
    names = ("X_OG", "X_OG_lifted", "time_lift", "outcome", "removal", "closed_q", "lifted_q")
    contacts = ("p_OQ", "nhat_Q_O", "f_Q_O")
    stored = [f"{when}_{name}" for when in ("closed", "lifted") for name in contacts]
    repeats = [field.name for field in HOLD_FIELDS]
    own = trials[grasps["trial_id"]].columns([*names, *stored, *repeats])

    X_TO = unpack_pose(scene["X_TO"][0, 0])
    of = "its trial and the pose of the object"
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_held", "lifted", "X_OG_lifted")):
        points, normals, forces = (own[f"{when}_{name}"] for name in contacts)
        due = {
            "X_TG": (X_TO @ unpack_pose(own[X_OG]))[:, :3].reshape(-1, 12),
            "p_TQ": points @ X_TO[:3, :3].T + X_TO[:3, 3],
            "nhat_Q_T": normals @ X_TO[:3, :3].T,
            "f_Q_T": forces @ X_TO[:3, :3].T,
            "q": own[f"{when}_q"],
        }
        for name, values in due.items():
            tolerance = FORCE_TOLERANCE if name == "f_Q_T" else POSITION_TOLERANCE
            yield from grasps.follows(f"{name}{suffix}", values, of, tolerance)
    lifted = np.isfinite(own["time_lift"]) & (own["outcome"] != Outcome.MOVED)
    yield from grasps.follows("outcome", own["outcome"], of)
    yield from grasps.follows("tested", lifted, "its trial's lift")
    yield from grasps.follows("sample", own["removal"] == Removal.KEPT, "/successes")
    for name in repeats:
        yield from grasps.follows(name, own[name], of)


# Views


def image_values(views: Batch, near: float, far: float, objects: int) -> Iterator[Violation]:
    """Depths are 0 or within near..far; masks name objects of the scene, and these have depths."""
    depth = views["depth"].reshape(len(views), -1) * DEPTH_UNIT
    mask = views["mask"].reshape(len(views), -1)
    low, high = np.where(depth > 0.0, depth, far).min(axis=1), depth.max(axis=1)
    bad = (low < near - DEPTH_UNIT) | (high > far + DEPTH_UNIT)
    what = f"depths must be 0 or within {near:g}..{far:g} m"
    yield from views.broken(what, bad, lambda i: f"{low[i]:.4g}..{high[i]:.4g}")
    yield from views.broken(
        "mask must be 0 to the number of objects", mask.max(axis=1) > objects, mask.max(axis=1)
    )
    yield from views.broken(
        "pixels of an object must have a depth",
        ((mask > 0) & (depth == 0.0)).any(axis=1),
        lambda i: "0",
    )


def table_pixels(views: Batch) -> Iterator[Violation]:
    """Pixels beside the mask that have a depth show the table."""
    off = np.zeros(len(views))
    for i in range(len(views)):
        p_TQ = _points(views, i, (views["mask"][i] == 0) & (views["depth"][i] > 0))
        outside = np.abs(p_TQ - P_TTABLE) - TABLE_HALF
        distance = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
        distance += np.abs(np.minimum(outside.max(axis=1, initial=-np.inf), 0.0))
        off[i] = distance.max(initial=0.0)
    what = f"points beside the mask must be on the table within {PICTURE_TOLERANCE:g} m"
    yield from views.broken(what, off > PICTURE_TOLERANCE, off)


def object_pixels(views: Batch, X_TO: Array, model: ObjectModel) -> Iterator[Violation]:
    """Some pixels inside the border of the mask are on the object's mesh."""
    chosen, owner = [], []
    for i in range(len(views)):
        inside = binary_erosion(views["mask"][i] == 1, np.ones((3, 3)), border_value=1)
        p_TQ = _points(views, i, inside)
        if len(p_TQ):
            measured = np.linspace(0, len(p_TQ) - 1, MEASURED_PIXELS).astype(int)
            chosen.append(transform_points(invert_pose(X_TO), p_TQ[measured]))
            owner.append(i)
    if not chosen:
        return
    _, distance, _ = model.visual.nearest.on_surface(np.concatenate(chosen))
    off = np.zeros(len(views))
    off[owner] = distance.reshape(len(owner), -1).max(axis=1)
    what = f"points in the mask must be on the object's mesh within {PICTURE_TOLERANCE:g} m"
    yield from views.broken(what, off > PICTURE_TOLERANCE, off)


def seen_contacts(
    views: Batch, of: Mapping[int, Batch], grasps: Batch | None
) -> Iterator[Violation]:
    """Contacts that are seen are on the mask and not behind all around; others have their cause."""
    beside, behind, open_ = np.zeros((3, len(views)))
    for i, view in enumerate(views.rows.tolist()):
        if view not in of or grasps is None:
            continue
        X_TC, seen = unpack_pose(views["X_TC"][i]), of[view]["visible"].ravel()
        p_TQ, nhat = (grasps[name].astype(float).reshape(-1, 3) for name in ("p_TQ", "nhat_Q_T"))
        p_CQ = transform_points(invert_pose(X_TC), p_TQ)
        pixels = project(views["K"][i].reshape(3, 3), p_CQ)
        depth, (v, u) = views["depth"][i] * DEPTH_UNIT, np.nonzero(views["mask"][i])
        for k in np.flatnonzero(seen):
            apart = np.hypot(u - pixels[k, 0], v - pixels[k, 1]).min(initial=np.inf)
            beside[i] = max(beside[i], apart) if np.isfinite(p_CQ[k]).all() else np.inf
            if apart <= MASK_TOLERANCE:
                farthest = _around(depth, pixels[k]).max()
                behind[i] = max(behind[i], p_CQ[k, 2] - farthest if farthest else 0.0)

        # What is hidden, though in the image and turned to the camera, has something before it, or
        # is no place on the object.
        facing = np.einsum("ij,ij->i", nhat, X_TC[:3, 3] - p_TQ) > POSITION_TOLERANCE
        edge = np.array(depth.shape[::-1]) - 2.0
        inside = ((pixels > 1.0) & (pixels < edge)).all(axis=1) & (p_CQ[:, 2] > 0.0)
        hidden = ~seen & facing & inside
        column, row = np.rint(pixels[hidden]).astype(int).T
        before = (depth[row, column] > 0.0) & (depth[row, column] < p_CQ[hidden, 2] - HIDDEN)
        in_sight = [np.hypot(u - x, v - y).min(initial=np.inf) for x, y in pixels[hidden][~before]]
        open_[i] = np.count_nonzero(np.array(in_sight) <= MASK_TOLERANCE)
    what = f"visible contacts must project within {MASK_TOLERANCE:g} px of the mask"
    yield from views.broken(what, beside > MASK_TOLERANCE, beside)
    what = f"visible contacts must not be more than {BEHIND:g} m behind all around them"
    yield from views.broken(what, behind > BEHIND, behind)
    what = f"hidden contacts that face the camera must have something {HIDDEN:g} m before them"
    yield from views.broken(what, open_ > 0, lambda i: f"{open_[i]:.0f} without")


def _around(depth: AnyArray, pixel: Array) -> AnyArray:
    """Return the depths within SILHOUETTE pixels of a pixel (2,), clipped into the image."""
    height, width = depth.shape
    u, v = np.clip(np.rint(pixel), 0, [width - 1, height - 1]).astype(int)
    low = np.maximum([v - SILHOUETTE, u - SILHOUETTE], 0)
    return depth[low[0] : v + SILHOUETTE + 1, low[1] : u + SILHOUETTE + 1]


def _points(views: Batch, i: int, chosen: AnyArray) -> Array:
    """Return the points p_TQ (m, 3) [m] of the pixels of a view where `chosen` (h, w) is true."""
    v, u = np.nonzero(chosen)
    depth = views["depth"][i][v, u] * DEPTH_UNIT
    p_CQ = unproject(views["K"][i].reshape(3, 3), np.column_stack([u, v]), depth)
    X_TC = unpack_pose(views["X_TC"][i])
    return np.asarray(p_CQ @ X_TC[:3, :3].T + X_TC[:3, 3])
