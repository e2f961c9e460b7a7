"""The command on arms, and the options that name an arm."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, TypeAlias

from cyclopts import Parameter

import drakegrasp as dg
from drakegrasp.cli.arguments import Count, Dataset, Name
from drakegrasp.cli.console import UsageError, processes, say
from drakegrasp.errors import counted

if TYPE_CHECKING:
    from drakegrasp.reach.arm import Arm

#: An arm, where it stands, and how it carries the hand.
ArmName: TypeAlias = Annotated[str, Parameter(metavar="NAME|URDF")]
BasePlace: TypeAlias = Annotated[str, Parameter(metavar="X,Y,Z,YAW", allow_leading_hyphen=True)]
Mount: TypeAlias = Annotated[str, Parameter(metavar="X,Y,Z,R,P,Y", allow_leading_hyphen=True)]


def reach(
    out: Dataset,
    /,
    *,
    arm: ArmName,
    base: BasePlace,
    flange: Name | None = None,
    mount: Mount | None = None,
    name: Name | None = None,
    workers: Count | None = None,
    quiet: bool = False,
) -> None:
    """Ask whether an arm gets its hand to the samples.

    The command writes OUT/reach/NAME.hdf5: for each sample, whether the arm comes straight to it
    and lifts, and its joint positions. Rows that are there are kept.

    Args:
        out: Directory of the dataset.
        arm: panda, ur5, ur10 (pip install 'drakegrasp[arms]'), or a URDF file.
        base: Where the arm stands on the table: X, Y, Z in metres from the centre of the table's
            top, and the yaw in degrees.
        flange: Link of the arm that carries the hand. [default: that of a named arm, or the last
            link of the file]
        mount: Pose of the hand's palm link on the flange: X, Y, Z in metres, roll, pitch, yaw in
            degrees. [default: that of the hand, for hands of the package]
        name: Name of the file. [default: that of the arm]
        workers: Number of processes on this machine. [default: one per core]
        quiet: Show no progress.
    """
    from drakegrasp.dataset.paths import reach_path
    from drakegrasp.dataset.schema import REACHES
    from drakegrasp.reach.rows import reach_dataset

    chosen = read_arm(arm, base, flange, mount)
    with processes(workers, "reach", "objects", show=not quiet) as more:
        rows = reach_dataset(out, chosen, name=name, **more)
    say(f"{counted(rows.count, 'grasp')} in {reach_path(out, name or chosen.name)}")
    for code, outcome in enumerate(REACHES):
        say(f"{outcome}: {(rows.reach_outcome == code).sum():,}")


def read_arm(arm: str, base: str | None, flange: str | None, mount: str | None) -> Arm:
    """Return the arm of the options `--arm`, `--base`, `--flange` and `--mount`.

    Raises:
        UsageError: If base or mount are not numbers.
        ConfigError: See `load_arm`.
    """
    from drakegrasp.reach.arm import mount_pose

    if base is None:
        raise UsageError("--base must be given with --arm: X,Y,Z,YAW")
    *place, yaw = _numbers("base", base, 4)
    stated = None if mount is None else _numbers("mount", mount, 6)
    X_FB = None if stated is None else mount_pose(stated[:3], stated[3:])
    return dg.load_arm(arm, (*place, math.radians(yaw)), flange=flange, mount=X_FB)


def _numbers(name: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise UsageError(f"--{name} must be {count} numbers with commas, got {text!r}")
    return numbers
