"""`verify` prints a line of JSON per predicted grasp; `score` writes a card with reference rows."""

from __future__ import annotations

import json
import shlex
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import click
from click.core import ParameterSource

from drakegrasp.cli.console import Command, progress_bar, say
from drakegrasp.cli.options import (
    CONNECTION,
    EXISTING,
    PATH,
    SPLITS,
    VerifyRequest,
    chosen_reading,
    chosen_workers,
    described,
)
from drakegrasp.runtime.executor import processes

if TYPE_CHECKING:
    from drakegrasp.runtime.executor import Executor
    from drakegrasp.runtime.progress import Report
    from drakegrasp.verification.result import Verification

#: Options that specify the grasps and their places; a protocol in MuJoCo determines all others.
PLACES = ("grasps", "mesh", "units", "dataset", "split", "frame", "camera", "hand")
#: Values of these others if they are not given, and their names on the command line.
_USUAL = {"method": "hand", "overrides": (), "snap_points": False, "tls": True}
_CALLED = {"mesh": "object", "overrides": "set", "tls": "no-tls", "tls_files": "tls-ca-file"}
#: Options of `score` that change no verdict.
_IDLE = {"as_json", "quiet", "tls", *(n[2:].replace("-", "_") for n in CONNECTION)}


@click.command(cls=Command)
@partial(described, request=VerifyRequest)
@click.argument("grasps", type=PATH, metavar="GRASPS")
def verify(
    quiet: bool = False,
    as_json: bool = False,
    protocol: str = "lift",
    simulator: Annotated[str | None, click.Choice(["drake", "mujoco"])] = None,
    assets: Path | None = None,
    **options: Any,
) -> None:
    """Try predicted grasps in the simulator.

    The command reports whether each grasp holds its object, and if not, why.

    GRASPS is a .npy array with one row per grasp, a .csv file with one line per grasp, or an HDF5
    file with an array `grasps` at its root or in a group. An array `rows` in the same place names
    the rows of the dataset. A grasp has 6 numbers per finger (18 for the Barrett Hand): the contact
    points in metres, then the outward unit normals, in the order of the hand's fingers.

    GRASPS may also be a file or a folder of postures, as for `build --postures`. They are tried on
    --object, or on the objects of --dataset that the file specifies by name or by `row`; with
    --split on the rows of these objects, as in `drakegrasp score`. They are ranked by the
    confidence that the file states.

    With a protocol other than lift, only the wrist pose that fits the contacts best is tried.
    GRASPS may then be a .npy file of DexGraspBench or a folder of such files, and --hand an MJCF
    whose world is the hand's root.

    If GRASPS is a data file of a dataset, and neither --object nor --dataset is given, the
    command tries the grasps of that dataset.

    One line of JSON per grasp is written to standard output or NAME.jsonl, and a table of the
    outcomes to standard error. A row that is not a valid grasp has the outcome `invalid`. The exit
    code is 0 if every grasp has a verdict, whatever it is, and 2 if the input cannot be used.

    Options:
        --object MESH (mesh): The object: a .obj, .stl, .ply or .glb file.
        --units m|cm|mm: Unit of length of the mesh. [default: m]
        --dataset FILE: Instead of --object: the data file OUT/grasping_oto.hdf5 or _otm. Each row
            specifies the object, its pose and the camera's pose.
        --split: Rows of the dataset, and group in an HDF5 file of grasps. [default: test]
        --rows 0,4,7-9|FILE.npy: With --dataset: for each grasp its row of the split, if the file
            does not specify it. [default: all rows]
        --frame: Frame of the grasps; mesh, with --object, has the axes and the origin of the mesh
            file. [default: object; with --dataset camera; for postures as the file specifies]
        --link, --preshape
        --camera FILE: With --object and --frame camera: .npy file with the camera's pose in the
            table-top frame X_TC, as (4, 4), or per grasp as (n, 4, 4) or (n, 12).
        --method: hand: close a simulated hand on the contacts and lift. forces: compute whether
            forces at the points of the surface that the contacts select can lift the object.
        --snap-points: First move the points, but not the normals, to the surface of the object.
        --protocol NAME|FILE.py:NAME: The rule of the verdict: {protocols}, or your own class. All
            protocols except lift run in MuJoCo.
        --simulator: Reject a protocol that runs in the other simulator. [default: either]
        --assets DIR: With files of DexGraspBench: the folder to which their object paths are
            relative. [default: .]
        --hand NAME|YAML|XML: The hand. [default: that of the configuration]
        --config YAML|PRESET: Configuration: a file, or the preset paper, fast, randomized or
            released. [default: that of the dataset, else the defaults]
        --set
        --out NAME: Write NAME.jsonl and NAME.h5 instead of printing JSON lines.
        CONNECTION
        --quiet: Show neither progress nor the table.
        --json (as_json): Print the JSON lines even with --out, without progress and table.
    """
    from drakegrasp.protocols.protocol import find_protocol

    workers = chosen_workers(options)
    rule, stored = find_protocol(protocol)
    if simulator not in (None, rule.simulator):
        raise click.UsageError(
            f"--simulator of protocol {stored} must be {rule.simulator}, got {simulator}"
        )
    if rule.simulator != "drake":
        request = VerifyRequest(**{name: options.pop(name) for name in PLACES})
        out, count = options.pop("out"), workers.pop("workers")
        _refuse_options(protocol, **workers, **options)
        _verify_by_protocol(request, protocol, assets, out, count, as_json=as_json, quiet=quiet)
    elif assets is not None:
        raise click.UsageError("--assets must be used with another --protocol than lift")
    else:
        _verify_by_lift(VerifyRequest(**options), workers, as_json, quiet or as_json)


def _refuse_options(protocol: str, **options: Any) -> None:
    """Reject options that the protocol determines itself.

    Raises:
        click.UsageError: If one is given.
    """
    for name, value in options.items():
        if value is not None and value != _USUAL.get(name):
            said = _CALLED.get(name, name.replace("_", "-"))
            raise click.UsageError(f"--{said} must not be used with protocol {protocol}")


def _verify_by_lift(
    request: VerifyRequest, workers: dict[str, Any], as_json: bool, quiet: bool
) -> None:
    from drakegrasp.api.verifying import run_verification
    from drakegrasp.cli.placing import place_requested
    from drakegrasp.cli.tables import make_console, verdict_table
    from drakegrasp.verification.hints import count_hints
    from drakegrasp.verification.result_files import (
        json_line,
        part_path,
        result_paths,
        text_lines,
        write_results,
    )

    # All input is read and checked before anything is simulated.
    out = request.out
    grasps, config, rows = place_requested(request)

    def deliver(index: int, result: Verification) -> None:
        write(json_line(index, result))

    # Lines are written as verdicts arrive, so an interrupted run keeps the finished ones.
    try:
        with text_lines(out, echo=as_json) as write:
            results = run_verification(grasps, config, **workers, on_result=deliver, show=not quiet)
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
        if best := [result.held for result in results if result.rank == 0]:
            say(f"{sum(best)} of {len(best)} best-ranked grasps hold", err=True)
        for hint, count in count_hints(result.hints for result in results):
            say(f"{count} of {len(results)} grasps would fit much better: {hint}", err=True)
        if lost := sum(result.misplaced and not result.hints for result in results):
            say(
                f"{lost} of {len(results)} grasps are far from the object in every known frame and "
                "unit",
                err=True,
            )


def _verify_by_protocol(
    request: VerifyRequest,
    protocol: str,
    assets: Path | None,
    out: Path | None,
    workers: int | None,
    *,
    as_json: bool,
    quiet: bool,
) -> None:
    """Write the verdicts, and print how many grasps hold."""
    from drakegrasp.protocols.postures import json_line, prepare_trials, verify_postures
    from drakegrasp.verification.result_files import refuse_unwritable, result_paths, text_lines

    if out is not None:
        refuse_unwritable(out)
    held, show, read = 0, not (quiet or as_json), request.grasps
    with TemporaryDirectory() as scratch, processes(workers) as execute:
        with progress_bar("cut", "objects", show=show) as report:
            if _is_foreign(request, assets):
                hand, folder, files = _foreign_files(request, protocol, assets)
            else:
                hand, folder, files = _own_files(request, Path(scratch), execute, report)
        trials = prepare_trials(protocol, hand, folder)

        # Write one line per verdict as soon as it is known.
        with (
            text_lines(out, echo=as_json) as write,
            progress_bar("verify", "grasps", show=show) as report,
        ):
            for index, result in enumerate(verify_postures(files, trials, execute)):
                name = read if folder == Path(scratch) else files[index]
                write(json_line(index, name, result, trials))
                held += result[0].success
                report(index + 1, len(files), holding=held)
    if out is not None and not as_json:
        say(str(result_paths(out)[0]))
    if show:
        say(f"{held:,} of {len(files):,} grasps hold by {trials.protocol}", err=True)


def _is_foreign(request: VerifyRequest, assets: Path | None) -> bool:
    """Return whether the grasps are files of DexGraspBench."""
    from drakegrasp.protocols.files import is_grasp_file

    path = request.grasps
    if Path(request.hand or "").suffix == ".xml" or assets is not None:
        return True
    if path.is_dir():
        return any(path.rglob("*.npy"))
    return path.suffix == ".npy" and is_grasp_file(path)


#: The MJCF of the hand, the folder of objects, and for each grasp its file or the reason for none.
_Files: TypeAlias = tuple[Path, Path, list[Path | str]]


def _foreign_files(request: VerifyRequest, protocol: str, assets: Path | None) -> _Files:
    """Return files of DexGraspBench unchanged."""
    from drakegrasp.errors import DataError, HandError

    given = {name: getattr(request, name) for name in PLACES if name not in ("grasps", "hand")}
    _refuse_options(f"{protocol} and files of DexGraspBench", **given)
    hand, path = Path(request.hand or ""), request.grasps
    if hand.suffix != ".xml":
        raise HandError(
            f"--hand must be an MJCF (.xml) with files of DexGraspBench, got {request.hand}"
        )
    files: list[Path | str] = [path] if path.is_file() else [*sorted(path.rglob("*.npy"))]
    if not files:
        raise DataError(f"{path}: must be a .npy file or a folder of them, got none")
    return hand, assets or Path(), files


def _own_files(request: VerifyRequest, folder: Path, execute: Executor, report: Report) -> _Files:
    """Write postures or contacts as files of DexGraspBench, and return them in order."""
    from drakegrasp.cli.placing import place_requested
    from drakegrasp.exchange.dexgraspbench import fitted_postures, write_grasps
    from drakegrasp.hand.description import load_hand
    from drakegrasp.runtime.environment import require_mujoco

    require_mujoco("mujoco", "coacd")
    placed, config, _ = place_requested(request)
    placed.sort(key=lambda grasp: grasp.index)
    hand, postures = load_hand(config.hand_source), fitted_postures(placed, execute)
    path, files = write_grasps(postures, hand, folder, execute=execute, report=report)
    return path, folder, files


@click.command(cls=Command)
@described
@click.argument("predictions", type=EXISTING, metavar="[PREDICTIONS]...", nargs=-1)
@click.pass_context
def score(
    context: click.Context,
    /,
    predictions: tuple[Path, ...],
    *,
    dataset: Path,
    split: Annotated[str, SPLITS] = "test",
    against: Annotated[tuple[Path, ...], EXISTING] = (),
    train: Path | None = None,
    references: tuple[str, ...] = (),
    per_object: Annotated[int | None, click.IntRange(1)] = None,
    frame: Annotated[str | None, click.Choice(["object", "camera", "table", "world"])] = None,
    link: str | None = None,
    preshape: str | None = None,
    protocol: str = "lift",
    out: Path | None = None,
    as_json: bool = False,
    quiet: bool = False,
    **options: Any,
) -> None:
    """Score predicted grasps against reference rows.

    Each of PREDICTIONS is a .npy, HDF5 or Parquet file of (n, 6k) numbers, one grasp per row of the
    split, or (n, m, 6k), m grasps per row, in the camera's frame. It may also be a file of postures
    with the `row` of each, or a file or folder of exported samples. Several files are treated as
    several training runs of one method. Without PREDICTIONS only the reference rows are scored.

    With --out the command writes card.json, card.md, card.png and the verdicts to DIR, so that an
    interrupted score can continue.

    Options:
        --dataset FILE: The data file of the predicted rows or views: OUT/grasping_oto.hdf5, _otm,
            or OUT/scenes.hdf5.
        --split: Rows of the dataset.
        --against FILE: Predictions of another method for the same rows: the card contains the
            difference of the headlines. May be given several times, once per training run of that
            method.
        --train FILE: Data file whose training rows are used for the reference rows. [default:
            --dataset]
        --reference NAME (references): Score these reference rows only; may be given several times:
            own, nearest image, constant, random, top-down, closing, palm normals, surface.
            [default: all]
        --per-object N: Maximum number of rows of each object.
        --frame: Frame of all postures, which overrides their files.
        --link, --preshape, --set
        --protocol NAME|FILE.py:NAME: The rule of a verdict, see `drakegrasp verify`. All protocols
            except lift try the first wrist pose of a prediction in MuJoCo.
        --out DIR: Folder of the card and of the verdicts, from which the same command continues.
            [default: nothing is written]
        --json (as_json): Print the card as JSON.
        CONNECTION
        --quiet: Show neither progress nor the table.
    """
    from drakegrasp.api.scoring import score as score_predictions
    from drakegrasp.cli.tables import make_console, score_table
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.scenes import open_rows
    from drakegrasp.errors import DataError, GraspError
    from drakegrasp.exchange.attempts import holds_postures
    from drakegrasp.scoring.card import share_text
    from drakegrasp.scoring.references import REFERENCES

    # A bad dataset is wrong usage, as for `verify`.
    workers = chosen_workers(options)
    try:
        read_manifest(dataset.parent)
        bare = not references and bool(predictions) and all(map(holds_postures, predictions))
        data = open_rows(dataset, split=split, fewer_fingers=bare)
        trained = None if train is None else open_rows(train, split="train")
    except DataError as error:
        raise GraspError(str(error)) from None
    references = references or tuple(REFERENCES)
    if data.has_fewer_fingers:
        say("no reference rows: some samples leave fingers out", err=True)
        references = ()
    scored = score_predictions(
        predictions,
        data,
        against=against or None,
        train=trained,
        references=references,
        per_object=per_object,
        read_as=chosen_reading({"frame": frame, "link": link, "preshape": preshape}),
        protocol=protocol,
        out=out,
        again=_command(context),
        **options,
        **workers,
        show=not quiet,
    )

    if as_json:
        click.echo(json.dumps(scored.card, indent=1, allow_nan=False))
    else:
        for name, value in scored.card["headline"].items():
            say(f"{name}: {share_text(value, 1, ' %')}")
        if out is not None:
            say(str(out / "card.md"))
    if not quiet:
        make_console(stderr=True).print(score_table(scored.card, scored.seconds))
        for warning in scored.card["warnings"]:
            say(f"warning: {warning}", err=True)


def _command(context: click.Context) -> str:
    """Return the command that reproduces the card, with all given options that affect it."""
    words = ["drakegrasp", "score"]
    for parameter in context.command.params:
        name = str(parameter.name)
        source, value = context.get_parameter_source(name), context.params[name]
        if name in _IDLE or source is not ParameterSource.COMMANDLINE or value is None:
            continue
        option = () if isinstance(parameter, click.Argument) else parameter.opts[:1]
        for each in value if isinstance(value, tuple) else (value,):
            words += [*option, str(each)]
    return shlex.join(words)
