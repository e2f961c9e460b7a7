"""Compare the verdicts on DexGraspBench's published grasps by its own code and by our protocols.

Input: the folder of DexGraspBench, whose own evaluation has been run (`task=eval
exp_name=example`), and the results of `drakegrasp verify --protocol`, one file of JSON lines per
protocol. Output: a table in Markdown with the number of held grasps, Wilson's interval, and how
many verdicts agree with those of the benchmark's code.

    python pipelines/measurements/protocols_compared.py DEXGRASPBENCH RESULTS.jsonl...

The benchmark's repository needs the meshes of the Shadow Hand in `third_party/mujoco_menagerie`;
the meshes of the fingertips collide, and the others are only visual. With `--dexgraspnet FOLDER
--count N --out FOLDER` the script writes N grasps of DexGraspNet, in equal numbers of each object,
as files of the benchmark.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from drakegrasp.exchange.dexgraspbench import write_object
from drakegrasp.protocols.files import read_dictionary

#: Folders of the benchmark's example grasps, and of its verdicts on them.
GRASPS, VERDICTS = "output/example_shadow/graspdata", "output/example_shadow/evaluation"
#: DexGraspNet has one posture per grasp. Pregrasp and squeeze open and close the bending joints by
#: this angle [rad].
APART = 0.1
_BENDING = {*(f"{f}J{j}" for f in ("FF", "MF", "RF", "LF") for j in range(3)), "THJ0", "THJ1"}
#: Joints of DexGraspNet's hand that turn in the opposite direction in the benchmark's hand.
_OPPOSITE = {"FFJ3", "MFJ3", "THJ0", "THJ1"}


def read_own_verdicts(folder: Path) -> dict[str, bool]:
    """Return the verdicts of the benchmark's code, by the path of the grasp."""
    root = folder / VERDICTS
    return {
        str(path.relative_to(root)): bool(read_dictionary(path)["succ_flag"])
        for path in sorted(root.rglob("*.npy"))
    }


def compare(own: dict[str, bool], lines: list[dict[str, Any]]) -> str:
    """Return the table row of a protocol: held, interval, agreement."""
    held = sum(line["success"] for line in lines)
    low, high = binomtest(held, len(lines)).proportion_ci(method="wilson")
    row = f"{lines[0]['protocol']} | {lines[0]['simulator']} {lines[0]['versions']['mujoco']} | "
    row += f"{held} of {len(lines)} | {held / len(lines):.1%} | {low:.0%} to {high:.0%}"
    pairs = []
    for line in lines:
        _, found, name = line["file"].partition("graspdata/")
        if found and name in own:
            pairs.append((own[name], line["success"]))
    if not pairs:
        return f"| {row} | |"
    equal = sum(one == other for one, other in pairs)
    return f"| {row} | {equal} of {len(pairs)} |"


def table(folder: Path, results: list[Path]) -> str:
    """Return the table of all protocols."""
    own = read_own_verdicts(folder)
    held = sum(own.values())
    low, high = binomtest(held, len(own)).proportion_ci(method="wilson")
    rows = [
        "| protocol | simulator | held | share | 95 % interval | as its own code |",
        "|---|---|---|---|---|---|",
        f"| DexGraspBench's own code | | {held} of {len(own)} | {held / len(own):.1%} "
        f"| {low:.0%} to {high:.0%} | |",
    ]
    for path in results:
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        rows.append(compare(own, lines))
    return "\n".join(rows)


def convert_dexgraspnet(folder: Path, out: Path, count: int) -> int:
    """Write grasps of DexGraspNet in the benchmark's format, and return their number.

    The palm of the benchmark's MJCF is 34 mm above its root. Both hands have the same joints in the
    same order; the joints in `_OPPOSITE` turn in the opposite direction.
    """
    files = sorted((folder / "data/dataset").glob("*.npy"))
    for file in files:
        # The object's convex parts, which make up its mesh.
        mesh = trimesh.load_mesh(folder / f"data/meshdata/{file.stem}/coacd/decomposed.obj")
        parts = mesh.split(only_watertight=False)
        write_object(out / "objects" / file.stem, [np.asarray(part.vertices) for part in parts])

        # Some grasps, from the first to the last.
        grasps = np.load(file, allow_pickle=True)
        (out / "grasps" / file.stem).mkdir(parents=True)
        for number in np.linspace(0, len(grasps) - 1, count // len(files)).astype(int).tolist():
            content: Any = _as_benchmark(grasps[number], f"objects/{file.stem}")
            np.save(out / "grasps" / file.stem / f"{number}.npy", content)
    return count // len(files) * len(files)


def _as_benchmark(grasp: dict[str, Any], path: str) -> dict[str, Any]:
    """Return a grasp of DexGraspNet in the benchmark's format."""
    q = grasp["qpos"]
    R = Rotation.from_euler("xyz", [q[f"WRJR{axis}"] for axis in "xyz"])
    root = np.array([q[f"WRJT{axis}"] for axis in "xyz"]) - R.apply([0.0, 0.0, 0.034])
    pose = np.array([*root, *R.as_quat(scalar_first=True)])

    # In the benchmark's hand, all bending joints bend towards larger angles.
    names = [name.removeprefix("robot0:") for name in q if name.startswith("robot0:")]
    sign = np.array([-1.0 if name in _OPPOSITE else 1.0 for name in names])
    closed = sign * np.array([q[f"robot0:{name}"] for name in names])
    step = APART * np.array([float(name in _BENDING) for name in names])
    return {
        "obj_pose": np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
        "obj_scale": float(grasp["scale"]),
        "obj_path": path,
        "pregrasp_qpos": np.concatenate([pose, closed - step]),
        "grasp_qpos": np.concatenate([pose, closed]),
        "squeeze_qpos": np.concatenate([pose, closed + step]),
    }


def main() -> None:
    """Print the table, or convert grasps."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bench", type=Path, help="folder of DexGraspBench")
    parser.add_argument("results", type=Path, nargs="*", help="JSON lines of verify --protocol")
    parser.add_argument("--dexgraspnet", type=Path, help="folder of DexGraspNet")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.dexgraspnet is None:
        sys.stdout.write(table(given.bench, given.results) + "\n")
    else:
        count = convert_dexgraspnet(given.dexgraspnet, given.out, given.count)
        sys.stdout.write(f"{count} grasps in {given.out}\n")


if __name__ == "__main__":
    main()
