"""Pin what a rebuilt house may not change: arrays of builds, scenes, verdicts, scores, objects.

The script runs commands on a few palm poses of built-in objects in a temporary folder and names
every array that comes out:

    python tests/helpers/pins.py [--few] FILE       writes them

`tests/test_pins.py` compares them on any machine, see docs/explanation/determinism.md, with
`tests/helpers/pins.npz`, and on every change a few of them, of one work unit, with
`tests/helpers/few_pins.npz`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import h5py
import numpy as np
import trimesh
from helpers.builds import build as build_here

import drakegrasp
from drakegrasp.runtime.executor import run_here
from drakegrasp.shapes.catalog import builtin_sources

#: Arrays by name: "build/trials/slip", "score/sets/...".
Pins: TypeAlias = dict[str, np.ndarray]

#: Objects of the dataset of which scenes, verdicts and a score are made, and palm poses of each.
OBJECTS, CANDIDATES = ("24_carton_1", "33_boot_1"), 16
#: The presets with the palm poses of their one work unit.
UNITS = {"paper": 6, "randomized": 12, "released": 6}
UNIT_OBJECT = "4_wineglass_1"
#: Of the frozen benchmark: its objects, and palm poses of each.
BENCHMARK, BENCHMARK_CANDIDATES = ("4_wineglass_1", "1_mug_2"), 3
#: Verdicts of each method, and of postures.
VERDICTS, POSTURES = 15, 6
#: Public attributes of a verdict that are numbers.
NUMBERS = ("matches", "p_OQ", "nhat_Q_O", "surface_distance", "epsilon")
#: An array of more numbers, as of images, is compared by means on other machines.
LARGE = 10_000
#: Simulated numbers of other machines are as near as this: metres, radians, newtons, shares.
NEAR = 1e-4
#: Leaves of JSON that say when, where and with what, or how long.
MACHINE = ("seconds", "version", "time", "path", "file", "sha256", "hash", "again", "content")


def command(*arguments: object) -> None:
    """Run `drakegrasp ARGUMENTS...` in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", "drakegrasp", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"LP_NUM_THREADS": "0", "DRAKE_ALLOW_NETWORK": "none"},
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, arguments))}:\n{done.stdout}{done.stderr}")


def arrays(path: Path, name: str) -> Pins:
    """Return the arrays of an HDF5 file by their paths in it."""
    found: Pins = {}

    def take(where: str, node: object) -> None:
        if isinstance(node, h5py.Dataset):
            value = node.asstr()[()] if h5py.check_string_dtype(node.dtype) else node[()]
            for part, column in columns(np.asarray(value)):
                found[f"{name}/{where}{part}"] = column

    with h5py.File(path) as file:
        file.visititems(take)
    return found


def columns(value: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield an array, or each field of a structured one; texts as text."""
    if value.dtype.names:
        for part in value.dtype.names:
            yield f"/{part}", value[part]
    else:
        yield "", value.astype(str) if value.dtype == object else value


def leaves(value: Any, name: str) -> Pins:
    """Return the numbers and words of JSON by their keys, without those of the machine."""
    if isinstance(value, dict):
        parts = [(str(k), v) for k, v in value.items() if not any(m in str(k) for m in MACHINE)]
    elif isinstance(value, list):
        parts = [(str(k), v) for k, v in enumerate(value)]
    else:
        return {name: np.asarray("null" if value is None else value)}
    return {k: v for part, each in parts for k, v in leaves(each, f"{name}/{part}").items()}


def everything(folder: Path) -> Pins:
    """Return all pins; `folder` is empty."""
    out = folder / "fast"
    found = build(out, "fast", CANDIDATES, OBJECTS)
    command("scenes", out, "--workers", 1, "--quiet")
    found |= arrays(out / "scenes.hdf5", "scenes")
    split = most_samples(out)
    found |= verdicts(out, split, folder)
    found |= score(out, split, folder / "score") | calls(out, split)
    for preset, candidates in UNITS.items():
        found |= build(folder / preset, preset, candidates, [UNIT_OBJECT])
    return found | benchmark(folder / "bench1")


def few(folder: Path) -> Pins:
    """Return a few pins in seconds, of one work unit of preset `fast`; `folder` is empty."""
    rules = ["candidates.max=2", "unit_candidates=2", "objects.resting_poses=1"]
    rules.append("builtin.per_class=1")
    config, out = drakegrasp.load_config("fast", overrides=rules), folder / "out"
    sources = builtin_sources(folder / "meshes", config.builtin, only=OBJECTS[:1])
    build_here(sources, out, config, run_here, show=False)
    split = most_samples(out)
    data = drakegrasp.GraspDataset(out / "grasping_oto.hdf5", split=split)
    drakegrasp.score([], data, references=["own"], per_object=1, out=folder / "score", workers=1)
    card = json.loads((folder / "score" / "card.json").read_text())
    return dataset(out, "few") | calls(out, split) | leaves(card, "score")


def build(out: Path, preset: str, candidates: int, objects: Sequence[str]) -> Pins:
    """Build a dataset of built-in objects by a preset; return its arrays."""
    only = [word for name in objects for word in ("--only", name)]
    units = ("--set", "unit_candidates=20", "--set", "objects.resting_poses=2")
    size = ("--candidates", candidates, "--per-class", 1, "--workers", 1)
    source = ("--objects", "builtin", "--config", preset, "--out", out)
    command("build", *source, *only, *size, *units, "--quiet")
    return dataset(out, preset)


def dataset(out: Path, name: str) -> Pins:
    """Return the arrays of the three files of a dataset."""
    files = ("trials", "grasping_oto", "grasping_otm")
    parts = [arrays(out / f"{file}.hdf5", f"{name}/{file}") for file in files]
    return {k: v for part in parts for k, v in part.items()}


def benchmark(out: Path) -> Pins:
    """Make objects of the frozen benchmark, and try a few palm poses on each."""
    only = [word for name in BENCHMARK for word in ("--only", name)]
    few = ("--set", f"candidates.max={BENCHMARK_CANDIDATES}", "--set", "objects.resting_poses=1")
    command("bench-set", out, *only, *few, "--workers", 1, "--quiet")
    found = dataset(out, "bench1")
    for mesh in sorted((out / "builtin").glob("*.obj")):
        digest = hashlib.sha256(mesh.read_bytes()).hexdigest()
        found[f"bench1/meshes/{mesh.stem}"] = np.asarray(digest)
    return found


def most_samples(out: Path) -> str:
    """Return the split of a dataset with the most samples."""
    with h5py.File(out / "grasping_oto.hdf5") as file:
        return max(("train", "valid", "test"), key=lambda name: len(file[name]["grasps"]))


def verdicts(out: Path, split: str, folder: Path) -> Pins:
    """Verify samples of a dataset, some moved by millimetres, and postures of its closed hands."""
    write_moved(out, split, folder / "moved.h5")
    write_postures(out, folder / "postures.npz")
    found = verified(folder / "moved.h5", out, folder / "hand.h5", "--split", split)
    return found | verified(folder / "postures.npz", out, folder / "posture.h5")


def write_moved(out: Path, split: str, path: Path) -> None:
    """Write grasps of rows: the samples, then the same with points 2 mm further along each axis."""
    with h5py.File(out / "grasping_oto.hdf5") as file:
        samples = file[split]["grasps"][:].astype(float)
    rows = np.arange(VERDICTS) % len(samples)
    grasps, points = samples[rows], samples.shape[1] // 2
    grasps[:, :points] += 0.002 * (np.arange(VERDICTS) // len(samples))[:, None]
    with h5py.File(path, "w") as file:
        file["grasps"], file["rows"] = grasps, rows


def write_postures(out: Path, path: Path) -> None:
    """Write palms and joints of hands that closed."""
    with h5py.File(out / "trials.hdf5") as file:
        trials, names = file["trials"], file["objects/name"].asstr()[:]
        closed = np.isfinite(trials["closed_q"][:]).all(axis=1)
        chosen = np.flatnonzero(closed)[:POSTURES]
        table = {
            name: trials[name][:][chosen] for name in ("object", "resting", "X_OG", "closed_q")
        }
    np.savez(
        path,
        object=names[table["object"]].astype(str),
        resting=table["resting"],
        X_FG=table["X_OG"],
        q_grasp=table["closed_q"],
    )


def verified(grasps: Path, out: Path, to: Path, *how: object) -> Pins:
    """Return the arrays of the verdicts on a file."""
    data = ("--dataset", out / "grasping_oto.hdf5", "--workers", 1, "--quiet")
    command("verify", grasps, *data, *how, "--out", to)
    return arrays(to, f"verdicts/{to.stem}")


def score(out: Path, split: str, to: Path) -> Pins:
    """Score samples as predictions beside two reference rows; return the card."""
    sets = ("--reference", "own", "--reference", "constant", "--per-object", 3)
    data = (
        "--dataset",
        out / "grasping_oto.hdf5",
        "--split",
        split,
        "--train",
        out / "grasping_oto.hdf5",
    )
    command("score", *data, *sets, "--workers", 1, "--quiet", "--out", to)
    return leaves(json.loads((to / "card.json").read_text()), "score")


def calls(out: Path, split: str) -> Pins:
    """Return what public calls say of a sample, and of a posture."""
    data = drakegrasp.GraspDataset(out / "grasping_oto.hdf5", split=split)
    verdict = drakegrasp.verify_grasp(data[0].grasp, data, row=0)
    told = {name: getattr(verdict, name) for name in NUMBERS}
    told |= {"reason": verdict.reason, "outcome": verdict.outcome.label}
    found = {f"calls/hand/{k}": np.asarray(v) for k, v in told.items()}

    # Two fingers and the thumb around a box, the palm above it.
    box = drakegrasp.place_object(trimesh.creation.box([0.07, 0.07, 0.07]))
    hand, X_OG = drakegrasp.load_hand(), np.diag([1.0, -1.0, -1.0, 1.0])
    X_OG[2, 3] = 0.095
    angles = {"proximal": 1.25, "distal": 1.25 / 3.0, "spread": 0.0}
    q_grasp = [angles[name.split("_")[1]] for name in hand.joint_names]
    posture = drakegrasp.make_posture(hand, X_OG, q_grasp, joints=hand.joint_names)
    trial = drakegrasp.run_trial(box, posture)
    told = {"outcome": trial.outcome.label, "slip": trial.lift.slip, "X_TO": trial.lift.X_TO}
    return found | {f"calls/posture/{k}": np.asarray(v) for k, v in told.items()}


def summaries(found: Pins) -> Pins:
    """Return what arrays are compared by on other machines: images by means, empty ones not."""
    return {name: _summary(value) for name, value in found.items() if value.size}


def _summary(value: np.ndarray) -> np.ndarray:
    if value.ndim < 3 or value.size < LARGE:
        return value
    return value.reshape(len(value), -1).mean(axis=1, dtype=float)


def write_values(path: Path, found: Pins) -> None:
    """Write the summaries of pins; single values share one text, as each array has an overhead."""
    values = summaries(found)
    single = {name: value.item() for name, value in values.items() if not value.ndim}
    many = {name: value for name, value in values.items() if value.ndim}
    np.savez_compressed(path, single=np.asarray(json.dumps(single)), **many)


def read_values(path: Path) -> Pins:
    """Return the summaries of pins that were written."""
    with np.load(path) as file:
        values = {name: file[name] for name in file.files}
    single = json.loads(values.pop("single").item())
    return values | {name: np.asarray(value) for name, value in single.items()}


def far(found: Pins, expected: Pins) -> list[str]:
    """Return a line for each summary that is gone or differs by more than another CPU's rounding.

    What is new has changed nothing.
    """

    def same(ours: np.ndarray, theirs: np.ndarray) -> bool:
        if ours.shape != theirs.shape or ours.dtype.kind != theirs.dtype.kind:
            return False
        if ours.dtype.kind != "f":
            return np.array_equal(ours, theirs)
        return np.allclose(ours, theirs, rtol=NEAR, atol=NEAR, equal_nan=True)

    lines = [f"gone: {name}" for name in expected.keys() - found.keys()]
    both = found.keys() & expected.keys()
    return sorted(lines + [f"differs: {n}" for n in both if not same(found[n], expected[n])])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("values", type=Path, help="file to write (.npz)")
    parser.add_argument("--few", action="store_true", help="write a few pins, no others")
    arguments = parser.parse_args()
    with TemporaryDirectory() as name:
        write_values(arguments.values, (few if arguments.few else everything)(Path(name)))
