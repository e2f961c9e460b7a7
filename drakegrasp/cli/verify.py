"""`drakegrasp verify`: predicted grasps in, one line of JSON per grasp out."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.options import PATH, shared

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification


@dataclass(frozen=True, kw_only=True)
class PostureRequest:
    """The options of the command for a protocol that runs in MuJoCo."""

    grasps: Path
    protocol: str
    hand: str | None
    assets: Path
    out: Path | None
    as_json: bool
    workers: int | None


@click.command()
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
    "--frame",
    type=click.Choice(["object", "camera", "workspace"]),
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
    "a class of your own. All but lift take GRASPS as files of DexGraspBench, and --hand as MJCF.",
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
@shared("--workers", "--scheduler", "--scheduler-file")
@shared("--quiet", help="Show neither progress nor the table.")
@shared("--json", help="Print the lines of JSON also with --out, and nothing else.")
def verify(
    out: Path | None,
    workers: int | None,
    scheduler: str | None,
    scheduler_file: Path | None,
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

    With another protocol than lift, GRASPS is a .npy file of DexGraspBench, with pregrasp, grasp
    and squeeze, or a folder of such files; --hand is an MJCF, whose world is the hand's root.

    If GRASPS is a data file of a dataset, and neither --object nor --dataset is given, the
    command tries the grasps of that dataset.

    One line of JSON per grasp goes to standard output or NAME.jsonl, a table of the outcomes to
    standard error. A row that is no grasp has the outcome `invalid`. Exit code: 0 if every grasp
    has a verdict, whatever it is; 2 for input that cannot be used.
    """
    if not _is_lift(protocol, simulator):
        _refuse_options(protocol, scheduler=scheduler, scheduler_file=scheduler_file, **options)
        _verify_postures(
            PostureRequest(
                grasps=options["grasps"],
                protocol=protocol,
                hand=options["hand"],
                assets=assets or Path(),
                out=out,
                as_json=as_json,
                workers=workers,
            ),
            show=not (quiet or as_json),
        )
        return
    if assets is not None:
        raise click.UsageError("--assets must be used with another --protocol than lift")
    from drakegrasp.api.verifying import run_verification
    from drakegrasp.cli.tables import make_console, verdict_table
    from drakegrasp.cli.verify_request import VerifyRequest, place_requested, requested_rows
    from drakegrasp.verification.hints import count_hints
    from drakegrasp.verification.result_files import (
        json_lines,
        part_path,
        result_paths,
        write_json_line,
        write_results,
    )

    # All input is read and checked before anything is simulated.
    request = VerifyRequest(**options, out=out)
    grasps, config = place_requested(request)
    rows = None if out is None else requested_rows(request, len(grasps))

    def print_line(index: int, result: Verification) -> None:
        write_json_line(index, result, sys.stdout)

    def deliver(index: int, result: Verification) -> None:
        write(index, result)
        if as_json and out is not None:
            print_line(index, result)

    # Lines are written as verdicts arrive, so an interrupted run leaves those that are done.
    quiet = quiet or as_json
    try:
        with nullcontext(print_line) if out is None else json_lines(out) as write:
            results = run_verification(
                grasps,
                workers=workers,
                scheduler=scheduler,
                scheduler_file=scheduler_file,
                on_result=deliver,
                show=not quiet,
            )
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


def _is_lift(name: str, simulator: str | None) -> bool:
    """Return whether a protocol is the lift in Drake.

    Raises:
        ConfigError: If there is no such protocol.
        click.UsageError: If it does not run in the simulator.
    """
    from drakegrasp.protocols.catalog import find_protocol

    protocol, stored = find_protocol(name)
    if simulator not in (None, protocol.simulator):
        raise click.UsageError(
            f"--simulator of protocol {stored} must be {protocol.simulator}, got {simulator}"
        )
    return protocol.simulator == "drake"


def _refuse_options(protocol: str, **options: Any) -> None:
    """Refuse options that grasps of DexGraspBench's format answer by themselves.

    Raises:
        click.UsageError: If one is given.
    """
    usual = {"method": "hand", "overrides": (), "snap_points": False}
    for name, value in options.items():
        if name not in ("grasps", "hand") and value is not None and value != usual.get(name):
            option = {"mesh": "object", "overrides": "set"}.get(name, name.replace("_", "-"))
            raise click.UsageError(f"--{option} must not be used with protocol {protocol}")


def _verify_postures(request: PostureRequest, *, show: bool) -> None:
    """Write the verdicts on files of DexGraspBench, and how many hold.

    Raises:
        DataError: If there are no files, or the results cannot be written.
        HandError, ConfigError, MachineError: As `prepare_trials`.
    """
    from drakegrasp.errors import DataError, HandError
    from drakegrasp.protocols.postures import json_line, prepare_trials, verify_postures
    from drakegrasp.runtime.executor import processes
    from drakegrasp.runtime.progress import progress_bar
    from drakegrasp.verification.result_files import refuse_unwritable, result_paths, text_lines

    # All files, and what they have in common.
    path, hand, out = request.grasps, Path(request.hand or ""), request.out
    if out is not None:
        refuse_unwritable(out)
    files = [path] if path.is_file() else sorted(path.rglob("*.npy"))
    if not files:
        raise DataError(f"{path}: must be a .npy file or a folder of them, got none")
    if hand.suffix != ".xml":
        raise HandError(
            f"--hand must be an MJCF (.xml) with --protocol {request.protocol}, got {request.hand}"
        )
    trials = prepare_trials(request.protocol, hand, request.assets)

    # A line per verdict as it comes.
    held = 0
    with (
        nullcontext(_print_line) if out is None else text_lines(out) as write,
        processes(request.workers) as execute,
        progress_bar("verify", "grasps", show=show) as report,
    ):
        for index, result in enumerate(verify_postures(files, trials, execute)):
            line = json_line(index, result, trials)
            write(line)
            if request.as_json and out is not None:
                _print_line(line)
            held += result.verdict.success
            report(index + 1, len(files), holding=held)
    if out is not None and not request.as_json:
        say(str(result_paths(out)[0]))
    if show:
        say(f"{held:,} of {len(files):,} grasps hold by {trials.protocol}", err=True)


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
