"""Networks that come with the package: from what a camera saw to grasps, the best first.

Input: an object's visible points in {T}, where the table is z = 0, or the views of scenes. Output:
`Attempts` with a confidence, which `exchange.attempts.write_attempts` writes, a robot executes, a
build tries and a score judges. A network proposes grasps (`scoring.proposals`) and orders them
(`scoring.ranking`) by its judge (`scoring.judge`). It needs no torch.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.scenes import SceneDataset
from drakegrasp.errors import GraspError, TooLittleSeenError
from drakegrasp.frames import invert_pose, unpack_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.files import hand_names
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.scoring.judge import Judge, judge_names, load_judge
from drakegrasp.scoring.proposals import propose
from drakegrasp.scoring.ranking import rank
from drakegrasp.simulation.attempts import Attempts, join_attempts
from drakegrasp.vision.depth_image import cloud_from_depth

#: The network that is used if none is named.
DEFAULT = "barrett-1"
#: What no network of this kind knows.
LIMITS = (
    "it sees one object alone on a table, from one side; it knows neither friction nor mass, nor "
    "other objects, nor the arm; it was trained in simulation and never tried on a robot"
)
#: What the file of a judge states for programs only.
_FOR_PROGRAMS = ("features", "fingerprint")


@dataclass(frozen=True, kw_only=True, eq=False)
class GraspNetwork:
    """A network for one hand, made by `load_network`.

    Attributes:
        name: Its name.
        hand: The hand that it is for.
        judge: Its judge, which orders the proposals.
    """

    name: str
    hand: Hand
    judge: Judge

    @property
    def card(self) -> str:
        """What it was trained on, the hash of the data, its scores, its limits and its licence."""
        stated = {k: v for k, v in self.judge.about.items() if k not in _FOR_PROGRAMS}
        stated["limits"] = LIMITS
        return "\n".join(f"{name}: {_words(value)}" for name, value in stated.items())

    def predict(
        self, cloud: npt.ArrayLike, name: str = "seen", count: int | None = None
    ) -> Attempts:
        """Return grasps for what a camera saw of an object, the best first.

        Args:
            cloud: (n, 3), points of the object only, in {T} [m]; the table is z = 0. Of a depth
                image: `cloud_from_depth`.
            name: Name of the object in the table.
            count: Maximum number of grasps; None for all that were proposed.

        Returns:
            Postures in the frame "table", with their `confidence`: the chance that the grasp would
            be a sample of a dataset.

        Raises:
            GraspError: If the cloud is invalid, or `count` is less than 1.
        """
        if count is not None and count < 1:
            raise GraspError(f"count must be 1 or more, got {count}")
        proposals = propose(cloud, self.hand, name=name)
        ranking = rank(proposals, cloud, self.hand, judge=self.judge)
        order = ranking.order[:count]
        chosen = proposals.at(order.tolist())
        return replace(chosen, confidence=ranking.score[order], row=np.arange(len(order)))


def load_network(name_or_path: str | Path = DEFAULT) -> GraspNetwork:
    """Return a network that comes with the package, or that of a file.

    Args:
        name_or_path: A name, e.g. "barrett-1", or the path of a file of weights (.npz).

    Raises:
        GraspError: If there is no such network, or the file is not one.
        HandError: If the hand has changed since the network was trained.
    """
    if str(name_or_path) not in (names := judge_names()) and not Path(name_or_path).is_file():
        raise GraspError(
            f"network must be one of {', '.join(names)}, or a file of weights (.npz), "
            f"got {str(name_or_path)!r}"
        )
    judge = load_judge(name_or_path)
    # A hand's name could be the path of any file.
    if (name := judge.about["hand"]) not in hand_names():
        raise GraspError(
            f"{name_or_path}: must be for a hand of {', '.join(hand_names())}, got {name!r}"
        )
    hand = load_hand(name)
    judge.refuse_other_hand(hand)
    return GraspNetwork(name=judge.name, hand=hand, judge=judge)


def _words(value: Any) -> str:
    """Return a value of a card as text."""
    if isinstance(value, dict):
        return "; ".join(f"{name} {_words(each)}" for name, each in value.items())
    return str(value)


def predict_scenes(
    network: GraspNetwork,
    path: Path,
    *,
    split: str = "test",
    count: int | None = None,
    execute: Executor = run_here,
    report: Report = silent,
) -> tuple[Attempts, int]:
    """Return the grasps of a network for all views of a split, in the frames of their objects.

    The rows of the views are those of `drakegrasp score`, see `dataset.scenes.SceneRows`.

    Args:
        network: The network.
        path: OUT/scenes.hdf5.
        split: `train`, `valid` or `test`.
        count: Maximum number of grasps of a view; None for all.
        execute: Executor of the views.
        report: Called after each view.

    Returns:
        Postures with the row that each is for (`of_row`), its resting pose and its confidence; and
        the number of views that show too little of their object for any.

    Raises:
        DataError: If the file cannot be used.
        GraspError: If the scenes are of another hand, or no view yields a posture, or a view is
            invalid.
    """
    data = SceneDataset(path, points=None, split=split, negatives="none", balance="view", grasps=1)
    if not len(data):
        raise GraspError(f"{path}: {data.emptiness}")
    hand = load_hand(read_manifest(data.path.parent).config.hand_source)
    if hand.name != network.hand.name:
        raise GraspError(
            f"{path}: must be scenes of the hand {network.hand.name}, as the network "
            f"{network.name}, got {hand.name}"
        )

    predict = partial(_predict_view, network, count)
    tables = list[Attempts]()
    for row, table in enumerate(in_order(execute)(predict, _views(data))):
        if table is not None:
            tables.append(replace(table, of_row=np.full(len(table), row)))
        report(row + 1, len(data))
    if not tables:
        raise GraspError(
            f"{path}: must have views with a sample in {split} that show their object, got "
            f"{len(data)} views"
        )
    return join_attempts(tables), len(data) - len(tables)


@dataclass(frozen=True, kw_only=True, eq=False)
class _View:
    """A view of a scene: its object with resting pose and pose X_TO (4, 4), and images."""

    name: str
    resting: int
    X_TO: Array
    depth: npt.NDArray[np.float32]
    K: Array
    mask: npt.NDArray[np.uint8]
    X_TC: Array


def _views(data: SceneDataset) -> Iterator[_View]:
    """Yield the views of a dataset in the order of its rows."""
    views, scenes = data.tables["views"], data.tables["scenes"]
    for view in data.views.tolist():
        scene, seen = views["scene"][view], data.images(view)
        yield _View(
            name=data.names[scenes["object"][scene, 0]],
            resting=int(scenes["resting"][scene, 0]),
            X_TO=unpack_pose(scenes["X_TO"][scene, 0]),
            depth=seen["depth"],
            K=seen["K"],
            mask=seen["mask"],
            X_TC=unpack_pose(views["X_TC"][view]),
        )


def _predict_view(network: GraspNetwork, count: int | None, view: _View) -> Attempts | None:
    """Return grasps for a view in {O}; None if it shows too little of its object.

    Raises:
        GraspError: If the view is invalid.
    """
    try:
        cloud = cloud_from_depth(view.depth, view.K, view.mask, view.X_TC)
        found = network.predict(cloud, view.name, count)
    except TooLittleSeenError:
        return None
    except GraspError as error:
        raise GraspError(f"a view of {view.name}: {error}") from None
    return replace(
        found,
        X_FG=multiply(invert_pose(view.X_TO), found.X_FG),
        frame="object",
        resting=np.full(len(found), view.resting),
    )
