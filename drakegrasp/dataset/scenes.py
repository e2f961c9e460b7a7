"""Scenes for training, as point clouds or images with grasps; their views as dataset rows.

Predictions for such rows are verified and scored like those for samples. Imports only h5py and
NumPy.

>>> data = SceneDataset("OUT/scenes.hdf5", points=2048)   # doctest: +SKIP
>>> item = data[0]                                        # doctest: +SKIP
>>> item["points"].shape, item["X_AG"].shape              # doctest: +SKIP
((2048, 3), (8, 4, 4))
"""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.dataset.hdf5 import (
    AnyArray,
    ImageRows,
    open_scenes,
    opened,
    read_columns,
    read_texts,
    validate_codes,
)
from drakegrasp.dataset.reader import GraspDataset, emptiness_of
from drakegrasp.dataset.schema import (
    DEPTH_UNIT,
    NO_OBJECT,
    SCENE_GRASP_FIELDS,
    SCENE_TABLES,
    SPLITS,
)
from drakegrasp.dataset.trials import Trials, reopened, stamp
from drakegrasp.errors import DataError
from drakegrasp.foreign_files import parse_json, validate_local
from drakegrasp.frames import X_WT, Frame, invert_pose, pack_pose, unpack_pose
from drakegrasp.grasp import pack_grasp
from drakegrasp.outcomes import LOST, Outcome
from drakegrasp.seeding import Stream
from drakegrasp.vision.camera import DepthSensor, spoil_depth

#: Frames of the grasps of a view.
FRAMES = (Frame.TABLE, Frame.CAMERA)
#: Which failed grasps are drawn: `tested`, lifts that were tried and lost the object; `closed`,
#: these and hands that closed without all fingertips on the object; `none`.
Negatives = Literal["tested", "closed", "none"]
#: Which grasps are drawn as good ones: samples, or all that were lifted.
Positives = Literal["kept", "lifted"]
#: Whether each object is drawn equally often, or each view.
Balance = Literal["object", "view"]
#: Number of points cached for each view, as a multiple of the points of an item.
POOL = 2
#: If there are more pixels than this multiple of the wanted number, each is drawn independently,
#: since few are then drawn twice.
MANY = 8
#: Labels by which grasps are counted.
LABELS = ("tested", "lifted", "kept")
#: Streams of the pixels cached for a view, of the draws for an item, and of two kinds of orders.
_VIEW, _ITEM, _ORDER, _ROUND = 0, 1, 2, 3


class SceneDataset:
    """Views of one split with grasps, as a sequence of items: dictionaries of NumPy arrays.

    An item is a view with some grasps of its scene that are drawn for it: good and bad ones
    alternate. The frame A is {T}, the table's, or {C}, the view's camera. A split without a grasp
    to draw has length 0.

    | key | shape, type | what |
    |---|---|---|
    | `points` | (n, 3) float32 | what the camera sees of object and table, p_AP [m] |
    | `colours` | (n, 3) float32 | their R, G, B in 0..1 |
    | `on_object` | (n,) bool | whether they are on the object |
    | `X_AG`, `X_AG_lifted` | (g, 4, 4) float32 | palm while closing, and after the lift [m] |
    | `q_open`, `q`, `q_lifted` | (g, j) float32 | joints open, closed, after the lift [rad or m] |
    | `p_AQ`, `nhat_Q_A` | (g, k, 3) float32 | contacts after closing [m], outward unit normals |
    | `f_Q_A` | (g, k, 3) float32 | forces of the fingertips after closing [N] |
    | `p_AQ_lifted`, `nhat_Q_A_lifted`, `f_Q_A_lifted` | (g, k, 3) float32 | after the lift |
    | `visible` | (g, k) bool | whether the camera sees the contact after closing |
    | `lifted`, `kept`, `precision`, `stable`, `tested` | (g,) bool | labels, see the schema |
    | `outcome` | (g,) uint8 | see `Outcome` |
    | `robust_kept`, `robust_tried` | (g,) int32 | k of n disturbed repeats, or 0 |
    | `trial_id` | (g,) int64 | row of trials.hdf5 |
    | `X_TC` | (4, 4) float32 | pose of the camera; X_TA is this, or 1 |
    | `X_AO` | (4, 4) float32 | pose of the object |
    | `mass`, `friction_hand`, `friction_table` | () float32 | of the object [kg], coefficients |
    | `view`, `scene`, `object` | () int64 | rows of /views, /scenes, /objects |

    In clutter.hdf5 a scene has up to o objects: `X_AO` is (o, 4, 4), and `mass`, `friction_*` and
    `object` are (o,), NaN and -1 beyond the last one. Grasps are of all objects, and further keys
    tell of each of them:

    | key | shape, type | what |
    |---|---|---|
    | `grasp_object` | (g,) uint8 | index of its object in the scene |
    | `free` | (g,) bool | whether the hand meets nothing else on its way, by geometry |
    | `clean` | (g,) bool | whether it is kept and leaves its neighbours where they are |

    With `points=None` an item has images instead of points: `rgb` (h, w, 3) uint8, `depth` (h, w)
    float32 [m], 0 for pixels without a depth, `mask` (h, w) uint8, 1 + index of the object, and the
    camera matrix `K` (3, 3) float32 [px]. Values that end in `_lifted` are NaN for hands that were
    not tried by a lift, and contacts are NaN for fingers that do not touch.

    Any number of forked or spawned processes may read; none keeps the file open. Each process
    caches points, or images, of the views that it has read. All draws depend only on seed, epoch
    and index.

    Args:
        path: OUT/scenes.hdf5 or OUT/clutter.hdf5.
        points: Number n of points of an item; None for images.
        frame: `table` or `camera`.
        negatives: Bad grasps to draw: `tested`, lifts that were tried and lost the object;
            `closed`, also hands that closed without all fingertips on the object; `none`.
        balance: `object`, so that each object is drawn equally often; `view`, so that each view is.
            A view is one of each object that has a grasp to draw in its scene.
        split: `train`, `valid` or `test`.
        grasps: Number g of grasps of an item. If a scene has fewer, some are repeated.
        positives: Good grasps to draw: `kept`, or `lifted`, whatever the filters decided. A grasp
            that is lifted and not a sample is never drawn as a bad one.
        on_object: Fraction of the points that are on the object, if enough of it is in the image.
        noise: Whether depths get the noise that was drawn for their view, if any was.
        objects: Names of the objects whose grasps are drawn and whose views are items; all if None.
        seed: Seed of all draws.
        cache: Memory for points or images of views, per process [byte]; other views are read again.

    Attributes:
        path: Absolute path of the file, since the working directory may change.
        split, frame: The arguments.
        names, classes: Names and classes of the objects, by row.
        joints, fingers: Names of the hand's joints and fingers, in the order of the arrays.
        views: Rows of /views that can be items: those whose scene has a grasp to draw.
        image_size: Height and width of the images [px].
        near, far: Near and far planes of the cameras [m].
        several: Whether the file has scenes of several objects.
        around: What was asked for in this file, with all surroundings (JSON); else empty.
        tables: Columns of /scenes, /views and /grasps by their names, for all splits; no images.
        epoch: Number of the epoch, on which all draws depend.
        emptiness: What is said of the split if it has no items.

    Raises:
        DataError: If the file is missing, damaged or differs from the schema, or an argument is
            unknown.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        points: int | None = 2048,
        frame: str = Frame.TABLE,
        negatives: Negatives = "tested",
        balance: Balance = "object",
        split: str = "train",
        grasps: int = 8,
        positives: Positives = "kept",
        on_object: float = 0.75,
        noise: bool = True,
        objects: Collection[str] | None = None,
        seed: int = 0,
        cache: int = 512 << 20,
    ) -> None:
        _validate_choice("frame", frame, FRAMES)
        _validate_choice("negatives", negatives, get_args(Negatives))
        _validate_choice("balance", balance, get_args(Balance))
        _validate_choice("positives", positives, get_args(Positives))
        _validate_choice("split", split, SPLITS)
        for name, count in (("points", points), ("grasps", grasps)):
            if count is not None and count < 1:
                raise DataError(f"{name} must be 1 or more, got {count}")
        if not 0.0 <= on_object <= 1.0:
            raise DataError(f"on_object must be 0 to 1, got {on_object}")
        validate_local(path)
        self.path = Path(path).absolute()
        self.split, self.frame, self.epoch = split, frame, 0
        self._points, self._grasps, self._seed = points, grasps, seed
        self._on_object, self._noise, self._cache = on_object, noise, cache
        # Cache by view: images, or the arrays `uv`, `depth`, `rgb` and `mask` of random pixels.
        self._pools: dict[int, dict[str, AnyArray]] = {}
        self._kept = 0

        # Everything except images and surfaces is read now.
        self._stamp = stamp(self.path)
        with open_scenes(self.path) as file:
            self.names, self.classes = (
                read_texts(file["objects"][key]) for key in ("name", "class_name")
            )
            self.tables: Mapping[str, Mapping[str, AnyArray]] = {
                group: read_columns(file[group], fields, [f.name for f in fields if not f.sample])
                for group, fields in SCENE_TABLES.items()
                if group not in ("objects", "visible")
            }
            self._visible = file["visible/visible"][:]
            self.image_size = file["views/mask"].shape[1:]
            self.joints = tuple(parse_json(file.attrs["joints"]))
            self.fingers = tuple(parse_json(file.attrs["fingers"]))
            self.near, self.far = float(file.attrs["near"]), float(file.attrs["far"])
            self.around = str(file.attrs.get("clutter", ""))
            self.several = bool(self.around)
        if objects is not None and (unknown := sorted(set(objects) - set(self.names))):
            raise DataError(f"objects must be of {self.path}, got {unknown[0]!r}")
        self._number()
        self._choose(negatives, positives, objects)
        self.views, self._order = self._order_of(balance)

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, index: int | tuple[int, int]) -> dict[str, AnyArray]:
        """Return an item by its index, or by epoch and index, as `rounds` yields them."""
        epoch, index = index if isinstance(index, tuple) else (self.epoch, operator.index(index))
        if not -len(self) <= index < len(self):
            below = f"index must be below {len(self)}, got {index}"
            raise IndexError(below if len(self) else self.emptiness)
        index %= len(self)

        # The view, and its frame.
        stream = Stream(self._seed, _ITEM, epoch, index)
        view = self._view_of(epoch, index)
        X_TC, scene = self._X_TC[view], self._scene_of[view]
        X_AT = invert_pose(X_TC) if self.frame == "camera" else np.eye(4)

        # Points or images, grasps, and the object.
        if self._points is None:
            item = {name: image.copy() for name, image in self._kept_of(view).items()}
        else:
            item = self._cloud(view, X_AT, stream)
        item |= self._grasps_of(view, self._drawn(scene, stream), X_AT)
        # A scene of one object has no axis of objects.
        of = slice(None) if self.several else 0
        scenes = self.tables["scenes"]
        item |= {
            key: np.asarray(scenes[key][scene, of], dtype=np.float32)
            for key in ("mass", "friction_hand", "friction_table")
        }
        return item | {
            "X_TC": X_TC.astype(np.float32),
            "X_AO": (X_AT @ unpack_pose(scenes["X_TO"][scene, of])).astype(np.float32),
            "view": np.asarray(view, dtype=np.int64),
            "scene": np.asarray(scene, dtype=np.int64),
            "object": np.asarray(scenes["object"][scene, of], dtype=np.int64),
        }

    def __iter__(self) -> Iterator[dict[str, AnyArray]]:
        return (self[i] for i in range(len(self)))

    def __repr__(self) -> str:
        return f"SceneDataset({str(self.path)!r}, split={self.split!r}): {len(self)} views"

    def __getstate__(self) -> dict[str, Any]:
        # Another process has its own cache.
        return {**self.__dict__, "_pools": {}, "_kept": 0}

    def rounds(self, seed: int = 0) -> Rounds:
        """Return a sampler for torch's DataLoader: each round has all items in a new order."""
        return Rounds(self, seed)

    def grasps_in(self, view: int, *, frame: str = Frame.TABLE) -> dict[str, AnyArray]:
        """Return all g grasps of a view's scene, by the keys of an item."""
        _validate_choice("frame", frame, FRAMES)
        X_AT = invert_pose(self._X_TC[view]) if frame == "camera" else np.eye(4)
        return self._grasps_of(view, self.rows_in(self._scene_of[view]), X_AT)

    def grasp_of(self, view: int, stream: Stream) -> dict[str, AnyArray]:
        """Return grasps of a view drawn from a stream, in {C}, with the keys of an item."""
        rows = self._drawn(int(self._scene_of[view]), stream)
        return self._grasps_of(view, rows, invert_pose(self._X_TC[view]))

    def rows_in(self, scene: int) -> npt.NDArray[np.int64]:
        """Return the rows of /grasps of a scene, which are consecutive."""
        return np.arange(*self._bounds[scene : scene + 2])

    def visible_in(self, view: int) -> npt.NDArray[np.bool_]:
        """Return which contacts (g, k) of its scene's grasps a view sees, in their order."""
        first, last = self._first_visible[view : view + 2]
        return self._visible[first:last]

    def surface(self, object: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
        """Return points p_OS (4096, 3) [m] on an object and their unit normals, by its row."""
        with self._opened() as file:
            points, normals = (file["objects"][name][object] for name in ("p_OS", "nhat_S_O"))
        return points, normals

    # Tables

    def _number(self) -> None:
        """Number the rows of /grasps by scene and of /visible by view."""
        views, scenes = self.tables["views"], self.tables["scenes"]
        count = len(scenes["split"])
        for name, shape in (("object", scenes["object"].shape), ("mask", self.image_size)):
            if count and 0 in shape:
                raise DataError(f"{self.path}: {name} must have a value in each row, got none")
        grasps = self.tables["grasps"]
        for name, values, codes in (
            ("/scenes/split", scenes["split"], len(SPLITS)),
            ("/scenes/object", scenes["object"][:, 0], len(self.names)),
            ("/views/scene", views["scene"], count),
            ("/grasps/scene", grasps["scene"], count),
            ("/grasps/object", grasps["object"], scenes["object"].shape[1]),
        ):
            validate_codes(self.path, name, values, codes)
        self._object_of = scenes["object"][grasps["scene"], grasps["object"]]
        validate_codes(self.path, "/grasps/object", self._object_of, len(self.names))

        # The grasps of a scene and the rows of a view are consecutive.
        in_scene = np.bincount(grasps["scene"], minlength=count)
        self._bounds = np.concatenate([[0], np.cumsum(in_scene)])
        self._scene_of = views["scene"]
        of_views = in_scene[self._scene_of]
        self._first_visible = np.concatenate([[0], np.cumsum(of_views)])
        if self._first_visible[-1] != len(self._visible):
            raise DataError(
                f"{self.path}: /visible must have {self._first_visible[-1]} rows, a row for each "
                f"view and grasp of its scene, got {len(self._visible)}"
            )
        self._X_TC = unpack_pose(views["X_TC"])

    def _choose(
        self, negatives: Negatives, positives: Positives, names: Collection[str] | None
    ) -> None:
        """Find the good and bad grasps of each scene, on the named objects."""
        grasps = self.tables["grasps"]
        bad = grasps["tested"] & ~grasps["lifted"]
        if negatives == "closed":
            bad |= grasps["outcome"] == Outcome.MISSING_FINGERTIP
        if negatives == "none":
            bad[:] = False
        good = grasps[positives]
        if names is not None:
            named = np.isin(self.names, sorted(names))[self._object_of]
            good, bad = good & named, bad & named
        self._kinds = []
        for first, last in zip(self._bounds[:-1], self._bounds[1:], strict=True):
            rows = np.arange(first, last)
            self._kinds.append((rows[good[rows]], rows[bad[rows]]))

    def _order_of(self, balance: Balance) -> tuple[AnyArray, AnyArray]:
        """Return the views to draw from, and for each item the index of its object or view."""
        scenes = self.tables["scenes"]
        usable = np.array([len(good) + len(bad) > 0 for good, bad in self._kinds], dtype=bool)
        filled = np.unique(scenes["split"][usable])
        self.emptiness = emptiness_of(self.split, [SPLITS[i] for i in filled])
        usable &= scenes["split"] == SPLITS.index(self.split)
        views = np.flatnonzero(usable[self._scene_of]) if len(usable) else np.zeros(0, np.int64)
        self._balance = balance
        if balance == "view" or not len(views):
            return views, np.arange(len(views))
        graspable = [np.unique(self._object_of[np.concatenate(kinds)]) for kinds in self._kinds]
        objects = [graspable[scene] for scene in self._scene_of[views]]
        self._by_object = [
            views[[i in there for there in objects]] for i in np.unique(np.concatenate(objects))
        ]
        return views, np.arange(len(views)) % len(self._by_object)

    # Draws

    def _view_of(self, epoch: int, index: int) -> int:
        """Return the view of an item: the next one of its object in the epoch's order."""
        if self._balance == "view":
            return int(self.views[index])
        place = int(self._order[index])
        own = self._by_object[place]
        turn, number = divmod(index // len(self._by_object), len(own))
        order = Stream(self._seed, _ORDER, epoch, place, turn).permutation(len(own))
        return int(own[order[number]])

    def _drawn(self, scene: int, stream: Stream) -> npt.NDArray[np.int64]:
        """Return rows (g,) of /grasps: good and bad ones alternate."""
        good, bad = self._kinds[scene]
        u = stream.uniform(self._grasps)
        rows = np.empty(self._grasps, dtype=np.int64)
        is_good = np.arange(self._grasps) % 2 == 0 if len(good) and len(bad) else len(good) > 0
        is_good = np.broadcast_to(is_good, self._grasps)
        if len(good):
            rows[is_good] = good[(u[is_good] * len(good)).astype(np.int64)]
        if len(bad):
            rows[~is_good] = bad[(u[~is_good] * len(bad)).astype(np.int64)]
        return rows

    def _grasps_of(self, view: int, rows: AnyArray, X_AT: Array) -> dict[str, AnyArray]:
        """Return the values of some grasps of a view's scene."""
        grasps = self.tables["grasps"]
        R_TA = X_AT[:3, :3].T
        first = self._first_visible[view] - self._bounds[self._scene_of[view]]
        found = {key: grasps[key][rows] for key in _AS_STORED}
        if self.several:
            found |= {key: grasps[key][rows] for key in ("free", "clean")}
            found["grasp_object"] = grasps["object"][rows]
        found["visible"] = self._visible[first + rows]
        for suffix in ("", "_lifted"):
            X_TG = unpack_pose(grasps[f"X_TG{suffix}"][rows])
            points, normals, forces = (
                grasps[f"{name}{suffix}"][rows] for name in ("p_TQ", "nhat_Q_T", "f_Q_T")
            )
            found[f"X_AG{suffix}"] = (X_AT @ X_TG).astype(np.float32)
            found[f"p_AQ{suffix}"] = (points @ R_TA + X_AT[:3, 3]).astype(np.float32)
            found[f"nhat_Q_A{suffix}"] = (normals @ R_TA).astype(np.float32)
            found[f"f_Q_A{suffix}"] = (forces @ R_TA).astype(np.float32)
        return found

    # Images and points

    def _cloud(self, view: int, X_AT: Array, stream: Stream) -> dict[str, AnyArray]:
        """Return the points of an item: a random run of consecutive points in the view's cache."""
        pool, n = self._kept_of(view), self._points or 0
        rows = (int(stream.integers(len(pool["uv"]), 1)[0]) + np.arange(n)) % len(pool["uv"])
        f_u, f_v, c_u, c_v = self.tables["views"]["K"][view][[0, 4, 2, 5]].astype(np.float32)
        z, uv = pool["depth"][rows], pool["uv"][rows].astype(np.float32)
        p_CP = np.column_stack([z * (uv[:, 0] - c_u) / f_u, z * (uv[:, 1] - c_v) / f_v, z])
        X_AC = (X_AT @ self._X_TC[view]).astype(np.float32)
        return {
            "points": p_CP @ X_AC[:3, :3].T + X_AC[:3, 3],
            "colours": pool["rgb"][rows] / np.float32(255.0),
            "on_object": pool["mask"][rows] > 0,
        }

    def _kept_of(self, view: int) -> dict[str, AnyArray]:
        """Return the cached images or pixels of a view, which are read when first needed.

        The caller must not change them.
        """
        if view in self._pools:
            return self._pools[view]
        kept = self.images(view)
        if self._points is not None:
            pixels = self._pixels(kept["depth"], kept["mask"], POOL * self._points, view)
            v, u = np.divmod(pixels, kept["depth"].shape[1])
            kept = {name: kept[name][v, u] for name in ("depth", "rgb", "mask")}
            kept["uv"] = np.column_stack([u, v]).astype(np.uint16)
        size = sum(array.nbytes for array in kept.values())
        if self._kept + size <= self._cache:
            self._pools[view] = kept
            self._kept += size
        return kept

    def _pixels(
        self, depth: AnyArray, mask: AnyArray, count: int, view: int
    ) -> npt.NDArray[np.int64]:
        """Return pixels (count,) with a depth, in random order, repeated if there are too few.

        Raises:
            DataError: If no pixel has a depth.
        """
        stream, has_depth = Stream(self._seed, _VIEW, view), depth > 0.0
        own = np.flatnonzero(has_depth & (mask > 0))
        others = np.flatnonzero(has_depth & (mask == 0))
        if not len(own) + len(others):
            raise DataError(f"{self.path}: view {view} must have a pixel with a depth, got none")
        wanted = round(self._on_object * count) if len(others) else count
        wanted = wanted if len(own) else 0
        chosen = [
            pixels[_choice(stream, len(pixels), number)]
            for pixels, number in ((own, wanted), (others, count - wanted))
            if number
        ]
        return np.concatenate(chosen)[stream.permutation(count)]

    def images(self, view: int) -> dict[str, AnyArray]:
        """Return the images of a view and its camera matrix, by the keys of an item."""
        views, (rgb, stored, mask) = self.tables["views"], self.stored_images(view)
        depth, K = stored * np.float32(DEPTH_UNIT), views["K"][view].reshape(3, 3)
        noise = float(views["depth_noise"][view])
        if self._noise and noise:
            sensor = DepthSensor(noise=noise, seed=int(views["depth_seed"][view]))
            depth = spoil_depth(depth, K, sensor, 0, self)
        return {"rgb": rgb, "depth": depth, "mask": mask, "K": K.astype(np.float32)}

    def stored_images(self, view: int) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return the images of a view as stored in the file.

        Returns:
            Colours (h, w, 3) uint8, clean depth (h, w) uint16 [DEPTH_UNIT], mask (h, w) uint8.
        """
        with self._opened() as file:
            rgb, depth, mask = (
                ImageRows(file["views"][name])[view] for name in ("rgb", "depth", "mask")
            )
        return rgb, depth, mask

    def _opened(self) -> Any:
        """Open the file, which must be the file that the tables were read from."""
        return reopened(self.path, self._stamp, "the scenes of a dataset")


def count_scenes(tables: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Return, for each split, the numbers of scenes, objects, views and grasps.

    Args:
        tables: Columns of /scenes, /views and /grasps: an open file, or `SceneDataset.tables`.
    """
    scenes, grasps = tables["scenes"], tables["grasps"]
    split, objects = scenes["split"][:], scenes["object"][:]
    of_views, of_grasps = split[tables["views"]["scene"][:]], split[grasps["scene"][:]]
    return {
        name: {
            "scenes": int((split == i).sum()),
            "objects": len(np.unique(objects[(split == i)[:, None] & (objects != NO_OBJECT)])),
            "views": int((of_views == i).sum()),
            "grasps": int((of_grasps == i).sum()),
            **{label: int(grasps[label][:][of_grasps == i].sum()) for label in LABELS},
        }
        for i, name in enumerate(SPLITS)
    }


def _choice(stream: Stream, among: int, count: int) -> npt.NDArray[np.int64]:
    """Return `count` random indices below `among`.

    They are distinct, unless `among` is less than `count` or more than `MANY * count`.
    """
    if among > MANY * count:
        return stream.integers(among, count)
    return stream.permutation(max(count, among))[:count] % among


class Rounds:
    """All items of a dataset in a random order, with the epoch, which increases with each round.

    The epoch is part of the index, so it reaches persistent workers, which keep their caches.
    """

    def __init__(self, data: SceneDataset, seed: int) -> None:
        self.data, self.epoch, self._seed = data, data.epoch, seed

    def __len__(self) -> int:
        return len(self.data)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        epoch, self.epoch = self.epoch, self.epoch + 1
        order = Stream(self._seed, _ROUND, epoch).permutation(len(self))
        return ((epoch, index) for index in order.tolist())


#: Fields of /grasps that items contain unchanged.
_AS_STORED = (
    *("q_open", "q", "q_lifted", "lifted", "kept", "precision", "stable", "tested", "outcome"),
    *("robust_kept", "robust_tried", "trial_id"),
)


def _validate_choice(name: str, value: object, known: tuple[str, ...]) -> None:
    if value not in known:
        raise DataError(f"{name} must be one of {', '.join(known)}, got {value!r}")


Columns = dict[str, AnyArray]

#: Outcomes of lifts to a verdict; a `table_contact` while closing is not one of these lifts.
TRIED = (Outcome.SUCCESS, *LOST, Outcome.TABLE_CONTACT)
#: Columns of /trials that /grasps copies, by their names in /grasps.
_COPIED = {f.name: f.of for f in SCENE_GRASP_FIELDS if f.of} | {
    name: name for name in ("trial_id", "outcome", "precision", "stable", "preshape", "unused")
}
#: Columns of /trials from which grasps of scenes follow.
GRASPS_FOLLOW_FROM = (
    *dict.fromkeys(_COPIED.values()),
    *("candidate", "standoff_index", "resting", "spread", "time_lift"),
    *("X_OG", "X_OG_lifted"),
    *(f"{when}_{name}" for when in ("closed", "lifted") for name in ("p_OQ", "nhat_Q_O", "f_Q_O")),
)
#: Name of the camera of rows of scenes.
CAMERA = "view"
#: First number of the key of the streams that choose the own grasps of rows.
_OWN = 4


def open_rows(path: Path, *, split: str, fewer_fingers: bool = False) -> GraspDataset:
    """Return a split of a data file or of a file of scenes, depending on the content of the file.

    Args:
        path: The file.
        split: Its split.
        fewer_fingers: Whether a data file may have samples that leave fingers out.

    Raises:
        DataError: See `GraspDataset` and `SceneDataset`.
    """
    if holds_scenes(path):
        return SceneRows(path, split=split)
    return GraspDataset(path, split=split, fewer_fingers=fewer_fingers)


def holds_scenes(path: Path) -> bool:
    """Return whether a file of a dataset holds scenes; otherwise it is a data file.

    Raises:
        DataError: If the file is missing or damaged.
    """
    with opened(path, "a data file or scenes of drakegrasp") as file:
        return "scenes" in file


def grasps_of_trials(trials: Mapping[str, AnyArray], X_TO: Array, samples: AnyArray) -> Columns:
    """Return the columns of /grasps that follow from trials, at the poses of their objects.

    Args:
        trials: Columns of n trials, by GRASPS_FOLLOW_FROM.
        X_TO: Poses of the trials' objects in the scenes, (n, 4, 4).
        samples: (n,), whether each trial is a sample.
    """
    outcome, R_OT = trials["outcome"], np.swapaxes(X_TO[:, :3, :3], 1, 2)
    columns = {name: trials[of] for name, of in _COPIED.items()}
    columns |= {
        "tested": np.isin(outcome, TRIED) & np.isfinite(trials["time_lift"]),
        "lifted": outcome == Outcome.SUCCESS,
        "kept": samples,
    }
    for suffix, when, X_OG in (("", "closed", "X_OG"), ("_lifted", "lifted", "X_OG_lifted")):
        columns[f"X_TG{suffix}"] = pack_pose(multiply(X_TO, unpack_pose(trials[X_OG])))
        points, normals, forces = (trials[f"{when}_{n}"] for n in ("p_OQ", "nhat_Q_O", "f_Q_O"))
        columns[f"p_TQ{suffix}"] = multiply(points, R_OT) + X_TO[:, None, :3, 3]
        columns[f"nhat_Q_T{suffix}"] = multiply(normals, R_OT)
        columns[f"f_Q_T{suffix}"] = multiply(forces, R_OT)
    return columns


class SceneRows(GraspDataset):
    """The views of a split as rows, with what scoring and verification need of `GraspDataset`.

    A row is a view of a scene that has a sample, in the order of `SceneDataset.views` with
    `negatives="none"`. The row's own grasp is one of these samples.
    Everything is in the view's camera frame. Verdicts are for the object where it rested in its
    trials, so the camera (`frame_work2cam_view`) is turned and moved back with the object.

    In scenes of several objects, a row has a grasp that is kept in its scene, and the object of
    this grasp, which the view must show. Verdicts are for the object where it is in its scene.

    Args:
        path: OUT/scenes.hdf5 or OUT/clutter.hdf5; OUT/trials.hdf5 must be in the same folder.
        split: `train`, `valid` or `test`.

    Attributes:
        views: (n,), rows of /views.
        several: Whether the scenes have several objects.
        scenes, places: (n,), rows of /scenes, and indices of the objects in them.

    Raises:
        DataError: If a file is missing or damaged, if the files belong to different states of the
            dataset, or if a sample leaves fingers out.
    """

    def __init__(self, path: str | Path, *, split: str = "train") -> None:
        self.path, self.split, self.camera = Path(path).absolute(), split, CAMERA
        self._file: h5py.File | None = None
        self._fields, self._process = {}, -1
        self._data = data = SceneDataset(
            path, points=None, split=split, negatives="none", balance="view", grasps=1
        )
        self.emptiness, self.several = data.emptiness, data.several
        trials, views = Trials(self.path.parent), data.tables["views"]
        validate_state(self.path, trials)

        # The own grasp of each view that shows its object, and the trial of this grasp.
        rows, grasps = list[tuple[int, int, int]](), list[Array]()
        for view in data.views.tolist():
            own = data.grasp_of(view, Stream(0, _OWN, view))
            place = int(own["grasp_object"][0]) if data.several else 0
            if not data.several or views["visible_share"][view, place] > 0.0:
                rows.append((view, place, own["trial_id"][0]))
                grasps.append(pack_grasp(own["p_AQ"][0], own["nhat_Q_A"][0]))
        self.views, self.places, ids = np.array(rows, dtype=np.int64).reshape(-1, 3).T
        self._length = len(self.views)
        validate_codes(self.path, "/grasps/trial_id", ids, len(trials))
        numbers = 6 * data.tables["grasps"]["p_TQ"].shape[1]
        packed = np.array(grasps, dtype=np.float32).reshape(-1, numbers)
        if not np.isfinite(packed).all():
            raise DataError(
                f"{path}: {split} must have contacts of all fingers, got samples that leave some "
                "out: commands need a hand whose preshapes close all fingers"
            )

        of = self.scenes, self.places = views["scene"][self.views], self.places
        scenes = data.tables["scenes"]
        objects = scenes["object"][of]
        needed = ("X_TO", "X_OG", "mass", "friction_hand", "friction_table")
        trial = trials[ids].columns(needed)
        # An object alone counts as if it had stayed where it rested, and the camera with it.
        stood, X_TC = unpack_pose(scenes["X_TO"][of]), unpack_pose(views["X_TC"][self.views])
        X_TO, X_OC = unpack_pose(trial["X_TO"]), multiply(invert_pose(stood), X_TC)
        conditions: Mapping[str, AnyArray] = trial
        if data.several:
            X_TO = stood
            conditions = {name: scenes[name][of] for name in needed[2:]}
        self._columns: dict[str, npt.NDArray[Any]] = {
            "grasps": packed,
            "trial_id": ids,
            "grasp_props/resting": scenes["resting"][of],
            "grasp_props/X_CG": pack_pose(multiply(invert_pose(X_OC), unpack_pose(trial["X_OG"]))),
            "object_props/object_name": np.array(data.names, dtype=object)[objects],
            "object_props/class_name": np.array(data.classes, dtype=object)[objects],
            "object_props/work2mass": conditions["mass"][:, None],
            f"object_props/frame_work2cam_{CAMERA}": pack_pose(multiply(X_TO, X_OC)),
            "object_props/frame_world2work": np.tile(pack_pose(X_WT), (self._length, 1)),
            "object_props/frame_world2obj": pack_pose(multiply(X_WT, X_TO)),
            "conditions/friction_hand": conditions["friction_hand"],
            "conditions/friction_table": conditions["friction_table"],
        }

        # All cameras share one lens.
        self.K = views["K"][0].reshape(3, 3)
        digest = hashlib.sha256(str(trials.attributes["signature"]).encode())
        told = [ids, self.views, views["X_TC"][self.views]]
        if data.several:
            told += [scenes["object"], scenes["X_TO"]]
            digest.update(data.around.encode())
        for values in told:
            digest.update(np.ascontiguousarray(values).tobytes())
        self.content = digest.hexdigest()

    def column(self, name: str) -> npt.NDArray[Any]:
        """Return all rows (n, ...) of a field that scoring needs.

        Raises:
            DataError: If there is no such field; images are read one by one.
        """
        if name not in self._columns:
            known = ", ".join(self._columns)
            raise DataError(f"field of a row of scenes must be one of {known}, got {name!r}")
        return self._columns[name]

    def rows(self, name: str, start: int, stop: int) -> npt.NDArray[Any]:
        """Return the rows `start` to `stop` - 1 of a field, see `column`."""
        return self.column(name)[start:stop]

    def value(self, name: str, row: int) -> Any:
        """Return a field of one row; `images` (4, h, w) and `masks` (h, w) as in data files.

        Raises:
            DataError: See `column`.
        """
        if name not in ("images", "masks"):
            return self.column(name)[row]
        seen = self._data.images(int(self.views[row]))
        if name == "masks":
            return (seen["mask"] == self.places[row] + 1).astype(np.uint8)
        depth = np.where(seen["depth"] > 0.0, seen["depth"], np.float32(self._data.far))
        colour = np.moveaxis(seen["rgb"], 2, 0) / np.float32(255.0)
        return np.concatenate([colour, depth[None]])


def validate_state(path: Path, trials: Trials) -> None:
    """Raise an error if a file of scenes was made from other trials.

    Raises:
        DataError: If it was made from other trials, or cannot be read.
    """
    with opened(path, "the scenes of a dataset") as file:
        for key in ("shards", "signature"):
            if str(file.attrs.get(key)) != str(trials.attributes.get(key)):
                raise DataError(
                    f"{path}: must be of the trials in its folder, got other scenes; run "
                    f"`drakegrasp {path.stem}` again"
                )
