"""Simulate attempts under other settings, and count how many labels change.

\b
    python pipelines/measurements/fidelity.py G3DB --units cm --candidates 600 --number 600

For each mesh, some attempts whose palm ray meets it are drawn with the seed, and simulated to a
verdict: as the configuration specifies, without the screen, at half the time step, with four times
as many faces, with Drake's other solvers, and with the other drives of the fingers. The script
prints JSON: the counts of each variant with their fractions, and how many labels depend on the
drive.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
import trimesh

from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.errors import ConfigError
from drakegrasp.generation.attempts import TrialSetup, list_attempts, predict_attempts, try_attempt
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.seeding import Stream
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.drive import drive_of


@dataclass(frozen=True)
class Variant:
    """Other settings for the same attempts, with which their labels are compared.

    Attributes:
        overrides: Changes of the configuration; `{half}` stands for half of its time step.
        fine: Whether each face of the object is cut into four, so that edges are half as long.
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
#: Drives of the fingers; the drives that were not used for the labels are also variants.
DRIVES = {f"drive_{drive}": drive for drive in ("worm", "torque", "locked")}


def variants(config: Config) -> dict[str, Variant]:
    """Return the variants of a configuration by name: `VARIANTS`, and the hand's other drives."""
    hand = load_hand(config.hand_source)
    own, others = drive_of(hand, config.lift), {}
    for name, drive in DRIVES.items():
        override = f"lift.drive={drive}"
        try:
            drive_of(hand, override_config(config, [override]).lift)
        except ConfigError:
            continue  # the hand cannot have this drive
        if drive != own:
            others[name] = Variant((override,))
    return {**VARIANTS, **others}


def compare_labels(setup: TrialSetup, attempts: Sequence[Attempt]) -> dict[str, Counter[str]]:
    """Return how labels of an object's attempts differ, by variant.

    `drive` counts the attempts whose label changes with any drive. Verdicts are compared, so each
    closed hand lifts until it is certain whether it holds.
    """
    setup = replace(setup, config=with_whole_lifts(setup.config))
    predictions = predict_attempts(setup, attempts)
    records = [try_attempt(setup, *pair) for pair in zip(attempts, predictions, strict=True)]
    labels = [record.outcome for record in records]
    lifted = [record.lift is not None for record in records]
    decided = [guess is not None and guess.outcome is not None for guess in predictions]

    found, depends = {}, np.zeros(len(attempts), dtype=np.bool_)
    for name, variant in variants(setup.config).items():
        pairs = list(zip(labels, simulate(setup, attempts, variant), strict=True))
        found[name] = count(pairs, decided, lifted)
        if name in DRIVES:
            depends |= [differ(*pair) for pair in pairs]
    drive = {"attempts": len(attempts), "lifted": sum(lifted), "flips": int(depends.sum())}
    return {**found, "drive": Counter(drive)}


def simulate(setup: TrialSetup, attempts: Sequence[Attempt], variant: Variant) -> Iterator[Outcome]:
    """Yield the outcomes of attempts under a variant."""
    # The screen works on the original surface, even if the variant has finer faces.
    half = setup.config.physics.time_step / 2.0
    other = override_config(setup.config, [t.format(half=half) for t in variant.overrides])
    predictions = predict_attempts(replace(setup, config=other), attempts)

    # Build the scene of the variant.
    prepared = setup.prepared
    if variant.fine:
        prepared = replace(prepared, model=finer(prepared.model))
    scene = build_scene(prepared.model, other.physics, load_hand(other.hand_source))
    setup = TrialSetup(prepared=prepared, config=other, scene=scene)
    for attempt, prediction in zip(attempts, predictions, strict=True):
        yield try_attempt(setup, attempt, prediction).outcome


def finer(model: ObjectModel) -> ObjectModel:
    """Return an object with the same collision surface, cut into four times as many faces."""
    vertices, faces = trimesh.remesh.subdivide(model.collision_vertices, model.collision_faces)
    return replace(model, collision_vertices=vertices, collision_faces=faces.astype(np.int32))


def differ(a: Outcome, b: Outcome) -> bool:
    """Return whether two outcomes are different labels."""
    # A screened attempt would have been a missing fingertip, so the two are the same label.
    alike = {Outcome.SCREENED: Outcome.MISSING_FINGERTIP}
    return alike.get(a, a) is not alike.get(b, b)


def count(
    pairs: Sequence[tuple[Outcome, Outcome]], decided: Sequence[bool], lifted: Sequence[bool]
) -> Counter[str]:
    """Return how often labels differ in pairs of outcomes: as configured, and under the variant.

    Args:
        pairs: The outcomes.
        decided: Whether geometry alone decided the first outcome of each pair.
        lifted: Whether the first outcome of each pair is the verdict of a lift.
    """
    success = Outcome.SUCCESS
    flips = [pair for pair in pairs if differ(*pair)]
    both = list(zip(pairs, decided, strict=True))
    return Counter(
        attempts=len(pairs),
        flips=len(flips),
        simulated=sum(a.stage > Stage.PLACED for a, _ in pairs),
        lifted=sum(lifted),
        lifted_flips=sum(up and differ(*pair) for pair, up in zip(pairs, lifted, strict=True)),
        successes=sum(a is success for a, _ in pairs),
        successes_other=sum(b is success for _, b in pairs),
        success_flips=sum(success in pair for pair in flips),
        decided=sum(decided),
        successes_lost_by_screen=sum(sure and b is success for (_, b), sure in both),
    )


def summary(objects: Sequence[dict[str, Counter[str]]]) -> dict[str, dict[str, Any]]:
    """Return the counts of all objects by variant, with fractions."""
    sums: dict[str, dict[str, Any]] = {}
    for name in objects[0]:
        n = {key: sum(each[name][key] for each in objects) for key in objects[0][name]}
        flips = n.get("lifted_flips", n["flips"])
        sums[name] = {
            **n,
            "flip_share": n["flips"] / max(1, n["attempts"]),
            "flip_share_of_lifted": flips / max(1, n["lifted"]),
        }
        if "simulated" in n:
            sums[name]["flip_share_of_simulated"] = n["flips"] / max(1, n["simulated"])

    # The successes without the screen show what the screen loses.
    off = sums["screen_off"]
    lost, successes = off["successes_lost_by_screen"], off["successes_other"]
    off["recall"] = 1.0 - lost / successes if successes else None
    off["precision"] = 1.0 - lost / off["decided"] if off["decided"] else None
    return sums


@click.command(help=__doc__)
@click.argument("meshes", type=click.Path(path_type=Path))
@click.option("--units", default="m", show_default=True, help="Unit of length of the meshes.")
@click.option("--config", help="Preset or YAML file.  [default: paper]")
@click.option("--set", "overrides", multiple=True, help="Change one setting, KEY=VALUE.")
@click.option("--candidates", default=100, show_default=True, help="Palm poses per object.")
@click.option("--number", default=100, show_default=True, help="Number of attempts per object.")
@one_thread
def main(
    meshes: Path,
    units: str,
    config: str | None,
    overrides: tuple[str, ...],
    candidates: int,
    number: int,
) -> None:
    """Run the script."""
    rules = load_config(config, [*overrides, f"candidates.max={candidates}"])
    sources, found = find_meshes(meshes, units=units), list[dict[str, Counter[str]]]()
    with progress_bar("fidelity", "objects") as progress:
        for source in sources:
            prepared = prepare(source, rules)
            attempts = list_attempts(prepared, range(len(prepared.candidates)), rules)
            hits = [attempt for attempt in attempts if attempt.ray_hits]
            rows = Stream(rules.seed).permutation(len(hits))[:number]
            scene = build_scene(prepared.model, rules.physics, load_hand(rules.hand_source))
            setup = TrialSetup(prepared=prepared, config=rules, scene=scene)
            found.append(compare_labels(setup, [hits[k] for k in rows]))
            progress(len(found), len(sources))
    click.echo(json.dumps(summary(found), indent=1))


if __name__ == "__main__":
    main()
