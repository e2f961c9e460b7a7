"""The scenes of a dataset, in its scenes.hdf5, beside a state of its other files."""

from __future__ import annotations

import os
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.opening import refuse_other_codes
from drakegrasp.dataset.paths import SCENES_FILE
from drakegrasp.dataset.scenes.reader import SceneDataset
from drakegrasp.dataset.scenes.rows import refuse_other_state
from drakegrasp.dataset.schema import VIEW_KINDS
from drakegrasp.dataset.trial_files import Stamp, stamp
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import Snapshot
from drakegrasp.pictures.thumbnails import colour_png

Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True, eq=False)
class Scenes:
    """All scenes of a dataset.

    Attributes:
        snapshot: State of the other files.
        stamp: Of scenes.hdf5.
        data: All tables, and the images of all views.
    """

    snapshot: Snapshot
    stamp: Stamp
    data: SceneDataset

    def __len__(self) -> int:
        return len(self.split)

    @cached_property
    def split(self) -> npt.NDArray[np.uint8]:
        """(n,), index into SPLITS."""
        return self.data.tables["scenes"]["split"]

    @cached_property
    def objects(self) -> npt.NDArray[np.int32]:
        """(n,), numbers of the objects in the snapshot."""
        known = {name: number for number, name in enumerate(self.snapshot.names)}
        numbers = np.array([known[name] for name in self.data.names], dtype=np.int32)
        return numbers[self.data.tables["scenes"]["object"][:, 0]]

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """Of each scene for addresses: the code of its object, and the resting pose."""
        resting = self.data.tables["scenes"]["resting"][:, 0].tolist()
        codes = (self.snapshot.codes[number] for number in self.objects.tolist())
        return tuple(f"{code}-{pose}" for code, pose in zip(codes, resting, strict=True))

    @cached_property
    def numbers(self) -> Mapping[str, int]:
        """Numbers of the scenes by their labels."""
        return {label: number for number, label in enumerate(self.labels)}

    @cached_property
    def counts(self) -> Mapping[str, Rows]:
        """(n,) each: how many grasps there are, are tested, held, samples; and the views."""
        tables, count = self.data.tables, len(self)
        grasps = tables["grasps"]
        labels = ("sample", "held", "tested")
        of = {name: grasps["scene"][grasps[name]] for name in labels}
        of |= {"grasps": grasps["scene"], "views": tables["views"]["scene"]}
        return {name: np.bincount(rows, minlength=count) for name, rows in of.items()}

    def views(self, scene: int) -> Rows:
        """Return the rows of a scene's views."""
        return np.flatnonzero(self.data.tables["views"]["scene"] == scene)

    def grasps(self, scene: int) -> Rows:
        """Return the rows of a scene's grasps: samples, others that hold, that fail, untested."""
        grasps, rows = self.data.tables["grasps"], self.data.rows_in(scene)
        sample, held, tested = (grasps[name][rows] for name in ("sample", "held", "tested"))
        return rows[np.argsort(-(4 * sample + 2 * held + 1 * tested), kind="stable")]

    def png(self, view: int) -> bytes:
        """Return the colours of a view as a PNG.

        Raises:
            DataError: If the file is damaged, or was replaced.
        """
        return colour_png(self.data.stored_images(view)[0])


class SceneFile:
    """The scenes.hdf5 of a dataset, read again when it or the dataset changes.

    Args:
        out: Directory of the dataset.
    """

    def __init__(self, out: Path) -> None:
        self._path = out / SCENES_FILE
        self._lock = threading.Lock()
        self._known: Scenes | None = None

    @property
    def is_there(self) -> bool:
        """Whether there is such a file, readable or not."""
        return os.path.lexists(self._path)

    def current(self, snapshot: Snapshot) -> Scenes:
        """Return the scenes beside a state of the dataset.

        Raises:
            DataError: If the file cannot be read, or is not of this dataset.
        """
        with self._lock:
            known, now = self._known, stamp(self._path)
            if known is None or known.snapshot is not snapshot or known.stamp != now:
                self._known = known = _read_scenes(self._path, now, snapshot)
            return known


def _read_scenes(path: Path, read_at: Stamp, snapshot: Snapshot) -> Scenes:
    refuse_other_state(path, snapshot.trials)
    data = SceneDataset(path, points=None)
    grasps, views = data.tables["grasps"], data.tables["views"]
    refuse_other_codes(path, "/grasps/outcome", grasps["outcome"], list(Outcome))
    refuse_other_codes(path, "/grasps/trial_id", grasps["trial_id"], len(snapshot.table))
    refuse_other_codes(path, "/views/kind", views["kind"], len(VIEW_KINDS))
    if not np.isfinite(data.tables["scenes"]["X_TO"]).all():
        raise DataError(f"{path}: /scenes/X_TO must be finite, got other numbers")
    if others := set(data.names) - set(snapshot.names):
        raise DataError(f"{path}: must be of objects of {snapshot.out}, got {min(others)}")
    return Scenes(snapshot=snapshot, stamp=read_at, data=data)
