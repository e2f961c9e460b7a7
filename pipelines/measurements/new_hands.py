"""Draft hands from the models of dex-urdf, build a small dataset with each, and try it again.

Input: a checkout of dexsuite/dex-urdf and a folder of meshes in metres. Output: a table in
Markdown, which reports the results, and how many samples hold again if their palm poses and joints
are passed back as postures. Steps whose results already exist are skipped. HAND may also be a hand
of the package.

    python pipelines/measurements/new_hands.py DEX_URDF MESHES [HAND...] --out FOLDER
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DrakegraspError
from drakegrasp.filters import Removal
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.posture import joint_order

#: Models of the right hands, and the options with which `hand new` reads them.
HANDS = {
    "Ability": ("ability_hand/ability_hand_right.urdf", ()),
    "Allegro": ("allegro_hand/allegro_hand_right.urdf", ()),
    "Barrett": ("barrett_hand/bhand_model.urdf", ("--effort", "2")),
    "Inspire": ("inspire_hand/inspire_hand_right.urdf", ()),
    "LEAP": ("leap_hand/leap_hand_right.urdf", ()),
    "Panda": ("panda_gripper/panda_gripper_glb.urdf", ()),
    "SCHUNK SVH": ("schunk_hand/schunk_svh_hand_right.urdf", ("--effort", "0.5")),
    "Shadow": ("shadow_hand/shadow_hand_right.urdf", ()),
}
#: Mass of the objects [kg], and maximum number of a hand's samples that are tried again.
MASS, MOST_AGAIN = 0.3, 40
HEADS = (
    *("hand", "attempts", "held", "precision", "stable", "samples", "distinct"),
    "held again as postures",
)


def main() -> None:
    """Build the missing datasets, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path, metavar="DEX_URDF")
    parser.add_argument("meshes", type=Path, metavar="MESHES")
    parser.add_argument("hands", nargs="*", metavar="HAND", help="[default: all]")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--candidates", type=int, default=60, help="palm poses of an object")
    parser.add_argument("--workers", type=int, default=1)
    arguments = parser.parse_args()
    _say(HEADS)
    _say(["---"] * len(HEADS))
    for name in arguments.hands or HANDS:
        _say([name, *measure(name, arguments)])


def measure(name: str, arguments: argparse.Namespace) -> list[str]:
    """Return the cells of a hand's row."""
    model, answers = HANDS.get(name, (name, ()))
    folder = arguments.out / model.split("/")[0]
    try:
        if name in HANDS and not (folder / "hand").is_dir():
            path = arguments.models / "robots/hands" / model
            _run("hand", "new", str(path), "--out", str(folder / "hand"), *answers)
        # Hands of the package need no draft.
        (hand,) = (folder / "hand").glob("*_hand.yaml") if name in HANDS else [name]
        build = ["--objects", arguments.meshes, "--config", "fast", "--set", f"hand={hand}"]
        build += ["--set", f"objects.mass={MASS}", "--workers", arguments.workers, "--quiet"]
        _run("build", *build, "--candidates", arguments.candidates, "--out", folder / "data")
        again = "-"
        if count := write_postures(folder / "data", folder / "samples.npz"):
            given = ["--postures", folder / "samples.npz", "--out", folder / "again"]
            _run("build", *build, *given)
            outcomes = Trials(folder / "again")["outcome"]
            again = f"{np.count_nonzero(outcomes == Outcome.SUCCESS)} of {count}"
        return [*_counts(folder / "data"), again]
    except (subprocess.CalledProcessError, DrakegraspError, ValueError) as error:
        return [str(getattr(error, "stderr", None) or error).strip().splitlines()[-1]]


def _counts(out: Path) -> list[str]:
    """Return the results of a dataset."""
    funnel = count_funnel(out)
    counts = (
        funnel.outcomes.sum(),
        funnel.outcomes[:, Outcome.SUCCESS].sum(),
        funnel.precision.sum(),
        funnel.stable.sum(),
        funnel.samples.sum(),
        funnel.distinct.sum(),
    )
    return [f"{int(n):,}" for n in counts]


def write_postures(out: Path, path: Path) -> int:
    """Write evenly chosen samples as postures that begin with the open hand; return the count."""
    trials = Trials(out)
    kept = np.flatnonzero(trials["removal"] == Removal.KEPT)
    if not len(kept):
        return 0
    chosen = kept[np.unique(np.linspace(0, len(kept) - 1, MOST_AGAIN).astype(int))]
    rows = trials[chosen].columns(
        ("object_name", "X_OG", "closed_q", "spread", "preshape", "resting")
    )
    hand = load_hand(read_manifest(out).config.hand_source)
    order = joint_order(hand)

    def opened(i: int) -> list[float]:
        shaped = hand.at(int(rows["preshape"][i]))
        named = joint_positions(shaped, float(rows["spread"][i]), np.zeros(shaped.num_fingers))
        return [named[joint] for joint in order]

    arrays: dict[str, Any] = {
        "object": np.array(rows["object_name"], dtype=str),
        "X_FG": rows["X_OG"],
        "q_grasp": rows["closed_q"],
        "q_pregrasp": np.array([opened(i) for i in range(len(chosen))]),
        "joints": np.array(order),
        "resting": rows["resting"],
    }
    if hand.preshapes:
        arrays["preshape"] = np.array([hand.preshape_names[i] for i in rows["preshape"]])
    np.savez(path, **arrays)
    return len(chosen)


def _run(*words: Any) -> None:
    """Run a drakegrasp command."""
    code = "from drakegrasp.cli.main import run; run()"
    command = [sys.executable, "-c", code, *map(str, words)]
    subprocess.run(command, check=True, capture_output=True, text=True)


def _say(cells: Any) -> None:
    sys.stdout.write(f"| {' | '.join(cells)} |\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
