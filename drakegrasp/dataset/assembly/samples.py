"""Samples: their values, and how they come into the two data files.

In: a success with its trial and its looks. Out: a record of all numbers of its sample; rows of
`grasping_oto.hdf5` and `grasping_otm.hdf5`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.hdf5 import COLUMN_CHUNK, AnyArray, create_field
from drakegrasp.dataset.schema import CAMERAS, DATA_FIELDS, stored_fields
from drakegrasp.frames import (
    X_WT,
    invert_pose,
    pack_pose,
    rotate_vectors,
    transform_points,
    unpack_pose,
)
from drakegrasp.grasp import pack_grasp, transform_grasp
from drakegrasp.objects.model import ObjectModel

#: Fields of a sample that are copied from /looks as they are stored, and their names there.
IMAGES = {"images": "image", "masks": "mask"}
#: Fields of a sample that are texts: of its object.
TEXTS = {"object_props/object_name": "name", "object_props/class_name": "class_name"}
_NUMBERS = tuple(f for f in DATA_FIELDS if f.name not in IMAGES and f.name not in TEXTS)


def record_type(sizes: Mapping[str, int], certified: bool) -> np.dtype[Any]:
    """Return the type of a record of all numbers of a sample, by the names of DATA_FIELDS.

    Args:
        sizes: Lengths of the letters in the shapes.
        certified: Whether the files have HOLD_FIELDS.
    """
    fields = stored_fields(_NUMBERS, certified=certified)
    return np.dtype([(f.name, f.dtype, f.row_shape(sizes)) for f in fields])


class SampleRows:
    """The rows of a split of a data file, written a chunk at a time from the first to the last."""

    def __init__(
        self,
        file: h5py.File,
        split: str,
        count: int,
        sizes: Mapping[str, int],
        texts: Mapping[str, Sequence[str]],
        certified: bool,
    ) -> None:
        """Create the split.

        Args:
            file: The data file.
            split: Name of the split.
            count: Number of its samples.
            sizes: Lengths of the letters in the shapes.
            texts: By the names of TEXTS, the text of each object, by row of /objects.
            certified: Whether the files have HOLD_FIELDS.
        """
        self._group, self._texts = file.create_group(split), texts
        for field in stored_fields(DATA_FIELDS, certified=certified):
            create_field(self._group, field, field.row_shape(sizes), count)
        self._images = {name: self._group[name].id for name in IMAGES}
        self._origins = {n: (0,) * (self._group[n].ndim - 1) for n in IMAGES}
        self._next = dict.fromkeys(IMAGES, 0)
        self._written = 0
        self._waiting: list[tuple[AnyArray, npt.NDArray[np.int32]]] = []

    def add_image(self, name: str, chunk: bytes, skipped: int) -> None:
        """Write the next row of images or masks: its stored bytes, and the skipped filters."""
        offset = (self._next[name], *self._origins[name])
        self._images[name].write_direct_chunk(offset, chunk, skipped)
        self._next[name] += 1

    def add_numbers(self, records: AnyArray, objects: npt.NDArray[np.int32]) -> None:
        """Add the next records (n,), with the row of /objects of each."""
        self._waiting.append((records, objects))
        if sum(len(records) for records, _ in self._waiting) >= COLUMN_CHUNK:
            self.flush()

    def flush(self) -> None:
        """Write the rows that wait."""
        if not self._waiting:
            return
        records, objects = (np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
        rows = slice(self._written, self._written + len(records))
        for name in records.dtype.names or ():
            self._group[name][rows] = records[name]
        for name, texts in self._texts.items():
            self._group[name][rows] = [texts[i] for i in objects]
        self._written, self._waiting = rows.stop, []


def sample_values(
    model: ObjectModel, trial: Mapping[str, Any], look: Mapping[str, Any], camera: str
) -> dict[str, Any]:
    """Return the numbers of a sample that follow from its trial, by the names of DATA_FIELDS.

    Args:
        model: The object.
        trial: Values of its row of /trials.
        look: Values of its row of /looks; images are not needed.
        camera: `oto` or `otm`.
    """
    # The poses of this sample.
    X_TO = unpack_pose(trial["X_TO"])
    X_TC = {c: unpack_pose(look[f"X_TC_{c}"]) for c in CAMERAS}
    X_CO = multiply(invert_pose(X_TC[camera]), X_TO)

    # Grasp, palm and forces in the frame of the file's camera. What is held is put in place with
    # the object: both go through its resting pose.
    values: dict[str, Any] = {}
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_held", "lifted", "X_OG_lifted")):
        grasp = pack_grasp(trial[f"{when}_p_OQ"], trial[f"{when}_nhat_Q_O"])
        values[f"grasps{suffix}"] = transform_grasp(X_CO, grasp)
        X_CG = multiply(X_CO, unpack_pose(trial[X_OG]))
        values[f"grasp_props/X_CG{suffix}"] = pack_pose(X_CG)
        f_Q_C = rotate_vectors(X_CO, trial[f"{when}_f_Q_O"])
        values[f"grasp_props/f_Q_C{suffix}"] = f_Q_C

    # Frames and mass properties, which do not depend on the camera of the file.
    R_TO = X_TO[:3, :3]
    I_OOcm_T = multiply(multiply(R_TO, model.I_OOcm_O), R_TO.T).ravel()
    properties = {
        "work2com": transform_points(X_TO, model.p_OOcm[None])[0],
        "work2inertia": trial["mass"] / model.mass * I_OOcm_T,
        "frame_cam2img_otm": look["X_CI_otm"],
        **{f"frame_cam2work_{c}": pack_pose(invert_pose(X)) for c, X in X_TC.items()},
        **{f"frame_work2cam_{c}": pack_pose(X) for c, X in X_TC.items()},
        "frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
        "frame_world2work": pack_pose(X_WT),
    }
    values |= {f"object_props/{name}": value for name, value in properties.items()}

    # All others are columns of the trial.
    return values | {field.name: trial[field.of] for field in DATA_FIELDS if field.of in trial}
