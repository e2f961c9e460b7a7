"""What a protocol is: numbers, their source, and a trial from which a verdict follows.

Input: the mass, friction, disturbances and limits of a published benchmark. Output:
`MujocoProtocol`, the base class of protocols that run in MuJoCo, including user-defined ones; the
protocols by name. A trial moves the
hand through three postures (pregrasp, grasp, squeeze), which form a `GraspMotion` in the joint
order of the hand's MJCF, and then pushes the object or lifts it. MuJoCo is loaded only with the
scene; a `scene` here is a `protocols.scene.ProtocolScene`. The docstring of each class describes
its protocol as a paper would.
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
    """Three postures of a hand with n joints, and the pose of the object.

    A posture is the pose of the MJCF's root in {W}, as position [m] and quaternion (w, x, y, z),
    followed by the joint positions [rad or m] in the order of the MJCF.

    Attributes:
        pregrasp: (7 + n,), posture at the start of the trial.
        grasp: (7 + n,), posture in which the fingers meet the object.
        squeeze: (7 + n,), commanded posture with which the fingers press.
        object_pose: (7,), position and quaternion of the object in {W}.
    """

    pregrasp: Array
    grasp: Array
    squeeze: Array
    object_pose: Array


@dataclass(frozen=True, kw_only=True)
class PostureVerdict:
    """Result and measurements of a trial.

    Attributes:
        success: Whether every rule of the protocol is met.
        reason: "" for a success, else the rule that is not met: `penetration` at the start,
            `moved`, `turned`, `diverged` (the simulation), or `invalid` with an explanation.
        moved: Distance of the object from its goal when the trial ended [m].
        turned: Angle of the object from its goal [rad].
        penetration: Deepest contact of hand and object at the start [m].
        push: Number of the push in which the trial ended; None if there was no push.
    """

    success: bool
    reason: str = ""
    moved: float = np.nan
    turned: float = np.nan
    penetration: float = np.nan
    push: int | None = None


class MujocoProtocol:
    """A protocol that runs in MuJoCo; unless changed, its numbers are those of DexGraspBench.

    A user-defined protocol is a subclass with a name, a source and other numbers, or with another
    `run`.

    Attributes:
        name: Name of the protocol.
        source: Source of the numbers: a repository and its commit, or a paper.
        mass: Mass of the object [kg]; None: from its density.
        density: Density of the object [kg/m^3], instead of the mass.
        friction: Coefficient of sliding, and torque about the normal per normal force [m].
        time_step: Time step of the simulation [s].
        noslip_iterations, impratio: Settings of MuJoCo's solver, whose friction cone is elliptic.
        solref, solimp: Settings of the hand's contacts, see MuJoCo's documentation.
        joint_margin: Distance from a joint's limit at which MuJoCo begins to enforce the limit [rad
            or m].
        position_gain, velocity_gain: Gains of every actuator; those of the MJCF if None.
        stage: Number of changes of the command from one posture to the next, and number of time
            steps after each change.
        acceleration: Force of a push over the object's mass [m/s^2].
        directions: Directions of the pushes in {W}, unit vectors.
        push: Number of times that a push is judged, and number of time steps before each judgement;
            a push ends early if the object is lost.
        lift: Height by which the hand is raised [m]; None for a protocol that pushes.
        max_penetration: Deepest allowed contact at the start, of hand and object and within the
            hand [m]; None if it is not checked.
        max_moved: The distance of the object from its goal must be below this [m].
        max_turned: The angle of the object from its goal must be below this [rad]; None if it is
            not checked.
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
        """Return the mass [kg] of an object with a given volume [m^3]."""
        return self.density * volume if self.mass is None else self.mass  # type: ignore[operator]

    def run(self, scene: Any, motion: GraspMotion) -> PostureVerdict:
        """Return the verdict on a grasp.

        Args:
            scene: Hand and object with the numbers of this protocol.
            motion: The grasp.
        """
        # The grasp fails if the hand starts deep in the object or in itself.
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
        """Return the verdict on an object that starts each push as it started the trial."""
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
        """Return the verdict on an object that has weight from the start and is lifted."""
        raised, height = motion.squeeze.copy(), np.array([0.0, 0.0, self.lift])
        raised[:3] += height
        self.apply(scene, np.array([0.0, 0.0, -1.0]))
        self.squeeze(scene, motion)
        scene.move(motion.squeeze, raised, *self.stage)
        return self.judge(scene, np.concatenate([goal[:3] + height, goal[3:]]))

    def squeeze(self, scene: Any, motion: GraspMotion) -> None:
        """Move the hand from the pregrasp to the grasp, and then to the squeeze."""
        scene.move(motion.pregrasp, motion.grasp, *self.stage)
        scene.move(motion.grasp, motion.squeeze, *self.stage)

    def apply(self, scene: Any, direction: Array) -> None:
        """Push the object from now on, at its centre of mass."""
        scene.push(self.acceleration * scene.mass * direction)

    def judge(self, scene: Any, goal: Array) -> PostureVerdict:
        """Return the verdict on the current pose of the object; `goal` is the desired pose (7,)."""
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
        """Return all numbers of the protocol by name, for a result."""
        names = [n for cls in reversed(type(self).__mro__) for n in inspect.get_annotations(cls)]
        return {n: getattr(self, n) for n in names if n not in ("name", "source")}


def displacement(one: Array, other: Array) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two poses (7,).

    A quaternion and its negative are one turn apart, as in DexGraspBench.
    """
    cosine = float(np.clip(one[3:] @ other[3:], -1.0, 1.0))
    return float(np.linalg.norm(other[:3] - one[:3])), 2.0 * float(np.arccos(cosine))


DEXGRASPBENCH = "github JYChen18/DexGraspBench, commit 1e7a5a6 (2025-06-05), config/task/eval.yaml"
DEXONOMY = "github JYChen18/Dexonomy, commit d561ff9 (2026-03-26), dexonomy/config/op/eval.yaml"


class Lift:
    """The object rests on a table under gravity; the hand closes on it and lifts it.

    The fingers close on the object, which is held in place, until they stop. Then the object is
    released, and the wrist moves on a path of limited speed and acceleration to 0.60 m above the
    table, where it stops. The grasp holds if every fingertip still touches the object there and the
    object does not touch the table. Mass, friction and the lift are those of the configuration,
    which the result names; the defaults are 1 kg and 0.71.
    """

    simulator = "drake"
    name = "lift"
    source = "drakegrasp, docs/explanation/physics.md"

    def numbers(self) -> dict[str, Any]:
        """Return nothing, since the numbers are those of the configuration."""
        return {}


class DexGraspBench(MujocoProtocol):
    """Pushes along six axes without gravity, of DexGraspBench (BODex, Chen et al., ICRA 2025).

    An object of 0.1 kg meets a hand with a coefficient of friction of 0.6 (torsional 0.02) in
    MuJoCo. The hand is welded to a moving frame, starts in the pregrasp, and moves to the grasp and
    then to the squeeze in 0.4 s each. Then a force of mass times 10 m/s^2 acts on the object's
    centre of mass for 2 s, along -x, +x, -y, +y, -z and +z of the world; each push begins from the
    start again. The grasp succeeds if the object stays within 5 cm and 15 degrees of its first pose
    in all six, and no contact at the start is deeper than 1 cm. Gains and force limits are those of
    the hand's MJCF; in that of the benchmark they are 5 N m/rad and 3 N m.
    """

    name = "dexgraspbench"
    source = DEXGRASPBENCH


class DexGraspBenchTabletop(MujocoProtocol):
    """A lift by 10 cm from a table, of DexGraspBench with `setting=tabletop`.

    As `dexgraspbench`, but with a plane at z = 0. A force of mass times 10 m/s^2 along -z acts on
    the object from the start, while the hand moves from pregrasp to grasp to squeeze and then, in
    another 0.4 s, 10 cm up. The grasp succeeds if the object is then within 5 cm and 15 degrees of
    its first pose raised by 10 cm.
    """

    name = "dexgraspbench-tabletop"
    source = DEXGRASPBENCH
    lift = 0.1


class DexonomyHard(MujocoProtocol):
    """Pushes along six axes with half the friction, of Dexonomy (Chen et al., RSS 2025), `hard`.

    An object of 0.1 kg meets a hand with a coefficient of friction of 0.3 (torsional 0.002) in
    MuJoCo, without noslip iterations and with impratio 1. Each move, from pregrasp to grasp and
    from grasp to squeeze, takes 0.1 s. Then the object's weight (9.8 m/s^2) acts at its centre of
    mass for 2 s, along +x, -x, +y, -y, +z and -z; each push begins from the start again. The grasp
    succeeds if the object stays within 5 cm and 15 degrees in all six. The penetration at the start
    is not checked.

    These are the numbers of the comment on `hard` in the configuration. The code of that commit
    halves the friction, but keeps 2 noslip iterations and impratio 10: `dexonomy-hard-as-run`.
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
        """Push with the weight of the modelled object, at the present centre of mass."""
        scene.push_where_it_is(self.acceleration * scene.modelled_mass * direction)


class DexonomyHardAsRun(DexonomyHard):
    """`dexonomy-hard` with the solver settings in the code of the commit.

    The settings are 2 noslip iterations and impratio 10.
    """

    name = "dexonomy-hard-as-run"
    noslip_iterations = 2
    impratio = 10.0


Protocol = Lift | MujocoProtocol


def find_protocol(name: str, code: Mapping[str, str] | None = None) -> tuple[Protocol, str]:
    """Return a protocol, and its name as stored in a result.

    Args:
        name: Name in the registry, or `FILE.py:NAME` of a user-defined protocol: a subclass of
            `MujocoProtocol` whose constructor takes no arguments.
        code: Text of the file by stored names, for a worker that does not have the file.

    Returns:
        The protocol, and its name; for a user-defined protocol with 16 digits of the file's
        SHA-256.

    Raises:
        ConfigError: If the name is unknown, or the user-defined protocol cannot be imported or
            constructed.
    """
    stored = name
    if ":" not in name:
        if not registry.is_known("protocols", name):
            known = listed(registry.names("protocols"))
            raise ConfigError(f"protocol must be one of {known}, or FILE.py:NAME, got {name!r}")
        found = registry.find("protocols", name)
    else:
        # A user-defined protocol comes from a file that is given now, never from a dataset.
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
