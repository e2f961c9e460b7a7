"""What the plan of an object, `objects/NAME.plan.h5`, must look like."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.layout.attributes import COUNT, TEXT, attribute_mistakes
from drakegrasp.dataset.layout.opening import refuse_first

#: Types and shapes of the arrays: `r` stands for the number of resting poses, `n` of palm poses.
ARRAYS: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "X_TO": ("float64", ("r", 4, 4)),
    "probability": ("float64", ("r",)),
    "table_force": ("float64", ("r",)),
    "stopped": ("bool", ("r",)),
    "X_OG": ("float64", ("n", 4, 4)),
    "distance": ("float64", ("n",)),
    "resting": ("int64", ("n",)),
    "source": ("int64", ("n",)),
    "log_density": ("float64", ("n",)),
}
#: Those of a plan of postures from outside, in addition; `j` stands for the number of joints.
#: `said` and `preshape` are lists of texts as JSON; `preshape` is left out where all are empty.
POSTURE_ARRAYS: dict[str, tuple[str, tuple[int | str, ...]]] = {
    **{name: ("float64", ("n", "j")) for name in ("q_grasp", "q_pregrasp", "q_squeeze")},
    "row": ("int64", ("n",)),
    "said": ("uint8", ("m",)),
    "preshape": ("uint8", ("p",)),
}
_ATTRIBUTES = {
    **dict.fromkeys(("model_sha256", "config_hash", "mesh_sha256"), TEXT),
    **dict.fromkeys(("combinations", "valid", "distinct", "max"), COUNT),
}


def refuse_other_plan(path: Path, file: h5py.File) -> None:
    """Refuse a file that is no plan of an object.

    Raises:
        DataError: If it is none; the first difference is told.
    """
    refuse_first(path, attribute_mistakes(file, _ATTRIBUTES).values())
    refuse_first(path, _other_arrays(file))


def _other_arrays(file: h5py.File) -> Iterator[str]:
    """Yield how the arrays of a plan differ from `ARRAYS`, and from those of postures."""
    lengths: dict[str, int] = {}
    postures = POSTURE_ARRAYS if "q_grasp" in file else {}
    for name, (dtype, axes) in (ARRAYS | postures).items():
        dataset = file.get(name)
        if dataset is None and name == "preshape":
            continue
        if not isinstance(dataset, h5py.Dataset):
            yield f"/{name}: the dataset must be there, got none"
            continue
        if dataset.dtype != np.dtype(dtype):
            yield f"/{name}: type must be {dtype}, got {dataset.dtype}"
        # The first array with a letter tells its length.
        stored = dataset.shape or ()
        for axis, length in zip(axes, stored, strict=False):
            if isinstance(axis, str):
                lengths.setdefault(axis, length)
        shape = tuple(lengths.get(a, 0) if isinstance(a, str) else a for a in axes)
        if stored != shape:
            yield f"/{name}: shape must be {shape}, got {dataset.shape}"
