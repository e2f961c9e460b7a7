"""Runs a trial of a dataset again, and reports the values that differ or records its motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import installed_versions, read_manifest
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.dataset.trials import Trials
from drakegrasp.generation.attempts import TrialSetup, find_attempt, trial_rows, try_attempt
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.recording import record_attempt
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import build_scene


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A trial that was run again.

    Attributes:
        trial_id: Row of the trial in /trials.
        object_name: Name of the object.
        recorded: Outcome in the file.
        found: Outcome of the replay.
        differences: Largest absolute difference of each field whose values differ.
        versions: Packages whose versions differ, with values "then -> now".
    """

    trial_id: int
    object_name: str
    recorded: Outcome
    found: Outcome
    differences: dict[str, float]
    versions: dict[str, str]

    @property
    def same(self) -> bool:
        """Whether the replay reproduced every stored value bit for bit."""
        return not self.differences


@one_thread
def replay_trial(out: str | Path, trial_id: int) -> Replay:
    """Run one trial of a dataset again, from its prepared object and its candidate.

    With the same machine and versions, the values are equal bit for bit. `versions` lists the
    packages that have other versions now.

    Raises:
        DataError: If the dataset or the trial is not there.
    """
    stored, prepared, attempt, config = _stored_trial(Path(out), trial_id)

    # Run the attempt as a work unit does, and create the row that the unit would store.
    scene = build_scene(prepared.model, config.physics, load_hand(config.hand_source))
    setup = TrialSetup(prepared=prepared, config=config, scene=scene)
    record = try_attempt(setup, attempt)
    row = trial_rows(setup, [attempt], [record])

    # Compare bit for bit; other versions may explain a difference.
    then, now = read_manifest(Path(out)).versions, installed_versions(config)
    pairs = {f.name: (stored[f.name], row[f.name][0]) for f in trial_columns() if f.name in row}
    return Replay(
        trial_id=trial_id,
        object_name=stored["object_name"],
        recorded=Outcome(int(stored["outcome"])),
        found=Outcome(int(row["outcome"][0])),
        differences={
            name: _difference(*pair)
            for name, pair in pairs.items()
            if not np.array_equal(*pair, equal_nan=True)
        },
        versions={
            key: f"{known} -> {now.get(key)}"
            for key, known in then.items()
            if now.get(key) != known
        },
    )


def record_trial(out: str | Path, trial_id: int, path: str | Path) -> Outcome:
    """Run one trial of a dataset again and write an HTML file that plays it back.

    Returns:
        The outcome of the replay.

    Raises:
        DataError: If the dataset or the trial is not there.
        OSError: If the file cannot be written.
    """
    _, prepared, attempt, config = _stored_trial(Path(out), trial_id)
    X_TO = prepared.resting_poses[attempt.resting]
    return record_attempt(prepared.model, X_TO, attempt, config, Path(path)).outcome


def _stored_trial(
    out: Path, trial_id: int
) -> tuple[dict[str, Any], PreparedObject, Attempt, Config]:
    """Return a row of trials.hdf5, with the object, attempt and configuration to run it again."""
    manifest, row = read_manifest(out), Trials(out).trial(trial_id)
    config = manifest.config
    prepared = load_prepared(out, row["object_name"], config)
    candidate, standoff = (int(row[key]) for key in ("candidate", "standoff_index"))
    return row, prepared, find_attempt(prepared, candidate, standoff, config), config


def _difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.max(np.abs(np.asarray(a, dtype=float) - np.asarray(b, dtype=float))))
