"""Renders of single rows: images with their contacts, and the 3D view.

Input: attempts, which are read from the files when requested, and the hand. The 3D view consists of
plain lists for JSON. Everything in it is in {T}, with the object in its resting pose: lifted hands
are moved back with the object, as in the dataset's `_lifted` fields, so that a slip in the hand is
visible as a different pose of the hand.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import open_hdf5
from drakegrasp.dataset.paths import DATA_FILES, reach_names, reach_path
from drakegrasp.dataset.schema import SPLITS, TRIAL_FIELDS
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DrakegraspError
from drakegrasp.frames import Array, invert_pose, rotate_vectors, transform_points, unpack_pose
from drakegrasp.page.snapshot import Snapshot, find_model
from drakegrasp.vision.camera import camera_pose_otm, camera_pose_oto, intrinsics, project

if TYPE_CHECKING:
    from drakegrasp.pictures.still_scene import StillScene

#: Columns that the dots on a thumbnail need.
THUMBNAIL = ("X_TO", "X_OG", "X_C0C", "closed_p_OQ", "closed_nhat_Q_O")
#: Length of the arrows along the normals [m].
ARROW = 0.03
#: Held while an arm is drawn, because Drake keeps one state of it.
_ARMS = threading.Lock()
_CAMERA_POSES = {"oto": camera_pose_oto, "otm": camera_pose_otm}


class Render(NamedTuple):
    """The images of a success by one camera.

    Attributes:
        image: (4, S, S) float32: R, G, B in 0..1 and depth [m].
        mask: (S, S) uint8, 1 where the object is seen.
    """

    image: npt.NDArray[np.float32]
    mask: npt.NDArray[np.uint8]


class Dot(NamedTuple):
    """A contact on an image.

    Attributes:
        finger: Number of the finger, in grasp order.
        u, v: Pixel of the contact.
        tip_u, tip_v: Pixel of the tip of its normal.
        hidden: Whether the object hides the contact.
    """

    finger: int
    u: float
    v: float
    tip_u: float
    tip_v: float
    hidden: bool


def read_rows(
    snapshot: Snapshot, places: Sequence[int], names: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Return the rows of attempts in `/trials`.

    Args:
        snapshot: State of the files.
        places: Rows of the attempts.
        names: Names of the columns; all if None.
    """
    columns = snapshot.trials[places].columns(names or [f.name for f in TRIAL_FIELDS])
    return [
        dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)
    ]


def read_render(snapshot: Snapshot, i: int, camera: str) -> Render | None:
    """Return the images of a sample, or None if they cannot be read.

    Args:
        snapshot: The dataset.
        i: Row of the attempt.
        camera: `oto` or `otm`.
    """
    split = snapshot.table.split
    if split[i] == NONE:
        return None
    row = np.count_nonzero(split[:i] == split[i])
    try:
        with open_hdf5(snapshot.out / DATA_FILES[camera]) as file:
            own = file[SPLITS[split[i]]]
            return Render(image=own["images"][row], mask=own["masks"][row])
    except (OSError, KeyError, ValueError, IndexError):
        return None


def contact_dots(
    snapshot: Snapshot,
    row: dict[str, Any],
    camera: str,
    *,
    contacts: tuple[Array, Array] | None = None,
) -> list[Dot]:
    """Return where a camera sees contacts; contacts behind the camera are left out.

    Args:
        snapshot: State of the files, with the configuration of the cameras.
        row: Row with the columns THUMBNAIL.
        camera: `oto` or `otm`.
        contacts: Points and normals (k, 3) in {O}; those of the row after closing if None.
    """
    # The contacts and the tips of their normals in {C}.
    p_OQ, nhat_Q_O = contacts or (row["closed_p_OQ"], row["closed_nhat_Q_O"])
    config = snapshot.config.camera
    X_TO, X_OG = unpack_pose(row["X_TO"]), unpack_pose(row["X_OG"])
    X_TC = _CAMERA_POSES[camera](multiply(X_TO, X_OG), config, unpack_pose(row["X_C0C"]))
    X_CO = multiply(invert_pose(X_TC), X_TO)
    p_CQ, nhat_Q_C = transform_points(X_CO, p_OQ), rotate_vectors(X_CO, nhat_Q_O)

    return dots_of(intrinsics(config), p_CQ, nhat_Q_C, config.near)


def dots_of(
    K: Array,
    p_CQ: Array,
    nhat_Q_C: Array,
    near: float,
    hidden: Sequence[bool] = (),
) -> list[Dot]:
    """Return contacts (k, 3) in {C} as dots, without those that are not beyond the near plane.

    Args:
        K: (3, 3), camera matrix [px].
        p_CQ: (k, 3), points [m]; NaN if there is none.
        nhat_Q_C: (k, 3), normals; their tips are at the distance `ARROW`.
        near: Near plane [m].
        hidden: (k,), whether something hides each contact; by default nothing does.
    """
    p_CE, dots = p_CQ + ARROW * np.nan_to_num(nhat_Q_C), []
    for finger, (point, tip) in enumerate(zip(p_CQ, p_CE, strict=True)):
        if np.isfinite(point).all() and min(point[2], tip[2]) > near:
            (u, v), (tip_u, tip_v) = project(K, np.array([point, tip])).tolist()
            dots.append(Dot(finger, u, v, tip_u, tip_v, finger < len(hidden) and hidden[finger]))
    return dots


class HandView:
    """The hand of a dataset for the 3D view; Drake is loaded when the hand is first needed.

    A hand that cannot be loaded here is a `problem`, not an error.

    Args:
        config: Configuration of the dataset.
    """

    def __init__(self, config: Config) -> None:
        self._source, self._lock = config.hand_source, threading.Lock()

    @cached_property
    def _loaded(self) -> tuple[StillScene | None, dict[str, bytes], str]:
        """The hand, the surfaces of its links, and why it cannot be shown."""
        from drakegrasp.hand.description import load_hand
        from drakegrasp.pictures.still_scene import StillScene, link_surfaces

        try:
            scene = StillScene(load_hand(self._source))
            return scene, link_surfaces(scene), ""
        except (DrakegraspError, RuntimeError, OSError) as error:
            return None, {}, f"the hand cannot be shown: {str(error).splitlines()[0]}"

    @property
    def problem(self) -> str:
        """Why the hand cannot be shown, in words; empty if it can."""
        return self._loaded[2]

    @property
    def surfaces(self) -> list[bytes]:
        """The shapes of each link that has one as JSON, see `pictures.still_scene`."""
        return list(self._loaded[1].values())

    def poses(self, X_TG: Array, q: Array | None, spread: float) -> list[list[float]]:
        """Return the poses of the links, column by column as for three.js; empty without a hand.

        A dataset that was built with other files of the hand may have another number of joints.

        Args:
            X_TG: (4, 4), pose of the palm.
            q: (j,), positions of the joints [rad or m]; None for the open hand.
            spread: Angle of the spread joints of the open hand [rad].
        """
        scene, surfaces, _ = self._loaded
        if scene is None:
            return []
        rest = scene.positions(spread)
        positions = rest if q is None else q
        if len(positions) != len(rest):
            return []
        with self._lock:
            scene.pose(X_TG, positions)
            return [columns_of(scene.link_pose(link)) for link in surfaces]


def attempt_scene(
    snapshot: Snapshot, i: int, row: Mapping[str, Any], hand: HandView
) -> dict[str, Any]:
    """Return the 3D view of an attempt as JSON types.

    Args:
        snapshot: State of the files.
        i: Place of the attempt in the table.
        row: Row with all columns of the attempt.
        hand: Hand of the dataset.
    """
    # The start is always shown; closed and lifted only if the attempt reached them.
    X_TO, spread = unpack_pose(row["X_TO"]), float(row["spread"])
    start = hand.poses(multiply(X_TO, unpack_pose(row["X_OG"])), None, spread)
    states = {"start": {"links": start, "contacts": []}} | hand_states(row, X_TO, hand)
    return make_scene(snapshot, int(snapshot.table.object[i]), X_TO, states, hand)


def hand_states(
    row: Mapping[str, Any], X_TO: Array, hand: HandView, kind: str = ""
) -> dict[str, Any]:
    """Return the states `closed` and `lifted` of a 3D view, as far as a row reached them.

    Args:
        row: Row of the dataset or of a table of verdicts, which may lack columns.
        X_TO: (4, 4), resting pose of the object.
        hand: Hand of the dataset.
        kind: See `contacts_of`.
    """
    states = {}
    for name, palm in (("closed", "X_OG"), ("lifted", "X_OG_lifted")):
        X_OG, q = row.get(palm), row.get(f"{name}_q")
        if X_OG is None or q is None or not (np.isfinite(X_OG).all() and np.isfinite(q).all()):
            continue
        links = hand.poses(multiply(X_TO, unpack_pose(X_OG)), q, 0.0)
        contacts = contacts_of(row, f"{name}_", X_TO, kind)
        states[name] = {"links": links, "contacts": contacts}
    return states


def make_scene(
    snapshot: Snapshot, number: int, X_TO: Array, states: dict[str, Any], hand: HandView
) -> dict[str, Any]:
    """Return a 3D view as JSON types.

    Args:
        snapshot: State of the files.
        number: Number of the object.
        X_TO: (4, 4), pose of the object.
        states: States by name, each with the poses of the links and the contacts.
        hand: Hand of the dataset.
    """
    return {
        "object": columns_of(X_TO),
        "objectNumber": number,
        "objectName": snapshot.names[number],
        "hasObject": find_model(snapshot.out, snapshot.names[number]) is not None,
        "links": len(hand.surfaces),
        "states": states,
        "arms": {},
    }


def contacts_of(
    row: Mapping[str, Any], when: str, X_TO: Array, kind: str = ""
) -> list[dict[str, Any]]:
    """Return the contacts of a row in {T}; empty if the row lacks them.

    Args:
        row: Row of the dataset or of a table of verdicts.
        when: Prefix of the names of the columns.
        X_TO: (4, 4), resting pose of the object.
        kind: Kind of the contacts in the view; only the kinds "" and `force` have forces.
    """
    points, normals, forces = (row.get(f"{when}{name}") for name in ("p_OQ", "nhat_Q_O", "f_Q_O"))
    if kind not in ("", "force") and points is not None:
        forces = np.zeros_like(points)
    if points is None or normals is None or forces is None:
        return []
    contacts = contacts_in_table(points, normals, forces, X_TO)
    return [{"kind": kind, **c} for c in contacts] if kind else contacts


def contacts_in_table(
    p_OQ: Array, nhat_Q_O: Array, f_Q_O: Array, X_TO: Array
) -> list[dict[str, Any]]:
    """Return contacts (k, 3) in {T} as JSON types, without fingers that do not touch."""
    p_TQ = transform_points(X_TO, p_OQ)
    nhat_T, f_T = (rotate_vectors(X_TO, vectors) for vectors in (nhat_Q_O, f_Q_O))
    return [
        {"finger": k, "p": p.tolist(), "n": np.nan_to_num(n).tolist(), "f": f.tolist()}
        for k, (p, n, f) in enumerate(zip(p_TQ, nhat_T, f_T, strict=True))
        if np.isfinite(p).all() and np.isfinite(f).all()
    ]


def columns_of(X: Array) -> list[float]:
    """Return a pose as sixteen numbers, column by column, rounded to six decimals."""
    return [round(value, 6) for value in X.T.ravel().tolist()]


def object_surface(snapshot: Snapshot, number: int) -> bytes | None:
    """Return the surface of an object as JSON by its number, see `pictures.still_scene`.

    It is None if there is no file of the object's meshes.

    Raises:
        MeshError: If the file cannot be read.
    """
    from drakegrasp.objects.model import load_object
    from drakegrasp.pictures.still_scene import object_json

    path = find_model(snapshot.out, snapshot.names[number])
    return None if path is None else object_json(load_object(path))


def arm_surface(snapshot: Snapshot, i: int, name: str) -> bytes | None:
    """Return an arm at the grasp of an attempt and before its approach as JSON.

    It is None if there is no such arm, or it does not reach the grasp.

    Args:
        snapshot: State of the files.
        i: Place of the attempt in the table.
        name: Name of the arm's file.

    Raises:
        DataError: If the file is damaged.
    """
    from drakegrasp.pictures.still_scene import arm_json
    from drakegrasp.reach.rows import draw_row

    if name not in reach_names(snapshot.out):
        return None
    with _ARMS:
        drawn = draw_row(reach_path(snapshot.out, name), snapshot.config, snapshot.key(i))
    return arm_json(drawn) if drawn else None
