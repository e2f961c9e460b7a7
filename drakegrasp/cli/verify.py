"""`verify` prints a line of JSON per predicted grasp."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import drakegrasp as dg
from drakegrasp.cli.arguments import (
    AnyPath,
    AsJson,
    DataFile,
    GraspFrame,
    Postures,
    Preset,
    Settings,
    Split,
    Units,
    Workers,
    given,
)
from drakegrasp.cli.console import MORE, UsageError, say, wrong_input
from drakegrasp.errors import GraspError, counted, listed

if TYPE_CHECKING:
    from drakegrasp.config import Config
    from drakegrasp.dataset.reader import PredictedRows
    from drakegrasp.protocols.postures import PostureResult, PostureTrials
    from drakegrasp.simulation.attempts import GraspTable, Rows
    from drakegrasp.verification.placing import PlacedGrasp
    from drakegrasp.verification.result import Verification

#: The split of a dataset if none is named.
DEFAULT_SPLIT = "test"


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Target:
    """What grasps are tried on, and how.

    Attributes:
        mesh: The object: a .obj, .stl, .ply or .glb file.
        units: Unit of length of the mesh. [default: m]
        dataset: Instead of --object: the data file OUT/grasping_oto.hdf5 or _otm, or scenes,
            OUT/scenes.hdf5 or OUT/clutter.hdf5. Each row or view specifies the object, its pose,
            its neighbours and the camera's pose.
        split: Rows of the dataset, and group in an HDF5 file of grasps. [default: test]
        frame: Frame of the grasps; mesh has the axes and the origin of the mesh file, and for
            postures needs --object. [default: object; with --dataset camera; for postures as the
            file specifies]
        hand: The hand. [default: that of the configuration]
        config: Configuration: a file, or the preset paper, released, fast, randomized, bench1 or
            clutter1. [default: that of the dataset, else the defaults]
        overrides: Change one setting, e.g. lift.hold_time=1; may be given several times.
    """

    mesh: Annotated[AnyPath | None, Parameter(name="--object", metavar="MESH")] = None
    units: Units | None = None
    dataset: DataFile | None = None
    split: Split | None = None
    frame: GraspFrame | None = None
    hand: Annotated[str | None, Parameter(metavar="NAME|YAML|XML")] = None
    config: Preset | None = None
    overrides: Settings = ()
    reading: Postures = field(default_factory=Postures)

    @property
    def read_as(self) -> dict[str, str]:
        """What applies to all postures, see `exchange.attempts.read_attempts`."""
        return given(frame=self.frame) | self.reading.asked()

    def refuse(self, where: str, *names: str) -> None:
        """Reject options that have no effect.

        Raises:
            GraspError: If one is given.
        """
        values, usual = vars(self) | vars(self.reading), vars(Target()) | vars(Postures())
        for name in names:
            if (value := values[name]) != usual[name]:
                option = {"mesh": "object", "overrides": "set"}.get(name, name).replace("_", "-")
                got = ", ".join(value) if isinstance(value, tuple) else value
                raise GraspError(f"--{option} must be left out {where}, got {got}")


def verify(
    grasps: AnyPath,
    /,
    *,
    target: Target = Target(),
    out: Annotated[AnyPath | None, Parameter(metavar="FILE")] = None,
    as_json: AsJson = False,
    quiet: bool = False,
    protocol: Annotated[str, Parameter(group=MORE, metavar="NAME|FILE.py:NAME")] = "lift",
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

    One line of JSON per grasp is written to standard output as soon as its verdict is known, and
    the counts of the outcomes to standard error. A row that is not a valid grasp has the outcome
    `invalid`. The exit code is 0 if every grasp has a verdict, whatever it is, and 2 if the input
    cannot be used.

    Args:
        grasps: The predicted grasps.
        out: Write all verdicts to this HDF5 file (.h5) instead of printing JSON lines.
        as_json: Print the JSON lines even with --out, and neither progress nor counts.
        quiet: Show neither progress nor counts.
        protocol: The rule of the verdict: lift, dexgraspbench, dexgraspbench-tabletop,
            dexonomy-hard, dexonomy-hard-as-run, or your own class. All protocols except lift run in
            MuJoCo.
        assets: With files of DexGraspBench: the folder to which their object paths are relative.
            [default: .]
    """
    from drakegrasp.protocols.protocol import find_protocol

    rule, _ = find_protocol(protocol)
    show, on = not (quiet or as_json), workers.asked()
    if rule.simulator != "drake":
        if on["scheduler"] or on["scheduler_file"]:
            raise UsageError(f"--scheduler must be left out with protocol {protocol}")
        if out is not None:
            raise UsageError(f"--out must be left out with protocol {protocol}, got {out}")
        _by_protocol(grasps, target, protocol, assets, workers=on["workers"], show=show)
    elif assets is not None:
        raise UsageError("--assets must be used with another --protocol than lift")
    else:
        _by_lift(grasps, target, out, lines=out is None or as_json, show=show, **on)


def _by_lift(path: Path, target: Target, out: Path | None, *, lines: bool, **how: Any) -> None:
    """Write the verdicts of a lift, and print their counts."""
    from drakegrasp.api.verifying import run_verification
    from drakegrasp.exchange.columns import HDF5_SUFFIXES
    from drakegrasp.runtime.files import validate_writable
    from drakegrasp.verification.result import json_line, write_results

    # All input is read and checked before anything is simulated.
    if out is not None:
        if out.suffix.lower() not in HDF5_SUFFIXES:
            raise UsageError(f"--out must be a file {' or '.join(HDF5_SUFFIXES)}, got {out}")
        with wrong_input():
            validate_writable(out)
    grasps, config, rows = place(path, target)

    def deliver(index: int, result: Verification) -> None:
        if lines:
            _write_line(json_line(index, result))

    results = run_verification(grasps, config, on_result=deliver, **how)
    if out is not None:
        write_results(results, out, config, rows)
        if not lines:
            say(str(out))
    if how["show"]:
        _say_counts(results)


def _write_line(line: str) -> None:
    """Write a line of JSON, whose texts are escaped already."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _say_counts(results: Sequence[Verification]) -> None:
    """Print how many grasps have each outcome and verdict, and what would fit much better."""
    total = f"of {counted(len(results), 'grasp')}"
    for outcome, count in Counter(result.outcome.label for result in results).most_common():
        say(f"{count:,} {total}: {outcome}", err=True)
    words = ["lifted", "matches", "precision", "stable", "kept", "lifted_any"]
    if any(result.placed.around for result in results):
        words.append("clean")
    counts = (f"{sum(getattr(each, word) for each in results):,} {word}" for word in words)
    say(f"verdicts: {', '.join(counts)}", err=True)
    if best := [result.lifted for result in results if result.grasp.rank == 0]:
        say(f"{sum(best)} of {len(best)} best-ranked grasps hold", err=True)
    for hint, count in Counter(hint for each in results for hint in each.hints).most_common():
        say(f"{count} {total} would fit much better: {hint}", err=True)
    if lost := sum(result.misplaced and not result.hints for result in results):
        say(f"{lost} {total} are far from the object in every known frame and unit", err=True)


def _by_protocol(
    path: Path, target: Target, protocol: str, assets: Path | None, **how: Any
) -> None:
    """Print the verdicts of a protocol of MuJoCo, and how many grasps hold."""
    from drakegrasp.api.verifying import verify_by_protocol, verify_files_by_protocol
    from drakegrasp.protocols.postures import json_line

    where, held = f"with protocol {protocol}", list[bool]()
    target.refuse(where, "config", "overrides", "link", "preshape")
    files = _bench_files(path, target, where, assets)

    def deliver(index: int, result: PostureResult, trials: PostureTrials) -> None:
        _write_line(json_line(index, files[index] if files else path, result, trials))
        held.append(result[0].success)

    if files:
        how |= {"hand": Path(target.hand or ""), "objects": assets or Path()}
        verify_files_by_protocol(files, protocol, deliver, **how)
    else:
        placed, config, _ = place(path, target)
        if any(grasp.placed.around for grasp in placed):
            must = "--protocol must be lift for scenes of several objects"
            raise GraspError(f"{must}, got {protocol}")
        grasps = sorted(placed, key=lambda grasp: grasp.index)
        verify_by_protocol(grasps, config, protocol, deliver, **how)
    if how["show"]:
        say(f"{sum(held):,} of {len(held):,} grasps hold by {protocol}", err=True)


def _bench_files(path: Path, target: Target, where: str, assets: Path | None) -> list[Path]:
    """Return the files of DexGraspBench at a path in their order; none for other grasps.

    Raises:
        GraspError: If there are such files, and options do not fit them.
    """
    from drakegrasp.protocols.postures import is_grasp_file

    suffix = Path(target.hand or "").suffix
    files = [path] if path.is_file() else sorted(path.rglob("*.npy"))
    if suffix != ".xml" and assets is None:
        own = path.is_file() and not (path.suffix == ".npy" and is_grasp_file(path))
        if own or not files:
            return []
    if not files:
        raise GraspError(f"{path}: must be a .npy file or a folder of them, got none")
    names = ("mesh", "units", "dataset", "split", "frame")
    target.refuse(f"{where} and files of DexGraspBench", *names)
    if suffix != ".xml":
        must = "--hand must be an MJCF (.xml) with files of DexGraspBench"
        raise GraspError(f"{must}, got {target.hand}")
    return files


def place(path: Path, target: Target) -> tuple[list[PlacedGrasp], Config, PredictedRows | None]:
    """Return the grasps of a file on their objects, the configuration, and the rows.

    There is at least one grasp. If friction was drawn for the row of a grasp, the grasp has its own
    configuration. The rows are those of a dataset to which the grasps belong, in the order of the
    file; None if they belong to none.

    Raises:
        GraspError, MeshError, ConfigError, HandError: If a file or an option cannot be used.
    """
    from drakegrasp.dataset.scenes import holds_scenes
    from drakegrasp.exchange.attempts import has_rows, holds_postures

    with wrong_input():
        postures, rows = holds_postures(path), None
        dataset = _dataset_of(path, target, postures)
        if dataset is None:
            placed, config = _of_mesh(path, target)
        elif (
            postures
            and target.split is None
            and not has_rows(path)
            and not (dataset.is_file() and holds_scenes(dataset))
        ):
            placed, config = _of_objects(path, target, dataset)
        else:
            placed, config, rows = _of_rows(path, target, dataset)
        # Invalid contacts are failures of a network, but such postures belong elsewhere.
        if postures and all(grasp.invalid for grasp in placed):
            raise GraspError(f"{path}: {placed[0].invalid}")
        return placed, config, rows


def _of_mesh(path: Path, target: Target) -> tuple[list[PlacedGrasp], Config]:
    """Return the grasps of a file on the mesh of --object, which they need not name.

    If all rows of a file name one other object, the file is used for this object.

    Raises:
        GraspError: If no grasp belongs to the object, or the grasps are for rows of a dataset.
    """
    from drakegrasp.exchange.attempts import read_predictions
    from drakegrasp.objects.sources import find_mesh
    from drakegrasp.simulation.attempts import GraspTable
    from drakegrasp.verification.placing import place_on_object

    assert target.mesh is not None
    config = dg.load_config(target.config, target.overrides, **given(hand=target.hand))
    name = find_mesh(target.mesh, units=target.units or "m").name
    hand = dg.load_hand(config.hand_source)
    table = read_predictions(path, hand, of=name, split=target.split, read_as=target.read_as)
    if table.of_row is not None:
        raise GraspError("rows must be in a file of grasps for --dataset only, got rows")
    how: dict[str, Any] = {}
    if isinstance(table, GraspTable):
        table = _of_object(table, name, path)
        named = table.objects
    else:
        how["frame"] = target.frame or "object"
        named = (name,) * len(table)
    placed = dg.place_object(target.mesh, units=target.units, config=config)
    ranked = _ranked(table, named)
    return place_on_object(ranked, placed, overrides=target.overrides, **how), config


def _of_object(table: GraspTable, name: str, path: Path) -> GraspTable:
    """Return the postures of an object, which they name or not; see `_of_mesh`."""
    own = [i for i, each in enumerate(table.objects) if each in ("", name)]
    others = sorted(set(table.objects) - {"", name})
    if others and not all(table.invalid[i] for i in own):
        left = f"{len(table) - len(own):,} postures of {listed(others)} are left out"
        say(f"{path}: {left}, as --object is {name}", err=True)
        return table.at(own)
    if others and (path.is_dir() or len(others) > 1):
        raise GraspError(f"{path}: postures must be of {name}, the --object, got {listed(others)}")
    if others:
        say(f"{path}: postures of {others[0]} are tried on {name}, the --object", err=True)
    return table


def _of_objects(path: Path, target: Target, dataset: Path) -> tuple[list[PlacedGrasp], Config]:
    """Return the postures of a file on the objects of a dataset that they name."""
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.exchange.attempts import read_attempts
    from drakegrasp.hand.settings import override_config
    from drakegrasp.verification.placing import place_on_dataset

    out = dataset.parent if dataset.is_file() else dataset
    config = override_config(read_manifest(out).config, target.overrides)
    table = read_attempts(path, dg.load_hand(config.hand_source), read_as=target.read_as)
    own = config if target.overrides else None
    table = _ranked(table, table.objects)
    return place_on_dataset(table, out, own, overrides=target.overrides), config


def _of_rows(
    path: Path, target: Target, dataset: Path
) -> tuple[list[PlacedGrasp], Config, PredictedRows]:
    """Return the grasps of a file on the objects of a dataset's rows or views, and the rows."""
    from drakegrasp.dataset.reader import PredictedRows
    from drakegrasp.dataset.scenes import open_rows
    from drakegrasp.exchange.attempts import read_predictions
    from drakegrasp.verification.placing import dataset_config, place_on_rows
    from drakegrasp.verification.prediction import choose_rows

    # For grasps from outside, only the objects and cameras of the rows are needed.
    split = target.split or DEFAULT_SPLIT
    data = open_rows(dataset, split=split, fewer_fingers=dataset != path)

    # A given configuration is used as it is; that of a dataset is combined with the rows' draws.
    own = None if target.config is None else dg.load_config(target.config, target.overrides)
    overrides = () if own else target.overrides
    config = dataset_config(data, own, target.hand, overrides)
    table = read_predictions(
        path, dg.load_hand(config.hand_source), of=data, read_as=target.read_as
    )
    rows = choose_rows(
        data, table.of_row, len(table), said="`rows` in the file says for which rows they are"
    )
    if table.left_out:
        say(table.left_out, err=True)
    placed = place_on_rows(
        _ranked(table, rows),
        data,
        rows,
        config=config,
        drawn=own is None,
        overrides=overrides,
        frame=target.frame or "camera",
    )
    return placed, config, PredictedRows.of(data, rows)


def _ranked(table: Rows, targets: Any) -> Rows:
    """Return grasps, ranked among those of the same object or row if they state a confidence."""
    from drakegrasp.simulation.attempts import ranked

    return table if table.confidence is None else ranked(table, targets)


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

    # The camera of a posture is that of its row.
    others = "" if postures else ", or grasps in an HDF5 file"
    for unused, where, *names in (
        (postures and target.frame == "camera", "with postures", "frame"),
        (postures and target.dataset, "with postures and --dataset", "units", "hand", "config"),
        (not postures, "without postures", "link", "preshape"),
        (target.mesh is None, "without --object", "units"),
        (target.dataset is None and not stored, f"without --dataset{others}", "split"),
    ):
        if unused:
            target.refuse(where, *names)
    if target.mesh is not None and target.frame == "camera":
        raise GraspError(
            "--frame must not be camera with --object, got camera: its pose is unknown"
        )
    return None if target.mesh is not None else target.dataset or path
