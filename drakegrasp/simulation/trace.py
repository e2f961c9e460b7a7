"""Records the states of a trial after each step, without changing a bit of its results.

Input: the scene of an attempt, and a function that runs it. Output: its result, and a `Trace`. The
function gets a scene whose simulator has one more monitor, which reads the state: positions,
contact forces, and the commanded positions of joints with their own motors. Drake calls a monitor
between two steps, so the steps stay the same, and the next step starts from the values that Drake
computed for the monitor. At the start of a simulation only positions are read: contact forces that
Drake computed there would stay cached after the next paths are commanded.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, TypeVar

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus

from drakegrasp.arithmetic import multiply
from drakegrasp.frames import X_WT, Array, invert_pose
from drakegrasp.hand.description import Hand
from drakegrasp.simulation.contacts import forces_on_object
from drakegrasp.simulation.scene import (
    Scene,
    closing_angles,
    commanded_joints,
    hand_joint_names,
    hand_positions,
    palm_pose,
)

Result = TypeVar("Result")

#: Two readings closer than this are of one state; steps are much longer [s].
SAME = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class Trace:
    """The motion of a hand with k fingers and j joints in a trial, at n times.

    Attributes:
        joints: Names of the joints, in the plant's order.
        times: (n,), simulated time since the start of the trial [s], increasing.
        X_TG, X_TO: (n, 4, 4), poses of palm and object.
        q: (n, j), positions of the joints [rad or m].
        commanded: (n, j), commanded positions of joints with their own motors [rad or m]; NaN for
            all other joints.
        rates: (j,), speed at which the hand file's motors close each joint [rad/s or m/s]; 0 for
            all other joints.
        f_T: (n, k, 3), force of each fingertip's link on the object in {T} [N].
    """

    joints: tuple[str, ...]
    times: Array
    X_TG: Array
    X_TO: Array
    q: Array
    commanded: Array
    rates: Array
    f_T: Array


def traced(scene: Scene, hand: Hand, run: Callable[[Scene], Result]) -> tuple[Result, Trace]:
    """Return the result of `run` and the states of its simulation.

    Args:
        scene: Scene of the hand or of one of its preshapes; it can be reused afterwards.
        hand: The hand with all its fingers.
        run: Simulates in the scene that it receives, which shares the diagram of `scene`.
    """
    looks = _Looks(hand)
    try:
        result = run(looks.watched(scene))
    finally:
        for simulator in looks.simulators:
            simulator.clear_monitor()
    return result, looks.trace(scene)


@dataclass(eq=False)
class _Looks:
    """The states since the last start of a simulation, one row per state."""

    hand: Hand
    simulators: list[Simulator] = field(default_factory=list)
    rows: list[tuple[Any, ...]] = field(default_factory=list)
    rates: Array = field(default_factory=lambda: np.zeros(0))

    def watched(self, scene: Scene) -> Scene:
        """Return a scene whose states are recorded, as are those of the scenes that continue it."""
        others: dict[str, Any] = {
            name: cache(lambda known=known: self.watched(known()))
            for name in ("coarse_scene", "own_motors")
            if (known := getattr(scene, name)) is not None
        }
        self.simulators.append(scene.simulator)
        return replace(
            scene, simulator=_Watched(scene.simulator, lambda: self.look(scene)), **others
        )

    def look(self, scene: Scene) -> None:
        """Add the state of a scene, unless it is the same as the last one."""
        begins = scene.time == 0.0
        if begins:
            self.rows, self.rates = [], _closing_rates(scene)
        elif scene.time < self.rows[-1][0] + SAME:
            return
        X_TW = invert_pose(X_WT)
        forces = {} if begins else forces_on_object(scene)
        commanded = np.full(len(self.rates), np.nan)
        if scene.joint_trajectory is not None:
            now = closing_angles(scene) if begins else commanded_joints(scene)
            commanded[_places(scene)] = now
        tips = [scene.plant.GetBodyByName(n, scene.instance) for n in self.hand.fingertip_links]
        self.rows.append(
            (
                scene.time,
                multiply(X_TW, palm_pose(scene)),
                multiply(X_TW, scene.pose(scene.object)),
                hand_positions(scene),
                commanded,
                # The axes of {T} are those of {W}.
                np.array([forces.get(tip.index(), np.zeros(3)) for tip in tips]),
            )
        )

    def trace(self, scene: Scene) -> Trace:
        """Return the recorded states; they are empty if nothing was simulated."""
        names = ("times", "X_TG", "X_TO", "q", "commanded", "f_T")
        columns = [*zip(*self.rows, strict=True)] or [()] * len(names)
        seen = {name: np.array(each) for name, each in zip(names, columns, strict=True)}
        return Trace(joints=tuple(hand_joint_names(scene)), rates=self.rates, **seen)


def _places(scene: Scene) -> list[int]:
    """Return the index of each closing joint among all joints."""
    names = hand_joint_names(scene)
    return [names.index(joint.name()) for joint in scene.closing_joints]


def _closing_rates(scene: Scene) -> Array:
    """Return `Trace.rates` of a scene."""
    names, hand = hand_joint_names(scene), scene.hand
    rates = np.zeros(len(names))
    if scene.joint_trajectory is None:
        speeds = hand.closing_speed[hand.motor_fingers].tolist()
        for driven, speed in zip(scene.driven, speeds, strict=True):
            for joint, ratio in driven.items():
                rates[names.index(joint.name())] = ratio * speed
    return rates


class _Watched:
    """A simulator with one more monitor, which runs after the monitor that the trial sets."""

    def __init__(self, simulator: Simulator, look: Callable[[], None]) -> None:
        self._simulator, self._look = simulator, look
        self._own: Callable[[Context], EventStatus] | None = None
        simulator.set_monitor(self._monitor)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._simulator, name)

    def set_monitor(self, monitor: Callable[[Context], EventStatus]) -> None:
        self._own = monitor

    def clear_monitor(self) -> None:
        self._own = None

    def get_monitor(self) -> Callable[[Context], EventStatus] | None:
        return self._own

    def _monitor(self, context: Context) -> EventStatus:
        status = EventStatus.DidNothing() if self._own is None else self._own(context)
        self._look()
        return status
