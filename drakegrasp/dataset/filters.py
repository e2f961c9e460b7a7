"""The paper's postprocessing: which successes become samples, and in which split.

Pure functions of arrays. A filter removes a grasp from the two data files, never from
trials.hdf5; every removal has one reason, the first that applies (Veres et al.,
"Postprocessing").
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt

from drakegrasp.config import FilterConfig, SplitConfig
from drakegrasp.frames import Array
from drakegrasp.seeding import Stream, object_key


class Removal(IntEnum):
    """Why a success is not a sample; the order is the order of the filters."""

    KEPT = 0
    NOT_SEEN = 1  # the object is in neither or only one image
    OUT_OF_VIEW = 2  # a contact point lies outside of an image
    BISECTS_TABLE = 3  # the camera is at the table's height or below it
    FLAT_DEPTH = 4  # the otm depth image varies too little
    OFF_SURFACE = 5  # a contact's centre is off the surface: patches on both sides of an edge
    OUTLIER = 6  # a component is beyond the limit of its object's population
    REJECTED = 7  # on the reject list from inspection

    @property
    def label(self) -> str:
        """The name as written in tables."""
        return self.name.lower()


@dataclass(frozen=True, kw_only=True, eq=False)
class Successes:
    """What the filters know of n successes.

    Attributes:
        trial_id: (n,) int64.
        object: (n,) int32, index of the object.
        grasp_T: (n, 6k), grasps in the table-top frame [m, -].
        seen: (n,) bool, whether both masks have object pixels.
        in_view: (n,) bool, whether all contacts project into both images.
        camera_height: (n,), of the cameras above the table [m].
        depth_variance: (n,), of the otm depth image [m^2].
        surface_distance: (n,), largest of the contacts' distances from the surface [m].
        certified_share, certified_friction: (n,), see the schema; no filter asks for them.
    """

    trial_id: npt.NDArray[np.int64]
    object: npt.NDArray[np.int32]
    grasp_T: Array
    seen: npt.NDArray[np.bool_]
    in_view: npt.NDArray[np.bool_]
    camera_height: Array
    depth_variance: Array
    surface_distance: Array
    certified_share: Array
    certified_friction: Array


def judge_successes(
    successes: Successes, config: FilterConfig, rejected: Sequence[int] = ()
) -> npt.NDArray[np.uint8]:
    """Return the `Removal` (n,) of each success."""
    removal = np.full(len(successes.trial_id), Removal.KEPT, dtype=np.uint8)
    for reason, bad in (
        (Removal.NOT_SEEN, ~successes.seen),
        (Removal.OUT_OF_VIEW, ~successes.in_view),
        (Removal.BISECTS_TABLE, successes.camera_height < config.min_camera_height),
        (Removal.FLAT_DEPTH, successes.depth_variance < config.min_depth_variance),
        # A mean normal of zero length, from patches that oppose each other, is not finite.
        (Removal.OFF_SURFACE, ~np.isfinite(successes.grasp_T).all(axis=1)),
        (Removal.OFF_SURFACE, successes.surface_distance > config.max_surface_distance),
    ):
        removal[bad & (removal == Removal.KEPT)] = reason
    kept = removal == Removal.KEPT
    if config.outlier_sigma > 0.0:
        for index in np.unique(successes.object[kept]):
            rows = np.flatnonzero(kept & (successes.object == index))
            outside = is_outlier(successes.grasp_T[rows], config.outlier_sigma)
            removal[rows[outside]] = Removal.OUTLIER
    listed = np.isin(successes.trial_id, np.asarray(rejected, dtype=np.int64))
    removal[listed & (removal == Removal.KEPT)] = Removal.REJECTED
    return removal


def is_outlier(values: Array, sigma: float) -> npt.NDArray[np.bool_]:
    """Return for rows (n, d) whether any component is beyond sigma deviations of its mean.

    A population of n has no component beyond (n - 1) / sqrt(n) deviations, so the paper's
    4 sigma removes nothing from objects with fewer than 18 grasps.
    """
    deviation = values.std(axis=0)
    return np.any(np.abs(values - values.mean(axis=0)) > sigma * deviation, axis=1)


def split_samples(
    objects: npt.NDArray[np.int32],
    names: Sequence[str],
    classes: Sequence[str],
    config: SplitConfig,
    seed: int,
) -> dict[str, npt.NDArray[np.int64]]:
    """Return the indices of the samples of each split, in their order.

    Per class one object, drawn with the seed, is tested whole; of the grasps of the others
    a share validates and the rest trains. A class with one object that has samples, or one that
    `train_classes` leaves out, is tested only. The draw of a class depends on its own
    objects alone.

    Args:
        objects: (n,), object index of each sample.
        names: Of the objects, by index.
        classes: Of the objects, by index.
        config: Share and classes.
        seed: Of the dataset.
    """
    members: dict[str, list[int]] = {}
    for index in np.unique(objects).tolist():
        members.setdefault(classes[index], []).append(index)
    parts: Mapping[str, list[npt.NDArray[np.int64]]] = {"train": [], "valid": [], "test": []}
    for class_name in sorted(members):
        indices = sorted(members[class_name], key=lambda i: names[i])
        # Three numbers, so it is never the stream of a candidate of an object of this name.
        stream = Stream(seed, object_key(class_name), 0, 1)
        trains = config.train_classes is None or class_name in config.train_classes
        if len(indices) < 2 or not trains:
            tested, others = indices, []
        else:
            tested = [indices[int(stream.integers(len(indices), 1)[0])]]
            others = [i for i in indices if i not in tested]
        parts["test"].append(np.flatnonzero(np.isin(objects, tested)))
        pool = np.flatnonzero(np.isin(objects, others))
        shuffled = pool[stream.permutation(len(pool))]
        count = round(config.valid_fraction * len(pool))
        parts["valid"].append(shuffled[:count])
        parts["train"].append(shuffled[count:])
    empty = [np.zeros(0, dtype=np.int64)]
    return {name: np.sort(np.concatenate(empty + found)) for name, found in parts.items()}
