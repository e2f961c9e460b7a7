"""Converts files and options of `drakegrasp verify` to placed grasps. Nothing is simulated.

Any mistake in the files or the options raises a `GraspError`, `MeshError`, `ConfigError` or
`HandError`, which counts as wrong usage.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from drakegrasp.cli.console import say
from drakegrasp.cli.options import VerifyRequest, chosen_reading
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset, PredictedRows
from drakegrasp.errors import DataError, GraspError, listed
from drakegrasp.exchange.attempts import has_rows, holds_postures, read_attempts
from drakegrasp.exchange.columns import HDF5_SUFFIXES, read_numbers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.sources import find_mesh
from drakegrasp.simulation.attempts import Attempts, Rows, ranked
from drakegrasp.simulation.placement import place_object
from drakegrasp.verification.placing import (
    PlacedGrasp,
    choose_rows,
    dataset_config,
    place_on_dataset,
    place_on_object,
    place_on_rows,
)
from drakegrasp.verification.prediction import ContactRows
from drakegrasp.verification.result_files import refuse_unwritable

#: Upper bound of the number of rows of a split.
MOST_ROWS = 10_000_000
#: The split of a dataset if none is named.
DEFAULT_SPLIT = "test"


def place_requested(
    request: VerifyRequest,
) -> tuple[list[PlacedGrasp], Config, PredictedRows | None]:
    """Return the grasps of a request on their objects, the configuration, and the rows.

    There is at least one grasp. If friction was drawn for the row of a grasp, the grasp has its own
    configuration. The rows are the rows of a dataset to which the grasps belong, in the order of
    the file; None if the grasps belong to no rows.

    Raises:
        GraspError, MeshError, ConfigError, HandError: If a file or an option cannot be used.
    """
    try:
        # Reject results that could not be written, and options without effect.
        if request.out is not None:
            refuse_unwritable(request.out)
        postures = holds_postures(request.grasps)
        path = _dataset_of(request, postures)
        found: tuple[list[PlacedGrasp], Config, PredictedRows | None]
        if path is None:
            found = _place_on_mesh(request)
        elif postures and request.split is None and not has_rows(request.grasps):
            found = _place_on_objects(request, path)
        else:
            found = _place_on_rows(request, path)
    except DataError as error:
        raise GraspError(str(error)) from None
    # Invalid contacts are failures of a network, but such a file of postures belongs elsewhere.
    if postures and all(grasp.invalid for grasp in found[0]):
        raise GraspError(f"{request.grasps}: {found[0][0].invalid}")
    return found


def _dataset_of(request: VerifyRequest, postures: bool) -> Path | None:
    """Return the data file or directory whose objects are grasped; None for --object.

    Raises:
        GraspError: If the choice is not clear, or an option is without effect.
    """
    path = _posture_dataset(request) if postures else _contact_dataset(request)
    if path is not None:
        _refuse_given("left out without --object", units=request.units)
    elif postures or request.grasps.suffix.lower() not in HDF5_SUFFIXES:
        others = "" if postures else ", or grasps in an HDF5 file"
        _refuse_given(f"left out without --dataset{others}", split=request.split)
    if path is not None or request.frame != "camera":
        _refuse_given("left out without --object and --frame camera", camera=request.camera)
    elif request.camera is None:
        raise GraspError("--camera FILE must be given with --object and --frame camera, got none")
    return path


def _posture_dataset(request: VerifyRequest) -> Path | None:
    """Return --dataset, on whose objects postures are tried if there is no --object."""
    # The camera of a posture is that of its row, and postures need no fit.
    _refuse_given(
        "left out with postures",
        frame="camera" if request.frame == "camera" else None,
        camera=request.camera,
        method=None if request.method == "hand" else request.method,
        snap_points=request.snap_points or None,
        rows=request.rows,
    )
    if (request.mesh is None) == (request.dataset is None):
        must = "--object MESH or --dataset FILE must be given with postures, one of them"
        raise GraspError(f"{request.grasps}: {must}")
    if request.dataset is not None:
        given = {"units": request.units, "hand": request.hand, "config": request.config}
        _refuse_given("left out with postures and --dataset", **given)
    return request.dataset


def _contact_dataset(request: VerifyRequest) -> Path | None:
    """Return the data file whose rows specify the objects: --dataset, or GRASPS itself."""
    _refuse_given("left out without postures", link=request.link, preshape=request.preshape)
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


def _place_on_mesh(request: VerifyRequest) -> tuple[list[PlacedGrasp], Config, None]:
    """Return all grasps on the object of --object, which they need not name, and the settings."""
    assert request.mesh is not None
    config = load_config(request.config, request.overrides)
    config = config if request.hand is None else override_config(config, [], hand=request.hand)
    name = find_mesh(request.mesh, units=request.units or "m").name
    table = _of_object(request, name, load_hand(config.hand_source))
    _refuse_given("left out without --dataset", rows=request.rows)
    if table.of_row is not None:
        raise GraspError("rows must be in a file of grasps for --dataset only, got rows")
    placed = place_on_object(
        _ranked(table, table.objects if isinstance(table, Attempts) else [name] * len(table)),
        place_object(request.mesh, units=request.units, config=config),
        frame=request.frame or "object",
        X_TC=None if request.camera is None else read_numbers(request.camera),
        method=request.method,
        snap_points=request.snap_points,
        overrides=request.overrides,
    )
    _say_nameless(table)
    return placed, config, None


def _place_on_rows(
    request: VerifyRequest, path: Path
) -> tuple[list[PlacedGrasp], Config, PredictedRows]:
    """Return grasps on the rows of a dataset, with the friction and mass drawn for each row."""
    # For grasps from outside, only the objects and cameras of the rows are needed.
    others = path != request.grasps
    data = GraspDataset(path, split=request.split or DEFAULT_SPLIT, fewer_fingers=others)

    # A given configuration is used as it is; that of a dataset is combined with the rows' draws.
    given, overrides = None, request.overrides
    if request.config is not None:
        given, overrides = load_config(request.config, overrides), ()
    config = dataset_config(data, given, request.hand, overrides)
    table = read_attempts(
        request.grasps,
        load_hand(config.hand_source),
        of=data,
        read_as=chosen_reading(vars(request)),
    )
    said = "`rows` in the file, or --rows, says for which rows they are"
    rows = choose_rows(data, _rows_of(request, table.of_row), len(table), said=said)
    placed = place_on_rows(
        _ranked(table, rows),
        data,
        rows,
        config=config,
        drawn=given is None,
        frame=request.frame or "camera",
        method=request.method,
        snap_points=request.snap_points,
        overrides=overrides,
    )
    bare = table.bare if isinstance(table, Attempts) else ""
    for told in filter(None, (bare, table.left_out)):
        say(told, err=True)
    return placed, config, PredictedRows.of(path, data.split, rows)


def _place_on_objects(
    request: VerifyRequest, dataset: Path
) -> tuple[list[PlacedGrasp], Config, None]:
    """Return postures on the objects of a dataset that they name, and the configuration."""
    out = dataset.parent if dataset.is_file() else dataset
    config = override_config(read_manifest(out).config, request.overrides)
    table = read_attempts(
        request.grasps, load_hand(config.hand_source), read_as=chosen_reading(vars(request))
    )
    assert isinstance(table, Attempts)
    _say_nameless(table)
    own = config if request.overrides else None
    table = _ranked(table, table.objects)
    return place_on_dataset(table, out, own, overrides=request.overrides), config, None


def _rows_of(
    request: VerifyRequest, known: npt.NDArray[np.int64] | None
) -> list[int] | npt.NDArray[np.int64] | None:
    """Return the row of each grasp, from the file or the option; None if neither specifies it."""
    text = request.rows
    if text is None:
        return known
    if known is not None:
        _refuse_given("left out with a file that has rows", rows=text)
    if request.dataset is None:
        _refuse_given("left out without --dataset", rows=text)
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


def _of_object(request: VerifyRequest, name: str, hand: Hand) -> Attempts | ContactRows:
    """Return the grasps of a file or a folder that belong to an object, and print the others.

    If all rows of a file name one other object, the file is used for this object.

    Raises:
        GraspError: If no grasp belongs to the object.
    """
    path = request.grasps
    table = read_attempts(
        path, hand, of=name, split=request.split, read_as=chosen_reading(vars(request))
    )
    if isinstance(table, ContactRows):
        return table
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


def _ranked(table: Rows, of: Sequence[str] | npt.NDArray[np.int64]) -> Rows:
    """Return a table with the ranks by the confidence that a file states, if it does."""
    return table if table.confidence is None else ranked(table, of)


def _say_nameless(table: Attempts | ContactRows) -> None:
    """Print how many postures specify no resting pose, and how many have no joints."""
    if isinstance(table, ContactRows):
        return
    for told in filter(None, (table.nameless, table.bare)):
        say(told, err=True)


def _refuse_given(how: str, **options: object) -> None:
    """Reject given options; `how` states how they must be given."""
    for name, value in options.items():
        if value is not None:
            raise GraspError(f"--{name.replace('_', '-')} must be {how}, got {value}")
