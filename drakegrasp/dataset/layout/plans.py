"""What the plan of an object, `objects/NAME.plan.h5`, must look like."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np

from drakegrasp.dataset.layout.attributes import COUNT, NUMBER, TEXT, TRUTH, attribute_mistakes
from drakegrasp.dataset.layout.opening import refuse_first

#: Shapes of the arrays; None stands for the number of palm poses.
ARRAYS: dict[str, tuple[int | None, ...]] = {
    "X_TO": (4, 4),
    "X_OG": (None, 4, 4),
    "distance": (None,),
}
_ATTRIBUTES = {
    **dict.fromkeys(("model_sha256", "config_hash", "mesh_sha256"), TEXT),
    **dict.fromkeys(("combinations", "valid", "distinct"), COUNT),
    "table_force": NUMBER,
    "stopped": TRUTH,
}


def refuse_other_plan(path: Path, file: h5py.File) -> None:
    """Refuse a file that is no plan of an object.

    Raises:
        DataError: If it is none; the first difference is told.
    """
    refuse_first(path, attribute_mistakes(file, _ATTRIBUTES))
    refuse_first(path, _other_arrays(file))


def _other_arrays(file: h5py.File) -> Iterator[str]:
    """Yield what the arrays of a plan have otherwise than `ARRAYS`, in words."""
    count: int | None = None
    for name, expected in ARRAYS.items():
        dataset = file.get(name)
        if not isinstance(dataset, h5py.Dataset):
            yield f"/{name}: the dataset must be there, got none"
            continue
        if dataset.dtype != np.float64:
            yield f"/{name}: type must be float64, got {dataset.dtype}"
        found = dataset.shape or ()
        count = found[0] if count is None and expected[0] is None and found else count
        shape = tuple(count if length is None else length for length in expected)
        if found != shape:
            yield f"/{name}: shape must be {shape}, got {dataset.shape}"
