"""The least height of the hand above the table: as Drake has it at each step, and what it decides.

Drake's own poses after every step, and the corners of its own hulls, are another way to the number
than the kinematics of the package and the states that it looks at.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from helpers.objects import from_above, standing

from drakegrasp.frames import X_WT
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.contacts import ClearanceMonitor
from drakegrasp.simulation.scene import Scene
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim

#: Stand-offs at which the tips pass 1 mm below the table's top and end above it, and 1 mm above.
SCRAPES, PASSES = 0.042, 0.044


@pytest.fixture
def noted(scene: Scene) -> Iterator[list[tuple[float, float]]]:
    """A list that gets the time [s] and the hand's least height [m] after each step.

    With worms the lift would take the place of the recorder.
    """
    inspector, seen = scene.scene_graph.model_inspector(), list[tuple[float, float]]()
    hulls = [
        (body, inspector.GetPoseInFrame(geometry), inspector.GetConvexHull(geometry))
        for body in scene.links
        for geometry in scene.plant.GetCollisionGeometriesForBody(body)
    ]

    def note(root: Any) -> None:
        context, lowest = scene.plant.GetMyContextFromRoot(root), np.inf
        for body, X_BS, hull in hulls:
            if hull is not None:  # boxes and cylinders are parts of the palm, above the fingertips
                X_WS = scene.plant.EvalBodyPoseInWorld(context, body) @ X_BS
                corners = [X_WS @ hull.vertex(i) for i in range(hull.num_vertices())]
                lowest = min(lowest, np.array(corners)[:, 2].min())
        seen.append((root.get_time(), lowest - X_WT[2, 3]))

    scene.simulator.set_monitor(note)
    yield seen
    scene.simulator.clear_monitor()


@pytest.mark.parametrize("standoff", [SCRAPES, PASSES])
def test_clearance_is_the_least_of_all_steps(scene, cube, config, noted, standoff) -> None:
    # The whole way from the open hand.
    rules = override_config(config, ["screen.mode=off", "lift.drive=torque"])
    record = run_attempt(scene, standing(cube), from_above(cube, standoff), rules)
    closing = [height for time, height in noted if time <= record.closed.duration]
    assert record.closed.clearance == pytest.approx(min(closing), abs=1e-4)
    # What geometry skips counts.
    quick = run_attempt(scene, standing(cube), from_above(cube, standoff), config)
    assert quick.closed.clearance == pytest.approx(min(closing), abs=1e-4)


def test_lift_begins_where_closing_ended(scene, cube, config, noted, monkeypatch) -> None:
    looks = list[float]()

    class Noted(ClearanceMonitor):
        def look(self, scene: Scene) -> None:
            looks.append(scene.time)
            super().look(scene)

    monkeypatch.setattr("drakegrasp.simulation.lift.ClearanceMonitor", Noted)
    rules = override_config(config, ["lift.drive=torque"])
    record = run_attempt(scene, standing(cube), from_above(cube, PASSES), rules)
    assert looks[0] == pytest.approx(record.closed.duration)
    lifting = [height for time, height in noted if time >= record.closed.duration - 1e-9]
    assert record.lift.clearance == pytest.approx(min(lifting), abs=1e-4)
    assert record.lift.clearance > record.closed.clearance + 1e-3


def test_hand_that_scrapes_the_table_on_its_way_is_refused(scene, cube, config) -> None:
    """It ends clear of the table, so that only the way says so; measuring changes nothing."""
    attempt = from_above(cube, SCRAPES)
    record = run_attempt(scene, standing(cube), attempt, config)
    assert record.closed.contacts.touching.all()
    assert not record.closed.contacts.hand_on_table
    assert record.closed.clearance < -config.close.scrape_depth
    assert (record.outcome, record.lift) == (Outcome.TABLE_CONTACT, None)

    before = override_config(config, ["close.scrape_depth=null"])
    lifted = run_attempt(scene, standing(cube), attempt, before)
    assert lifted.outcome is Outcome.SUCCESS
    assert np.isnan(lifted.closed.clearance)
    deeper = override_config(config, ["close.scrape_depth=0.002"])
    allowed = run_attempt(scene, standing(cube), attempt, deeper)
    for stage in ("closed", "lift"):
        one, other = (getattr(r, stage).contacts for r in (allowed, lifted))
        assert pickle.dumps(one) == pickle.dumps(other)
