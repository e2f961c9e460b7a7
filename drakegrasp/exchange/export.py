"""Export: the samples of a dataset in the format of another tool.

In: the directory of a dataset and a format. Out: a new directory, complete or absent. Each format
is a module with one function that writes a directory, and its line in pyproject.toml.
"""

from __future__ import annotations

import inspect
from pathlib import Path

from drakegrasp import registry
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError
from drakegrasp.exchange.publication import Publication
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.runtime.progress import Report, silent


def export_dataset(
    out: str | Path,
    directory: str | Path,
    form: str,
    *,
    publication: Publication | None = None,
    progress: Report = silent,
) -> int:
    """Write the samples of a dataset in another format and return their number.

    Args:
        out: Directory of the dataset.
        directory: Where to write; it must be new or empty, and appears when it is complete.
        form: The name of an exporter, see `drakegrasp.registry`.
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
    if not registry.is_known("exporters", form):
        known = ", ".join(registry.names("exporters"))
        raise DataError(f"format must be one of {known}, got {form!r}")
    for path in DATA_FILES.values():
        if not any(
            len(GraspDataset(out / path, split=split, fewer_fingers=True)) for split in SPLITS
        ):
            raise DataError(f"{out / path}: must have samples to export, got none")
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise DataError(f"{directory}: must be a new or empty directory, got one that holds files")

    write = registry.find("exporters", form)
    about = {"publication": publication or Publication()}
    told = about if "publication" in inspect.signature(write).parameters else {}
    with atomic_folder(directory) as folder:
        count: int = write(out, folder, progress, **told)
    return count
