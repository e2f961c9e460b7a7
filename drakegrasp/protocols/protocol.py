"""What a protocol is: numbers, their source, and a trial from which a verdict follows.

In: the numbers of a field's benchmark. Out: `MujocoProtocol`, the base of those that run in MuJoCo,
and of a user's own; the protocols by name. A trial moves the hand through three postures (pregrasp,
grasp, squeeze), each a `GraspMotion` in the order of the hand's MJCF, and then pushes the object or
lifts it. MuJoCo is loaded with the scene only: a `scene` here is a `protocols.scene.ProtocolScene`.
Each class says what a paper would say of it.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drakegrasp import registry
from drakegrasp.errors import ConfigError, listed
from drakegrasp.frames import Array
from drakegrasp.registry import own_class, read_class, run_own

#: Unit vectors of the six pushes in {W}, in the order of DexGraspBench.
AXES = ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1))


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspMotion:
    """Three postures of a hand with n joints, and where the object is.

    A posture is the pose of the MJCF's root in {W}, as position [m] and quaternion (w, x, y, z),
    then the joint positions [rad or m] in the order of the MJCF.

    Attributes:
        pregrasp: (7 + n,), where the trial begins.
        grasp: (7 + n,), where the fingers meet the object.
        squeeze: (7 + n,), the command with which they press.
        object_pose: (7,), position and quaternion of the object in {W}.
    """

    pregrasp: Array
    grasp: Array
    squeeze: Array
    object_pose: Array


@dataclass(frozen=True, kw_only=True)
class PostureVerdict:
    """What a trial measured.

    Attributes:
        success: Whether every rule of the protocol is met.
        reason: "" of a success, else the rule that is not: `penetration` at the start, `moved`,
            `turned`, `diverged` (the simulation), or `invalid` with what is wrong.
        moved: Distance of the object from where it should be, when the trial ended [m].
        turned: Its angle from there [rad].
        penetration: Deepest contact of hand and object at the start [m].
        push: Number of the push in which the trial ended, None if there was none.
    """

    success: bool
    reason: str = ""
    moved: float = np.nan
    turned: float = np.nan
    penetration: float = np.nan
    push: int | None = None


class MujocoProtocol:
    """A protocol that runs in MuJoCo; without changes the numbers of DexGraspBench.

    A protocol of your own is a subclass with a name, a source and other numbers, or with another
    `run`.

    Attributes:
        name: By which it is asked for.
        source: Where the numbers are from: a repository and its commit, or a paper.
        mass: Of the object [kg]; None: from its density.
        density: [kg/m^3], in place of the mass.
        friction: Coefficient of sliding, and torque about the normal per normal force [m].
        time_step: [s].
        noslip_iterations, impratio: Of MuJoCo's solver, whose cone is elliptic.
        solref, solimp: Of the hand's contacts, see MuJoCo's documentation.
        joint_margin: Distance from a joint's limit at which MuJoCo begins to hold it [rad or m].
        position_gain, velocity_gain: Of every actuator; those of the MJCF if None.
        stage: How often the command changes on the way from posture to posture, and the time steps
            in between.
        acceleration: Force of a push over the object's mass [m/s^2].
        directions: Of the pushes in {W}, unit vectors.
        push: How often a push is judged, and the time steps in between; it ends early when the
            object has gone.
        lift: By how much the hand is raised [m]; None of a protocol that pushes.
        max_penetration: Deepest contact allowed at the start, of hand and object and within the
            hand [m]; None if it is not asked.
        max_moved: The object must be nearer to where it should be [m].
        max_turned: Its angle from there must be smaller [rad]; None if it is not asked.
    """

    simulator = "mujoco"
    name: str
    source: str
    mass: float | None = 0.1
    density: float | None = None
    friction: tuple[float, float] = (0.6, 0.02)
    time_step: float = 0.004
    noslip_iterations: int = 2
    impratio: float = 10.0
    solref: tuple[float, float] = (0.005, 1.0)
    solimp: tuple[float, float, float] = (0.5, 0.99, 0.0001)
    joint_margin: float = 0.0
    position_gain: float | None = None
    velocity_gain: float | None = None
    stage: tuple[int, int] = (10, 10)
    acceleration: float = 10.0
    directions: tuple[tuple[float, float, float], ...] = AXES
    push: tuple[int, int] = (10, 50)
    lift: float | None = None
    max_penetration: float | None = 0.01
    max_moved: float = 0.05
    max_turned: float | None = float(np.deg2rad(15.0))

    def object_mass(self, volume: float) -> float:
        """Return the mass of an object of a volume [m^3] in [kg]."""
        return self.density * volume if self.mass is None else self.mass  # type: ignore[operator]

    def run(self, scene: Any, motion: GraspMotion) -> PostureVerdict:
        """Return the verdict on a grasp.

        Args:
            scene: Hand and object with the numbers of this protocol.
            motion: The grasp.
        """
        # A hand that begins deep in the object, or in itself, has failed.
        scene.reset(motion.pregrasp, motion.object_pose)
        penetration, within_hand = scene.penetrations()
        if self.max_penetration is not None and (
            max(penetration, within_hand) > self.max_penetration
        ):
            return PostureVerdict(success=False, reason="penetration", penetration=penetration)

        goal = scene.object_pose()
        if self.lift is None:
            verdict = self.judge_pushes(scene, motion, goal)
        else:
            verdict = self.judge_lift(scene, motion, goal)
        return replace(verdict, penetration=penetration)

    def judge_pushes(self, scene: Any, motion: GraspMotion, goal: Array) -> PostureVerdict:
        """Return the verdict on an object that each push finds as the trial began."""
        verdict = PostureVerdict(success=False)
        for number, direction in enumerate(self.directions):
            scene.reset(motion.pregrasp, motion.object_pose)
            self.squeeze(scene, motion)
            self.apply(scene, np.asarray(direction, dtype=float))
            for _ in range(self.push[0]):
                scene.step(self.push[1])
                verdict = replace(self.judge(scene, goal), push=number)
                if not verdict.success:
                    return verdict
        return verdict

    def judge_lift(self, scene: Any, motion: GraspMotion, goal: Array) -> PostureVerdict:
        """Return the verdict on an object that weighs from the start and is lifted."""
        raised, height = motion.squeeze.copy(), np.array([0.0, 0.0, self.lift])
        raised[:3] += height
        self.apply(scene, np.array([0.0, 0.0, -1.0]))
        self.squeeze(scene, motion)
        scene.move(motion.squeeze, raised, *self.stage)
        return self.judge(scene, np.concatenate([goal[:3] + height, goal[3:]]))

    def squeeze(self, scene: Any, motion: GraspMotion) -> None:
        """Move the hand from the pregrasp to the grasp and on to the squeeze."""
        scene.move(motion.pregrasp, motion.grasp, *self.stage)
        scene.move(motion.grasp, motion.squeeze, *self.stage)

    def apply(self, scene: Any, direction: Array) -> None:
        """Push the object from now on, at its centre of mass."""
        scene.push(self.acceleration * scene.mass * direction)

    def judge(self, scene: Any, goal: Array) -> PostureVerdict:
        """Return the verdict on where the object is now; it should be in a pose (7,)."""
        moved, turned = displacement(goal, scene.object_pose())
        reason = ""
        if scene.diverged or not np.isfinite([moved, turned]).all():
            reason = "diverged"
        elif moved >= self.max_moved:
            reason = "moved"
        elif self.max_turned is not None and turned >= self.max_turned:
            reason = "turned"
        return PostureVerdict(success=not reason, reason=reason, moved=moved, turned=turned)

    def numbers(self) -> dict[str, Any]:
        """Return all numbers by name, for a result."""
        names = [n for cls in reversed(type(self).__mro__) for n in inspect.get_annotations(cls)]
        return {n: getattr(self, n) for n in names if n not in ("name", "source")}


def displacement(one: Array, other: Array) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two poses (7,).

    A quaternion that has gone round by a whole turn is one turn away, as in DexGraspBench.
    """
    cosine = float(np.clip(one[3:] @ other[3:], -1.0, 1.0))
    return float(np.linalg.norm(other[:3] - one[:3])), 2.0 * float(np.arccos(cosine))


DEXGRASPBENCH = "github JYChen18/DexGraspBench, commit 1e7a5a6 (2025-06-05), config/task/eval.yaml"
DEXONOMY = "github JYChen18/Dexonomy, commit d561ff9 (2026-03-26), dexonomy/config/op/eval.yaml"


class Lift:
    """The object rests on a table under gravity; the hand closes on it and lifts it.

    The fingers close on the object, which is held in place, until they stop. Then it is freed, and
    the wrist moves on a path of limited speed and acceleration to 0.60 m above the table, where it
    holds still. The grasp holds if every fingertip still touches the object there and the object
    does not touch the table. Mass, friction and the lift are those of the configuration, which the
    result names; by default 1 kg and 0.71.
    """

    simulator = "drake"
    name = "lift"
    source = "drakegrasp, docs/explanation/physics.md"

    def numbers(self) -> dict[str, Any]:
        """Return nothing: the numbers are those of the configuration."""
        return {}


class DexGraspBench(MujocoProtocol):
    """Pushes along six axes without gravity, of DexGraspBench (BODex, Chen et al., ICRA 2025).

    An object of 0.1 kg meets a hand with a coefficient of friction of 0.6 (torsional 0.02) in
    MuJoCo. The hand is welded to a moving frame, starts in the pregrasp, and goes to the grasp and
    on to the squeeze in 0.4 s each. Then a force of mass times 10 m/s^2 acts on the object's centre
    of mass for 2 s, along -x, +x, -y, +y, -z and +z of the world, each from the start anew. The
    grasp succeeds if the object stays within 5 cm and 15 degrees of its first pose in all six, and
    no contact at the start is deeper than 1 cm. Gains and force limits are those of the hand's
    MJCF: 5 N m/rad and 3 N m in the benchmark's.
    """

    name = "dexgraspbench"
    source = DEXGRASPBENCH


class DexGraspBenchTabletop(MujocoProtocol):
    """A lift by 10 cm from a table, of DexGraspBench with `setting=tabletop`.

    As `dexgraspbench`, with a plane at z = 0. A force of mass times 10 m/s^2 along -z acts on the
    object from the start, while the hand goes from pregrasp to grasp to squeeze and, in another
    0.4 s, 10 cm up. The grasp succeeds if the object is then within 5 cm and 15 degrees of its
    first pose raised by 10 cm.
    """

    name = "dexgraspbench-tabletop"
    source = DEXGRASPBENCH
    lift = 0.1


class DexonomyHard(MujocoProtocol):
    """Pushes along six axes with half the friction, of Dexonomy (Chen et al., RSS 2025), `hard`.

    An object of 0.1 kg meets a hand with a coefficient of friction of 0.3 (torsional 0.002) in
    MuJoCo, without iterations against slip and with impratio 1. From pregrasp to grasp to squeeze
    it takes 0.1 s each. Then the object's weight (9.8 m/s^2) acts at its centre of mass for 2 s,
    along +x, -x, +y, -y, +z and -z, each from the start anew. The grasp succeeds if the object
    stays within 5 cm and 15 degrees in all six. How deep the hand begins is not asked.

    These are the numbers of the comment on `hard` in the configuration. The code of the commit
    halves the friction, but keeps 2 iterations and impratio 10: `dexonomy-hard-as-run`.
    """

    name = "dexonomy-hard"
    source = DEXONOMY
    friction = (0.3, 0.002)
    noslip_iterations = 0
    impratio = 1.0
    joint_margin = 0.1
    stage = (5, 5)
    acceleration = 9.8
    directions = (
        *((1, 0, 0), (-1, 0, 0), (0, 1, 0)),
        *((0, -1, 0), (0, 0, 1), (0, 0, -1)),
    )
    max_penetration = None

    def apply(self, scene: Any, direction: Array) -> None:
        """Push with the weight that the model has, where the centre of mass is now."""
        scene.push_where_it_is(self.acceleration * scene.modelled_mass * direction)


class DexonomyHardAsRun(DexonomyHard):
    """`dexonomy-hard` with the solver's settings that the code of the commit has.

    2 iterations against slip, and impratio 10.
    """

    name = "dexonomy-hard-as-run"
    noslip_iterations = 2
    impratio = 10.0


Protocol = Lift | MujocoProtocol


def find_protocol(name: str, code: Mapping[str, str] | None = None) -> tuple[Protocol, str]:
    """Return a protocol, and the name that a result keeps of it.

    Args:
        name: Of the registry, or `FILE.py:NAME` of a user's own; a subclass of `MujocoProtocol`
            that is made without arguments.
        code: Text of the file by stored names, for a worker that has no such file.

    Returns:
        The protocol; and its name, of a user's own with 16 digits of the file's SHA-256.

    Raises:
        ConfigError: If there is none of that name, or the user's own cannot be imported or made.
    """
    stored = name
    if ":" not in name:
        if not registry.is_known("protocols", name):
            known = listed(registry.names("protocols"))
            raise ConfigError(f"protocol must be one of {known}, or FILE.py:NAME, got {name!r}")
        found = registry.find("protocols", name)
    else:
        # A user's own comes from a file that is given now, never from a dataset.
        if code is None:
            stored, text = read_class(name)
            code = {stored: text}
        found = own_class(stored, code, key="protocol", method="run", takes=("scene", "motion"))
    if found is Lift:
        return Lift(), stored

    made = run_own(stored, found)
    if not isinstance(made, MujocoProtocol):
        raise ConfigError(f"{name}: must be a subclass of MujocoProtocol, got {found.__name__}")
    if not (hasattr(made, "name") and hasattr(made, "source")):
        raise ConfigError(f"{name}: must have a name and a source, got none")
    if (made.mass is None) == (made.density is None):
        raise ConfigError(
            f"{made.name}: mass or density must be None, and only one of them, "
            f"got {made.mass} and {made.density}"
        )
    return made, stored
