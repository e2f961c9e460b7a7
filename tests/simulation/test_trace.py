"""A trial that is watched is the same trial, to the last bit."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from helpers.objects import STANDOFF, from_above, standing

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import rotate_vectors
from drakegrasp.hand.settings import override_config
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.scene import hand_joint_names, hand_positions
from drakegrasp.simulation.trace import traced
from drakegrasp.simulation.trial import run_attempt

pytestmark = pytest.mark.sim


@pytest.mark.parametrize("own_motors", [False, True])
def test_watched_trial_gives_the_same_bits(scene, cube, config, hand, own_motors):
    """Of the hand's motors, whose worms are followed from step to step, and of motors of joints."""
    config = override_config(config, ["lift.drive=worm"])
    attempt = from_above(cube, STANDOFF)
    if own_motors:
        run_attempt(scene, standing(cube), attempt, config)
        closed = hand_positions(scene)
        path = np.array([0.0 * closed, closed, 1.05 * closed])
        start = {"spread": 0.0, "closing": np.zeros(3), "path": path}
        attempt = Attempt(X_OG=attempt.X_OG, own_motors=True, **start)

    def run(scene):
        return run_attempt(scene, standing(cube), attempt, config)

    record, trace = traced(scene, hand, run)
    assert record.lift is not None
    assert scene.simulator.get_monitor() is None
    assert pickle.dumps(record) == pickle.dumps(run(scene))

    # The states are those of the record, and between two of them is a step.
    closed, lifted = record.closed, record.lift
    steps = np.diff(trace.times)
    longest = config.physics.coarse_steps * config.physics.time_step
    assert (steps > 0.0).all() and steps.max() < 1.001 * longest
    place = np.argmin(np.abs(trace.times - closed.duration))
    assert np.array_equal(trace.q[place], closed.q)
    assert np.array_equal(trace.q[-1], lifted.q)
    assert np.array_equal(trace.X_TO[-1], lifted.X_TO)
    assert trace.X_TG[-1] == pytest.approx(multiply(lifted.X_TO, lifted.X_OG), abs=1e-12)
    assert trace.X_TO[0] == pytest.approx(record.X_TO, abs=1e-12)
    forces = rotate_vectors(lifted.X_TO, lifted.contacts.f_Q_O)
    assert trace.f_T[-1] == pytest.approx(forces, abs=0.05)
    assert not trace.f_T[0].any()

    # Where the motors drive the joints.
    driven = [hand_joint_names(scene).index(f.closing_joint) for f in hand.fingers]
    if own_motors:
        assert trace.commanded[[0, -1]][:, driven] == pytest.approx(path[[0, 2]][:, driven])
        assert not trace.rates.any()
    else:
        assert np.isnan(trace.commanded).all()
        assert np.array_equal(trace.rates[driven], hand.closing_speed)
