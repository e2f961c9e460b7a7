"""The protocols by name, and those of a user's own. pyproject.toml lists them.

In: a name, or `file.py:Name`. Out: a protocol. Each class says what a paper would say of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drakegrasp import registry
from drakegrasp.errors import ConfigError, listed
from drakegrasp.frames import Array
from drakegrasp.protocols.protocol import MujocoProtocol, Simulator
from drakegrasp.runtime.user_code import own_class, read_class, run_own

DEXGRASPBENCH = "github JYChen18/DexGraspBench, commit 1e7a5a6 (2025-06-05), config/task/eval.yaml"
DEXONOMY = "github JYChen18/Dexonomy, commit d561ff9 (2026-03-26), dexonomy/config/op/eval.yaml"


@dataclass(frozen=True, kw_only=True)
class Lift:
    """The object rests on a table under gravity; the hand closes on it and lifts it.

    The fingers close on the object, which is held in place, until they stop. Then it is freed, and
    the wrist moves on a path of limited speed and acceleration to 0.60 m above the table, where it
    holds still. The grasp holds if every fingertip still touches the object there and the object
    does not touch the table. Mass, friction and the lift are those of the configuration, which the
    result names; by default 1 kg and 0.71.
    """

    name: str = "lift"
    source: str = "drakegrasp, docs/explanation/physics.md"

    @property
    def simulator(self) -> Simulator:
        """Where it runs."""
        return "drake"

    def numbers(self) -> dict[str, Any]:
        """Return nothing: the numbers are those of the configuration."""
        return {}


@dataclass(frozen=True, kw_only=True)
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

    name: str = "dexgraspbench"
    source: str = DEXGRASPBENCH


@dataclass(frozen=True, kw_only=True)
class DexGraspBenchTabletop(MujocoProtocol):
    """A lift by 10 cm from a table, of DexGraspBench with `setting=tabletop`.

    As `dexgraspbench`, with a plane at z = 0. A force of mass times 10 m/s^2 along -z acts on the
    object from the start, while the hand goes from pregrasp to grasp to squeeze and, in another
    0.4 s, 10 cm up. The grasp succeeds if the object is then within 5 cm and 15 degrees of its
    first pose raised by 10 cm.
    """

    name: str = "dexgraspbench-tabletop"
    source: str = DEXGRASPBENCH
    lift: float | None = 0.1


@dataclass(frozen=True, kw_only=True)
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

    name: str = "dexonomy-hard"
    source: str = DEXONOMY
    friction: tuple[float, float] = (0.3, 0.002)
    noslip_iterations: int = 0
    impratio: float = 1.0
    joint_margin: float = 0.1
    stage: tuple[int, int] = (5, 5)
    acceleration: float = 9.8
    directions: tuple[tuple[float, float, float], ...] = (
        *((1, 0, 0), (-1, 0, 0), (0, 1, 0)),
        *((0, -1, 0), (0, 0, 1), (0, 0, -1)),
    )
    max_penetration: float | None = None

    def apply(self, scene: Any, direction: Array) -> None:
        """Push with the weight that the model has, where the centre of mass is now."""
        scene.push_where_it_is(self.acceleration * scene.modelled_mass * direction)


@dataclass(frozen=True, kw_only=True)
class DexonomyHardAsRun(DexonomyHard):
    """`dexonomy-hard` with the solver's settings that the code of the commit has.

    2 iterations against slip, and impratio 10.
    """

    name: str = "dexonomy-hard-as-run"
    noslip_iterations: int = 2
    impratio: float = 10.0


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
    if ":" not in name and registry.is_known("protocols", name):
        return registry.find("protocols", name)(), name
    if ":" not in name:
        known = listed(registry.names("protocols"))
        raise ConfigError(f"protocol must be one of {known}, or FILE.py:NAME, got {name!r}")

    # A user's own comes from a file that is given now, never from a dataset.
    if code is None:
        stored, text = read_class(name)
        code = {stored: text}
    else:
        stored = name
    found = own_class(stored, code, key="protocol", method="run", takes=("scene", "motion"))
    made = run_own(stored, found)
    if not isinstance(made, MujocoProtocol):
        raise ConfigError(f"{name}: must be a subclass of MujocoProtocol, got {found.__name__}")
    return made, stored
