"""Try stored attempts of a dataset again, in the scene as this version builds it.

    python pipelines/measurements/attempts_again.py OUT MESHES --units cm --count 1000
    python pipelines/measurements/attempts_again.py OUT MESHES --set physics.time_step=0.004

OUT may be of an older schema: resting poses X_TO and palm poses X_OG are those of its files, and
the objects are prepared anew from their meshes. Prints JSON: CPU seconds, and how many labels are
others than the stored ones; attempts that geometry alone decided are left out.
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

from drakegrasp.build.prepare import prepare
from drakegrasp.config import override_config
from drakegrasp.dataset.filters import breaks_hold
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.blas import one_thread
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.seeding import Stream
from drakegrasp.simulation.candidates import Pregrasp
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.trial import run_attempt

#: Columns of the stored attempts.
COLUMNS = ("object", "outcome", "X_TO", "X_OG", "spread", "lifted_other_links", "slip", "turn")


def stored_attempts(out: Path, count: int) -> tuple[dict[str, npt.NDArray[Any]], list[str]]:
    """Return columns of `count` simulated attempts, drawn by seed 0, and the objects' names."""
    with h5py.File(out / TRIALS_FILE) as file:
        simulated = np.flatnonzero(np.isfinite(file["trials/time_close"][()]))
        order = np.array(Stream(0).permutation(len(simulated)))
        rows = np.sort(simulated[order[:count]])
        columns = {name: file["trials"][name][()][rows] for name in COLUMNS}
        return columns, list(file["objects/name"].asstr()[()])


@one_thread
def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path, help="directory of a dataset")
    parser.add_argument("meshes", type=Path, help="directory of its meshes")
    parser.add_argument("--units", default="m", choices=("m", "cm", "mm"))
    parser.add_argument("--count", type=int, default=1000, help="attempts (default: 1000)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    arguments = parser.parse_args(argv)

    # The attempts as they are stored, and each object as this version prepares it.
    config = override_config(read_manifest(arguments.dataset).config, arguments.settings)
    columns, names = stored_attempts(arguments.dataset, arguments.count)
    sources = {s.name: s for s in find_meshes(arguments.meshes, units=arguments.units)}
    kept = {
        "then": _is_sample(columns, config.filters),
        "now": np.zeros(len(columns["outcome"]), dtype=bool),
    }
    outcomes, seconds = np.zeros(len(kept["now"]), dtype=int), 0.0
    with progress_bar("Attempts", "attempt") as report:
        done = 0
        for number in np.unique(columns["object"]):
            model = prepare(sources[names[number]], config).model
            scene = build_scene(model, config.physics, load_hand(config.hand))
            if scene.coarse_scene is not None:
                scene.coarse_scene()  # it is built once, and not at the cost of the first lift
            for i in np.flatnonzero(columns["object"] == number):
                X_TO, X_OG = (unpack_pose(columns[name][i]) for name in ("X_TO", "X_OG"))
                attempt = Pregrasp(X_OG=X_OG, spread=columns["spread"][i], audited=True)
                start = time.process_time()
                record = run_attempt(scene, X_TO, attempt, config)
                seconds += time.process_time() - start
                outcomes[i] = record.outcome
                if record.lifted is not None:
                    row = {
                        "outcome": [record.outcome],
                        "lifted_other_links": [record.lifted.other_links],
                        "slip": [record.slip],
                        "turn": [record.turn],
                    }
                    kept["now"][i] = _is_sample(row, config.filters)[0]
                report(done := done + 1, len(outcomes))

    # What changed.
    pairs = zip(columns["outcome"].tolist(), outcomes.tolist(), strict=True)
    changed = Counter(f"{Outcome(a).label} -> {Outcome(b).label}" for a, b in pairs if a != b)
    held = [columns["outcome"] == Outcome.SUCCESS, outcomes == Outcome.SUCCESS]
    result = {
        "settings": arguments.settings,
        "attempts": len(outcomes),
        "cpu_seconds": round(seconds, 2),
        "outcome_changed": sum(changed.values()),
        "held": _counts(*held),
        "sample": _counts(kept["then"], kept["now"]),
        "changed": dict(changed.most_common()),
    }
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 0


def _is_sample(columns: Any, filters: Any) -> npt.NDArray[np.bool_]:
    """Return whether attempts are held, and the filters of the hold keep them."""
    held = np.asarray(columns["outcome"]) == Outcome.SUCCESS
    limits = breaks_hold(filters, *(columns[k] for k in ("lifted_other_links", "slip", "turn")))
    return np.asarray(held & ~np.any([broken for _, broken in limits], axis=0))


def _counts(then: npt.NDArray[np.bool_], now: npt.NDArray[np.bool_]) -> dict[str, int]:
    names = {"then": then, "now": now, "lost": then & ~now, "won": now & ~then}
    return {name: int(np.sum(values)) for name, values in names.items()}


if __name__ == "__main__":
    sys.exit(main())
