"""`verify` prints a line of JSON per predicted grasp."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from cyclopts import Parameter

import drakegrasp as dg
from drakegrasp.cli.arguments import (
    AnyPath,
    AsJson,
    DataFile,
    Name,
    Preset,
    Settings,
    Split,
    Units,
    Workers,
    given,
)
from drakegrasp.cli.console import UsageError, say, wrong_input
from drakegrasp.cli.help import MORE
from drakegrasp.errors import GraspError, listed

if TYPE_CHECKING:
    from drakegrasp.config import Config
    from drakegrasp.dataset.reader import PredictedRows
    from drakegrasp.protocols.postures import PostureResult, PostureTrials
    from drakegrasp.simulation.attempts import Attempts
    from drakegrasp.verification.placing import PlacedGrasp
    from drakegrasp.verification.prediction import ContactRows
    from drakegrasp.verification.result import Verification

#: The split of a dataset if none is named.
DEFAULT_SPLIT = "test"
#: Rows as text: numbers of at most seven digits, and ranges of them.
ROWS = re.compile(r"\d{1,7}(-\d{1,7})?(,\s*\d{1,7}(-\d{1,7})?)*")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Target:
    """What grasps are tried on, and how.

    Attributes:
        mesh: The object: a .obj, .stl, .ply or .glb file.
        units: Unit of length of the mesh. [default: m]
        dataset: Instead of --object: the data file OUT/grasping_oto.hdf5 or _otm. Each row
            specifies the object, its pose and the camera's pose.
        split: Rows of the dataset, and group in an HDF5 file of grasps. [default: test]
        frame: Frame of the grasps; mesh, with --object, has the axes and the origin of the mesh
            file. [default: object; with --dataset camera; for postures as the file specifies]
        hand: The hand. [default: that of the configuration]
        config: Configuration: a file, or the preset paper, fast, randomized or released. [default:
            that of the dataset, else the defaults]
        overrides: Change one setting, e.g. lift.hold_time=1; may be given several times.
        method: hand: close a simulated hand on the contacts and lift. forces: compute whether
            forces at the points of the surface that the contacts select can lift the object.
        rows: With --dataset: for each grasp its row of the split, if the file does not specify it,
            e.g. 0,4,7-9 or a .npy file. [default: all rows]
        camera: With --object and --frame camera: .npy file with the camera's pose in the table-top
            frame X_TC, as (4, 4), or per grasp as (n, 4, 4) or (n, 12).
        snap_points: First move the points, but not the normals, to the surface of the object.
        link: Frame or link of the poses in files of postures, which overrides the files: palm, the
            palm link, or a frame of another tool that the hand file names, e.g. graspgen.
        preshape: Preshape for rows of postures that name none; the value each, for palm poses
            alone, tries all preshapes in turn.
    """

    mesh: Annotated[AnyPath | None, Parameter(name="--object", metavar="MESH")] = None
    units: Units | None = None
    dataset: DataFile | None = None
    split: Split | None = None
    frame: Literal["object", "camera", "table", "mesh"] | None = None
    hand: Annotated[str | None, Parameter(metavar="NAME|YAML|XML")] = None
    config: Preset | None = None
    overrides: Settings = ()
    method: Literal["hand", "forces"] = "hand"
    rows: Annotated[str | None, Parameter(group=MORE, metavar="ROWS")] = None
    camera: Annotated[AnyPath | None, Parameter(group=MORE, metavar="FILE")] = None
    snap_points: Annotated[bool, Parameter(group=MORE)] = False
    link: Annotated[Name | None, Parameter(group=MORE)] = None
    preshape: Annotated[Name | None, Parameter(group=MORE)] = None

    @property
    def read_as(self) -> dict[str, str]:
        """What applies to all postures, see `exchange.attempts.read_attempts`."""
        return given(frame=self.frame, link=self.link, preshape=self.preshape)

    def refuse(self, where: str, *names: str) -> None:
        """Reject options that have no effect.

        Raises:
            GraspError: If one is given.
        """
        for name in names:
            if (value := getattr(self, name)) != getattr(Target, name):
                option = {"mesh": "object", "overrides": "set"}.get(name, name).replace("_", "-")
                got = ", ".join(value) if isinstance(value, tuple) else value
                raise GraspError(f"--{option} must be left out {where}, got {got}")


def verify(
    grasps: AnyPath,
    /,
    *,
    target: Target = Target(),
    out: Annotated[AnyPath | None, Parameter(metavar="NAME")] = None,
    as_json: AsJson = False,
    quiet: bool = False,
    protocol: Annotated[str, Parameter(group=MORE, metavar="NAME|FILE.py:NAME")] = "lift",
    simulator: Annotated[Literal["drake", "mujoco"] | None, Parameter(group=MORE)] = None,
    assets: Annotated[AnyPath | None, Parameter(group=MORE, metavar="DIR")] = None,
    workers: Workers = Workers(),
) -> None:
    """Try predicted grasps in the simulator.

    The command reports whether each grasp holds its object, and if not, why.

    GRASPS is a .npy array with one row per grasp, or an HDF5 file with an array `grasps` at its
    root or in a group. An array `rows` in the same place names the rows of the dataset. A grasp has
    6 numbers per finger (18 for the Barrett Hand): the contact points in metres, then the outward
    unit normals, in the order of the hand's fingers.

    GRASPS may also be a file or a folder of postures, as for `build --postures`. They are tried on
    --object, or on the objects of --dataset that the file specifies by name or by `row`; with
    --split on the rows of these objects, as in `drakegrasp score`. They are ranked by the
    confidence that the file states.

    With a protocol other than lift, only the wrist pose that fits the contacts best is tried.
    GRASPS may then be a .npy file of DexGraspBench or a folder of such files, and --hand an MJCF
    whose world is the hand's root.

    If GRASPS is a data file of a dataset, and neither --object nor --dataset is given, the command
    tries the grasps of that dataset.

    One line of JSON per grasp is written to standard output or NAME.jsonl, and a table of the
    outcomes to standard error. A row that is not a valid grasp has the outcome `invalid`. The exit
    code is 0 if every grasp has a verdict, whatever it is, and 2 if the input cannot be used.

    Args:
        grasps: The predicted grasps.
        out: Write NAME.jsonl and NAME.h5 instead of printing JSON lines.
        as_json: Print the JSON lines even with --out, without progress and table.
        quiet: Show neither progress nor the table.
        protocol: The rule of the verdict: lift, dexgraspbench, dexgraspbench-tabletop,
            dexonomy-hard, dexonomy-hard-as-run, or your own class. All protocols except lift run in
            MuJoCo.
        simulator: Reject a protocol that runs in the other simulator. [default: either]
        assets: With files of DexGraspBench: the folder to which their object paths are relative.
            [default: .]
    """
    from drakegrasp.protocols.protocol import find_protocol
    from drakegrasp.verification.result_files import refuse_unwritable

    rule, stored = find_protocol(protocol)
    if simulator not in (None, rule.simulator):
        must = f"--simulator of protocol {stored} must be {rule.simulator}"
        raise UsageError(f"{must}, got {simulator}")
    with wrong_input():
        if out is not None:
            refuse_unwritable(out)
    show, on = not (quiet or as_json), workers.asked()
    if rule.simulator != "drake":
        if on["scheduler"] or on["scheduler_file"]:
            raise UsageError(f"--scheduler must be left out with protocol {protocol}")
        how: dict[str, Any] = {"workers": on["workers"], "show": show}
        _by_protocol(grasps, target, protocol, out, as_json, assets, **how)
    elif assets is not None:
        raise UsageError("--assets must be used with another --protocol than lift")
    else:
        _by_lift(grasps, target, out, as_json, show=show, **on)


def _by_lift(path: Path, target: Target, out: Path | None, echo: bool, **how: Any) -> None:
    """Write the verdicts of a lift, and print their counts."""
    from drakegrasp.api.verifying import run_verification
    from drakegrasp.cli.tables import make_console, verdict_table
    from drakegrasp.verification import result_files as files
    from drakegrasp.verification.hints import count_hints

    # All input is read and checked before anything is simulated.
    grasps, config, rows = place(path, target)

    def deliver(index: int, result: Verification) -> None:
        write(files.json_line(index, result))

    # Lines are written as verdicts arrive, so an interrupted run keeps the finished ones.
    try:
        with files.text_lines(out, echo=echo) as write:
            results = run_verification(grasps, config, on_result=deliver, **how)
            if out is not None:
                files.write_results(results, files.result_paths(out)[1], config, rows)
    except BaseException:
        if out is not None and files.part_path(out).exists():
            say(f"{files.part_path(out)}: the verdicts so far", err=True)
        raise

    for written in () if out is None or echo else files.result_paths(out):
        say(str(written))
    if not how["show"]:
        return
    total = f"of {len(results)} grasps"
    make_console(stderr=True).print(verdict_table(results))
    if best := [result.held for result in results if result.rank == 0]:
        say(f"{sum(best)} of {len(best)} best-ranked grasps hold", err=True)
    for hint, count in count_hints(result.hints for result in results):
        say(f"{count} {total} would fit much better: {hint}", err=True)
    if lost := sum(result.misplaced and not result.hints for result in results):
        say(f"{lost} {total} are far from the object in every known frame and unit", err=True)


def _by_protocol(
    path: Path,
    target: Target,
    protocol: str,
    out: Path | None,
    echo: bool,
    assets: Path | None,
    **how: Any,
) -> None:
    """Write the verdicts of a protocol of MuJoCo, and print how many grasps hold."""
    from drakegrasp.api.protocols import verify_by_protocol, verify_files_by_protocol
    from drakegrasp.protocols.postures import json_line
    from drakegrasp.verification.result_files import result_paths, text_lines

    where, held = f"with protocol {protocol}", list[bool]()
    target.refuse(where, "method", "snap_points", "rows", "config", "overrides", "link", "preshape")
    files = _bench_files(path, target, where, assets)

    def deliver(index: int, result: PostureResult, trials: PostureTrials) -> None:
        write(json_line(index, files[index] if files else path, result, trials))
        held.append(result[0].success)

    with text_lines(out, echo=echo) as write:
        if files:
            how |= {"hand": Path(target.hand or ""), "objects": assets or Path()}
            verify_files_by_protocol(files, protocol, deliver, **how)
        else:
            placed, config, _ = place(path, target)
            grasps = sorted(placed, key=lambda grasp: grasp.index)
            verify_by_protocol(grasps, config, protocol, deliver, **how)
    if out is not None and not echo:
        say(str(result_paths(out)[0]))
    if how["show"]:
        say(f"{sum(held):,} of {len(held):,} grasps hold by {protocol}", err=True)


def _bench_files(path: Path, target: Target, where: str, assets: Path | None) -> list[Path]:
    """Return the files of DexGraspBench at a path in their order; none for other grasps.

    Raises:
        GraspError: If there are such files, and options do not fit them.
    """
    from drakegrasp.protocols.files import is_grasp_file

    suffix = Path(target.hand or "").suffix
    files = [path] if path.is_file() else sorted(path.rglob("*.npy"))
    if suffix != ".xml" and assets is None:
        own = path.is_file() and not (path.suffix == ".npy" and is_grasp_file(path))
        if own or not files:
            return []
    if not files:
        raise GraspError(f"{path}: must be a .npy file or a folder of them, got none")
    names = ("mesh", "units", "dataset", "split", "frame", "camera")
    target.refuse(f"{where} and files of DexGraspBench", *names)
    if suffix != ".xml":
        must = "--hand must be an MJCF (.xml) with files of DexGraspBench"
        raise GraspError(f"{must}, got {target.hand}")
    return files


class Read(NamedTuple):
    """The grasps of a file, and what they are on.

    Attributes:
        table: The grasps.
        on: A mesh, the rows of a dataset, or a dataset whose objects the grasps name.
        config: The configuration that the caller gives; None for that of each object or row.
        targets: (n,), the object or the row of each grasp.
    """

    table: Attempts | ContactRows
    on: Path | dg.GraspDataset
    config: Config | None
    targets: Any


def place(path: Path, target: Target) -> tuple[list[PlacedGrasp], Config, PredictedRows | None]:
    """Return the grasps of a file on their objects, the configuration, and the rows.

    There is at least one grasp. If friction was drawn for the row of a grasp, the grasp has its own
    configuration. The rows are those of a dataset to which the grasps belong, in the order of the
    file; None if they belong to none.

    Raises:
        GraspError, MeshError, ConfigError, HandError: If a file or an option cannot be used.
    """
    from drakegrasp.api.verifying import place_grasps
    from drakegrasp.dataset.reader import PredictedRows
    from drakegrasp.exchange.attempts import has_rows, holds_postures
    from drakegrasp.exchange.columns import read_numbers
    from drakegrasp.simulation.attempts import ranked

    with wrong_input():
        postures = holds_postures(path)
        dataset = _dataset_of(path, target, postures)
        if dataset is None:
            read = _of_mesh(path, target)
        elif postures and target.split is None and not has_rows(path):
            read = _of_objects(path, target, dataset)
        else:
            read = _of_rows(path, target, dataset)
        table, data = read.table, read.on if isinstance(read.on, dg.GraspDataset) else None
        if table.confidence is not None:
            table = ranked(table, read.targets)
        placed, config = place_grasps(
            table,
            read.on,
            None if data is None else read.targets,
            frame=target.frame,
            X_TC=None if target.camera is None else read_numbers(target.camera),
            units=target.units,
            hand=None if dataset is None else target.hand,
            method=target.method,
            snap_points=target.snap_points,
            config=read.config,
            overrides=target.overrides,
        )
        # Invalid contacts are failures of a network, but such postures belong elsewhere.
        if postures and all(grasp.invalid for grasp in placed):
            raise GraspError(f"{path}: {placed[0].invalid}")
        _say_all(table.left_out)
        if data is None:
            return placed, config, None
        return placed, config, PredictedRows.of(data.path, data.split, read.targets)


def _of_mesh(path: Path, target: Target) -> Read:
    """Return the grasps of a file that belong to the mesh of --object, which they need not name.

    If all rows of a file name one other object, the file is used for this object.

    Raises:
        GraspError: If no grasp belongs to the object, or the grasps are for rows of a dataset.
    """
    from drakegrasp.exchange.attempts import read_predictions
    from drakegrasp.objects.sources import find_mesh
    from drakegrasp.simulation.attempts import Attempts

    assert target.mesh is not None
    config = dg.load_config(target.config, target.overrides, **given(hand=target.hand))
    name = find_mesh(target.mesh, units=target.units or "m").name
    hand = dg.load_hand(config.hand_source)
    table = read_predictions(path, hand, of=name, split=target.split, read_as=target.read_as)
    if table.of_row is not None:
        raise GraspError("rows must be in a file of grasps for --dataset only, got rows")
    if not isinstance(table, Attempts):
        return Read(table, target.mesh, config, [name] * len(table))
    own = [i for i, each in enumerate(table.objects) if each in ("", name)]
    others = sorted(set(table.objects) - {"", name})
    if others and not all(table.invalid[i] for i in own):
        left = f"{len(table) - len(own):,} postures of {listed(others)} are left out"
        say(f"{path}: {left}, as --object is {name}", err=True)
        table = table.at(own)
    elif others and (path.is_dir() or len(others) > 1):
        raise GraspError(f"{path}: postures must be of {name}, the --object, got {listed(others)}")
    elif others:
        say(f"{path}: postures of {others[0]} are tried on {name}, the --object", err=True)
    return Read(table, target.mesh, config, table.objects)


def _of_objects(path: Path, target: Target, dataset: Path) -> Read:
    """Return the postures of a file that name objects of a dataset."""
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.exchange.attempts import read_attempts
    from drakegrasp.hand.settings import override_config
    from drakegrasp.simulation.attempts import Attempts

    out = dataset.parent if dataset.is_file() else dataset
    config = override_config(read_manifest(out).config, target.overrides)
    table = read_attempts(path, dg.load_hand(config.hand_source), read_as=target.read_as)
    assert isinstance(table, Attempts)
    return Read(table, out, None, table.objects)


def _of_rows(path: Path, target: Target, dataset: Path) -> Read:
    """Return the grasps of a file for rows of a dataset."""
    from drakegrasp.exchange.attempts import read_predictions
    from drakegrasp.verification.placing import choose_rows, dataset_config

    # For grasps from outside, only the objects and cameras of the rows are needed.
    split = target.split or DEFAULT_SPLIT
    data = dg.GraspDataset(dataset, split=split, fewer_fingers=dataset != path)

    own = None if target.config is None else dg.load_config(target.config, target.overrides)
    config = dataset_config(data, own, target.hand, () if own else target.overrides)
    hand = dg.load_hand(config.hand_source)
    table = read_predictions(path, hand, of=data, read_as=target.read_as)
    if table.of_row is not None:
        target.refuse("with a file that has rows", "rows")
    rows = table.of_row if target.rows is None else _read_rows(target.rows)
    said = "`rows` in the file, or --rows, says for which rows they are"
    rows = choose_rows(data, rows, len(table), said=said)
    return Read(table, data, own, rows)


def _dataset_of(path: Path, target: Target, postures: bool) -> Path | None:
    """Return the data file or directory whose objects are grasped; None for --object.

    Raises:
        GraspError: If the choice is not clear, or an option is without effect.
    """
    from drakegrasp.exchange.columns import HDF5_SUFFIXES

    stored = not postures and path.suffix.lower() in HDF5_SUFFIXES
    if target.mesh is not None and target.dataset is not None:
        raise GraspError("--object or --dataset must be given, got both")
    if target.mesh is None and target.dataset is None:
        if not stored:
            where = "where the grasps are not in a data file of a dataset, got neither"
            raise GraspError(f"--object MESH or --dataset FILE must be given {where} for {path}")
        if target.frame not in (None, "camera"):
            must = "--frame must be camera for a dataset's own grasps"
            raise GraspError(f"{must}, got {target.frame}")

    # The camera of a posture is that of its row, and postures need no fit.
    framed = target.mesh is not None and target.frame == "camera"
    others = "" if postures else ", or grasps in an HDF5 file"
    for unused, where, *names in (
        (postures, "with postures", "camera", "method", "snap_points", "rows"),
        (postures and target.frame == "camera", "with postures", "frame"),
        (postures and target.dataset, "with postures and --dataset", "units", "hand", "config"),
        (not postures, "without postures", "link", "preshape"),
        (target.mesh is None, "without --object", "units"),
        (target.dataset is None, "without --dataset", "rows"),
        (target.dataset is None and not stored, f"without --dataset{others}", "split"),
        (not framed, "without --object and --frame camera", "camera"),
    ):
        if unused:
            target.refuse(where, *names)
    if framed and target.camera is None:
        raise GraspError("--camera FILE must be given with --object and --frame camera, got none")
    return None if target.mesh is not None else target.dataset or path


def _read_rows(text: str) -> Any:
    """Return the rows that a text or a .npy file names; ranges include both ends."""
    import numpy as np

    from drakegrasp.exchange.columns import read_numbers

    if text.endswith(".npy"):
        rows = read_numbers(Path(text)).ravel()
        if not (np.isfinite(rows).all() and (rows == np.floor(rows)).all()):
            raise GraspError(f"{text}: must hold whole numbers, got others")
        return rows.astype(np.int64)
    if not ROWS.fullmatch(text):
        raise GraspError(f"--rows must be as 0,4,7-9 or a .npy file, got {text[:40]!r}")
    ends = [part.partition("-") for part in text.split(",")]
    return [row for first, _, last in ends for row in range(int(first), int(last or first) + 1)]


def _say_all(*texts: str) -> None:
    for text in filter(None, texts):
        say(text, err=True)
