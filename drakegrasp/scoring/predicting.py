"""Predictions: from what a camera saw to grasps, the best first. No network is needed.

Input: an object's visible points in {T}, where the table is z = 0, or the views of scenes. Output:
a `GraspTable`, which `exchange.attempts.write_attempts` writes, a robot executes, a build tries and
a score judges. `propose` puts palms around the points, the fixed ones of `simulation.palms`, which
the sampler `closing` also tries on whole objects; `predict` orders them (`scoring.ranking`) and
states a confidence.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import Config
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.scenes import SceneDataset, SceneRows
from drakegrasp.errors import GraspError, TooLittleSeenError
from drakegrasp.foreign_files import parse_json
from drakegrasp.frames import invert_pose, unpack_pose
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.settings import override_config
from drakegrasp.mesh.cloud import hull_solid, read_cloud
from drakegrasp.objects.surroundings import Neighbourhood, Wall, surroundings_of
from drakegrasp.reach.arm import Arm
from drakegrasp.runtime.executor import Executor, in_order, run_here
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.scoring.ranking import Ranking, chosen_hand, rank, seen_neighbours
from drakegrasp.simulation.attempts import UNTOLD, GraspTable, join_attempts, make_attempts
from drakegrasp.simulation.closing import closing_positions
from drakegrasp.simulation.palms import Palms
from drakegrasp.vision.depth_image import View, cloud_from_depth


def propose(
    cloud: npt.ArrayLike, hand: Hand | str | None = None, *, name: str = "seen"
) -> GraspTable:
    """Return 30 to 70 grasps for what a camera saw, the simplest first.

    The smallest rectangle around the points, seen from above, has a long side. The first palm looks
    down on its centre and closes across the narrow side, as deep as the table and the hand's
    smallest stand-off allow. The other palms from above are turned, higher or deeper by 20 mm,
    shifted along the long side, tilted by 25 degrees, or have another spread. Then follow palms
    from all sides, slanted by 55 degrees or horizontal, which close across the vertical. No two
    palms of one spread are within 8 mm and 12 degrees.

    Args:
        cloud: (n, 3), points of the object only, in {T} [m]; the table is z = 0.
        hand: A hand, or an argument of `load_hand`; None for the default hand. Of a hand with
            preshapes, the first preshape is used.
        name: Name of the object in the table.

    Returns:
        Postures in the frame "table". The pregrasp is the open hand, and the grasp has closed on
        the points.

    Raises:
        GraspError: If the cloud is invalid.
        HandError: If the hand cannot be used, or several of its fingers move one link.
    """
    points, hand = read_cloud(cloud), chosen_hand(hand)
    preshape = hand.preshape_names[0] if hand.preshapes else None
    shaped = hand.at(0)
    palms = Palms(points, shaped).fixed()

    # Close the hand on the points, with one spread at a time.
    solid = hull_solid(points)
    names, count = shaped.joint_order, len(palms)
    poses, spreads = np.array([palm.X_TG for palm in palms]), [palm.spread for palm in palms]
    q_opened, q_grasp = np.zeros((2, count, len(names)))
    for spread in dict.fromkeys(spreads):
        rows = np.flatnonzero(np.array(spreads) == spread)
        closing = closing_positions(solid, shaped, spread, poses[rows])
        for q, closed in ((q_opened, np.zeros_like(closing)), (q_grasp, closing)):
            for row, each in zip(rows, closed, strict=True):
                at = joint_positions(shaped, spread, each)
                q[row] = [at[joint] for joint in names]
    return make_attempts(
        hand,
        [name] * count,
        poses,
        q_grasp,
        q_pregrasp=q_opened,
        joints=names,
        frame="table",
        said=[palm.said for palm in palms],
        preshape=[preshape] * count,
    )


def predict(
    cloud: Array,
    view: View | None,
    config: Config,
    *,
    simulate: int,
    count: int | None = None,
    name: str = "seen",
    arm: Arm | None = None,
    around: Neighbourhood | None = None,
) -> tuple[GraspTable, Ranking]:
    """Return grasps for what a camera saw of an object, the best first, and their ranking.

    Args:
        cloud: (n, 3), points of the object only, in {T} [m].
        view: The image that shows them; None if there is none.
        config: The hand, and the rules of the lifts.
        simulate: See `rank`.
        count: Maximum number of grasps; None for all that were proposed.
        name: Name of the object in the table.
        arm: See `rank`.
        around: See `rank`.

    Returns:
        Postures in the frame "table", whose `confidence` is the chance of a sample, or 0 for what
        the arm does not reach, with the joints of the arm; and the ranking of all proposals.

    Raises:
        GraspError, HandError, MeshError: See `propose` and `rank`.
    """
    hand = load_hand(config.hand_source)
    proposals = propose(cloud, hand, name=name)
    how: dict[str, Any] = {"simulate": simulate, "view": view, "config": config, "arm": arm}
    ranking = rank(proposals, cloud, hand, **how, around=around)
    order = ranking.order[:count]
    chosen = replace(proposals.at(order.tolist()), row=np.arange(len(order)))
    if arm is None:
        return replace(chosen, confidence=ranking.chance[order]), ranking
    none, found = np.full(len(arm.joints), np.nan), [ranking.reach[i] for i in order]
    return replace(
        chosen,
        confidence=np.where(ranking.reachable, ranking.chance, 0.0)[order],
        q_arm=np.array([none if reach is None else reach.q[1] for reach in found]),
    ), ranking


def predict_scenes(
    path: Path,
    *,
    split: str = "test",
    simulate: int = 0,
    count: int | None = None,
    overrides: Sequence[str] = (),
    arm: Arm | None = None,
    execute: Executor = run_here,
    report: Report = silent,
) -> tuple[GraspTable, int]:
    """Return grasps for all views of a split, in the frames of their objects.

    The rows of the views are those of `drakegrasp score`, see `dataset.scenes.SceneRows`. Among
    other objects, lifts are tried and arms are asked among those that the view shows, completed
    from it.

    Args:
        path: OUT/scenes.hdf5 or OUT/clutter.hdf5.
        split: `train`, `valid` or `test`.
        simulate: See `rank`; the lifts have the rules of the dataset.
        count: Maximum number of grasps of a view; None for all.
        overrides: Strings `"a.b=c"`, which change the configuration of the dataset.
        arm: See `rank`; its base is on the table of the scenes.
        execute: Executor of the views.
        report: Called after each view.

    Returns:
        Postures with the row that each is for (`of_row`), its resting pose and its confidence; and
        the number of views that show too little of their object for any.

    Raises:
        DataError: If the file cannot be used.
        GraspError: If no view yields a posture, or a view is invalid.
        ConfigError: If an override is invalid.
    """
    data = SceneDataset(path, points=None, split=split, negatives="none", balance="view", grasps=1)
    if not len(data):
        raise GraspError(f"{path}: {data.emptiness}")

    rows = SceneRows(path, split=split) if data.several else None
    views = list(data.views.tolist() if rows is None else rows.views.tolist())
    places = [0] * len(views) if rows is None else rows.places.tolist()
    config = override_config(read_manifest(data.path.parent).config, overrides)

    # The grasps of each view, in the order of the rows.
    work = partial(_predict_view, config, simulate, count, arm)
    tables = list[GraspTable]()
    for row, table in enumerate(in_order(execute)(work, _views(data, views, places))):
        if table is not None:
            tables.append(replace(table, of_row=np.full(len(table), row)))
        report(row + 1, len(views))

    if not tables:
        raise GraspError(
            f"{path}: must have views with a sample in {split} that show their object, got "
            f"{len(views)} views"
        )
    return join_attempts(tables), len(views) - len(tables)


class _SceneView(NamedTuple):
    """A view of a scene: its object with resting pose and pose X_TO (4, 4), and the image.

    In scenes of several objects, `instances` (h, w) is the mask of all of them, and there are the
    walls of the surroundings.
    """

    name: str
    resting: int
    X_TO: Array
    view: View
    instances: AnyArray | None = None
    walls: tuple[Wall, ...] = ()


def _views(
    data: SceneDataset, chosen: Sequence[int], places: Sequence[int]
) -> Iterator[_SceneView]:
    """Yield views of a dataset, each with the object at its place in the scene."""
    views, scenes = data.tables["views"], data.tables["scenes"]
    trees = parse_json(data.around)["surroundings"] if data.several else {}
    for i, place in zip(chosen, places, strict=True):
        scene, seen = views["scene"][i], data.images(i)
        X_TC, mask = unpack_pose(views["X_TC"][i]), (seen["mask"] == place + 1).astype(np.uint8)
        found = _SceneView(
            name=data.names[scenes["object"][scene, place]],
            resting=int(scenes["resting"][scene, place]),
            X_TO=unpack_pose(scenes["X_TO"][scene, place]),
            view=View(depth=seen["depth"], mask=mask, K=seen["K"], X_TC=X_TC),
        )
        if data.several:
            name = str(scenes["surroundings"][scene])
            walls = surroundings_of(name, trees[name], str(data.path)).walls
            found = found._replace(resting=UNTOLD, instances=seen["mask"], walls=walls)
        yield found


def _predict_view(
    config: Config, simulate: int, count: int | None, arm: Arm | None, seen: _SceneView
) -> GraspTable | None:
    """Return grasps for a view in {O}; None if it shows too little of its object.

    Raises:
        GraspError: If the view is invalid.
    """
    view = seen.view
    try:
        cloud, around = cloud_from_depth(view.depth, view.K, view.mask, view.X_TC), None
        if seen.instances is not None and (simulate or arm is not None):
            around = seen_neighbours(view, seen.instances, walls=seen.walls, config=config)
        how: dict[str, Any] = {"simulate": simulate, "count": count, "name": seen.name, "arm": arm}
        found, _ = predict(cloud, view, config, **how, around=around)
    except TooLittleSeenError:
        return None
    except GraspError as error:
        raise GraspError(f"a view of {seen.name}: {error}") from None
    return replace(
        found,
        X_FG=multiply(invert_pose(seen.X_TO), found.X_FG),
        frame="object",
        resting=np.full(len(found), seen.resting),
    )
