"""Turns files and options of `drakegrasp verify` into placed grasps. Nothing is simulated.

Whatever is wrong with the files or the options is a `GraspError`, `MeshError`, `ConfigError` or
`HandError`, that is wrong usage.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from drakegrasp.cli.console import say
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.predicted_rows import PredictedRows
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError, GraspError, listed
from drakegrasp.exchange.attempts import has_rows, holds_postures, read_attempts
from drakegrasp.frames import Array
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import read_hand_file
from drakegrasp.hand.files import hand_file
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import find_mesh
from drakegrasp.simulation.attempts import Attempts
from drakegrasp.simulation.placement import place_object
from drakegrasp.verification.placing import (
    dataset_config,
    place_on_dataset,
    place_on_object,
    place_on_rows,
)
from drakegrasp.verification.prediction import (
    HDF5_SUFFIXES,
    read_grasps,
    read_numbers,
    read_predictions,
)
from drakegrasp.verification.result_files import refuse_unwritable
from drakegrasp.verification.verify import PlacedGrasp

if TYPE_CHECKING:
    from drakegrasp.cli.predictions import VerifyRequest

#: No split has so many rows.
MOST_ROWS = 10_000_000
#: The split of a dataset if none is named.
DEFAULT_SPLIT = "test"


def place_requested(request: VerifyRequest) -> tuple[list[PlacedGrasp], Config]:
    """Return the grasps of a request on their objects, at least one, and its configuration.

    The configuration of a grasp is another one where friction was drawn for its row.

    Raises:
        GraspError, MeshError, ConfigError, HandError: If a file or an option cannot be used.
    """
    try:
        return _place(request)
    except DataError as error:
        raise GraspError(str(error)) from None


def requested_rows(request: VerifyRequest, count: int) -> PredictedRows | None:
    """Return the rows of the dataset that the grasps of a request are for, as the files say.

    Args:
        request: That `place_requested` has accepted.
        count: Number of its grasps.
    """
    split = request.split or DEFAULT_SPLIT
    if holds_postures(request.grasps):
        if request.dataset is None or not has_rows(request.grasps):
            return None
        data = GraspDataset(request.dataset, split=split, fewer_fingers=True)
        hand = load_hand(dataset_config(data).hand_source)
        return PredictedRows.of(
            request.dataset, split, read_attempts(request.grasps, hand, of=data).of_row
        )
    path = _dataset_path(request)
    if path is None:
        return None
    rows = _rows_of(request, read_predictions(request.grasps, split=split).rows)
    return PredictedRows.of(path, split, np.arange(count) if rows is None else np.asarray(rows))


def _place(request: VerifyRequest) -> tuple[list[PlacedGrasp], Config]:
    # Refuse results that could not be written, and options without effect.
    if request.out is not None:
        refuse_unwritable(request.out)
    if holds_postures(request.grasps):
        return _place_postures(request)
    path = _dataset_path(request)
    _refuse_idle(request, path)

    # A dataset has a default split. An HDF5 file of grasps may have no groups at all.
    split = request.split if path is None else request.split or DEFAULT_SPLIT
    data = None
    if path is not None:
        # Of rows for the grasps of others only objects and cameras are needed.
        others = path != request.grasps
        data = GraspDataset(path, split=split or DEFAULT_SPLIT, fewer_fingers=others)
    predicted = read_predictions(request.grasps, split=split)
    rows = _rows_of(request, predicted.rows)

    # Without a dataset all grasps are for the one mesh.
    overrides, given = request.overrides, None
    if path is None or request.config is not None:
        given, overrides = load_config(request.config, overrides), ()
    if data is None:
        if rows is not None:
            raise GraspError("rows must be in a file of grasps for --dataset only, got rows")
        assert request.mesh is not None and given is not None
        config = given if request.hand is None else override_config(given, [], hand=request.hand)
        _refuse_no_grasps(request.grasps, predicted.grasps, config)
        placed = place_on_object(
            predicted.grasps,
            place_object(request.mesh, units=request.units, config=config),
            frame=request.frame or "object",
            X_TC=None if request.camera is None else read_numbers(request.camera),
            method=request.method,
            snap_points=request.snap_points,
        )
        return placed, config

    # A configuration that is given is used as it is; that of a dataset with what its rows drew.
    config = dataset_config(data, given, request.hand, overrides)
    _refuse_no_grasps(request.grasps, predicted.grasps, config)
    placed = place_on_rows(
        predicted.grasps,
        data,
        rows,
        frame=request.frame or "camera",
        hand=request.hand,
        method=request.method,
        snap_points=request.snap_points,
        config=given,
        overrides=overrides,
    )
    return placed, config


def _rows_of(request: VerifyRequest, known: npt.NDArray[np.int64] | None) -> list[int] | None:
    """Return the row of each grasp, as the file or the option says; None if neither does."""
    text = request.rows
    if text is None:
        return None if known is None else [int(row) for row in np.ravel(known)]
    if known is not None:
        _refuse_given("left out with a file that has rows", rows=text)
    if request.dataset is None:
        _refuse_given("given with --dataset only", rows=text)
    if text.endswith(".npy"):
        rows = read_numbers(Path(text)).ravel()
        if not (np.isfinite(rows).all() and (rows == np.floor(rows)).all()):
            raise GraspError(f"{text}: must hold whole numbers, got others")
        return [int(row) for row in rows]

    # Rows, and ranges that include both ends.
    found = list[int]()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            raise GraspError(f"--rows must be as 0,4,7-9 or a .npy file, got {text!r}")
        if max(len(first), len(last)) > len(str(MOST_ROWS)) or int(last or first) >= MOST_ROWS:
            raise GraspError(f"--rows must be below {MOST_ROWS:,}, got {part.strip()[:40]}")
        found += range(int(first), int(last or first) + 1)
    return found


def _place_postures(request: VerifyRequest) -> tuple[list[PlacedGrasp], Config]:
    """Return the postures of a file on their objects, and the configuration."""
    # They say their frame themselves, and need no fit.
    _refuse_given(
        "left out with postures",
        frame=request.frame,
        camera=request.camera,
        method=None if request.method == "hand" else request.method,
        snap_points=request.snap_points or None,
        rows=request.rows,
    )
    if (request.mesh is None) == (request.dataset is None):
        raise GraspError("--object MESH or --dataset FILE must be given with postures, one of them")
    if request.dataset is not None:
        return _postures_on(request.dataset, request)
    _refuse_given("given with --dataset only", split=request.split)
    config = load_config(request.config, request.overrides)
    config = config if request.hand is None else override_config(config, [], hand=request.hand)

    # All are tried on the one object, which they need not name.
    assert request.mesh is not None
    name = find_mesh(request.mesh, units=request.units or "m").name
    table = _of_object(request.grasps, name, load_hand(config.hand_source))
    thing = place_object(request.mesh, units=request.units, config=config)
    _say_nameless(table)
    return place_on_object(table, thing, overrides=request.overrides), config


def _of_object(path: Path, name: str, hand: Hand) -> Attempts:
    """Return the postures of a file or a folder that are of an object, and say which are not.

    A file of one other object is for this one: nothing else can be meant.

    Raises:
        GraspError: If none is of it.
    """
    table = read_attempts(path, hand, of=name)
    own = [i for i, each in enumerate(table.objects) if each in ("", name)]
    others = sorted(set(table.objects) - {"", name})
    if not others:
        return table
    if not all(table.invalid[i] for i in own):
        left = len(table) - len(own)
        say(
            f"{path}: {left:,} postures of {listed(others)} are left out, as --object is {name}",
            err=True,
        )
        return table.at(own)
    if path.is_dir() or len(others) > 1:
        raise GraspError(f"{path}: postures must be of {name}, the --object, got {listed(others)}")
    say(f"{path}: postures of {others[0]} are tried on {name}, the --object", err=True)
    return table


def _say_nameless(table: Attempts) -> None:
    """Say how many postures name no resting pose."""
    if table.nameless:
        say(table.nameless, err=True)


def _postures_on(dataset: Path, request: VerifyRequest) -> tuple[list[PlacedGrasp], Config]:
    """Return postures on the rows of a dataset, or without `row` on the objects that they name."""
    given = {"units": request.units, "hand": request.hand, "config": request.config}
    _refuse_given("left out with postures and --dataset", **given)
    if has_rows(request.grasps):
        data = GraspDataset(dataset, split=request.split or DEFAULT_SPLIT, fewer_fingers=True)
        hand = load_hand(dataset_config(data).hand_source)
        table = read_attempts(request.grasps, hand, of=data)
        placed = place_on_rows(table, data, table.of_row, overrides=request.overrides)
        return placed, dataset_config(data, overrides=request.overrides)
    _refuse_given("given with `row` in the postures", split=request.split)
    out = dataset.parent if dataset.is_file() else dataset
    config = override_config(read_manifest(out).config, request.overrides)
    table = read_attempts(request.grasps, load_hand(config.hand_source))
    _say_nameless(table)
    own = config if request.overrides else None
    return place_on_dataset(table, out, own, overrides=request.overrides), config


def _refuse_no_grasps(path: Path, grasps: Array, config: Config) -> None:
    """Refuse numbers that are no grasps of the hand, with the name of their file."""
    try:
        read_grasps(grasps, len(read_hand_file(hand_file(config.hand_source)).fingers))
    except GraspError as error:
        raise GraspError(f"{path}: {error}") from None


def _dataset_path(request: VerifyRequest) -> Path | None:
    """Return the data file whose rows give the objects: --dataset, or GRASPS itself."""
    if request.mesh is not None and request.dataset is not None:
        raise GraspError("--object or --dataset must be given, got both")
    if request.mesh is not None or request.dataset is not None:
        return request.dataset
    if request.grasps.suffix.lower() not in HDF5_SUFFIXES:
        raise GraspError(
            "--object MESH or --dataset FILE must be given where the grasps are not in a data "
            f"file of a dataset, got neither for {request.grasps}"
        )
    if request.frame not in (None, "camera"):
        raise GraspError(f"--frame must be camera for a dataset's own grasps, got {request.frame}")
    return request.grasps


def _refuse_idle(request: VerifyRequest, dataset: Path | None) -> None:
    """Refuse options without effect, and a missing camera."""
    if dataset is not None:
        _refuse_given("given with --object only", units=request.units)
    elif request.grasps.suffix.lower() not in HDF5_SUFFIXES:
        _refuse_given("given with --dataset or grasps in an HDF5 file only", split=request.split)
    if dataset is not None or request.frame != "camera":
        _refuse_given("given with --object and --frame camera only", camera=request.camera)
    elif request.camera is None:
        raise GraspError("--camera FILE must be given with --object and --frame camera, got none")


def _refuse_given(how: str, **options: object) -> None:
    """Refuse options that are given, and must be otherwise."""
    for name, value in options.items():
        if value is not None:
            raise GraspError(f"--{name.replace('_', '-')} must be {how}, got {value}")
