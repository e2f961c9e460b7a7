"""Try stored attempts of a dataset again, in the scene as this version builds it.

    python pipelines/measurements/attempts_again.py OUT MESHES --units cm --count 1000
    python pipelines/measurements/attempts_again.py OUT MESHES --set physics.time_step=0.004
    python pipelines/measurements/attempts_again.py OUT MESHES --lifts 9 --set lift.stop_when=never

`--lifts N` takes N samples and N lifts that gave none. OUT may be of an older schema: resting poses
X_TO and palm poses X_OG are those of its files, and the objects are prepared anew from their
meshes. Prints JSON: CPU seconds; how many labels are others than the stored ones; of the grasps
that are samples then and now, what was measured. Attempts that geometry alone decided are left out,
and so are the image filters: a sample here is a grasp that passed the filters of the hold.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.config import FilterConfig
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.filters import first_removal
from drakegrasp.frames import unpack_pose
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import override_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.seeding import Stream
from drakegrasp.simulation.candidates import Pregrasp
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.trial import run_attempt
from drakegrasp.table import Table

QUANTILES = (0.1, 0.5, 0.9)
#: Columns that say what a lift is, and all that are read.
HOLD = ("outcome", "lifted_other_links", "slip", "turn")
COLUMNS = ("object", "X_TO", "X_OG", "spread", "lifted_f_Q_O", *HOLD)


def stored_attempts(
    out: Path, count: int, lifts: int, filters: FilterConfig
) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
    """Return columns of simulated attempts, drawn by seed 0, and the objects' names.

    Args:
        out: Directory of a dataset.
        count: Number of attempts, if `lifts` is 0.
        lifts: Number of samples, and of other lifts.
        filters: What a sample is.
    """
    with h5py.File(out / TRIALS_FILE) as file:
        trials = file["trials"]
        simulated = np.isfinite(trials["time_close"][()])
        groups = [(simulated, count)]
        if lifts:
            sample = _is_sample({name: trials[name][()] for name in HOLD}, filters)
            lifted = np.isfinite(trials["slip"][()])
            groups = [(sample, lifts), (lifted & ~sample, lifts)]
        rows = np.sort(np.concatenate([_drawn(np.flatnonzero(g), n) for g, n in groups]))
        columns = {name: trials[name][()][rows] for name in COLUMNS}
        return columns, list(file["objects/name"].asstr()[()])


def _drawn(rows: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
    return rows[np.array(Stream(0).permutation(len(rows)), dtype=np.int64)[:count]]


@one_thread
def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="directory of a dataset")
    parser.add_argument("meshes", type=Path, help="directory of its meshes")
    parser.add_argument("--units", default="m", choices=("m", "cm", "mm"))
    parser.add_argument("--count", type=int, default=1000, help="attempts (default: 1000)")
    parser.add_argument("--lifts", type=int, default=0, help="this many samples and other lifts")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    arguments = parser.parse_args(argv)

    # The attempts as they are stored, and each object as this version prepares it.
    config = override_config(read_manifest(arguments.dataset).config, arguments.settings)
    columns, names = stored_attempts(
        arguments.dataset, arguments.count, arguments.lifts, config.filters
    )
    sources = {s.name: s for s in find_meshes(arguments.meshes, units=arguments.units)}
    kept = {
        "then": _is_sample(columns, config.filters),
        "now": np.zeros(len(columns["outcome"]), dtype=bool),
    }
    outcomes, seconds = np.zeros(len(kept["now"]), dtype=int), 0.0
    measured = _measured(columns["slip"], columns["turn"], columns["lifted_f_Q_O"])
    again = {name: np.full(len(values), np.nan) for name, values in measured.items()}
    with progress_bar("Attempts", "attempt") as report:
        done = 0
        for number in np.unique(columns["object"]):
            model = prepare(sources[names[number]], config).model
            scene = build_scene(model, config.physics, load_hand(config.hand_source))
            if scene.coarse_scene is not None:
                scene.coarse_scene()  # it is built once, and not at the cost of the first lift
            for i in np.flatnonzero(columns["object"] == number):
                X_TO, X_OG = (unpack_pose(columns[name][i]) for name in ("X_TO", "X_OG"))
                attempt = Pregrasp(X_OG=X_OG, spread=columns["spread"][i], audited=True)
                start = time.process_time()
                record = run_attempt(scene, X_TO, attempt, config)
                seconds += time.process_time() - start
                outcomes[i] = record.outcome
                if record.lift is not None:
                    row = {
                        "outcome": [record.outcome],
                        "lifted_other_links": [record.lift.contacts.other_links],
                        "slip": [record.lift.slip],
                        "turn": [record.lift.turn],
                    }
                    kept["now"][i] = _is_sample(row, config.filters)[0]
                    values = _measured(
                        record.lift.slip, record.lift.turn, record.lift.contacts.f_Q_O
                    )
                    for name, value in values.items():
                        again[name][i] = value
                report(done := done + 1, len(outcomes))

    # What changed.
    pairs = zip(columns["outcome"].tolist(), outcomes.tolist(), strict=True)
    changed = Counter(f"{Outcome(a).label} -> {Outcome(b).label}" for a, b in pairs if a != b)
    both = kept["then"] & kept["now"]
    held = [columns["outcome"] == Outcome.SUCCESS, outcomes == Outcome.SUCCESS]
    result = {
        "settings": arguments.settings,
        "attempts": len(outcomes),
        "cpu_seconds": round(seconds, 2),
        "outcome_changed": sum(changed.values()),
        "held": _counts(*held),
        "sample": _counts(kept["then"], kept["now"]),
        "changed": dict(changed.most_common()),
        "of_samples_10_50_90_percent": {
            name: {
                "then": np.quantile(then[both], QUANTILES).round(2).tolist(),
                "now": np.quantile(again[name][both], QUANTILES).round(2).tolist(),
                "difference": np.quantile(again[name][both] - then[both], QUANTILES)
                .round(2)
                .tolist(),
            }
            for name, then in measured.items()
            if both.any()
        },
    }
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 0


def _is_sample(columns: Any, filters: FilterConfig) -> npt.NDArray[np.bool_]:
    """Return whether attempts are held, and the filters of the hold keep them."""
    held = np.asarray(columns["outcome"]) == Outcome.SUCCESS
    hold = Table(
        other_links=columns["lifted_other_links"], slip=columns["slip"], turn=columns["turn"]
    )
    return np.asarray(held & (first_removal(hold, filters) == Removal.KEPT))


def _measured(
    slip: npt.ArrayLike, turn: npt.ArrayLike, f_Q_O: npt.ArrayLike
) -> dict[str, npt.NDArray[np.float64]]:
    """Return slip [mm], turn [deg] and the sum of the fingertips' forces [N] of lifts."""
    forces = np.linalg.norm(f_Q_O, axis=-1).sum(axis=-1)
    return {"slip": 1e3 * np.asarray(slip), "turn": np.rad2deg(turn), "force": forces}


def _counts(then: npt.NDArray[np.bool_], now: npt.NDArray[np.bool_]) -> dict[str, int]:
    names = {"then": then, "now": now, "lost": then & ~now, "won": now & ~then}
    return {name: int(np.sum(values)) for name, values in names.items()}


if __name__ == "__main__":
    sys.exit(main())
