"""What the 3D view of an attempt shows: poses of links, contacts, the table.

In: a row of `/trials` and the hand. Out: plain lists for JSON. Everything is in {T}, on the object
in its resting pose: what was lifted is moved back with the object, as in the dataset's `_held`
fields, so that a slip in the hand shows as another place of the hand.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config
from drakegrasp.errors import DrakegraspError
from drakegrasp.frames import Array, rotate_vectors, transform_points, unpack_pose
from drakegrasp.page.catalog import Snapshot, find_model

#: Object meshes that are kept in memory.
KEPT_MESHES = 32


class HandView:
    """The hand of a dataset for the 3D view; Drake is loaded when it is first asked.

    Args:
        config: Configuration of the dataset.
    """

    def __init__(self, config: Config) -> None:
        self._source = config.hand_source
        self._lock = threading.Lock()
        self._scene: Any = None
        self._surfaces: dict[str, bytes] = {}
        #: Why there is no hand to show, in words; empty if there is one.
        self.problem = ""

    def load(self) -> None:
        """Load the hand; a hand that cannot be loaded here is a `problem`, and no error."""
        with self._lock:
            if self._scene is not None or self.problem:
                return
            from drakegrasp.hand.description import load_hand
            from drakegrasp.pictures.still_scene import StillScene
            from drakegrasp.pictures.surfaces import link_surfaces

            try:
                scene = StillScene(load_hand(self._source))
                self._surfaces, self._scene = link_surfaces(scene), scene
            except (DrakegraspError, RuntimeError, OSError) as error:
                self.problem = f"the hand cannot be shown: {str(error).splitlines()[0]}"

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the links with a shape, in the order of their numbers in addresses."""
        self.load()
        return tuple(self._surfaces)

    def surface(self, number: int) -> bytes:
        """Return what is shown of a link, see `pictures.surfaces`.

        Raises:
            IndexError: If there is no link of that number.
        """
        link = self.links[number]  # first, since it may load them
        return self._surfaces[link]

    def poses(self, X_TG: Array, q: Array | None, spread: float) -> list[list[float]]:
        """Return the poses of the links, column by column as for three.js; none without a hand.

        A dataset that was made with other files of the hand may have another number of joints.

        Args:
            X_TG: (4, 4), pose of the palm.
            q: (j,), positions of the joints [rad or m]; None for the open hand.
            spread: Angle of the spread joints of the open hand [rad].
        """
        self.load()
        if self._scene is None:
            return []
        from drakegrasp.pictures.still_scene import Poses

        with self._lock:
            rest = self._scene.positions(spread)
            positions = rest if q is None else q
            if len(positions) != len(rest):
                return []
            self._scene.pose(Poses(X_WG=X_TG, q=positions))
            return [_columns(self._scene.link_pose(link)) for link in self._surfaces]


def scene_of(snapshot: Snapshot, i: int, row: Mapping[str, Any], hand: HandView) -> dict[str, Any]:
    """Return the 3D view of an attempt as JSON types.

    Args:
        snapshot: State of the files.
        i: Place of the attempt in the table.
        row: All its columns.
        hand: Of the dataset.
    """
    # The start always; closed and lifted as far as the attempt got.
    X_TO = unpack_pose(row["X_TO"])
    X_TG = multiply(X_TO, unpack_pose(row["X_OG"]))
    spread = float(row["spread"])
    states: dict[str, Any] = {"start": {"links": hand.poses(X_TG, None, spread), "contacts": []}}
    if np.isfinite(row["time_close"]):
        links = hand.poses(X_TG, row["closed_q"], spread)
        states["closed"] = {"links": links, "contacts": _contacts(row, "closed", X_TO)}
    if np.isfinite(row["time_lift"]) and np.isfinite(row["X_OG_lifted"]).all():
        X_TG_held = multiply(X_TO, unpack_pose(row["X_OG_lifted"]))
        links = hand.poses(X_TG_held, row["lifted_q"], spread)
        states["lifted"] = {"links": links, "contacts": _contacts(row, "lifted", X_TO)}

    return make_scene(snapshot, int(snapshot.table.object[i]), X_TO, states, hand)


def make_scene(
    snapshot: Snapshot, number: int, X_TO: Array, states: dict[str, Any], hand: HandView
) -> dict[str, Any]:
    """Return a 3D view as JSON types.

    Args:
        snapshot: State of the files.
        number: Of the object.
        X_TO: (4, 4), its pose.
        states: By their names, each with the poses of the links and the contacts.
        hand: Of the dataset.
    """
    return {
        "object": _columns(X_TO),
        "objectCode": snapshot.codes[number],
        "objectName": snapshot.names[number],
        "hasObject": find_model(snapshot.out, snapshot.names[number]) is not None,
        "links": len(hand.links),
        "states": states,
    }


def _contacts(row: Mapping[str, Any], when: str, X_TO: Array) -> list[dict[str, Any]]:
    """Return the contacts of one instant in {T}."""
    points, normals, forces = (row[f"{when}_{name}"] for name in ("p_OQ", "nhat_Q_O", "f_Q_O"))
    return contacts_in_table(points, normals, forces, X_TO)


def contacts_in_table(p_OQ: Array, nhat_Q_O: Array, f_Q_O: Array, X_TO: Array) -> list[Any]:
    """Return contacts (k, 3) in {T} as JSON types; a finger that does not touch has none."""
    p_TQ = transform_points(X_TO, p_OQ)
    nhat_T, f_T = (rotate_vectors(X_TO, vectors) for vectors in (nhat_Q_O, f_Q_O))
    return [
        {"finger": k, "p": p.tolist(), "n": np.nan_to_num(n).tolist(), "f": f.tolist()}
        for k, (p, n, f) in enumerate(zip(p_TQ, nhat_T, f_T, strict=True))
        if np.isfinite(p).all() and np.isfinite(f).all()
    ]


def _columns(X: Array) -> list[float]:
    """Return a pose as sixteen numbers, column by column, to a micrometre and a microradian."""
    return [round(value, 6) for value in X.T.ravel().tolist()]


def object_surface(snapshot: Snapshot, number: int) -> bytes | None:
    """Return what is shown of an object by its number, see `pictures.surfaces`.

    It is None if there is no file of the object's meshes.

    Raises:
        MeshError: If the file cannot be read.
    """
    path = find_model(snapshot.out, snapshot.names[number])
    return None if path is None else _read_surface(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=KEPT_MESHES)
def _read_surface(path: Path, modified: int) -> bytes:
    """Return what is shown of an object's file; one written at another time [ns] is read again."""
    from drakegrasp.objects.model import load_object
    from drakegrasp.pictures.surfaces import object_json

    return object_json(load_object(path))
