"""What an attempt has from the configuration, its object and the seed, derived again.

In: rows of `/trials` and the dataset around them. Out: a violation for each row whose conditions,
resting pose or chance are others. The functions are those by which a build draws and computes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from drakegrasp.config import RandomizeConfig
from drakegrasp.dataset.checks.findings import Violation
from drakegrasp.dataset.checks.rows import POSITION_TOLERANCE, AnyArray, Batch
from drakegrasp.dataset.checks.trials import required_of
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.paths import FILE_NAME, model_path
from drakegrasp.dataset.schema import CONDITION_FIELDS
from drakegrasp.errors import HandError
from drakegrasp.hand.folder import is_hand
from drakegrasp.hand.lift_chance import GRASP_CONTACTS, ClosedGrasp, LiftChance, read_lift_chance
from drakegrasp.objects.model import ObjectModel, load_object
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.conditions import draw_conditions
from drakegrasp.simulation.verdict import judge_closed, scrapes

#: Objects whose meshes, with their search trees, stay in memory during a task; samples are ordered
#: by object.
KEPT_OBJECTS = 4
#: Chances are rounded to about a millionth.
CHANCE_TOLERANCE = 1e-5

#: Returns an object by its name, or None if its file is broken, which is a finding.
LoadModel = Callable[[str], ObjectModel | None]


@dataclass(frozen=True, kw_only=True)
class Dataset:
    """The dataset around a file that is checked.

    Attributes:
        out: Its directory.
        manifest: Its manifest.
        readable: Names of the objects whose meshes can be read.
    """

    out: Path
    manifest: Manifest
    readable: frozenset[str]

    def loader(self) -> LoadModel:
        """Return what loads the objects, and keeps some, while a task has it."""
        out, readable = self.out, self.readable

        def load(name: str) -> ObjectModel | None:
            return load_object(model_path(out, name)) if name in readable else None

        return lru_cache(KEPT_OBJECTS)(load)


def resting_poses(batch: Batch, manifest: Manifest) -> Iterator[Violation]:
    """Every attempt starts from one of its object's resting poses."""
    objects, resting = batch["object"].astype(int), batch["resting"].astype(int)
    poses = [np.array([pose.X_TO for pose in entry.resting]) for entry in manifest.objects]
    unknown = resting >= np.array([len(own) for own in poses])[objects]
    what = "resting must be one of its object's resting poses"
    yield from batch.broken(what, unknown, resting)
    if len(batch):
        pairs = zip(objects, np.where(unknown, 0, resting), strict=True)
        due = np.array([poses[i][k] for i, k in pairs])
        known = batch.where(~unknown)
        of = f"the resting poses in {FILE_NAME}"
        yield from known.follows("X_TO", due[~unknown], of, POSITION_TOLERANCE)


def conditions(batch: Batch, manifest: Manifest, model: LoadModel) -> Iterator[Violation]:
    """Friction, mass, looks, cameras and noise are what the seed gives, or the usual ones."""
    due = {f.name: np.array(batch[f.name]) for f in CONDITION_FIELDS}
    for name, known, rows in _by_object(batch, manifest, model):
        own = manifest.config_of(name)
        # Where nothing is drawn all attempts of an object have the same conditions.
        if own.randomize == RandomizeConfig():
            for key, value in draw_conditions(known, own, 0, 0).values().items():
                due[key][rows] = value
            continue
        for row in rows.tolist():
            numbers = (int(batch[key][row]) for key in ("candidate", "standoff_index", "child"))
            for key, value in draw_conditions(known, own, *numbers).values().items():
                due[key][row] = value
    for key, values in due.items():
        yield from batch.follows(key, values, "what the seed gives the attempt", 0.0)


def chances(
    batch: Batch, required: Sequence[bool], manifest: Manifest, model: LoadModel
) -> Iterator[Violation]:
    """A closed hand that may lift has the chance of a sample that its contacts give.

    Args:
        batch: Rows of `/trials`, with sound contacts.
        required: Whether a grasp needs each fingertip on the object.
        manifest: Of the dataset.
        model: Loads its objects.
    """
    # Other files of the hand may have other weights.
    try:
        if not is_hand(manifest.config.hand_source, manifest.versions.get("hand")):
            return
        chance = read_lift_chance(manifest.config.hand_source)
    except HandError:
        return

    # A hand that was never closed has no `time_close`.
    fields = ("closed_touching", "closed_other_links", "closed_hand_on_table")
    verdict = judge_closed(
        *(batch[name] for name in fields),
        required=required_of(batch, required),
        scraped=scrapes(batch["clearance_close"], manifest.config.close),
    )
    lifts = np.isfinite(batch["time_close"]) & (verdict == Outcome.SUCCESS)
    due = np.where(lifts & (chance is not None), batch["chance"], np.nan)
    for _, known, rows in _by_object(batch, manifest, model):
        # That of fewer fingers is of their contacts alone.
        own = rows[lifts[rows] & (batch["unused"][rows] == 0)]
        if chance is not None and len(own):
            due[own] = _chance(chance, batch.where(np.isin(np.arange(len(batch)), own)), known)
    yield from batch.follows("chance", due, "the contacts after closing", CHANCE_TOLERANCE)


def _chance(chance: LiftChance, closed: Batch, model: ObjectModel) -> AnyArray:
    """Return the chances (n,) of closed hands about one object."""
    grasp = ClosedGrasp(
        **{name: closed[f"closed_{name}"] for name in GRASP_CONTACTS},
        X_TO=closed.pose("X_TO"),
        p_OOcm=model.p_OOcm,
        friction_hand=closed["friction_hand"],
    )
    return chance.of(grasp)


def _by_object(
    batch: Batch, manifest: Manifest, model: LoadModel
) -> Iterator[tuple[str, ObjectModel, AnyArray]]:
    """Yield name and model of each object that can be read, and the indices of its rows."""
    for index in np.unique(batch["object"]).tolist():
        # Its file may have another name of it, see `ObjectEntry.drawn_as`.
        name = manifest.objects[index].name
        known = model(name)
        if known is not None:
            yield name, known, np.flatnonzero(batch["object"] == index)
