"""Rows of scenes: grasps as they follow from trials, and views as rows of a data file.

Predictions for such views are verified and scored as those for samples.

In: scenes.hdf5, in the directory of its dataset. Out: a `GraspDataset` whose rows are the views of
scenes that have a sample. Imports h5py and NumPy only.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.opening import opened, refuse_other_codes
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneDataset
from drakegrasp.dataset.schema import SCENE_GRASP_FIELDS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.frames import X_WT, invert_pose, pack_pose, unpack_pose
from drakegrasp.grasp import pack_grasp
from drakegrasp.outcomes import LOST, Outcome
from drakegrasp.seeding import Stream

Columns = dict[str, AnyArray]

#: Outcomes of lifts to a verdict; `table_contact` after closing is not one.
LIFTED = (Outcome.SUCCESS, *LOST, Outcome.TABLE_CONTACT)
#: Fields of /grasps that are columns of /trials, by their names here.
_COPIED = {f.name: f.of for f in SCENE_GRASP_FIELDS if f.of} | {
    name: name for name in ("trial_id", "outcome", "precision", "stable", "preshape", "unused")
}
#: Columns of /trials that grasps of scenes follow from.
GRASPS_FOLLOW_FROM = (
    *dict.fromkeys(_COPIED.values()),
    *("candidate", "standoff_index", "child", "resting", "spread", "time_lift"),
    *("X_OG", "X_OG_lifted"),
    *(f"{when}_{name}" for when in ("closed", "lifted") for name in ("p_OQ", "nhat_Q_O", "f_Q_O")),
)
#: The camera of such rows.
CAMERA = "view"
#: First number of the place of the streams that choose own grasps.
_OWN = 4


def open_rows(path: Path, *, split: str, fewer_fingers: bool = False) -> GraspDataset:
    """Return a split of a data file, or of scenes.hdf5, by what the file holds.

    Args:
        path: The file.
        split: Its split.
        fewer_fingers: Whether a data file may have samples that leave fingers out.

    Raises:
        DataError: See `GraspDataset` and `SceneDataset`.
    """
    with opened(path, "a data file or scenes of drakegrasp") as file:
        of_scenes = "scenes" in file
    if of_scenes:
        return SceneRows(path, split=split)
    return GraspDataset(path, split=split, fewer_fingers=fewer_fingers)


def grasps_of_trials(trials: Mapping[str, AnyArray], X_TO: Array, weights: Array) -> Columns:
    """Return the columns of /grasps that follow from trials, put where their objects lie.

    Args:
        trials: Columns of n trials, by GRASPS_FOLLOW_FROM.
        X_TO: Poses of their objects in the scenes, (n, 4, 4).
        weights: (n,), of those that are samples, NaN of others.
    """
    outcome, R_OT = trials["outcome"], np.swapaxes(X_TO[:, :3, :3], 1, 2)
    columns = {name: trials[of] for name, of in _COPIED.items()}
    columns |= {
        "tested": np.isin(outcome, LIFTED) & np.isfinite(trials["time_lift"]),
        "held": outcome == Outcome.SUCCESS,
        "sample": np.isfinite(weights),
        "weight": np.nan_to_num(weights),
    }
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_held", "lifted", "X_OG_lifted")):
        columns[f"X_TG{suffix}"] = pack_pose(multiply(X_TO, unpack_pose(trials[X_OG])))
        points, normals, forces = (trials[f"{when}_{n}"] for n in ("p_OQ", "nhat_Q_O", "f_Q_O"))
        columns[f"p_TQ{suffix}"] = multiply(points, R_OT) + X_TO[:, None, :3, 3]
        columns[f"nhat_Q_T{suffix}"] = multiply(normals, R_OT)
        columns[f"f_Q_T{suffix}"] = multiply(forces, R_OT)
    return columns


class SceneRows(GraspDataset):
    """The views of a split as rows; what scoring and verification ask of `GraspDataset` is there.

    A row is a view of a scene that has a sample, in the order of `SceneDataset.views` with
    `negatives="none"`. Its own grasp is one of these samples, drawn by their weights. All is in the
    view's camera frame. Verdicts are of the object where it rested in its trials, so the camera
    (`frame_work2cam_view`) is turned and moved back with it.

    Args:
        path: OUT/scenes.hdf5; OUT/trials.hdf5 must be beside it.
        split: `train`, `valid` or `test`.

    Attributes:
        views: (n,), rows of /views.

    Raises:
        DataError: If a file is missing or damaged, they are not of one state, or a sample leaves
            fingers out.
    """

    def __init__(self, path: str | Path, *, split: str = "train") -> None:
        self.path, self.split, self.camera = Path(path), split, CAMERA
        self._file: h5py.File | None = None
        self._fields, self._process = {}, -1
        self._data = data = SceneDataset(
            path, points=None, split=split, negatives="none", balance="view", grasps=1
        )
        self.views = data.views
        self._length = len(self.views)

        # An own grasp of each view, and its trial.
        trials, ids = Trials(self.path.parent), np.zeros(self._length, dtype=np.int64)
        refuse_other_state(self.path, trials)
        grasps = []
        for i, view in enumerate(self.views.tolist()):
            own = data.grasp_of(view, Stream(0, _OWN, view))
            ids[i] = own["trial_id"][0]
            grasps.append(pack_grasp(own["p_AQ"][0], own["nhat_Q_A"][0]))
        refuse_other_codes(self.path, "/grasps/trial_id", ids, len(trials))
        numbers = 6 * data.tables["grasps"]["p_TQ"].shape[1]
        packed = np.array(grasps, dtype=np.float32).reshape(-1, numbers)
        if not np.isfinite(packed).all():
            raise DataError(
                f"{path}: {split} must have contacts of all fingers, got samples that leave some "
                "out: commands need a hand whose preshapes close all fingers"
            )

        views = data.tables["views"]
        scene = views["scene"][self.views]
        objects = data.tables["scenes"]["object"][scene, 0]
        trial = trials[ids].columns(("X_TO", "mass", "friction_hand", "friction_table"))
        # Where the camera would be if the object had stayed where it rested.
        X_TO = unpack_pose(trial["X_TO"])
        X_OC = multiply(
            invert_pose(unpack_pose(data.tables["scenes"]["X_TO"][scene, 0])),
            unpack_pose(views["X_TC"][self.views]),
        )
        self._columns: dict[str, npt.NDArray[Any]] = {
            "grasps": packed,
            "trial_id": ids,
            "grasp_props/resting": data.tables["scenes"]["resting"][scene, 0],
            "object_props/object_name": np.array(data.names, dtype=object)[objects],
            "object_props/class_name": np.array(data.classes, dtype=object)[objects],
            "object_props/work2mass": trial["mass"][:, None],
            f"object_props/frame_work2cam_{CAMERA}": pack_pose(multiply(X_TO, X_OC)),
            "object_props/frame_world2work": np.tile(pack_pose(X_WT), (self._length, 1)),
            "object_props/frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
            "conditions/friction_hand": trial["friction_hand"],
            "conditions/friction_table": trial["friction_table"],
        }

        # All cameras have one lens.
        self.K = views["K"][0].reshape(3, 3)
        digest = hashlib.sha256(str(trials.attributes["signature"]).encode())
        for values in (ids, self.views, views["X_TC"][self.views]):
            digest.update(np.ascontiguousarray(values).tobytes())
        self.content = digest.hexdigest()

    def column(self, name: str) -> npt.NDArray[Any]:
        """Return all rows (n, ...) of a field that scoring needs.

        Raises:
            DataError: If there is no such field; images are read one by one.
        """
        if name not in self._columns:
            known = ", ".join(self._columns)
            raise DataError(f"field of a row of scenes must be one of {known}, got {name!r}")
        return self._columns[name]

    def rows(self, name: str, start: int, stop: int) -> npt.NDArray[Any]:
        """Return the rows `start` to `stop` - 1 of a field, see `column`."""
        return self.column(name)[start:stop]

    def value(self, name: str, row: int) -> Any:
        """Return a field of one row; `images` (4, h, w) and `masks` (h, w) as in data files.

        Raises:
            DataError: See `column`.
        """
        if name not in ("images", "masks"):
            return self.column(name)[row]
        seen = self._data.images(int(self.views[row]))
        if name == "masks":
            return (seen["mask"] > 0).astype(np.uint8)
        depth = np.where(seen["depth"] > 0.0, seen["depth"], np.float32(self._data.far))
        colour = np.moveaxis(seen["rgb"], 2, 0) / np.float32(255.0)
        return np.concatenate([colour, depth[None]])


def refuse_other_state(path: Path, trials: Trials) -> None:
    """Refuse a scenes.hdf5 that was made of other trials.

    Raises:
        DataError: If it was, or it cannot be read.
    """
    with opened(path, "the scenes of a dataset") as file:
        for key in ("shards", "signature"):
            if str(file.attrs.get(key)) != str(trials.attributes.get(key)):
                raise DataError(
                    f"{path}: must be of the trials beside it, got one of others; run "
                    "`drakegrasp scenes` again"
                )
