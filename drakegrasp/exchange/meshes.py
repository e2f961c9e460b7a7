"""Meshes for another group's network: the objects of a dataset in {O} [m], and tables of its rows.

Input: a dataset. Output: `<object>.obj` for each object, `objects.yaml` with their properties, and
`rows_<split>.csv` with one line per sample. From this folder `build --objects` builds the same
objects. The frame of such a mesh file is {O}, so a pose that a network predicts in it is in {O}:
`score` reads it with `--frame object`, and `verify --object` with any frame. The columns of the
tables have the names of the arrays of postures.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES, model_path
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.exchange.dexgraspbench import pose_vector
from drakegrasp.frames import unpack_pose
from drakegrasp.mesh.wavefront import obj_text
from drakegrasp.objects.model import load_object
from drakegrasp.objects.sources import MANIFEST_NAME
from drakegrasp.runtime.progress import Report
from drakegrasp.simulation.attempts import CONDITIONS

#: Description of the format in `drakegrasp export --help`.
HELP = "the objects [m] and tables of the rows, for another network"
#: Name of the things that the command counts.
COUNTS = "object"
#: Columns of the object's pose X_TO on the table: position [m] and quaternion.
PLACE = tuple(f"object_{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))


def write_meshes(out: Path, folder: Path, progress: Report) -> int:
    """Write the objects of a dataset and return their number; see `export_dataset`."""
    manifest = read_manifest(out)
    said = {}
    for done, entry in enumerate(manifest.objects, start=1):
        model = load_object(model_path(out, entry.name))
        text = obj_text(model.visual_vertices, model.visual_faces, normals=False)
        (folder / f"{entry.name}.obj").write_text(text, encoding="utf-8")
        said[entry.name] = {
            "class": entry.class_name,
            "mass": entry.mass,
            **({} if entry.friction is None else {"friction": entry.friction}),
            **({} if entry.licence is None else {"licence": entry.licence}),
            **({} if entry.mesh_name == entry.name else {"group": entry.mesh_name}),
            **({} if entry.group is None else {"group": entry.group}),
        }
        progress(done, len(manifest.objects))
    text = yaml.safe_dump({"units": "m", "objects": said}, sort_keys=False)
    (folder / MANIFEST_NAME).write_text(text, encoding="utf-8")

    # Write one table for each split that has rows.
    scale_of = {entry.name: entry.scale for entry in manifest.objects}
    trials = Trials(out)
    for split in SPLITS:
        data = GraspDataset(out / DATA_FILES["oto"], split=split, fewer_fingers=True)
        if len(data):
            _write_rows(folder / f"rows_{split}.csv", trials[data.column("trial_id")], scale_of)
    return len(manifest.objects)


def _write_rows(path: Path, samples: Trials, scale_of: Mapping[str, float]) -> None:
    """Write the table of a split, given the trials of its rows in the order of the rows."""
    names = samples["object_name"].tolist()
    places = np.array([pose_vector(X_TO) for X_TO in unpack_pose(samples["X_TO"])])
    columns: dict[str, Sequence[Any]] = {
        "row": range(len(names)),
        "object": names,
        "file": [f"{name}.obj" for name in names],
        "class": samples["class_name"].tolist(),
        "resting": samples["resting"].tolist(),
        **dict(zip(PLACE, places.T.tolist(), strict=True)),
        **{name: samples[name].tolist() for name in CONDITIONS},
        "source_scale": [scale_of[name] for name in names],
    }
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([columns, *zip(*columns.values(), strict=True)])
