"""Names and paths of a dataset's files."""

from __future__ import annotations

import hashlib
from pathlib import Path

from drakegrasp.dataset.hdf5 import opened_sealed
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.errors import DataError
from drakegrasp.foreign_files import NAME_RULE, is_name, read_content

#: Files of all attempts, of samples by camera and of scenes, and the manifest.
TRIALS_FILE = "trials.hdf5"
DATA_FILES = {camera: f"grasping_{camera}.hdf5" for camera in CAMERAS}
SCENES_FILE = "scenes.hdf5"
#: File of scenes of several objects, and the folder of its scenes, see `clutter_path`.
CLUTTER_FILE, CLUTTER_FOLDER = "clutter.hdf5", "clutter"
MANIFEST_FILE = "manifest.json"
#: Folder of the files of arms, see `reach_path`.
REACH_FOLDER = "reach"
#: Files that `assemble` writes; they always belong to one state.
ASSEMBLED_FILES = (TRIALS_FILE, *DATA_FILES.values())
#: Folder of the meshes of the built-in objects, in a dataset that is built from them.
BUILTIN_FOLDER = "builtin"
#: File in this folder in which the frozen benchmark describes itself.
BENCHMARK_FILE = "benchmark.json"


def model_path(out: Path, name: str) -> Path:
    """Return the path of an object's meshes and mass properties."""
    return out / "objects" / f"{_file_name(name)}.npz"


def plan_path(out: Path, name: str) -> Path:
    """Return the path of an object's resting pose and palm poses."""
    return out / "objects" / f"{_file_name(name)}.plan.h5"


def reach_path(out: Path, name: str, *, clutter: bool = False) -> Path:
    """Return the path of what an arm, by a name of its own, can do about the grasps.

    Args:
        out: Directory of the dataset.
        name: The name.
        clutter: Whether it is about the grasps of clutter.hdf5, not about samples.
    """
    folder = out / REACH_FOLDER / (CLUTTER_FOLDER if clutter else "")
    return folder / f"{_file_name(name)}.hdf5"


def reach_names(out: Path, *, clutter: bool = False) -> list[str]:
    """Return the names of the arms that a dataset has files of; see `reach_path`."""
    folder = reach_path(out, "any", clutter=clutter).parent
    return sorted(path.stem for path in folder.glob("*.hdf5"))


def clutter_path(out: Path, number: int) -> Path:
    """Return the path of a scene of several objects, by its number."""
    return out / CLUTTER_FOLDER / f"{number:06d}.h5"


def object_files(out: Path, name: str) -> tuple[Path, Path]:
    """Return the paths of both files of an object."""
    return model_path(out, name), plan_path(out, name)


def places(out: Path, *paths: Path) -> dict[str, Path]:
    """Return the existing files among `paths`, by their paths in the dataset's directory."""
    return {path.relative_to(out).as_posix(): path for path in paths if path.is_file()}


def shards_folder(out: Path, name: str) -> Path:
    """Return the folder of an object's shards."""
    return out / "shards" / _file_name(name)


def _file_name(name: str) -> str:
    """Return a name after checking that it leads to no other folder.

    Raises:
        DataError: If the name might lead to another folder.
    """
    if not is_name(name):
        raise DataError(f"the name of an object must be {NAME_RULE}, got {name!r}")
    return name


def recorded_model(out: Path, name: str) -> str:
    """Return the hexadecimal hash of an object's mesh file that its plan stores.

    The plan is sealed.

    Raises:
        DataError: If the plan is missing or has changed.
    """
    with opened_sealed(plan_path(out, name), "plan of an object") as (file, _):
        return str(file.attrs["model_sha256"])


def read_model_file(out: Path, name: str, expected: str) -> bytes:
    """Return the content of the file of an object's meshes.

    Raises:
        DataError: If the file is missing or its hexadecimal hash differs from `expected`.
    """
    model = model_path(out, name)
    content = read_content(model) if model.is_file() else None
    if content is None or hashlib.sha256(content).hexdigest() != expected:
        got = "none" if content is None else "other content"
        raise DataError(f"{model}: must be the file that was written with its plan, got {got}")
    return content
