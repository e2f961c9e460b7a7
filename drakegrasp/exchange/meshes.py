"""Meshes for another group's network: the objects of a dataset in {O} [m].

Input: a dataset. Output: `<object>.obj` for each object, and `objects.yaml` with their properties.
From this folder `build --objects` builds the same objects. The frame of such a mesh file is {O}, so
a pose that a network predicts in it is in {O}: `score` reads it with `--frame object`, and `verify
--object` with any frame.
"""

from __future__ import annotations

from pathlib import Path

import yaml

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.mesh.surfaces import obj_text
from drakegrasp.objects.model import load_object
from drakegrasp.objects.sources import MANIFEST_NAME
from drakegrasp.runtime.progress import Report

#: Description of the format in `drakegrasp export --help`.
HELP = "the objects [m], for another network"
#: Name of the things that the command counts.
COUNTS = "object"


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
            **({} if entry.group is None else {"group": entry.group}),
        }
        progress(done, len(manifest.objects))
    text = yaml.safe_dump({"units": "m", "objects": said}, sort_keys=False)
    (folder / MANIFEST_NAME).write_text(text, encoding="utf-8")

    return len(manifest.objects)
