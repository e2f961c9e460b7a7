"""The commands on predictions: `predict` writes grasps, the best first, and `score` their card."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

from cyclopts import Parameter
from cyclopts.validators import Number

import drakegrasp as dg
from drakegrasp.cli.arguments import (
    AnyPath,
    AsJson,
    Count,
    DataFile,
    Existing,
    File,
    Folder,
    Positive,
    Postures,
    RowFrame,
    Settings,
    Split,
    Units,
    Workers,
    given,
)
from drakegrasp.cli.console import MORE, UsageError, same_command, say, say_json, wrong_input
from drakegrasp.cli.reach import ArmOptions
from drakegrasp.errors import GraspError, MeshError, counted

if TYPE_CHECKING:
    from drakegrasp.arithmetic import Array
    from drakegrasp.hand.description import Hand
    from drakegrasp.reach.arm import Arm
    from drakegrasp.simulation.attempts import GraspTable
    from drakegrasp.table import AnyArray
    from drakegrasp.vision.depth_image import View

#: Suffixes of scenes, and of files of postures that are written.
HDF5 = (".h5", ".hdf5")
#: Kinds of INPUT, and the options that only they have.
KINDS = {
    "scenes": ("split", "workers"),
    "a cloud": ("units",),
    "a depth image": ("camera", "mask", "object_label", "camera_pose", "depth_scale"),
}
#: Number of grasps for one object that lifts try if it is not given; scenes have many views.
SIMULATED = 5
#: Options of `score` that change no verdict: flags, and options with a value.
IDLE = (
    ("--json", "--quiet", "--tls", "--no-tls"),
    ("--workers", "--scheduler", "--scheduler-file", "--tls-ca-file", "--tls-cert", "--tls-key"),
)
Metres: TypeAlias = Annotated[float, Parameter(metavar="METRES", validator=Number(gt=0.0))]


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DepthImage:
    """What makes a depth image a view of one object.

    Attributes:
        camera: Camera matrix of a depth image in pixels: four numbers, or a file with K or with fx,
            fy, cx and cy.
        mask: Image or .npy of the size of the depth image: 0, and one other value on the object.
        object_label: Value of the mask on the object; other values above 0 are its neighbours.
        camera_pose: .npy file with the pose of the camera over the table, X_TC, as (4, 4).
            [default: from the plane on which the object stands]
        depth_scale: Unit of a .png depth image. [default: 0.001]
    """

    camera: Annotated[str | None, Parameter(metavar="FX,FY,CX,CY|JSON")] = None
    mask: File | None = None
    object_label: Positive | None = None
    camera_pose: File | None = None
    depth_scale: Metres | None = None


def predict(
    source: Annotated[File, Parameter(name="INPUT")],
    /,
    *,
    out: Annotated[AnyPath, Parameter(metavar="FILE")],
    simulate: Annotated[Count | None, Parameter(metavar="K", validator=Number(gte=0))] = None,
    count: Positive | None = None,
    overrides: Settings = (),
    split: Split | None = None,
    units: Units | None = None,
    image: DepthImage = DepthImage(),
    robot: ArmOptions = ArmOptions(),
    workers: Count | None = None,
    quiet: bool = False,
) -> None:
    """Write grasps for what a camera saw, best first.

    INPUT is the file scenes.hdf5 or clutter.hdf5 of a dataset, for all views of a split, in the
    rows of `drakegrasp score`; or a cloud of one object (.npy of shape (n, 3), or .ply), over a
    table that is z = 0, with +z up; or a depth image (.png of 16 bits, or .npy in metres) with a
    camera matrix and a mask of one object, or of several objects with the label of one.

    Grasps are proposed and ordered by closing the hand on the points. Then the first ones are
    tried by lifts in simulation, on the object completed from what was seen, until one holds in all
    its lifts; for scenes only with --simulate. The command also says if no grasp is likely to hold.

    The grasps are written as a file of postures with a confidence each. `drakegrasp score` and
    `build --postures` take those of scenes. Those of a cloud are in the frame of the cloud, and
    those of a depth image in the frame of the camera.

    Args:
        source: Scenes, a cloud or a depth image.
        out: HDF5 file (.h5) to write.
        simulate: Largest number of grasps of a view that lifts try; 0 for none. [default: 5 for
            one object, 0 for scenes]
        count: Maximum number of grasps of a view. [default: all that are proposed]
        overrides: Change one setting of the preset fast, or for scenes of the dataset, e.g.
            hand=allegro or objects.mass=0.3; may be given several times.
        split: Views of scenes. [default: test]
        units: Unit of length of a cloud. [default: m]
        workers: Number of processes for scenes. [default: one per core]
        quiet: Show neither progress nor what to expect.
    """
    from drakegrasp.exchange.attempts import write_attempts

    # All input is checked before anything is predicted.
    _validate_place(out, source)
    kind = _kind_of(source, image.camera)
    options = {"split": split, "units": units, "workers": workers}
    _validate_options(kind, options | vars(image))
    how: dict[str, Any] = {"overrides": overrides, "count": count, "show": not quiet}
    arm = how["arm"] = robot.asked()
    if kind == "scenes":
        how |= {"split": split or "test", "simulate": simulate or 0, "workers": workers}
        found, hand = _of_scenes(source, **how)
    else:
        tries = SIMULATED if simulate is None else simulate
        if kind == "a cloud":
            seen = _Seen(cloud=_read_cloud(source, units or "m"))
        else:
            seen = _see(source, image, show=not quiet)
        found, hand = _of_object(seen, tries, **how)
    write_attempts(out, found, hand, arm_joints=() if arm is None else arm.joints)
    say(str(out))


def _validate_place(out: Path, source: Path) -> None:
    """Reject a file that cannot be written, or would replace one that is not of postures.

    Raises:
        UsageError: If it is such a file.
        DataError: If it cannot be written.
    """
    from drakegrasp.exchange.attempts import holds_postures
    from drakegrasp.runtime.files import validate_writable

    if out.suffix.lower() not in HDF5:
        raise UsageError(f"--out must be a file {' or '.join(HDF5)}, got {str(out)!r}")
    if out.exists() and out.samefile(source):
        raise UsageError(f"--out must be another file than INPUT, got {str(out)!r}")
    validate_writable(out)
    try:
        known = not out.exists() or holds_postures(out)
    except GraspError:  # no HDF5 file
        known = False
    if not known:
        raise UsageError(f"--out must be a new file or one of postures, got {str(out)!r}")


def _kind_of(source: Path, camera: str | None) -> str:
    """Return the kind of INPUT, one of `KINDS`.

    Raises:
        UsageError: If the suffix is of none of them.
    """
    suffix = source.suffix.lower()
    if suffix in HDF5:
        return "scenes"
    if suffix == ".png" or (suffix == ".npy" and camera is not None):
        return "a depth image"
    if suffix in (".npy", ".ply"):
        return "a cloud"
    raise UsageError(f"INPUT must be .hdf5, .npy, .ply or .png, got {str(source)!r}")


def _validate_options(kind: str, options: dict[str, Any]) -> None:
    """Reject options of other kinds of INPUT, and a depth image without camera and mask.

    Raises:
        UsageError: If there is one.
    """
    for name, value in options.items():
        if value is not None and name not in KINDS[kind]:
            due = next(other for other, names in KINDS.items() if name in names)
            hint = ": a depth image in a .npy file needs --camera" if due == "a depth image" else ""
            option = name.replace("_", "-")
            raise UsageError(f"--{option} must be given with {due} only, got {kind}{hint}")
    for name in ("camera", "mask") if kind == "a depth image" else ():
        if options[name] is None:
            raise UsageError(f"--{name} must be given with {kind}, got none")


def _of_scenes(
    path: Path, *, overrides: tuple[str, ...], show: bool, **how: Any
) -> tuple[GraspTable, Hand]:
    """Return the grasps for the views of a split and their hand; print how many there are."""
    import numpy as np

    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.hand.settings import override_config

    with wrong_input():
        found, blind = dg.predict_scenes(path, overrides=overrides, show=show, **how)
        config = override_config(read_manifest(path.parent).config, overrides)
    if show:
        views = len(set(found.of_row.tolist()))
        say(f"{len(found):,} grasps of {views:,} views", err=True)
        if found.q_arm is not None:
            served = len(set(found.of_row[np.isfinite(found.q_arm[:, 0])].tolist()))
            say(f"the arm reaches a grasp of {served:,} of {views:,} views", err=True)
    if blind:
        say(f"{blind:,} views show too little of their object: no grasp", err=True)
    return found, dg.load_hand(config.hand_source)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """What a camera saw of an object.

    Attributes:
        cloud: (n, 3), points of the object in {T} [m].
        view: The image that shows them, if there is one.
        instances: (h, w), the mask of several objects, if it is one.
    """

    cloud: Array
    view: View | None = None
    instances: AnyArray | None = None


def _of_object(
    seen: _Seen,
    simulate: int,
    *,
    overrides: tuple[str, ...],
    count: int | None,
    show: bool,
    arm: Arm | None,
) -> tuple[GraspTable, Hand]:
    """Return the grasps for an object and their hand; print what to expect of them.

    They are in {T}, or in the frame of the view's camera if there is a view.
    """
    import numpy as np

    from drakegrasp.arithmetic import multiply
    from drakegrasp.frames import invert_pose
    from drakegrasp.scoring.predicting import predict as predict_grasps
    from drakegrasp.scoring.ranking import seen_neighbours

    config, view, around = dg.load_config("fast", list(overrides)), seen.view, None
    if view is not None and seen.instances is not None and (simulate or arm is not None):
        around = seen_neighbours(view, seen.instances, config=config)
        if show:
            say(f"{counted(len(around.models), 'neighbour')} completed from the view", err=True)
    how: dict[str, Any] = {"simulate": simulate, "count": count, "arm": arm, "around": around}
    found, ranking = predict_grasps(seen.cloud, view, config, **how)

    if view is not None:
        X_TC = np.asarray(view.X_TC)
        X_CG = multiply(invert_pose(X_TC), found.X_FG)
        X_TC = X_TC[None].repeat(len(found), axis=0)
        found = replace(found, X_FG=X_CG, frame="camera", X_TC=X_TC)
    if show:
        say(ranking.explain(), err=True)
        if arm is not None and found.q_arm is not None and np.isfinite(found.q_arm[0]).all():
            joints = zip(arm.joints, found.q_arm[0].tolist(), strict=True)
            say("joints at the first grasp: " + ", ".join(f"{n} {q:.4f}" for n, q in joints))
    return found, dg.load_hand(config.hand_source)


def _read_cloud(path: Path, units: str) -> Array:
    """Return the points (n, 3) of a file [m].

    Raises:
        GraspError: If the file has none.
    """
    from drakegrasp.exchange.columns import read_numbers
    from drakegrasp.mesh.loading import load_points
    from drakegrasp.objects.sources import UNITS

    try:
        points = read_numbers(path) if path.suffix.lower() == ".npy" else load_points(path)
    except MeshError as error:
        raise GraspError(str(error)) from None
    if points.ndim == 2 and points.shape[1] != 3:
        raise GraspError(
            f"{path}: must be a cloud (n, 3), got {points.shape}: a depth image needs --camera"
        )
    return UNITS[units] * points


def _read_depth(path: Path, scale: float | None) -> Array:
    """Return the depths (h, w) of a file [m].

    Raises:
        GraspError: If the file has none.
        UsageError: If a scale is given for a file in metres.
    """
    from drakegrasp.exchange.columns import read_numbers
    from drakegrasp.vision.depth_image import read_depth_png

    if path.suffix.lower() == ".png":
        return read_depth_png(path, 0.001 if scale is None else scale)
    if scale is not None:
        raise UsageError("--depth-scale must be given with a .png only, got a .npy in metres")
    depth = read_numbers(path)
    if depth.ndim != 2:
        got = f"an array of shape {depth.shape}"
        raise GraspError(f"{path}: must be a depth image (h, w), got {got}")
    return depth


def _see(path: Path, image: DepthImage, *, show: bool) -> _Seen:
    """Return what a depth image shows of the object and beside it.

    Raises:
        GraspError: If a file is invalid; the message names it.
    """
    from drakegrasp.exchange.attempts import named
    from drakegrasp.exchange.columns import read_numbers
    from drakegrasp.frames import read_pose
    from drakegrasp.vision import depth_image as images
    from drakegrasp.vision.depth_image import View

    assert image.camera is not None and image.mask is not None
    depth = _read_depth(path, image.depth_scale)
    K, off, instances = images.read_camera(image.camera, depth.shape), "", None
    if image.object_label is None:
        own = images.read_mask(image.mask)
    else:
        instances = images.read_labels(image.mask, image.object_label)
        own = instances == image.object_label

    if image.camera_pose is not None:
        with named(image.camera_pose):
            pose = read_pose(read_numbers(image.camera_pose), "X_TC")
            share = images.table_share(depth, K, own, pose)
    else:
        with named(path):
            pose, residual, share = images.fit_table(depth, K, own)
        off = f", {1e3 * residual:.1f} mm off its plane (rms)"
    if show and not math.isnan(share):
        table = f"table: {share:.0%} of the pixels beside the object{off}"
        say(f"{table}; the camera is {1e3 * pose[2, 3]:.0f} mm above it", err=True)
    with named(path):
        cloud = images.cloud_from_depth(depth, K, own, pose)
    view = View(depth=depth, mask=own, K=images.read_lens(K), X_TC=pose)
    return _Seen(cloud=cloud, view=view, instances=instances)


def score(
    predictions: Annotated[tuple[Existing, ...], Parameter(name="PREDICTIONS")] = (),
    /,
    *,
    dataset: DataFile,
    split: Split = "test",
    against: Annotated[tuple[Existing, ...], Parameter(metavar="FILE")] = (),
    references: Annotated[tuple[str, ...], Parameter(name="--reference", metavar="NAME")] = (),
    per_object: Positive | None = None,
    out: Folder | None = None,
    overrides: Settings = (),
    as_json: AsJson = False,
    quiet: bool = False,
    train: Annotated[DataFile | None, Parameter(group=MORE)] = None,
    frame: Annotated[RowFrame | None, Parameter(group=MORE)] = None,
    postures: Postures = Postures(),
    protocol: Annotated[str, Parameter(group=MORE, metavar="NAME|FILE.py:NAME")] = "lift",
    robot: ArmOptions = ArmOptions(),
    workers: Workers = Workers(),
) -> None:
    """Score predicted grasps against reference rows.

    Each of PREDICTIONS is a .npy or HDF5 file of (n, 6k) numbers, one grasp per row of the
    split, or (n, m, 6k), m grasps per row, in the camera's frame. It may also be a file of postures
    with the `row` of each, or a file or folder of exported samples. Several files are treated as
    several training runs of one method. Without PREDICTIONS only the reference rows are scored.

    With --out the command writes card.json, card.md, card.png and the verdicts to DIR, so that an
    interrupted score can continue.

    Args:
        predictions: Files of one method.
        dataset: The data file of the predicted rows or views: OUT/grasping_oto.hdf5, _otm,
            OUT/scenes.hdf5, or OUT/clutter.hdf5.
        split: Rows of the dataset.
        against: Predictions of another method for the same rows: the card contains the difference
            of the headlines. May be given several times, once per training run of that method.
        references: Score these reference rows only; may be given several times: own, nearest image,
            constant, random, top-down, closing. [default: all]
        per_object: Maximum number of rows of each object.
        out: Folder of the card and of the verdicts, from which the same command continues.
            [default: nothing is written]
        overrides: Change one setting, e.g. lift.hold_time=1; may be given several times.
        as_json: Print the card as JSON.
        quiet: Show neither progress nor warnings.
        train: Data file whose training rows are used for the reference rows. [default: --dataset]
        frame: Frame of all postures, which overrides their files.
        protocol: The rule of a verdict, see `drakegrasp verify`. All protocols except lift try the
            first wrist pose of a prediction in MuJoCo.
    """
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.scenes import open_rows
    from drakegrasp.exchange.attempts import holds_postures
    from drakegrasp.scoring.references import REFERENCES

    on, arm = workers.asked(), robot.asked()
    with wrong_input():
        read_manifest(dataset.parent)
        bare = not references and bool(predictions) and all(map(holds_postures, predictions))
        data = open_rows(dataset, split=split, fewer_fingers=bare)
        trained = None if train is None else open_rows(train, split="train")
    references = references or tuple(REFERENCES)
    if data.has_fewer_fingers:
        say("no reference rows: some samples leave fingers out", err=True)
        references = ()
    scored = dg.score(
        predictions,
        data,
        against=against or None,
        train=trained,
        references=references,
        per_object=per_object,
        overrides=overrides,
        read_as=given(frame=frame) | postures.asked(),
        protocol=protocol,
        arm=arm,
        out=out,
        again=same_command(*IDLE),
        **on,
        show=not quiet,
    )
    _say_card(scored.card, out, as_json=as_json, quiet=quiet)


def _say_card(card: Mapping[str, Any], out: Path | None, *, as_json: bool, quiet: bool) -> None:
    """Print the headlines of a card, or the card, and unless quiet all sets and warnings."""
    from drakegrasp.scoring.card import share_text

    if as_json:
        say_json(card, indent=1)
    else:
        for name, value in card["headline"].items():
            say(f"{name}: {share_text(value, 1, ' %')}")
        if out is not None:
            say(str(out / "card.md"))
    if not quiet:
        for name, each in card["sets"].items():
            shares = {m: share_text(of, 1, " %") for m, of in each["measures"].items()}
            clean = f", clean {shares['clean']}" if "clean" in shares else ""
            say(f"{name}: {shares['headline']}{clean}", err=True)
        for warning in card["warnings"]:
            say(f"warning: {warning}", err=True)
