"""Export: the samples of a dataset in the format of another tool.

In: the directory of a dataset and a format. Out: a new directory, complete or absent. Each format
is a module with one function that writes a directory; `FORMATS` names them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, get_args

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.exchange.publication import Publication
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.runtime.progress import Report, silent

#: `hf` needs the extra `[hub]`; `dexgraspbench` and `mjcf` need `[peer]`.
Format = Literal["hf", "original", "dexgraspbench", "isaac_grasp", "glb", "mjcf"]
FORMATS: tuple[Format, ...] = get_args(Format)


def export_dataset(
    out: str | Path,
    directory: str | Path,
    form: Format,
    *,
    publication: Publication | None = None,
    progress: Report = silent,
) -> int:
    """Write the samples of a dataset in another format and return their number.

    Args:
        out: Directory of the dataset.
        directory: Where to write; it must be new or empty, and appears when it is complete.
        form: One of `FORMATS`.
        publication: What the card and the metadata of format `hf` say of the publishers.
        progress: Called with the number of samples done and of all.

    Raises:
        DataError: If there is no dataset, it is of another schema or has no samples, or the
            directory holds something.
        MachineError: If a package is missing that the format needs.
        OSError: If the disk is full; nothing is left behind.
    """
    # A dataset that cannot be read is refused before anything is written.
    out, directory = Path(out), Path(directory)
    if form not in FORMATS:
        raise DataError(f"format must be one of {', '.join(FORMATS)}, got {form!r}")
    for path in DATA_FILES.values():
        if not any(
            len(GraspDataset(out / path, split=split, fewer_fingers=True)) for split in SPLITS
        ):
            raise DataError(f"{out / path}: must have samples to export, got none")
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise DataError(f"{directory}: must be a new or empty directory, got one that holds files")

    write = _writer(form, publication or Publication())
    with atomic_folder(directory) as folder:
        return write(out, folder, progress)


def _writer(form: Format, publication: Publication) -> Callable[[Path, Path, Report], int]:
    """Return the function that writes a format; its libraries are loaded when it is asked for."""
    if form == "hf":
        from drakegrasp.exchange.hub.folder import write_hub

        return partial(write_hub, publication=publication)
    if form == "original":
        from drakegrasp.exchange.original import write_original

        return write_original
    if form == "glb":
        from drakegrasp.exchange.posed_scenes import write_glb

        return write_glb
    if form == "isaac_grasp":
        from drakegrasp.exchange.isaac_grasp import write_isaac_grasp

        return write_isaac_grasp
    require_mujoco("mujoco", "coacd")
    if form == "mjcf":
        from drakegrasp.exchange.mujoco_scenes import write_mjcf

        return write_mjcf
    from drakegrasp.exchange.dexgraspbench import write_dexgraspbench

    return write_dexgraspbench
