"""Scenes of a dataset on the page: its scenes.hdf5 to train on, and its clutter.hdf5."""

from __future__ import annotations

from collections import Counter
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.clutter import surroundings_in
from drakegrasp.dataset.hdf5 import validate_codes
from drakegrasp.dataset.paths import CLUTTER_FILE, SCENES_FILE
from drakegrasp.dataset.scenes import SceneDataset, validate_state
from drakegrasp.dataset.schema import (
    HITS_NOTHING,
    HITS_TABLE,
    NO_OBJECT,
    NOT_TRIED,
    SPLITS,
    VIEW_KINDS,
)
from drakegrasp.errors import DataError
from drakegrasp.frames import unpack_pose
from drakegrasp.mesh.surfaces import convex_hull
from drakegrasp.objects.surroundings import BUILT_IN
from drakegrasp.outcomes import Outcome
from drakegrasp.page.gallery import Gallery, Places, Query
from drakegrasp.page.renders import (
    ARROW,
    HandView,
    columns_of,
    contacts_in_table,
    dots_of,
    make_scene,
)
from drakegrasp.page.snapshot import Snapshot
from drakegrasp.pictures.style import INSTANCE_COLOURS, REACHED, TRUE, beside_instances, colour_png
from drakegrasp.table import Table

Rows = npt.NDArray[np.int64]
#: Maximum number of palms in the 3D view, number of these with a hand, and number of grasps of
#: which words tell what happened.
PALMS, HANDS, TOLD = 100, 8, 40
#: Choice of all surroundings that are not built in.
OWN = "own"
#: Length of the line along +Gz from a palm's origin on an image [m].
PALM = 0.06
#: Display of a grasp by its labels: the words, their style class, and the colour of its palm.
HOLDS, FAILS, UNKNOWN = (
    ("holds", "lifted", TRUE),
    ("fails", "failed", REACHED),
    ("is not tested", "", "#F0E442"),
)
CLEAN, KEPT, NOT_KEPT, FREE, HITS = (
    ("is kept and moves no neighbour", "lifted", TRUE),
    ("is kept", "lifted", "#56B4E9"),
    ("is not kept", "failed", REACHED),
    ("is free, but not tried", "", "#F0E442"),
    ("is not free", "", "#555B63"),
)


class Scenes(Gallery):
    """All scenes of a dataset.

    Args:
        snapshot: State of the other files of the dataset.

    Attributes:
        FILE: Name of the file of the scenes.
        VIEWS: Folder of the addresses of their views.
        PANELS: Number of images side by side in the picture of a view.
        LABELS: Labels by which grasps are counted; earlier ones make a grasp better.

    Raises:
        DataError: If the file cannot be read, or belongs to another dataset.
    """

    HOME, ROW, NOUN = "/scenes", "scene", "scene"
    FILE, VIEWS, PANELS = SCENES_FILE, "/view", 1
    LABELS: ClassVar[tuple[str, ...]] = ("kept", "lifted", "tested")
    CHOICES: ClassVar = {"split": SPLITS}
    SELECTS: ClassVar = {name: name for name in ("class", "object", "split")}
    SORTS: ClassVar = {
        "kept": "samples",
        "lifted": "grasps that hold",
        "tested": "tested grasps",
        "grasps": "grasps",
        "row": "row of the file",
    }
    KINDS: ClassVar[tuple[tuple[str, str, str], ...]] = (HOLDS, FAILS, UNKNOWN)

    def __init__(self, snapshot: Snapshot) -> None:
        path = snapshot.out / self.FILE
        validate_state(path, snapshot.trials)
        data = SceneDataset(path, points=None)
        scenes, grasps, views = (data.tables[name] for name in ("scenes", "grasps", "views"))
        validate_codes(path, "/grasps/outcome", grasps["outcome"], [*Outcome, NOT_TRIED])
        validate_codes(path, "/grasps/trial_id", grasps["trial_id"], snapshot.table.count)
        validate_codes(path, "/views/kind", views["kind"], len(VIEW_KINDS))
        there = scenes["object"] != NO_OBJECT
        if not np.isfinite(scenes["X_TO"][there]).all():
            raise DataError(f"{path}: /scenes/X_TO must be finite, got other numbers")
        if others := set(data.names) - set(snapshot.names):
            raise DataError(f"{path}: must be of objects of {snapshot.out}, got {min(others)}")

        # Numbers of grasps in each scene, in all and by their labels, and of views.
        self.snapshot, self.data = snapshot, data
        self.labels = {name: self._label(name) for name in self.LABELS}
        of = {name: grasps["scene"][has] for name, has in self.labels.items()}
        of |= {"grasps": grasps["scene"], "views": views["scene"]}
        numbers = np.array([snapshot.names.index(name) for name in data.names], dtype=np.int32)
        self.objects = np.where(there, numbers[scenes["object"]], NO_OBJECT)
        self.table = Table(
            {name: np.bincount(rows, minlength=len(scenes["split"])) for name, rows in of.items()},
            object=self.objects[:, 0],
            split=scenes["split"],
            resting=scenes["resting"][:, 0],
        )

    def views(self, scene: int) -> Rows:
        """Return the rows of a scene's views."""
        return np.flatnonzero(self.data.tables["views"]["scene"] == scene)

    def grasps(self, scene: int) -> Rows:
        """Return the rows of a scene's grasps, those with the first labels first."""
        rows = self.data.rows_in(scene)
        lacks = [~self.labels[name][rows] for name in reversed(self.LABELS)]
        return rows[np.lexsort(lacks)]

    def picture(self, view: int) -> bytes:
        """Return the picture of a view, as a PNG."""
        return colour_png(self.data.stored_images(view)[0])

    def _label(self, name: str) -> npt.NDArray[np.bool_]:
        """Return which grasps have a label."""
        return self.data.tables["grasps"][name]

    def of_objects(self, wanted: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return which scenes have one of some objects."""
        return (wanted[self.objects] & (self.objects != NO_OBJECT)).any(axis=1)

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
            "kinds_of_palms": self.KINDS,
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
            "href": f"{self.VIEWS}/{i}-{k}.png",
            "size": self.data.image_size,
            "panels": self.PANELS,
            "kind": VIEW_KINDS[self.data.tables["views"]["kind"][view]],
            "dots": [dot for dot in dots if np.isfinite(dot).all()],
            "palm": [dot for dot in palm if np.isfinite(dot).all()],
        }

    def _visible(self, i: int, grasps: Rows) -> npt.NDArray[np.bool_]:
        """Return which contacts (v, g, k) of some grasps (g,) each view (v,) sees."""
        places, views = grasps - self.data.rows_in(i)[:1], self.views(i).tolist()
        return np.array([self.data.visible_in(view)[places] for view in views])

    def _name(self, i: int, row: int) -> str:
        """Return the name of a grasp in its scene."""
        return f"trial {self.data.tables['grasps']['trial_id'][row]}"

    def _holds(self, row: int) -> tuple[str, str, str]:
        """Return the display of a grasp by its labels, one of KINDS."""
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
                states[self._name(i, row)] = {
                    "links": hand.poses(X, table["q"][row].astype(float), 0.0),
                    "contacts": contacts_in_table(points, normals, forces, np.eye(4)),
                }
            colour = self._holds(row)[2]
            palms.append({"p": X[:3, 3].tolist(), "z": X[:3, 2].tolist(), "colour": colour})
        states = states or {"no grasp": {"links": [], "contacts": []}}
        scene = make_scene(self.snapshot, int(self.table.object[i]), X_TO, states, hand)
        return scene | {"palms": palms}


class Clutter(Scenes):
    """All scenes of several objects of a dataset, with grasps that were tried among neighbours."""

    HOME, ROW = "/clutter", "clutter"
    FILE, VIEWS, PANELS = CLUTTER_FILE, "/instances", 2
    LABELS = ("clean", "kept", "lifted", "tested", "tried", "free")
    KINDS = (CLEAN, KEPT, NOT_KEPT, FREE, HITS)
    CHOICES: ClassVar = {"split": SPLITS, "surroundings": (*BUILT_IN, OWN)}
    SELECTS: ClassVar = {name: name for name in ("class", "object", "split", "surroundings")}
    SORTS: ClassVar = {
        "clean": "clean grasps",
        "kept": "kept grasps",
        "free": "free grasps",
        "grasps": "grasps",
        "row": "row of the file",
    }

    def __init__(self, snapshot: Snapshot) -> None:
        self.around = surroundings_in(snapshot.out / self.FILE)
        super().__init__(snapshot)
        scenes = self.data.tables["scenes"]
        names = np.array([n if n in BUILT_IN else OWN for n in scenes["surroundings"]])
        self.table = self.table.with_columns({name: names == name for name in set(names)})

    def picture(self, view: int) -> bytes:
        """Return the colours of a view beside the masks of its objects, as a PNG."""
        colours, _, mask = self.data.stored_images(view)
        return colour_png(beside_instances(colours, mask))

    def _label(self, name: str) -> npt.NDArray[np.bool_]:
        grasps = self.data.tables["grasps"]
        return grasps["outcome"] != NOT_TRIED if name == "tried" else grasps[name]

    def identity(self, i: int) -> dict[str, Any]:
        """Return how people name a scene, what is in it, and its numbers of grasps."""
        names = [self.snapshot.names[number] for number in self._numbers(i)]
        around = self.data.tables["scenes"]["surroundings"][i]
        return {**super().identity(i), "title": f"scene {i}", "names": names, "around": around}

    def row(self, i: int, hand: HandView) -> dict[str, Any]:
        """Return the content of a scene's page, with its objects and its best grasps."""
        grasps, known = self.data.tables["grasps"], self.grasps(i)
        objects = []
        for k in range(len(self._numbers(i))):
            own = known[grasps["object"][known] == k]
            hits = [self._named(i, hit) for hit in grasps["hit"][own] if hit != HITS_NOTHING]

            # The least and the largest share that a view shows.
            shares = self.data.tables["views"]["visible_share"][self.views(i), k]
            shares = np.sort(shares[np.isfinite(shares)])
            seen = dict.fromkeys(f"{share:.0%}" for share in shares)

            objects.append(
                {
                    "name": self._named(i, k),
                    "colour": INSTANCE_COLOURS[k],
                    "visible": " to ".join([*seen][:: max(len(seen) - 1, 1)]),
                    "grasps": len(own),
                    **{name: int(has[own].sum()) for name, has in self.labels.items()},
                    "hits": Counter(hits).most_common(),
                }
            )

        return {
            **super().row(i, hand),
            "objects": objects,
            "grasps": [self._grasp(i, row) for row in known[:TOLD].tolist()],
        }

    def _numbers(self, i: int) -> list[int]:
        """Return the numbers of the objects of a scene."""
        return [number for number in self.objects[i].tolist() if number != NO_OBJECT]

    def _named(self, i: int, k: int) -> str:
        """Return the name of what a hand intersects first, by its code."""
        if k == HITS_TABLE:
            return "table or wall"
        return self.snapshot.names[self.objects[i, k]] + self._copy(i, k)

    def _copy(self, i: int, k: int) -> str:
        """Return which of several equal objects of a scene one is; empty if it is the only one."""
        same = self.objects[i] == self.objects[i, k]
        return f" ({np.count_nonzero(same[: k + 1])})" if np.count_nonzero(same) > 1 else ""

    def _name(self, i: int, row: int) -> str:
        return super()._name(i, row) + self._copy(i, self.data.tables["grasps"]["object"][row])

    def _grasp(self, i: int, row: int) -> dict[str, Any]:
        """Return what happened to a grasp of a scene, in words."""
        grasp = {name: values[row] for name, values in self.data.tables["grasps"].items()}
        kind, text, moved = self._holds(row), "", ""

        # How it ended, or why it was not tried.
        words = [("free, not tried" if kind is FREE else "not free", "")]
        if kind is HITS:
            text = f"the hand meets {self._named(i, grasp['hit'])}"
        elif kind is not FREE:
            outcome = Outcome(int(grasp["outcome"]))
            words = [(outcome.label.replace("_", " "), "lifted" if grasp["lifted"] else "failed")]
            words += [(name, "lifted") for name in ("kept", "clean") if grasp[name]]
            text = outcome.text

        if np.isfinite(grasp["neighbour_shift"]):
            name, shift = self._named(i, grasp["neighbour"]), 1e3 * grasp["neighbour_shift"]
            moved = f"{name} by {shift:.1f} mm, {np.degrees(grasp['neighbour_turn']):.1f}°"

        return {
            "row": row,
            "trial": int(grasp["trial_id"]),
            "object": self._named(i, grasp["object"]),
            "colour": INSTANCE_COLOURS[grasp["object"]],
            "words": words,
            "text": text,
            "moved": moved,
        }

    def _holds(self, row: int) -> tuple[str, str, str]:
        has = {name: values[row] for name, values in self.labels.items()}
        if has["tried"]:
            return CLEAN if has["clean"] else KEPT if has["kept"] else NOT_KEPT
        return FREE if has["free"] else HITS

    def _scene(self, i: int, grasps: Rows, hand: HandView) -> dict[str, Any]:
        """Return the 3D view, with the neighbours of the first object and the walls."""
        poses = unpack_pose(self.data.tables["scenes"]["X_TO"][i])
        walls = self.around[self.data.tables["scenes"]["surroundings"][i]].walls
        numbers = self._numbers(i)
        return super()._scene(i, grasps, hand) | {
            "colours": list(INSTANCE_COLOURS[: len(numbers)]),
            "others": [
                {"pose": columns_of(X), "mesh": f"/mesh/object-{number}.json"}
                for X, number in zip(poses[1:], numbers[1:], strict=False)
            ],
            "walls": [
                {"vertices": each.vertices.ravel().tolist(), "faces": each.faces.ravel().tolist()}
                for each in (convex_hull(wall.corners) for wall in walls)
            ],
        }
