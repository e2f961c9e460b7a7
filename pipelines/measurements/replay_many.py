"""Check whether many trials of a dataset are reproduced bit for bit when they are run again.

\b
    python pipelines/measurements/replay_many.py OUT 100 > replay_many.json

Of N trials at least half were lifted, and three in ten ended while the fingers closed; the others
are of any kind. They are drawn with a seed from all trials of the dataset. Each trial is run as
`drakegrasp replay` does, and every stored value is compared. The script prints JSON: how many
trials of each kind were run and are equal, and which values differ in the others. The exit code is
1 if any trial differs.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import multiprocessing
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.generation.replay import Replay, replay_trial
from drakegrasp.runtime.progress import progress_bar

#: Fractions of the trials that were lifted, and that ended while closing.
SHARES = {"lifted": 0.5, "closing": 0.3}


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("number", metavar="N", type=click.IntRange(min=1))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@click.option("--workers", type=click.IntRange(min=1), default=1, show_default=True)
def main(out: Path, number: int, seed: int, workers: int) -> None:
    """Run the script."""
    kinds = choose_trials(out, number, seed)
    tasks = [(out, trial) for trial in kinds]
    found: list[Replay] = []
    with (
        multiprocessing.get_context("spawn").Pool(workers) as pool,
        progress_bar("replay", "trials") as report,
    ):
        for again in pool.imap(_replay, tasks):
            found.append(again)
            report(len(found), len(tasks))

    result = summarise(kinds, found)
    click.echo(json.dumps(result, indent=1))
    sys.exit(0 if result["equal"] == result["trials"] else 1)


def choose_trials(out: Path, number: int, seed: int) -> dict[int, str]:
    """Return the ids of trials to run, each with its kind: lifted, closing or placed.

    Raises:
        UsageError: If there are too few trials of a kind.
    """
    with h5py.File(out / TRIALS_FILE, "r") as file:
        closed = np.isfinite(file["trials/time_close"][:])
        lifted = np.isfinite(file["trials/time_lift"][:])
    kind = np.where(lifted, "lifted", np.where(closed, "closing", "placed"))

    # Draw the required kinds first, then any kind.
    rng = np.random.default_rng(seed)
    chosen: dict[int, str] = {}
    for name, share in SHARES.items():
        chosen |= _draw(rng, kind, kind == name, round(share * number), name)
    left = np.ones(len(kind), dtype=bool)
    left[list(chosen)] = False
    chosen |= _draw(rng, kind, left, number - len(chosen), "any")
    return dict(sorted(chosen.items()))


def _draw(
    rng: np.random.Generator,
    kind: npt.NDArray[np.str_],
    allowed: npt.NDArray[np.bool_],
    number: int,
    name: str,
) -> dict[int, str]:
    rows = np.flatnonzero(allowed)
    if len(rows) < number:
        raise click.UsageError(f"trials ({name}) must be at least {number}, got {len(rows)}")
    return {int(row): str(kind[row]) for row in rng.choice(rows, number, replace=False)}


def summarise(kinds: dict[int, str], found: list[Replay]) -> dict[str, Any]:
    """Return the counts of trials that were run and that are equal, and the differences."""
    equal = [again for again in found if again.same]
    return {
        "trials": len(found),
        "equal": len(equal),
        "run_by_kind": dict(Counter(kinds[again.trial_id] for again in found)),
        "equal_by_kind": dict(Counter(kinds[again.trial_id] for again in equal)),
        "run_by_outcome": dict(Counter(again.recorded.label for again in found)),
        "objects": len({again.object_name for again in found}),
        "other_versions": found[0].versions,
        "different": {
            again.trial_id: {
                "object": again.object_name,
                "was": again.recorded.label,
                "is": again.found.label,
                **again.differences,
            }
            for again in found
            if not again.same
        },
    }


def _replay(task: tuple[Path, int]) -> Replay:
    out, trial = task
    return replay_trial(out, trial)


if __name__ == "__main__":
    main()
