"""`predict` writes a network's grasps for views of scenes, or for what a camera saw."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from drakegrasp.cli.console import Command, progress_bar, say
from drakegrasp.cli.options import FILE, SPLITS, described
from drakegrasp.runtime.executor import processes

if TYPE_CHECKING:
    from drakegrasp.arithmetic import Array
    from drakegrasp.hand.description import Hand
    from drakegrasp.scoring.network import GraspNetwork
    from drakegrasp.simulation.attempts import Attempts

#: Suffixes of scenes, and of files of postures that are written.
HDF5 = (".h5", ".hdf5")
#: Kinds of INPUT, and the options that each has.
KINDS = {
    "scenes": ("split", "workers"),
    "a cloud": ("units",),
    "a depth image": ("camera", "mask", "camera_pose", "depth_scale"),
}
#: Number of grasps in the printed table.
SHOWN = 5


@click.command(cls=Command)
@described
@click.argument("source", type=FILE, metavar="INPUT")
def predict(
    source: Path,
    *,
    out: Path,
    network: str | None = None,
    count: Annotated[int | None, click.IntRange(1)] = None,
    split: Annotated[str | None, SPLITS] = None,
    units: Annotated[str | None, click.Choice(["m", "cm", "mm"])] = None,
    camera: str | None = None,
    mask: Annotated[Path | None, FILE] = None,
    camera_pose: Annotated[Path | None, FILE] = None,
    depth_scale: Annotated[float | None, click.FloatRange(0.0, min_open=True)] = None,
    workers: int | None = None,
    quiet: bool = False,
) -> None:
    """Write a network's grasps for what a camera saw, best first.

    INPUT is the file scenes.hdf5 of a dataset, for all views of a split, in the rows of
    `drakegrasp score`; or a cloud of one object (.npy of shape (n, 3), or .ply), over a table that
    is z = 0, with +z up; or a depth image (.png of 16 bits, or .npy in metres) with a camera matrix
    and a mask of one object.

    The grasps are written as a file of postures with a confidence each. `drakegrasp score` and
    `build --postures` take those of scenes. Those of a cloud are in the frame of the cloud, and
    those of a depth image in the frame of the camera.

    Options:
        --out FILE: HDF5 file (.h5) to write.
        --network NAME|FILE: The network. [default: barrett-1]
        --count K: Maximum number of grasps of a view. [default: all that are proposed]
        --split: Views of scenes. [default: test]
        --units m|cm|mm: Unit of length of a cloud. [default: m]
        --camera FX,FY,CX,CY|JSON: Camera matrix of a depth image in pixels: four numbers, or a file
            with K or with fx, fy, cx and cy.
        --mask FILE: Image or .npy of the size of the depth image: 0, and one other value on the
            object.
        --camera-pose FILE: .npy file with the pose of the camera over the table, X_TC, as (4, 4).
            [default: from the plane on which the object stands]
        --depth-scale METRES: Unit of a .png depth image. [default: 0.001]
        --workers N: Number of processes for scenes. [default: one per core]
        --quiet: Show neither progress nor the table.
    """
    from drakegrasp.exchange.attempts import write_attempts
    from drakegrasp.scoring.network import load_network
    from drakegrasp.verification.result_files import refuse_unwritable_files

    # All input is checked before anything is predicted.
    if out.suffix.lower() not in HDF5:
        raise click.UsageError(f"--out must be a file {' or '.join(HDF5)}, got {str(out)!r}")
    if out.exists() and out.samefile(source):
        raise click.UsageError(f"--out must be another file than INPUT, got {str(out)!r}")
    refuse_unwritable_files(out)
    _refuse_foreign(out)
    given: dict[str, Any] = {"split": split, "workers": workers, "units": units}
    given |= {"camera": camera, "mask": mask, "camera_pose": camera_pose}
    given["depth_scale"] = depth_scale
    kind = _kind_of(source, camera)
    _refuse_others(kind, given)
    chosen = load_network() if network is None else load_network(network)

    # Scenes have many objects, the other kinds one.
    pose = None
    if kind == "scenes":
        found = _of_scenes(chosen, source, split or "test", count, workers, show=not quiet)
    else:
        if kind == "a cloud":
            cloud = _read_cloud(source, units or "m")
        else:
            cloud, pose = _of_depth(source, camera, mask, camera_pose, depth_scale, show=not quiet)
        found = chosen.predict(cloud, count=count)
    write_attempts(out, _seen_from(found, pose), chosen.hand, network=chosen.name)
    say(str(out))
    if not quiet and kind != "scenes":
        _print_best(found, pose, chosen.hand)


def _refuse_foreign(out: Path) -> None:
    """Reject to replace a file that is not of postures, e.g. one of a dataset.

    Raises:
        click.UsageError: If it is another file.
    """
    from drakegrasp.errors import GraspError
    from drakegrasp.exchange.attempts import holds_postures

    try:
        known = not out.exists() or holds_postures(out)
    except GraspError:  # no HDF5 file
        known = False
    if not known:
        raise click.UsageError(f"--out must be a new file or one of postures, got {str(out)!r}")


def _kind_of(source: Path, camera: str | None) -> str:
    """Return the kind of INPUT, one of `KINDS`.

    Raises:
        click.UsageError: If the suffix is of none of them.
    """
    suffix = source.suffix.lower()
    if suffix in HDF5:
        return "scenes"
    if suffix == ".png" or (suffix == ".npy" and camera is not None):
        return "a depth image"
    if suffix in (".npy", ".ply"):
        return "a cloud"
    raise click.UsageError(f"INPUT must be .hdf5, .npy, .ply or .png, got {str(source)!r}")


def _refuse_others(kind: str, given: Mapping[str, Any]) -> None:
    """Reject options of other kinds of INPUT, and a depth image without camera and mask.

    Raises:
        click.UsageError: If there is one.
    """
    for name, value in given.items():
        if value is not None and name not in KINDS[kind]:
            due = next(other for other, names in KINDS.items() if name in names)
            hint = ": a depth image in a .npy file needs --camera" if due == "a depth image" else ""
            raise click.UsageError(
                f"{_option(name)} must be given with {due} only, got {kind}{hint}"
            )
    if kind == "a depth image":
        for name in ("camera", "mask"):
            if given[name] is None:
                raise click.UsageError(f"{_option(name)} must be given with {kind}, got none")


def _option(name: str) -> str:
    """Return the option of a parameter."""
    return f"--{name.replace('_', '-')}"


def _of_scenes(
    network: GraspNetwork,
    path: Path,
    split: str,
    count: int | None,
    workers: int | None,
    *,
    show: bool,
) -> Attempts:
    """Return the grasps for the views of a split, and print how many there are."""
    from drakegrasp.errors import DataError, GraspError
    from drakegrasp.scoring.network import predict_scenes

    with processes(workers) as execute, progress_bar("predict", "views", show=show) as report:
        try:
            found, blind = predict_scenes(
                network, path, split=split, count=count, execute=execute, report=report
            )
        except DataError as error:  # wrong usage, as for `score`
            raise GraspError(str(error)) from None
    if show:
        views = len(set(found.of_row.tolist()))
        say(f"{len(found):,} grasps of {views:,} views", err=True)
    if blind:
        say(f"{blind:,} views show too little of their object: no grasp", err=True)
    return found


def _read_cloud(path: Path, units: str) -> Array:
    """Return the points (n, 3) of a file [m].

    Raises:
        GraspError: If the file has none.
    """
    from drakegrasp.errors import GraspError, MeshError
    from drakegrasp.exchange.columns import read_numbers
    from drakegrasp.mesh.loading import load_points
    from drakegrasp.objects.sources import UNITS

    if path.suffix.lower() == ".npy":
        points = read_numbers(path)
        if points.ndim == 2 and points.shape[1] != 3:
            raise GraspError(
                f"{path}: must be a cloud (n, 3), got {points.shape}: a depth image needs --camera"
            )
        return UNITS[units] * points
    try:
        return UNITS[units] * load_points(path)
    except MeshError as error:
        raise GraspError(str(error)) from None


def _of_depth(
    path: Path,
    camera: str | None,
    mask: Path | None,
    camera_pose: Path | None,
    scale: float | None,
    *,
    show: bool,
) -> tuple[Array, Array]:
    """Return the object's points (n, 3) in {T} [m], and the camera's pose X_TC (4, 4).

    Raises:
        GraspError: If a file is invalid; the message names it.
    """
    from drakegrasp.errors import GraspError
    from drakegrasp.exchange.attempts import named
    from drakegrasp.exchange.columns import read_numbers
    from drakegrasp.frames import read_pose
    from drakegrasp.vision.depth_image import (
        cloud_from_depth,
        fit_table,
        read_camera,
        read_depth_png,
        read_mask,
        table_share,
    )

    assert camera is not None and mask is not None
    if path.suffix.lower() == ".png":
        depth = read_depth_png(path, 0.001 if scale is None else scale)
    elif scale is not None:
        raise click.UsageError("--depth-scale must be given with a .png only, got a .npy in metres")
    else:
        depth = read_numbers(path)
    with named(path):
        if depth.ndim != 2:
            raise GraspError(f"must be a depth image (h, w), got an array of shape {depth.shape}")
    K, own = read_camera(camera, depth.shape), read_mask(mask)
    if camera_pose is not None:
        with named(camera_pose):
            pose = read_pose(read_numbers(camera_pose), "X_TC")
            share = table_share(depth, K, own, pose)
        off = ""
    else:
        with named(path):
            pose, residual, share = fit_table(depth, K, own)
        off = f", {1e3 * residual:.1f} mm off its plane (rms)"
    if show and not math.isnan(share):
        say(
            f"table: {share:.0%} of the pixels beside the object{off}; the camera is "
            f"{1e3 * pose[2, 3]:.0f} mm above it",
            err=True,
        )
    with named(path):
        return cloud_from_depth(depth, K, own, pose), pose


def _seen_from(found: Attempts, X_TC: Array | None) -> Attempts:
    """Return grasps in {T} in the frame of a camera, if there is one."""
    from drakegrasp.arithmetic import multiply
    from drakegrasp.frames import invert_pose

    if X_TC is None:
        return found
    X_CG = multiply(invert_pose(X_TC), found.X_FG)
    return replace(found, X_FG=X_CG, frame="camera", X_TC=X_TC[None].repeat(len(found), axis=0))


def _print_best(found: Attempts, X_TC: Array | None, hand: Hand) -> None:
    """Print the best grasps: score, directions of approach and of closing, and palm's position."""
    from drakegrasp.cli.tables import make_table, print_table
    from drakegrasp.hand.finger_sweep import find_opposition

    frames = (
        {"{T}": found.X_FG}
        if X_TC is None
        else {"{T}": found.X_FG, "{C}": _seen_from(found, X_TC).X_FG}
    )
    heads = ["grasp", "score"]
    along, _ = find_opposition(hand)
    for frame in frames:
        heads += [f"approach\nin {frame}", f"closes along\nin {frame}", f"palm in\n{frame} [mm]"]
    rows = []
    for i, score in enumerate(found.confidence[:SHOWN].tolist()):
        cells = [str(i), f"{score:.3f}"]
        for X_FG in frames.values():
            cells += [_numbers(axis, "z.2f") for axis in (X_FG[i, :3, 2], X_FG[i, :3, :3] @ along)]
            cells += [_numbers(1e3 * X_FG[i, :3, 3], "z.0f")]
        rows.append(cells)
    print_table(make_table("The best grasps", heads, rows))


def _numbers(values: Array, form: str) -> str:
    return " ".join(f"{value:{form}}" for value in values.tolist())
