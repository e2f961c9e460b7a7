"""Measure where the time of simulated attempts goes, phase by phase.

\b
    python pipelines/measurements/speed.py phases MESHES --units cm --config paper --candidates 100

A phase is a stage (closing or lifting), a step size, and whether the object touches the table. The
script prints JSON: for each phase the CPU seconds, their fraction of all phases, the number of
steps, the milliseconds per step, and the mean number of contact polygons between hand and object
and between object and table, counted at the end of each simulated period.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

import click

from drakegrasp.config import Config
from drakegrasp.generation.attempts import (
    TrialSetup,
    list_attempts,
    look_at,
    predict_attempts,
    try_attempt,
)
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.simulation.scene import Scene, TrialLimits
from drakegrasp.simulation.scene_cache import cached_scene

#: What is summed for each phase; the last two at the end of each period.
COUNTED = "seconds", "steps", "periods", "hand", "table"


@click.command(help=__doc__)
@click.argument("meshes", type=click.Path(path_type=Path, exists=True))
@click.option("--units", type=click.Choice(["m", "cm", "mm"]), default="m", show_default=True)
@click.option("--config", default="paper", show_default=True, help="Preset or YAML file.")
@click.option("--candidates", type=click.IntRange(min=1), default=100, show_default=True)
@click.option("--only", multiple=True, metavar="NAME", help="Object to measure; repeatable.")
def main(meshes: Path, units: str, config: str, candidates: int, only: tuple[str, ...]) -> None:
    """Run the script."""
    sources = [s for s in find_meshes(meshes, units=units) if not only or s.name in only]
    rules = load_config(config, overrides=[f"candidates.max={candidates}"])
    phases = defaultdict[str, dict[str, float]](dict)
    advance = TrialLimits.advance

    def timed(limits: TrialLimits, scene: Scene, duration: float) -> None:
        # `lift` and `trial` call this; only a scene with coarse steps has no such scene.
        stage = "lift" if sys._getframe(1).f_code.co_name == "lift" else "close"
        size = "coarse" if stage == "lift" and scene.coarse_scene is None else "fine"
        began = time.thread_time()
        advance(limits, scene, duration)
        seconds = time.thread_time() - began
        hand, table = count_polygons(scene)
        phase = phases[f"{stage}, {size} steps, object {'on' if table else 'off'} the table"]
        steps = duration / scene.physics.time_step
        for name, value in zip(COUNTED, (seconds, steps, 1, hand, table), strict=True):
            phase[name] = phase.get(name, 0.0) + value

    stages, held = dict[str, float](), 0
    with patch.object(TrialLimits, "advance", timed), progress_bar("measure", "objects") as report:
        for number, source in enumerate(sources, 1):
            held += try_object(source, rules, stages)
            report(number, len(sources), grasps=held)
    total = sum(phase["seconds"] for phase in phases.values())
    rows = {
        name: {
            "seconds": round(phase["seconds"], 2),
            "fraction": round(phase["seconds"] / total, 3),
            "steps": round(phase["steps"]),
            "ms_per_step": round(1e3 * phase["seconds"] / phase["steps"], 2),
            "hand_polygons": round(phase["hand"] / phase["periods"], 1),
            "table_polygons": round(phase["table"] / phase["periods"], 1),
        }
        for name, phase in sorted(phases.items(), key=lambda item: -item[1]["seconds"])
    }
    result = {"objects": len(sources), "held": held, "stages": stages, "phases": rows}
    sys.stdout.write(json.dumps(result, indent=1) + "\n")


@one_thread
def try_object(source: MeshSource, config: Config, stages: dict[str, float]) -> int:
    """Try the attempts of a mesh as a build does, and return how many hold.

    Args:
        source: The mesh.
        config: The configuration.
        stages: CPU seconds by stage; updated in place.
    """

    @contextmanager
    def stage(name: str) -> Iterator[None]:
        began = time.process_time()
        yield
        stages[name] = stages.get(name, 0.0) + time.process_time() - began

    with stage("prepare"):
        prepared = prepare(source, config)
    attempts = list_attempts(prepared, range(len(prepared.candidates)), config)
    with stage("scene"):
        scene = cached_scene(prepared.model, config.physics, config.hand_source)
        setup = TrialSetup(prepared=prepared, config=config, scene=scene)
    with stage("field"):
        _ = prepared.model.field
    with stage("screen"):
        predictions = predict_attempts(setup, attempts)
    with stage("try"):
        records = list(map(try_attempt, [setup] * len(attempts), attempts, predictions))
    held = [
        (attempt, record)
        for attempt, record in zip(attempts, records, strict=True)
        if record.outcome is Outcome.SUCCESS
    ]
    with stage("look"):
        for attempt, record in held:
            look_at(setup, attempt, record.X_TO)
    return len(held)


def count_polygons(scene: Scene) -> tuple[int, int]:
    """Return the contact polygons now: of hand and object, and of the table."""
    results = scene.plant.get_contact_results_output_port().Eval(scene.context)
    slab = set(scene.plant.GetCollisionGeometriesForBody(scene.table))
    hand = table = 0
    for i in range(results.num_hydroelastic_contacts()):
        surface = results.hydroelastic_contact_info(i).contact_surface()
        if {surface.id_M(), surface.id_N()} & slab:
            table += surface.num_faces()
        else:
            hand += surface.num_faces()
    return hand, table
