"""Exports the samples of a dataset in the format of another tool.

Input: the directory of a dataset and a format. Output: a new directory, which is either complete or
absent. Each format is a module with one function that writes a directory; the registry lists them.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp import registry
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE, model_path
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import NO_PRESHAPE, SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError, DrakegraspError, one_line
from drakegrasp.foreign_files import validate_local
from drakegrasp.frames import Array, unpack_pose
from drakegrasp.hand.description import Hand
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.runtime.files import atomic_folder, disk_full_named, is_no_room
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.simulation.attempts import CONDITIONS


def export_dataset(
    out: str | Path,
    directory: str | Path,
    form: str,
    *,
    progress: Report = silent,
    **options: Any,
) -> int:
    """Write the samples of a dataset in another format and return their number.

    Args:
        out: Directory of the dataset.
        directory: Directory to write, new or empty; it appears when it is complete.
        form: Name of an exporter, see `drakegrasp.registry`.
        progress: Called with the number of samples written and of all samples.
        options: Options of the format, see `options_of`, e.g. `licence` of format `hf`.

    Raises:
        DataError: If there is no dataset, the dataset has another schema or no samples, the
            directory is not empty, or the format does not have an option.
        MachineError: If a package that the format needs is missing.
        DiskFullError: If the disk is full; no files are left behind.
    """
    # A dataset that cannot be read is rejected before anything is written.
    validate_local(directory)
    out, directory = Path(out), Path(directory)
    if not registry.is_known("exporters", form):
        known = ", ".join(registry.names("exporters"))
        raise DataError(f"format must be one of {known}, got {form!r}")
    for name, value in options.items():
        if name not in options_of(form):
            raise DataError(f"{name} must be left out with format {form}, got {value!r}")
    for path in DATA_FILES.values():
        found = [GraspDataset(out / path, split=split, fewer_fingers=True) for split in SPLITS]
        if not any(map(len, found)):
            raise DataError(f"{out / path}: must have samples to export, got none")
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise DataError(f"{directory}: must be a new or empty directory, got one that holds files")

    write = registry.find("exporters", form)
    with disk_full_named(directory), atomic_folder(directory) as folder:
        try:
            return int(write(out, folder, progress, **options))
        except DrakegraspError:
            raise
        except (Exception, SystemExit) as error:
            if is_no_room(error):
                raise
            raise DataError(
                f"{out}: exporter {registry.with_owner('exporters', form)} must write the samples "
                f"and return their number, got {type(error).__name__} ({one_line(error)})"
            ) from error


def options_of(form: str) -> tuple[str, ...]:
    """Return the names of an exporter's options, which are its parameters after the first three."""
    write = registry.find("exporters", form)
    if not callable(write):
        owned = registry.with_owner("exporters", form)
        raise DataError(f"exporter {owned} must be a function, got {type(write).__name__}")
    return tuple(inspect.signature(write).parameters)[3:]


@dataclass(frozen=True, kw_only=True, eq=False)
class ClosedGrasp:
    """A sample after the fingers have closed on the resting object.

    Attributes:
        trial_id: Row of the sample in /trials.
        split: `train`, `valid` or `test`.
        object_name: Name of the object.
        X_TO, X_TG: Poses (4, 4) of the object and of the palm in {T}.
        q: (n,), positions of the hand's joints [rad or m], in the plant's order.
        spread: Angle of the spread joints [rad].
        unused: Fingers that the preshape does not use, as bits: 1 for the first finger.
        preshape: Index of the hand's preshape; None if the sample has no preshape.
        conditions: (3,), friction of hand and table and mass [kg] of the trial; None if not known.
    """

    trial_id: int
    split: str
    object_name: str
    X_TO: Array
    X_TG: Array
    q: Array
    spread: float
    unused: int = 0
    preshape: int | None = None
    conditions: Array | None = None

    def preshape_name(self, hand: Hand) -> str:
        """Return the name of the sample's preshape of a hand; empty if it has no preshape."""
        none = self.preshape is None or not hand.preshapes
        return "" if none else hand.preshape_names[self.preshape or 0]


def samples_by_object(
    out: Path, progress: Report
) -> Iterator[tuple[ObjectModel, list[ClosedGrasp]]]:
    """Yield each object that has samples with its samples, and tell the progress.

    Raises:
        DataError: See `read_closed_grasps`.
    """
    grasps, done = list(read_closed_grasps(out)), 0
    progress(0, len(grasps))
    for name, same in groupby(grasps, key=lambda grasp: grasp.object_name):
        own = list(same)
        yield load_object(model_path(out, name)), own
        done += len(own)
        progress(done, len(grasps))


def read_closed_grasps(out: Path) -> Iterator[ClosedGrasp]:
    """Yield the samples of a dataset in the order of its trials, so object by object.

    Raises:
        DataError: If a file of the dataset is missing or belongs to another dataset, or a sample
            has a number that is not finite.
    """
    kept = Trials(out).where(kept=True)
    names = ("object_name", "split", "X_TO", "X_OG", "closed_q", "spread", "unused", "preshape")
    samples, rows = kept.columns((*names, *CONDITIONS)), kept.trial_ids
    if not np.isin(samples["split"], range(len(SPLITS))).all():
        raise DataError(f"{out}: data files must hold the samples of {TRIALS_FILE}, got others")
    for name in ("X_TO", "X_OG", "closed_q", "spread"):
        for row, values in zip(rows.tolist(), samples[name], strict=True):
            if not np.isfinite(values).all():
                raise DataError(f"{out}: {name} of trial {row} must be finite numbers, got others")

    conditions = np.column_stack([samples[name] for name in CONDITIONS])
    X_TO, X_OG = (unpack_pose(samples[name]) for name in ("X_TO", "X_OG"))
    for i, row in enumerate(rows.tolist()):
        yield ClosedGrasp(
            trial_id=row,
            split=SPLITS[samples["split"][i]],
            object_name=samples["object_name"][i],
            X_TO=X_TO[i],
            X_TG=X_TO[i] @ X_OG[i],
            q=samples["closed_q"][i],
            spread=float(samples["spread"][i]),
            unused=int(samples["unused"][i]),
            preshape=None if (k := int(samples["preshape"][i])) == NO_PRESHAPE else k,
            conditions=conditions[i],
        )
