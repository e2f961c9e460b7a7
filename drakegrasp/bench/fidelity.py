"""Simulates the same attempts in other ways and counts how many labels that changes.

In: attempts of one object with their records and predictions. Out: counts for each variant: without
the screen, at half the time step, with finer surfaces, with Drake's other solvers, and with the
other drives of the fingers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import trimesh

from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.errors import ConfigError
from drakegrasp.generation.attempts import TrialSetup, predict_attempts, try_attempt
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import drive_of
from drakegrasp.simulation.screen import Prediction
from drakegrasp.simulation.trial import TrialRecord


@dataclass(frozen=True)
class Variant:
    """Another way to simulate the same attempts, with which their labels are compared.

    Attributes:
        overrides: Changes of the configuration; `{half}` stands for half of its time step.
        fine: Whether to cut each face of the object into four, so that edges are half as long.
    """

    overrides: tuple[str, ...] = ()
    fine: bool = False


VARIANTS = {
    "screen_off": Variant(("screen.mode=off",)),
    "half_step": Variant(("physics.time_step={half}", "physics.coarse_steps=1")),
    "coarse_steps_off": Variant(("physics.coarse_steps=1",)),
    "double_resolution": Variant(fine=True),
    "similar": Variant(("physics.solver=similar",)),
    "sap": Variant(("physics.solver=sap",)),
}
#: Drives of the fingers, of which those that were not measured are variants as well.
DRIVES = {f"drive_{drive}": drive for drive in ("worm", "torque", "locked")}


class Simulated(NamedTuple):
    """An attempt as it was measured."""

    attempt: Attempt
    record: TrialRecord
    prediction: Prediction | None


def variants(config: Config) -> dict[str, Variant]:
    """Return the variants of a configuration by name: `VARIANTS`, and its hand's other drives."""
    hand = load_hand(config.hand_source)
    own = drive_of(hand, config.lift)
    others = {}
    for name, drive in DRIVES.items():
        override = f"lift.drive={drive}"
        try:
            drive_of(hand, override_config(config, [override]).lift)
        except ConfigError:
            continue  # the hand cannot have this drive
        if drive != own:
            others[name] = Variant((override,))
    return {**VARIANTS, **others}


def compare_labels(
    bench: TrialSetup, simulated: Sequence[Simulated], count: Callable[[Outcome], None]
) -> dict[str, Any]:
    """Simulate some of an object's attempts by each variant, and return how labels differ.

    Args:
        bench: What was measured.
        simulated: The attempts.
        count: Called with each outcome.

    Returns:
        Counts of each variant under "fidelity", and how many labels depend on the drive under
        "drive".
    """
    # Verdicts are compared: what was ended without one is lifted again, to its end.
    bench = replace(bench, config=with_whole_lifts(bench.config))
    records = [
        try_attempt(bench, one.attempt, one.prediction)
        if one.record.outcome.dataset_only
        else one.record
        for one in simulated
    ]
    labels = [record.outcome for record in records]
    lifted = [record.lift is not None for record in records]
    decided = [
        one.prediction is not None and one.prediction.outcome is not None for one in simulated
    ]

    # A label depends on the drive if any other drive gives another label.
    fidelity, depends = {}, np.zeros(len(simulated), dtype=np.bool_)
    for name, variant in variants(bench.config).items():
        outcomes = _simulate(bench, [one.attempt for one in simulated], variant, count)
        pairs = list(zip(labels, outcomes, strict=True))
        fidelity[name] = _count(pairs, decided, lifted)
        if name in DRIVES:
            depends |= [_differ(*pair) for pair in pairs]
    drive = {"attempts": len(simulated), "lifted": sum(lifted), "flips": int(depends.sum())}
    return {"fidelity": fidelity, "drive": drive}


def sum_fidelity(reports: Sequence[Mapping[str, Mapping[str, int]]]) -> dict[str, dict[str, Any]]:
    """Return the counts of all objects by variant, with shares."""
    sums = {}
    for name in reports[0]:
        counts = _total([report[name] for report in reports])
        sums[name] = {
            **counts,
            "flip_share": counts["flips"] / max(1, counts["attempts"]),
            "flip_share_of_simulated": counts["flips"] / max(1, counts["simulated"]),
            "flip_share_of_lifted": counts["lifted_flips"] / max(1, counts["lifted"]),
        }

    # Without the screen, the successes show what the screen loses.
    off = sums["screen_off"]
    lost, successes = off["successes_lost_by_screen"], off["successes_other"]
    off["recall"] = 1.0 - lost / successes if successes else None
    off["precision"] = 1.0 - lost / off["decided"] if off["decided"] else None
    return sums


def sum_drive(reports: Sequence[Mapping[str, int]]) -> dict[str, Any]:
    """Return how many labels of all objects depend on the drive, with shares."""
    counts = _total(reports)
    return {
        **counts,
        "flip_share": counts["flips"] / max(1, counts["attempts"]),
        "flip_share_of_lifted": counts["flips"] / max(1, counts["lifted"]),
    }


def _total(reports: Sequence[Mapping[str, int]]) -> dict[str, Any]:
    return {key: sum(report[key] for report in reports) for key in reports[0]}


def _simulate(
    bench: TrialSetup,
    attempts: Sequence[Attempt],
    variant: Variant,
    count: Callable[[Outcome], None],
) -> list[Outcome]:
    """Return the outcomes of attempts by a variant."""
    # The screen works on the original surface, also if the variant has finer faces.
    half = bench.config.physics.time_step / 2.0
    other = override_config(bench.config, [t.format(half=half) for t in variant.overrides])
    predictions = predict_attempts(replace(bench, config=other), attempts)

    # The scene is the variant's.
    prepared = bench.prepared
    if variant.fine:
        prepared = replace(prepared, model=_finer(prepared.model))
    scene = build_scene(prepared.model, other.physics, load_hand(other.hand_source))
    bench = TrialSetup(prepared=prepared, config=other, scene=scene)

    outcomes = []
    for attempt, prediction in zip(attempts, predictions, strict=True):
        outcomes.append(try_attempt(bench, attempt, prediction).outcome)
        count(outcomes[-1])
    return outcomes


def _finer(model: ObjectModel) -> ObjectModel:
    """Return an object whose collision surface is the same in four times as many faces."""
    vertices, faces = trimesh.remesh.subdivide(model.collision_vertices, model.collision_faces)
    return replace(model, collision_vertices=vertices, collision_faces=faces.astype(np.int32))


def _differ(a: Outcome, b: Outcome) -> bool:
    """Return whether two outcomes are different labels."""
    # Screened attempts stand for missing fingertips, so the two are the same label.
    alike = {Outcome.SCREENED: Outcome.MISSING_FINGERTIP}
    return alike.get(a, a) is not alike.get(b, b)


def _count(
    pairs: Sequence[tuple[Outcome, Outcome]], decided: Sequence[bool], lifted: Sequence[bool]
) -> dict[str, int]:
    """Return how often labels differ, from pairs of outcomes: as measured, by the variant.

    Args:
        pairs: The outcomes.
        decided: Whether geometry alone decided the first outcome of each pair.
        lifted: Whether the first outcome of each pair is the verdict of a lift.
    """
    success = Outcome.SUCCESS
    flips = [pair for pair in pairs if _differ(*pair)]
    both = list(zip(pairs, decided, strict=True))
    return {
        "attempts": len(pairs),
        "flips": len(flips),
        "simulated": sum(a.stage > Stage.PLACED for a, _ in pairs),
        "lifted": sum(lifted),
        "lifted_flips": sum(up and _differ(*pair) for pair, up in zip(pairs, lifted, strict=True)),
        "successes": sum(a is success for a, _ in pairs),
        "successes_other": sum(b is success for _, b in pairs),
        "success_flips": sum(success in pair for pair in flips),
        "decided": sum(decided),
        "successes_lost_by_screen": sum(sure and b is success for (_, b), sure in both),
    }
