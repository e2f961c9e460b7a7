"""Measure what a build is worth: distinct grasps per core-second, beside other builds.

    NEW='new=drakegrasp build --objects {objects} --out {out} --samples-per-object 30'
    OLD='old=/other/version/bin/drakegrasp build --objects {objects} --out {out} --config fast'
    SCRIPT=pipelines/measurements/distinct_grasps.py
    python $SCRIPT --g3db DIR --work DIR --build "$NEW" --build "$OLD"

The script lays out the meshes of a list of `mesh_lists.yaml` (by default `reporting`, on which
nothing was tuned), runs each command with one worker, and prints JSON for each: attempts, samples,
distinct grasps, approach cells, CPU seconds of the whole command, distinct grasps and cells per
core-second, the share of the distinct grasps by elevation of the approach, and for each object its
samples and distinct grasps. Commands of other versions may be given, too; two builds that are
compared should run at the same time, with `--only` in two shells. G3DB is github ashleylid/G3DB,
folder objects/grasp_meshes/final_mesh.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import yaml

from drakegrasp.arithmetic import multiply
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.frames import unpack_pose
from drakegrasp.grasp import approach_cells, distinct_grasps, elevation_bands
from drakegrasp.shapes.catalog import export_builtin

LISTS = Path(__file__).parent / "mesh_lists.yaml"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--g3db", type=Path, required=True, help="folder of the meshes of G3DB")
    parser.add_argument("--work", type=Path, required=True, help="folder for meshes and datasets")
    parser.add_argument("--list", default="reporting", help="list of meshes  [default: reporting]")
    parser.add_argument("--build", action="append", required=True, metavar="NAME=COMMAND")
    parser.add_argument("--only", help="run only the build of this name")
    arguments = parser.parse_args(argv)

    meshes = arguments.work / f"meshes_{arguments.list}"
    lay_out(arguments.list, arguments.g3db, meshes)
    for text in arguments.build:
        name, _, command = text.partition("=")
        if arguments.only in (None, name):
            out = arguments.work / name
            seconds = run(command.format(objects=meshes, out=out))
            print(json.dumps({"build": name, **worth(out, seconds)}), flush=True)  # noqa: T201
    return 0


def lay_out(name: str, g3db: Path, folder: Path) -> None:
    """Write the meshes of a list into a folder, with their units."""
    meshes = yaml.safe_load(LISTS.read_text(encoding="utf-8"))[name]
    folder.mkdir(parents=True, exist_ok=True)
    for mesh in meshes["g3db"]:
        shutil.copy(g3db / f"{mesh}.obj", folder)
    export_builtin(folder, meshes["builtin"])
    units = {"objects": {mesh: {"units": "cm"} for mesh in meshes["g3db"]}}
    (folder / "objects.yaml").write_text(yaml.safe_dump(units), encoding="utf-8")


def run(command: str) -> float:
    """Run a command with one worker and return its CPU seconds, those of its processes included."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    one = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "LP_NUM_THREADS": "0"}
    subprocess.run(
        [*shlex.split(command), "--workers", "1"],
        env={**os.environ, **one},
        stdout=sys.stderr,
        check=True,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def worth(out: Path, seconds: float) -> dict[str, Any]:
    """Return the numbers of a dataset of this or an earlier version."""
    with h5py.File(out / DATA_FILES["oto"]) as file:
        ids = np.sort(np.concatenate([file[split]["trial_id"][:] for split in SPLITS]))
    with h5py.File(out / TRIALS_FILE) as file:
        trials, names = file["trials"], file["objects/name"].asstr()[:].tolist()
        attempts = len(trials["outcome"])
        objects, resting = (trials[name][:][ids] for name in ("object", "resting"))
        X_OG, X_TO = (unpack_pose(trials[name][:][ids]) for name in ("X_OG", "X_TO"))

    kept = distinct_grasps(np.column_stack([objects, resting]), X_OG)
    cells = approach_cells(X_OG)[kept]
    bands = elevation_bands(multiply(X_TO, X_OG)[kept])
    count = int(kept.sum())
    of_all = np.bincount(objects, minlength=len(names))
    of_distinct = np.bincount(objects[kept], minlength=len(names))
    pairs = {*zip(objects[kept].tolist(), cells.tolist(), strict=True)}
    return {
        "attempts": attempts,
        "samples": len(ids),
        "distinct": count,
        "cells": len(pairs),
        "cpu_seconds": round(seconds, 1),
        "distinct_per_core_second": round(count / seconds, 3),
        "cells_per_core_second": round(len(pairs) / seconds, 3),
        "elevation": (np.bincount(bands, minlength=3) / max(count, 1)).round(3).tolist(),
        "largest_share": round(float(of_distinct.max() / max(count, 1)), 3),
        "objects": {
            name: (int(samples), int(own))
            for name, samples, own in zip(names, of_all, of_distinct, strict=True)
        },
    }


if __name__ == "__main__":
    raise SystemExit(main())
