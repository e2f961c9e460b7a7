"""Runs a trial of a dataset again, and reports the values that differ or records its motion.

A trial is a row of trials.hdf5, or a grasp that was tried among others, a row of clutter.hdf5.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.config import Config
from drakegrasp.dataset.clutter import Clutter, load_scene
from drakegrasp.dataset.hdf5 import open_scenes, read_columns
from drakegrasp.dataset.manifest import installed_versions, read_manifest
from drakegrasp.dataset.paths import CLUTTER_FILE
from drakegrasp.dataset.prepared_objects import PreparedObject, load_prepared
from drakegrasp.dataset.scenes import validate_state
from drakegrasp.dataset.schema import NOT_TRIED, SCENE_GRASP_FIELDS
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.generation.attempts import TrialSetup, find_attempt, trial_rows, try_attempt
from drakegrasp.generation.clutter_scene import try_grasp
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.recording import record_attempt
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import build_scene

#: Columns of /grasps that tell of a try in a scene.
TRY_LABELS = (
    *("object", "trial_id", "outcome", "tested", "lifted", "kept", "clean", "precision", "stable"),
    *("neighbour", "neighbour_shift", "neighbour_turn"),
)


@dataclass(frozen=True, kw_only=True)
class Replay:
    """A trial that was run again.

    Attributes:
        trial_id: Row of the trial in /trials; of a grasp among others, that of its sample.
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

    found = {f.name: row[f.name][0] for f in trial_columns() if f.name in row}
    return _compared(Path(out), trial_id, stored["object_name"], stored, found)


@one_thread
def replay_clutter(out: str | Path, row: int) -> Replay:
    """Try a grasp of clutter.hdf5 again, in its scene, and compare its labels; see `replay_trial`.

    Args:
        out: Directory of the dataset.
        row: Row of /grasps, of a grasp that was tried.

    Raises:
        DataError: If the dataset, its clutter.hdf5 or the grasp is not there.
    """
    clutter, i, attempt, stored = _stored_try(Path(out), row)
    found = {
        name: np.asarray(value, dtype=stored[name].dtype)
        for name, value in try_grasp(clutter, i, attempt).items()
    }
    return _compared(Path(out), int(stored["trial_id"]), clutter.names[i], stored, found)


def _compared(
    out: Path, trial_id: int, name: str, stored: Mapping[str, Any], found: Mapping[str, Any]
) -> Replay:
    """Return how stored and found values compare bit for bit, by the names of the found ones."""
    manifest = read_manifest(out)
    # Other versions may explain a difference.
    then, now = manifest.versions, installed_versions(manifest.config)
    pairs = {key: (stored[key], value) for key, value in found.items()}
    return Replay(
        trial_id=trial_id,
        object_name=name,
        recorded=Outcome(int(stored["outcome"])),
        found=Outcome(int(found["outcome"])),
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


def record_clutter(out: str | Path, row: int, path: str | Path) -> Outcome:
    """Try a grasp of clutter.hdf5 again and write an HTML file that plays it back.

    Returns:
        The outcome of the replay.

    Raises:
        DataError: If the dataset, its clutter.hdf5 or the grasp is not there.
        OSError: If the file cannot be written.
    """
    clutter, i, attempt, _ = _stored_try(Path(out), row)
    X_TO, around = clutter.simulated(i)
    about = clutter.models[i], X_TO, attempt, clutter.config, Path(path)
    return record_attempt(*about, around=around or None).outcome


def _stored_try(out: Path, row: int) -> tuple[Clutter, int, Attempt, dict[str, Any]]:
    """Return the scene, object, attempt and labels of a row of /grasps in clutter.hdf5."""
    path, trials = out / CLUTTER_FILE, Trials(out)
    validate_state(path, trials)
    with open_scenes(path) as file:
        grasps = read_columns(file["grasps"], SCENE_GRASP_FIELDS, ("scene", *TRY_LABELS))
    if not 0 <= row < grasps.count or grasps.outcome[row] == NOT_TRIED:
        tried = np.flatnonzero(grasps.outcome != NOT_TRIED)
        known = f"{tried[0]} to {tried[-1]}" if len(tried) else "none"
        raise DataError(f"{path}: row must be of a grasp that was tried, {known}, got {row}")

    # The attempt is that of the dataset.
    stored = {name: grasps[name][row] for name in grasps}
    clutter, i = load_scene(path, int(stored["scene"])), int(stored["object"])
    trial = trials.trial(int(stored["trial_id"]))
    candidate, standoff = (int(trial[key]) for key in ("candidate", "standoff_index"))
    attempt = find_attempt(clutter.prepared[i], candidate, standoff, clutter.config)
    return clutter, i, attempt, stored


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
