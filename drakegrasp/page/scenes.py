"""Scenes for training, on the page: the scenes.hdf5 of a dataset, with its other files."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.hdf5 import validate_codes
from drakegrasp.dataset.scenes import SceneDataset, validate_state
from drakegrasp.dataset.schema import SPLITS, VIEW_KINDS
from drakegrasp.errors import DataError
from drakegrasp.frames import unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.page.gallery import Gallery, Places, Query
from drakegrasp.page.renders import ARROW, HandView, contacts_in_table, dots_of, make_scene
from drakegrasp.page.snapshot import Snapshot
from drakegrasp.pictures.style import REACHED, TRUE
from drakegrasp.table import Table

Rows = npt.NDArray[np.int64]
#: Maximum number of palms in the 3D view, and number of these with a hand.
PALMS, HANDS = 100, 8
#: Length of the line along +Gz from a palm's origin on an image [m].
PALM = 0.06
#: Display of a grasp by its labels: the word, its style class, and the colour of its palm.
HOLDS, FAILS, UNKNOWN = (
    ("holds", "lifted", TRUE),
    ("fails", "failed", REACHED),
    ("not tested", "", "#F0E442"),
)


class Scenes(Gallery):
    """All scenes of a dataset.

    Args:
        path: Path of scenes.hdf5.
        snapshot: State of the other files.

    Raises:
        DataError: If the file cannot be read, or belongs to another dataset.
    """

    HOME, ROW, NOUN = "/scenes", "scene", "scene"
    CHOICES: ClassVar = {"split": SPLITS}
    SELECTS: ClassVar = {name: name for name in ("class", "object", "split")}
    SORTS: ClassVar = {
        "kept": "samples",
        "lifted": "grasps that hold",
        "tested": "tested grasps",
        "grasps": "grasps",
        "row": "row of the file",
    }

    def __init__(self, path: Path, snapshot: Snapshot) -> None:
        validate_state(path, snapshot.trials)
        data = SceneDataset(path, points=None)
        scenes, grasps, views = (data.tables[name] for name in ("scenes", "grasps", "views"))
        validate_codes(path, "/grasps/outcome", grasps["outcome"], list(Outcome))
        validate_codes(path, "/grasps/trial_id", grasps["trial_id"], snapshot.table.count)
        validate_codes(path, "/views/kind", views["kind"], len(VIEW_KINDS))
        if not np.isfinite(scenes["X_TO"]).all():
            raise DataError(f"{path}: /scenes/X_TO must be finite, got other numbers")
        if others := set(data.names) - set(snapshot.names):
            raise DataError(f"{path}: must be of objects of {snapshot.out}, got {min(others)}")

        # Numbers of grasps in each scene, of tested and lifted ones, of samples, and of views.
        of = {name: grasps["scene"][grasps[name]] for name in ("kept", "lifted", "tested")}
        of |= {"grasps": grasps["scene"], "views": views["scene"]}
        numbers = np.array([snapshot.names.index(name) for name in data.names], dtype=np.int32)
        self.snapshot, self.data = snapshot, data
        self.table = Table(
            {name: np.bincount(rows, minlength=len(scenes["split"])) for name, rows in of.items()},
            object=numbers[scenes["object"][:, 0]],
            split=scenes["split"],
            resting=scenes["resting"][:, 0],
        )

    def views(self, scene: int) -> Rows:
        """Return the rows of a scene's views."""
        return np.flatnonzero(self.data.tables["views"]["scene"] == scene)

    def grasps(self, scene: int) -> Rows:
        """Return the rows of a scene's grasps: samples, other lifted ones, failed, untested."""
        grasps, rows = self.data.tables["grasps"], self.data.rows_in(scene)
        kept, lifted, tested = (grasps[name][rows] for name in ("kept", "lifted", "tested"))
        return rows[np.argsort(-(4 * kept + 2 * lifted + 1 * tested), kind="stable")]

    # Contents of pages.

    def identity(self, i: int) -> dict[str, Any]:
        """Return how people name a scene, and its numbers of grasps."""
        counts = {name: int(values[i]) for name, values in self.table.items()}
        split, resting = SPLITS[counts["split"]], counts["resting"]
        return {**super().identity(i), "split": split, "resting": resting, "counts": counts}

    def summary(self, query: Query, chosen: Places) -> dict[str, Any]:
        """Return the content of the gallery besides its cards."""
        out = self.snapshot.out
        views = int(self.table.views[chosen].sum())
        return {"title": out.name or str(out), "views": views}

    def cards(self, shown: Places) -> list[dict[str, Any]]:
        """Return the content of the cards of scenes, with the views that show their grasps best."""
        cards = []
        for i in shown.tolist():
            drawn, best = self._drawn(i), 0
            if drawn is not None and len(self.views(i)):
                best = int(np.argmax(self._visible(i, np.array([drawn])).sum(axis=(1, 2))))
            cards.append({"view": self._seen(i, best, drawn) if len(self.views(i)) else None})
        return cards

    def row(self, i: int, hand: HandView) -> dict[str, Any]:
        """Return the content of a scene's page."""
        grasps, drawn = self.grasps(i), self._drawn(i)
        trials = self.data.tables["grasps"]["trial_id"]
        return {
            "drawn": None if drawn is None else int(trials[drawn]),
            "views": [self._seen(i, k, drawn) for k in range(len(self.views(i)))],
            "kinds_of_palms": [HOLDS, FAILS, UNKNOWN],
            "scene": self._scene(i, grasps, hand),
        }

    def _drawn(self, i: int) -> int | None:
        """Return the row of the grasp drawn into the views: the best one, or None if it fails."""
        grasps, lifted = self.grasps(i), self.data.tables["grasps"]["lifted"]
        return int(grasps[0]) if len(grasps) and lifted[grasps[0]] else None

    def _seen(self, i: int, k: int, drawn: int | None) -> dict[str, Any]:
        """Return the k-th view of a scene, and where it sees a grasp's palm and contacts."""
        view = int(self.views(i)[k])
        dots, palm = [], []
        if drawn is not None:
            grasps, row = self.data.grasps_in(view, frame="camera"), drawn - self.data.rows_in(i)[0]
            K = self.data.tables["views"]["K"][view].reshape(3, 3)
            p_CQ, nhat, X_CG = (
                grasps[name][row].astype(float) for name in ("p_AQ", "nhat_Q_A", "X_AG")
            )
            near = self.data.near
            dots = dots_of(K, p_CQ, nhat, near, (~grasps["visible"][row]).tolist())
            # The palm is drawn like a contact: a dot with a line.
            along = PALM / ARROW * X_CG[None, :3, 2]
            palm = dots_of(K, X_CG[None, :3, 3], along, near)
        return {
            "href": f"/view/{i}-{k}.png",
            "size": self.data.image_size,
            "kind": VIEW_KINDS[self.data.tables["views"]["kind"][view]],
            "dots": [dot for dot in dots if np.isfinite(dot).all()],
            "palm": [dot for dot in palm if np.isfinite(dot).all()],
        }

    def _visible(self, i: int, grasps: Rows) -> npt.NDArray[np.bool_]:
        """Return which contacts (v, g, k) of some grasps (g,) each view (v,) sees."""
        places, views = grasps - self.data.rows_in(i)[:1], self.views(i).tolist()
        return np.array([self.data.visible_in(view)[places] for view in views])

    def _holds(self, row: int) -> tuple[str, str, str]:
        """Return the display of a grasp by its labels: HOLDS, FAILS or UNKNOWN."""
        table = self.data.tables["grasps"]
        if table["lifted"][row]:
            return HOLDS
        return FAILS if table["tested"][row] else UNKNOWN

    def _scene(self, i: int, grasps: Rows, hand: HandView) -> dict[str, Any]:
        """Return the 3D view: the hands of the best grasps, and further palms, in {T}."""
        table = self.data.tables["grasps"]
        X_TO = unpack_pose(self.data.tables["scenes"]["X_TO"][i, 0])
        X_TG = unpack_pose(table["X_TG"][grasps].astype(float))
        known = np.isfinite(X_TG).all(axis=(1, 2)) & np.isfinite(table["q"][grasps]).all(axis=1)

        # The hands of the best grasps, with their contacts; the palms of more grasps.
        states, palms, rows = {}, [], grasps[known][:PALMS].tolist()
        for k, (row, X) in enumerate(zip(rows, X_TG[known], strict=False)):
            if k < HANDS:
                points, normals, forces = (
                    table[name][row].astype(float) for name in ("p_TQ", "nhat_Q_T", "f_Q_T")
                )
                states[f"trial {table['trial_id'][row]}"] = {
                    "links": hand.poses(X, table["q"][row].astype(float), 0.0),
                    "contacts": contacts_in_table(points, normals, forces, np.eye(4)),
                }
            colour = self._holds(row)[2]
            palms.append({"p": X[:3, 3].tolist(), "z": X[:3, 2].tolist(), "colour": colour})
        states = states or {"no grasp": {"links": [], "contacts": []}}
        scene = make_scene(self.snapshot, int(self.table.object[i]), X_TO, states, hand)
        return scene | {"palms": palms}
