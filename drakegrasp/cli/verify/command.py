"""`drakegrasp verify`: predicted grasps in, one line of JSON per grasp out."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.help import Command
from drakegrasp.cli.options import PATH, chosen_workers, connection_options, shared
from drakegrasp.cli.verify.protocol import (
    PLACES,
    ProtocolRequest,
    is_lift,
    refuse_options,
    verify_by_protocol,
)

if TYPE_CHECKING:
    from drakegrasp.cli.verify.request import VerifyRequest
    from drakegrasp.verification.result import Verification


class _Frame(click.Choice):  # type: ignore[type-arg]
    """The frames of grasps; `workspace` is an earlier name of `table`."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the frame of a word."""
        return super().convert("table" if value == "workspace" else value, param, ctx)


@click.command(cls=Command)
@click.argument("grasps", type=PATH, metavar="GRASPS")
@click.option(
    "--object",
    "mesh",
    type=PATH,
    metavar="MESH",
    help="The object: a .obj, .stl, .ply or .glb file.",
)
@click.option("--units", metavar="m|cm|mm", help="Unit of length of the mesh.  [default: m]")
@click.option(
    "--dataset",
    type=PATH,
    metavar="FILE",
    help="Instead of --object: the data file OUT/grasping_oto.hdf5 or _otm. Each row gives the "
    "object, its pose and the camera's pose.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    help="Rows of the dataset, and group in an HDF5 file of grasps.  [default: test]",
)
@click.option(
    "--rows",
    metavar="0,4,7-9|FILE.npy",
    help="With --dataset: the row of the split that each grasp is for, where the file does not "
    "say.  [default: all rows]",
)
@click.option(
    "--frame",
    type=_Frame(["object", "camera", "table"]),
    help="Frame of the grasps.  [default: object; with --dataset camera]",
)
@click.option(
    "--camera",
    type=PATH,
    metavar="FILE",
    help="With --object and --frame camera: .npy file with the camera's pose in the table-top "
    "frame X_TC, as (4, 4), or per grasp as (n, 4, 4) or (n, 12).",
)
@click.option(
    "--method",
    type=click.Choice(["hand", "forces"]),
    default="hand",
    show_default=True,
    help="hand: close a simulated hand on the contacts and lift. forces: ask "
    "whether forces at the contacts that they select on the surface can lift the object.",
)
@click.option(
    "--snap-points",
    is_flag=True,
    help="Move the points, not the normals, to the surface of the object first.",
)
@click.option(
    "--protocol",
    metavar="NAME|FILE.py:NAME",
    default="lift",
    show_default=True,
    help="The rule of the verdict: lift, dexgraspbench, dexgraspbench-tabletop, dexonomy-hard, or "
    "a class of your own. All but lift run in MuJoCo.",
)
@click.option(
    "--simulator",
    type=click.Choice(["drake", "mujoco"]),
    help="Where the protocol must run.  [default: where it is at home]",
)
@click.option(
    "--assets",
    type=PATH,
    metavar="DIR",
    help="With files of DexGraspBench: the folder in which they name their objects.  [default: .]",
)
@click.option(
    "--hand", metavar="NAME|YAML|XML", help="The hand.  [default: that of the configuration]"
)
@click.option(
    "--config",
    metavar="YAML|PRESET",
    help="Configuration: a file, or the preset paper, fast, randomized or released.  [default: "
    "that of the dataset, else the defaults]",
)
@shared("--set")
@click.option(
    "--out",
    type=PATH,
    metavar="NAME",
    help="Write NAME.jsonl and NAME.h5 instead of printing lines of JSON.",
)
@connection_options
@shared("--quiet", help="Show neither progress nor the table.")
@shared("--json", help="Print the lines of JSON also with --out, and nothing else.")
def verify(
    out: Path | None,
    quiet: bool,
    as_json: bool,
    protocol: str,
    simulator: str | None,
    assets: Path | None,
    **options: Any,
) -> None:
    """Try predicted grasps in the simulator.

    The command says whether each grasp holds its object, and if not, why.

    GRASPS is a .npy array with a row per grasp, a .csv file with a line per grasp, or an HDF5
    file with an array `grasps` at its root or in a group. An array `rows` beside it names the
    rows of the dataset. A grasp has 6 numbers per finger (18 for the Barrett Hand): the contact
    points in metres, then the unit normals out of the object, in the order of the hand's
    fingers.

    GRASPS may also be a file or a folder of postures as `build --postures` reads it, on --object
    or on the objects of --dataset that it names, or that its `row` says.

    With another protocol than lift, the first wrist pose that fits contacts is tried. There GRASPS
    may be a .npy file of DexGraspBench or a folder of such files, and --hand an MJCF, whose world
    is the hand's root.

    If GRASPS is a data file of a dataset, and neither --object nor --dataset is given, the
    command tries the grasps of that dataset.

    One line of JSON per grasp goes to standard output or NAME.jsonl, a table of the outcomes to
    standard error. A row that is no grasp has the outcome `invalid`. Exit code: 0 if every grasp
    has a verdict, whatever it is; 2 for input that cannot be used.
    """
    from drakegrasp.cli.verify.request import VerifyRequest

    workers = chosen_workers(options)
    if not is_lift(protocol, simulator):
        grasps = {name: options.pop(name) for name in PLACES}
        number = workers.pop("workers")
        refuse_options(protocol, **workers, **options)
        request = ProtocolRequest(protocol=protocol, assets=assets, **grasps)
        verify_by_protocol(request, out, number, as_json=as_json, quiet=quiet)
    elif assets is not None:
        raise click.UsageError("--assets must be used with another --protocol than lift")
    else:
        _verify_by_lift(VerifyRequest(**options, out=out), workers, as_json, quiet or as_json)


def _verify_by_lift(
    request: VerifyRequest, workers: dict[str, Any], as_json: bool, quiet: bool
) -> None:
    from drakegrasp.api.verifying import run_verification
    from drakegrasp.cli.tables import make_console, verdict_table
    from drakegrasp.cli.verify.request import place_requested, requested_rows
    from drakegrasp.verification.hints import count_hints
    from drakegrasp.verification.result_files import (
        json_lines,
        part_path,
        result_paths,
        write_json_line,
        write_results,
    )

    # All input is read and checked before anything is simulated.
    out = request.out
    grasps, config = place_requested(request)
    rows = None if out is None else requested_rows(request, len(grasps))

    def print_line(index: int, result: Verification) -> None:
        write_json_line(index, result, sys.stdout)

    def deliver(index: int, result: Verification) -> None:
        write(index, result)
        if as_json and out is not None:
            print_line(index, result)

    # Lines are written as verdicts arrive, so an interrupted run leaves those that are done.
    try:
        with nullcontext(print_line) if out is None else json_lines(out) as write:
            results = run_verification(grasps, **workers, on_result=deliver, show=not quiet)
            if out is not None:
                write_results(results, result_paths(out)[1], config, rows)
    except BaseException:
        if out is not None and part_path(out).exists():
            say(f"{part_path(out)}: the verdicts so far", err=True)
        raise

    for path in () if out is None or as_json else result_paths(out):
        say(str(path))
    if not quiet:
        make_console(stderr=True).print(verdict_table(results))
        for hint, count in count_hints(result.hints for result in results):
            say(f"{count} of {len(results)} grasps would fit much better: {hint}", err=True)
        if lost := sum(result.misplaced and not result.hints for result in results):
            say(
                f"{lost} of {len(results)} grasps are off the object, in every frame and unit that "
                "is known here",
                err=True,
            )
