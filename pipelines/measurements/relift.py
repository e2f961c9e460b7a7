"""Try stored attempts of a dataset again with other settings, and report how they end.

    python pipelines/measurements/relift.py OUT --count 256 --set physics.time_step=0.002
    python pipelines/measurements/relift.py OUT --rows both --count 300 --set lift.stop_when=never
    python pipelines/measurements/relift.py OUT --rows attempts --set lift.stop_when=lost_sample

Each attempt is tried as it is stored, and then with the settings of `--set`. The script prints JSON
for both: the number of lifts with a verdict; the numbers that are lifted and that are samples, with
their intervals; the outcomes that differ from those as stored; and CPU seconds. Samples are judged
by the filters except those that need pictures, the outlier filter and user-defined filters. For
lifts it also prints the medians of slip, turn, force and of how far a closing joint opened.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal
from drakegrasp.generation.attempts import find_attempt, judge_sample
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.seeding import Stream
from drakegrasp.simulation.scene_cache import cached_scene
from drakegrasp.simulation.trial import TrialRecord, run_attempt

#: Results of an attempt under one change, or of all attempts.
Found = dict[str, Any]
#: Last number of the keys of the random streams.
PLACE = 25
STORED, SET = "as stored", "as set"


def chosen_rows(out: Path, kind: str, count: int, seed: int) -> npt.NDArray[np.int64]:
    """Return ids of drawn attempts of one kind, or of equally many samples and other lifts."""
    trials = Trials(out)
    ids, is_lift = trials.trial_ids, np.isfinite(trials["time_lift"])
    is_sample = np.isin(ids, trials.where(kept=True).trial_ids)
    groups = {
        "attempts": [np.isfinite(trials["time_close"])],
        "lifts": [is_lift],
        "samples": [is_sample],
        "both": [is_sample, is_lift & ~is_sample],
    }[kind]
    found = []
    for group in groups:
        pile = ids[group]
        found.append(pile[Stream(seed, PLACE).permutation(len(pile))[:count]])
    return np.sort(np.concatenate(found))


def try_again(
    out: Path,
    trial_id: int,
    stored: Config,
    other: Config,
    prepared: Callable[[str], PreparedObject],
) -> list[Found]:
    """Return the results of an attempt as stored, and with the changed settings.

    Args:
        out: Directory of the dataset.
        trial_id: Id of the attempt.
        stored: Configuration of the dataset.
        other: Configuration with the changed settings.
        prepared: Function that returns a prepared object of the dataset by its name.
    """
    row = Trials(out).trial(trial_id)
    model = prepared(row["object_name"])
    hand = load_hand(stored.hand_source)
    # The palm pose is that of the stored settings, friction and mass are those of the others.
    drawn = {"physics": other.physics, "randomize": other.randomize}
    found = []
    for change, draw, rules in (
        (STORED, stored, stored),
        (SET, stored.model_copy(update=drawn), other),
    ):
        candidate, standoff = int(row["candidate"]), int(row["standoff_index"])
        attempt = find_attempt(model, candidate, standoff, draw)
        scene = cached_scene(model.model, rules.physics, rules.hand_source, attempt.preshape)
        start = time.process_time()
        record = run_attempt(scene, model.resting_poses[attempt.resting], attempt, rules)
        spent = time.process_time() - start
        removal = judge_sample(model.model, record, rules, views=False)
        told = {"outcome": record.outcome.label, "kept": removal is Removal.KEPT}
        found.append({"change": change, **told, "seconds": spent, **measured(hand, record)})
    return found


def measured(hand: Hand, record: TrialRecord) -> Found:
    """Return slip [mm], turn [deg], sum of forces [N] and largest opening [deg] of a lift."""
    if record.lift is None or record.closed is None:
        return {}
    joints = [hand.joint_names.index(finger.closing_joint) for finger in hand.fingers]
    opened = float((record.closed.q - record.lift.q)[joints].max())
    return {
        "slip": 1e3 * record.lift.slip,
        "turn": float(np.rad2deg(record.lift.turn)),
        "force": float(np.linalg.norm(record.lift.contacts.f_Q_O, axis=1).sum()),
        "opened": float(np.rad2deg(opened)),
    }


def summary(rows: Sequence[Sequence[Found]]) -> dict[str, Found]:
    """Return the results of all attempts by change."""
    by_change: dict[str, list[tuple[Found, Found]]] = {}
    for row in rows:
        for found in row:
            by_change.setdefault(found["change"], []).append((row[0], found))
    return {change: _of_change(pairs) for change, pairs in by_change.items()}


def _of_change(pairs: Sequence[tuple[Found, Found]]) -> Found:
    failed = {outcome.label for outcome in Outcome if outcome.inconclusive}
    own = [found for _, found in pairs if found["outcome"] not in failed]
    others = Counter(
        f"{stored['outcome']} -> {found['outcome']}"
        for stored, found in pairs
        if stored["outcome"] != found["outcome"]
    )
    tried = [found for found in own if "slip" in found]
    return {
        "tried": len(pairs),
        "with a verdict": len(own),
        "lifted": _share([found["outcome"] == Outcome.SUCCESS.label for found in own]),
        "kept": _share([found["kept"] for found in own]),
        "CPU seconds": round(sum(found["seconds"] for _, found in pairs), 2),
        "changed": dict(others.most_common()),
        "medians": {
            name: round(float(np.median([found[name] for found in tried])), 3)
            for name in ("slip", "turn", "force", "opened")
            if tried
        },
    }


def _share(hits: Sequence[bool]) -> list[float]:
    """Return the count, the fraction, and its interval."""
    low, high = np.nan, np.nan
    if hits:
        low, high = binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
    return [
        sum(hits),
        *(round(float(x), 3) for x in (np.mean(hits) if hits else np.nan, low, high)),
    ]


@one_thread
def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="directory of a dataset")
    parser.add_argument("--rows", default="lifts", choices=("attempts", "lifts", "samples", "both"))
    parser.add_argument("--count", type=int, default=100, help="rows of each kind (default: 100)")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings")
    arguments = parser.parse_args(argv)

    out, rows = arguments.dataset, list[list[Found]]()
    config = read_manifest(out).config
    other = override_config(config, arguments.settings)
    prepared = lru_cache(1)(lambda name: load_prepared(out, name, config))
    ids = chosen_rows(out, arguments.rows, arguments.count, config.seed)
    with progress_bar("attempts", "attempts") as report:
        for trial_id in ids.tolist():
            rows.append(try_again(out, trial_id, config, other, prepared))
            report(len(rows), len(ids))
    result: Found = {"settings": arguments.settings, "rows": arguments.rows, **summary(rows)}
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
