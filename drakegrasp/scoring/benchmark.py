"""The frozen benchmark `drakegrasp-bench-1`: its objects, and its description on a card.

Input: a directory. Output: meshes with their own masses and frictions, for a build with the preset
`bench1`, and a file that states where the meshes differ from the published ones. All draws come
from `seeding`, so everybody who builds the benchmark gets the same objects.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import yaml

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import differences, read_manifest
from drakegrasp.dataset.paths import BENCHMARK_FILE, BUILTIN_FOLDER, DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError, MeshError, listed
from drakegrasp.foreign_files import read_json
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MANIFEST_NAME
from drakegrasp.runtime.files import write_atomic
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.seeding import Stream, object_key
from drakegrasp.shapes.catalog import CLASSES, LICENCE, BuiltinObject, draw_builtin, wavefront

NAME, PRESET = "drakegrasp-bench-1", "bench1"
#: Masses [kg] and friction coefficients from which those of the objects are drawn.
MASSES = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)
FRICTIONS = (0.3, 0.5, 0.71)
#: Number of classes that no training set may have, and the seed that chooses them.
NEW_CLASSES, SEED = 16, 20261
#: Digits of the published hashes of the meshes.
HASH_DIGITS = 16


def new_classes() -> list[str]:
    """Return the classes that no training set may have, sorted."""
    order = Stream(SEED, object_key(NAME)).permutation(len(CLASSES))
    return sorted(CLASSES[i].name for i in order[:NEW_CLASSES])


def published() -> dict[str, Any]:
    """Return the published facts of the benchmark: versions, hashes of meshes and of all rows."""
    text = resources.files("drakegrasp.scoring").joinpath("bench1.json").read_text("utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


def material_of(item: BuiltinObject) -> tuple[float, float]:
    """Return mass [kg] and friction coefficient of an object.

    The objects of a class take the coefficients in turn, beginning with a random one. So each
    coefficient belongs to a third of the objects, from all classes.
    """
    mass = Stream(SEED, object_key(NAME), object_key(item.name)).integers(len(MASSES), 1)[0]
    start = Stream(SEED, object_key(NAME), object_key(item.object_class.name)).integers(3, 1)[0]
    return MASSES[int(mass)], FRICTIONS[int(start + item.index) % len(FRICTIONS)]


def rows_digest(data: GraspDataset, rows: Sequence[int]) -> str:
    """Return a hash of some rows of a split, to the last bit, whatever their numbers of trials are.

    It covers the objects' names, their poses, those of camera and palm, and the grasps.
    """
    names = data.column("object_props/object_name")[list(rows)].tolist()
    digest = hashlib.sha256(json.dumps(names).encode())
    poses = "frame_world2obj", f"frame_work2cam_{data.camera}"
    for field in (*(f"object_props/{pose}" for pose in poses), "grasp_props/X_CG", "grasps"):
        digest.update(data.column(field)[list(rows)].tobytes())
    return digest.hexdigest()


def write_objects(
    out: Path, config: Config, *, only: Collection[str] = (), progress: Report = silent
) -> Path:
    """Write the objects of the benchmark and return their folder.

    Args:
        out: Directory of the benchmark.
        config: The preset, or a smaller one, e.g. in tests.
        only: Names of the objects; all if empty.
        progress: Is called with the number of written meshes.

    Raises:
        MeshError: If `only` names no object.
        OSError: If the files cannot be written.
    """
    # Choose the objects.
    items = {item.name: item for item in draw_builtin(config.builtin)}
    unknown = sorted(set(only) - items.keys())
    if unknown:
        raise MeshError(
            f"only must be names of objects of {NAME} ({listed(list(items))}), got {unknown[0]!r}"
        )
    chosen = [item for name, item in items.items() if not only or name in only]

    # Write their meshes, and compare them with the published ones.
    folder, known, differ = out / BUILTIN_FOLDER, published(), list[str]()
    folder.mkdir(parents=True, exist_ok=True)
    said: dict[str, Any] = {}
    for done, item in enumerate(chosen, start=1):
        content = wavefront(item.build())
        digest = hashlib.sha256(content).hexdigest()[:HASH_DIGITS]
        if known["objects"].get(item.name) != digest:
            differ.append(item.name)
        write_atomic(folder / f"{item.name}.obj", content)
        mass, friction = material_of(item)
        said[item.name] = {"mass": mass, "friction": friction}
        progress(done, len(chosen))

    # Write the manifest and the description of the benchmark.
    text = yaml.safe_dump({"units": "m", "licence": LICENCE, "objects": said}, sort_keys=True)
    write_atomic(folder / MANIFEST_NAME, text.encode())
    about = {
        "name": NAME,
        "objects": len(chosen),
        "of": len(known["objects"]),
        "different_meshes": differ,
        "new_classes": new_classes(),
    }
    write_atomic(folder / BENCHMARK_FILE, (json.dumps(about, indent=1) + "\n").encode())
    return folder


def read_benchmark(out: Path, config: Config, versions: Mapping[str, str]) -> dict[str, Any] | None:
    """Return the description of the benchmark in a directory; None for another dataset.

    Args:
        out: The directory.
        config: Configuration of the trials; the published one tries only the first wrist pose.
        versions: Versions of the packages that run the trials. Those that differ from the published
            versions are returned, because simulated values may then differ.

    Raises:
        DataError: If the file of the benchmark, or the data file in the same folder, is damaged.
    """
    path = out / BUILTIN_FOLDER / BENCHMARK_FILE
    if not path.is_file():
        return None
    try:
        found = read_json(path)
        whole = found["objects"] == found["of"] and not found["different_meshes"]
        built = read_manifest(out).config
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: must be the file of a benchmark, got another: {error}") from None

    # Compare the rows with the published ones; with other versions some rows may differ.
    if (data_file := out / DATA_FILES["oto"]).is_file():
        test, known = GraspDataset(data_file, split="test"), published()["rows"]
        found["rows"], found["published_rows"] = len(test), known["count"]
        found["rows_as_published"] = rows_digest(test, range(len(test))) == known["sha256"]

    # Find differences from the published benchmark: in the settings of the trials, and in the
    # settings of the build, which a score cannot correct.
    stated, preset = published()["versions"], load_config(PRESET, ["verify.max_tries=1"])
    other = differences(preset, config, ignored=())
    other = other or differences(preset, built, ignored=("verify", "attempt_seconds"))
    return {
        **found,
        "frozen": bool(whole and not other),
        "other_settings": other,
        "other_versions": {
            name: f"{versions.get(name)}, published with {version}"
            for name, version in stated.items()
            if version != versions.get(name, "")
        },
    }
