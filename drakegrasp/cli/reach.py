"""The command on arms, and the options that name an arm."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeAlias

from cyclopts import Parameter

import drakegrasp as dg
from drakegrasp.cli.arguments import Count, Dataset, Name, NewFile
from drakegrasp.cli.console import UsageError, processes, say
from drakegrasp.errors import counted

if TYPE_CHECKING:
    from drakegrasp.reach.arm import Arm

#: Options of an arm.
ArmName: TypeAlias = Annotated[str, Parameter(metavar="NAME|URDF")]
BasePlace: TypeAlias = Annotated[str, Parameter(metavar="X,Y,Z,YAW", allow_leading_hyphen=True)]
Mount: TypeAlias = Annotated[str, Parameter(metavar="X,Y,Z,R,P,Y", allow_leading_hyphen=True)]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ArmOptions:
    """An arm, where it stands, and how it carries the hand.

    Attributes:
        arm: panda, ur5, ur10 (pip install 'drakegrasp[arms]'), or a URDF file.
        base: Where the arm stands on the table: X, Y, Z in metres from the centre of the table's
            top, and the yaw in degrees.
        flange: Link of the arm that carries the hand. [default: that of a named arm, or the last
            link of the file]
        mount: Pose of the hand's palm link on the flange: X, Y, Z in metres, roll, pitch, yaw in
            degrees. [default: that of the hand, for hands of the package]
    """

    arm: ArmName | None = None
    base: BasePlace | None = None
    flange: Name | None = None
    mount: Mount | None = None

    def asked(self) -> Arm | None:
        """Return the arm; None if none is named.

        Raises:
            UsageError: If the base is missing, or base or mount are not numbers.
            ConfigError: See `load_arm`.
        """
        from drakegrasp.reach.arm import mount_pose

        if self.arm is None:
            if any(value is not None for value in vars(self).values()):
                raise UsageError("--arm must be given with --base, --flange and --mount, got none")
            return None
        if self.base is None:
            raise UsageError("--base must be given with --arm, got none")
        *place, yaw = _numbers("base", self.base, 4)
        stated = None if self.mount is None else _numbers("mount", self.mount, 6)
        X_FB = None if stated is None else mount_pose(stated[:3], stated[3:])
        about = (*place, math.radians(yaw))
        return dg.load_arm(self.arm, about, flange=self.flange, mount=X_FB)


def reach(
    out: Dataset,
    /,
    *,
    robot: ArmOptions = ArmOptions(),
    name: Name | None = None,
    clutter: bool = False,
    picture: Annotated[NewFile | None, Parameter(name="--map", metavar="PNG")] = None,
    workers: Count | None = None,
    quiet: bool = False,
) -> None:
    """Ask whether an arm gets its hand to the samples.

    The command writes OUT/reach/NAME.hdf5: for each sample, whether the arm comes straight to it
    and lifts, and its joint positions. Rows that are there are kept. With --clutter it writes
    OUT/reach/clutter/NAME.hdf5.

    Args:
        out: Directory of the dataset.
        name: Name of the file. [default: that of the arm]
        clutter: Ask for the free grasps of clutter.hdf5 instead: arm and hand must not hit the
            other objects and the walls, either.
        picture: Instead of the file, draw a map: where on the table the arm reaches the grasps of
            some samples.
        workers: Number of processes on this machine. [default: one per core]
        quiet: Show no progress.
    """
    from drakegrasp.dataset.paths import reach_path
    from drakegrasp.dataset.schema import REACHES
    from drakegrasp.reach.rows import reach_dataset

    chosen = robot.asked()
    if chosen is None:
        raise UsageError("--arm must be given, got none")
    if picture is not None:
        if clutter:
            raise UsageError("--clutter must not be given with --map, got both")
        _draw_map(out, chosen, picture, workers, show=not quiet)
        return
    with processes(workers, "reach", "objects", show=not quiet) as more:
        rows = reach_dataset(out, chosen, name=name, clutter=clutter, **more)
    path = reach_path(out, name or chosen.name, clutter=clutter)
    say(f"{counted(rows.count, 'grasp')} in {path}")
    for code, outcome in enumerate(REACHES):
        say(f"{outcome}: {(rows.reach_outcome == code).sum():,}")


def _draw_map(out: Path, arm: Arm, png: Path, workers: int | None, *, show: bool) -> None:
    """Draw where on the table an arm reaches samples of a dataset."""
    from drakegrasp.pictures.charts import draw_reach
    from drakegrasp.pictures.style import save_figure
    from drakegrasp.reach.place import map_reach
    from drakegrasp.runtime.files import validate_writable

    validate_writable(png)
    with processes(workers, "map", "objects", show=show) as more:
        found = map_reach(out, arm, **more)
    title = f"{arm.name} at the filled circle, {counted(found.count, 'sample')}"
    save_figure(draw_reach(found.p_TS, found.share, arm.base, title=title), png, dpi=150)
    say(str(png))


def _numbers(name: str, text: str, count: int) -> list[float]:
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != count:
        raise UsageError(f"--{name} must be {count} numbers with commas, got {text!r}")
    return numbers
