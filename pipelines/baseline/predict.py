"""Predict with a checkpoint of `train.py`, and write a file for `drakegrasp score` and others.

  python pipelines/baseline/predict.py postures.pt OUT/scenes.hdf5 predicted.h5
  python pipelines/baseline/predict.py postures.pt OUT/scenes.hdf5 judged.h5 --judge classifier.pt
  python pipelines/baseline/predict.py postures.pt OUT/scenes.hdf5 closed.h5 --choose closing
  python pipelines/baseline/predict.py contacts.pt OUT/grasping_oto.hdf5 predicted.h5

`verify` and `build` read the file as well. Postures are written in the form that `drakegrasp build
--postures` reads, each with the row of the split for which it is.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
import torch
from batches import as_input, centred, object_points
from networks import (
    ContactNetwork,
    GraspClassifier,
    HandCoordinates,
    PostureNetwork,
    PostureSize,
)
from torch import Tensor
from train import SEEN

import drakegrasp as dg
from drakegrasp.arithmetic import Array
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.errors import DataError, DrakegraspError
from drakegrasp.hand.description import load_hand
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.simulation.attempts import join_attempts, make_attempts

#: Two proposals are the same if their palms differ by less than both limits [m, rad].
SAME = (0.01, np.deg2rad(15))
#: Number of proposals from which a judge chooses.
POOL = 64
#: Views or images that are processed together.
BATCH = 32


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("data", type=Path, help="scenes.hdf5, or a data file for contacts")
    parser.add_argument("out", type=Path, help="HDF5 file to write")
    parser.add_argument("--split", default="test", help="[default: test]")
    parser.add_argument("--judge", type=Path, help="checkpoint of the classifier that ranks")
    parser.add_argument(
        "--choose",
        choices=("chance", "closing"),
        default="chance",
        help="ranking: the network's or the judge's chance, or drakegrasp.rank of the proposals "
        "and of grasps from above  [default: chance]",
    )
    parser.add_argument("--proposals", type=int, default=5, help="proposals per view  [default: 5]")
    parser.add_argument("--views", type=int, help="views per scene  [default: all]")
    arguments = parser.parse_args(argv)
    try:
        checkpoint = load(arguments.checkpoint, "postures", "contacts")
        with torch.no_grad():
            arrays = PREDICT[checkpoint["task"]](checkpoint, arguments)
    except DrakegraspError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 2

    partial_file = arguments.out.with_suffix(".part")
    with h5py.File(partial_file, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    partial_file.replace(arguments.out)
    print(f"{arguments.out}: {len(arrays['confidence'])} rows")  # noqa: T201
    return 0


def load(path: Path, *tasks: str) -> dict[str, Any]:
    """Return the content of a checkpoint; its task must be one of `tasks`."""
    try:
        content: dict[str, Any] = torch.load(path, weights_only=True)
        task = content["task"]
    except Exception as error:  # a damaged archive can raise any exception
        raise DataError(f"{path}: must be a checkpoint of train.py, got {error!r:.80}") from error
    if task not in tasks:
        raise DataError(f"{path}: must be a checkpoint of {' or '.join(tasks)}, got {task}")
    return content


# Postures


def predict_postures(checkpoint: dict[str, Any], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return postures for the views of a split, best first, in the form of a file of postures."""
    network = PostureNetwork(PostureSize(**checkpoint["size"])).eval()
    network.load_state_dict(checkpoint["weights"])
    hand, judge = HandCoordinates(**checkpoint["hand"]), None
    if arguments.judge:
        said = load(arguments.judge, "classifier")
        of_judge = HandCoordinates(**said["hand"])
        classifier = GraspClassifier(len(of_judge.directions)).eval()
        classifier.load_state_dict(said["weights"])
        judge = classifier, of_judge

    closing_hand = None
    if arguments.choose == "closing":
        closing_hand = load_hand(read_manifest(arguments.data.parent).config.hand_source)

    # The views that `drakegrasp score` counts, in its order of rows.
    data = dg.SceneDataset(
        arguments.data, split=arguments.split, negatives="none", balance="view", grasps=1
    )
    found: dict[str, list[Any]] = {key: [] for key in COLUMNS}
    chosen = _views(data, arguments.views)
    pool = max(POOL, arguments.proposals)
    with progress_bar("predict", "view") as progress:
        for done, index in enumerate(chosen):
            item = data[index]
            points = torch.from_numpy(object_points(item["points"], item["on_object"]))[None]
            batch = centred({"points": points, "X_TG": torch.eye(4)[None, None]})
            confidence, X_TG, q = proposals(network, hand, batch["points"], pool)
            if judge is not None:
                clouds = batch["points"][:, :SEEN].expand(len(X_TG), -1, -1)
                confidence = judge[0](clouds, X_TG, judge[1].coordinates(q))[:, 1].sigmoid()

            # Back to the original position of the cloud.
            X_TG[:, :3, 3] += batch["shift"]
            table = Choice(X_TG.numpy(), q.numpy(), hand.opened(q).numpy(), confidence.numpy())
            if closing_hand is not None:
                cloud = item["points"][item["on_object"]]
                table = chosen_by_closing(table, cloud, closing_hand, data.joints)
            order = np.argsort(-table.confidence, kind="stable")[: arguments.proposals]

            # Into the object's frame.
            X_OG = np.linalg.inv(item["X_AO"].astype(float)) @ table.X_TG[order].astype(float)
            scene = int(item["scene"])
            rows = {
                "object": [data.names[int(item["object"])]] * len(order),
                "resting": [int(data.tables["scenes"]["resting"][scene, 0])] * len(order),
                "row": [index] * len(order),
                "X_FG": X_OG,
                "q_grasp": table.q_grasp[order],
                "q_pregrasp": table.q_pregrasp[order],
                "confidence": table.confidence[order],
            }
            for key, values in rows.items():
                found[key].extend(values)
            progress(done + 1, len(chosen))
    arrays: dict[str, Any] = {key: np.array(values) for key, values in found.items()}
    arrays["object"] = np.array(found["object"], dtype=h5py.string_dtype())
    return arrays | {"frame": "object", "joints": np.array(data.joints, dtype=h5py.string_dtype())}


class Choice(NamedTuple):
    """n proposals for a view: X_TG (n, 4, 4), closed and open joints (n, j), confidence (n,)."""

    X_TG: Array
    q_grasp: Array
    q_pregrasp: Array
    confidence: Array


def chosen_by_closing(found: Choice, cloud: Array, hand: dg.Hand, joints: Sequence[str]) -> Choice:
    """Return proposals and grasps from above, with the score of `drakegrasp.rank` as confidence.

    If a view shows too little for that, the proposals are returned unchanged.

    Args:
        found: Proposals of the network.
        cloud: (n, 3), points on the object in {T} [m].
        hand: The hand.
        joints: (j,), names of the hand's joints.
    """
    try:
        above = dg.propose(cloud, hand)
    except dg.GraspError:
        return found
    own = make_attempts(
        hand,
        above.objects[:1] * len(found.X_TG),
        found.X_TG,
        found.q_grasp,
        q_pregrasp=found.q_pregrasp,
        joints=joints,
        frame="table",
    )
    both = join_attempts([own, above])
    order = [hand.joint_order.index(name) for name in joints]
    q = both.q_grasp[:, order], both.q_pregrasp[:, order]
    return Choice(both.X_FG, *q, dg.rank(both, cloud, hand).score)


COLUMNS = ("object", "resting", "row", "X_FG", "q_grasp", "q_pregrasp", "confidence")


def proposals(
    network: PostureNetwork, hand: HandCoordinates, points: Tensor, count: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the most likely modes of a cloud (1, n, 3), no two of them the same.

    Modes are ordered by the density of the whole mixture: the weight of a single mode is small
    where many agree.

    Returns:
        Log densities (m,), largest first, poses X_TG (m, 4, 4) and closed joints (m, j),
        m <= count.
    """
    modes = network(points)
    density = network.log_density(modes, *modes[1:])[0]
    _, position, rotation, coordinates = (each[0] for each in modes)
    kept: list[int] = []
    for mode in density.argsort(descending=True, stable=True).tolist():
        near = (position[kept] - position[mode]).norm(dim=-1) < SAME[0]
        cosine = ((rotation[kept] * rotation[mode]).sum((-1, -2)) - 1) / 2
        if not (near & (cosine > np.cos(SAME[1]))).any():
            kept.append(mode)
        if len(kept) == count:
            break
    X_TG = torch.eye(4).repeat(len(kept), 1, 1)
    X_TG[:, :3, :3], X_TG[:, :3, 3] = rotation[kept], position[kept]
    # Coordinates far outside the training data may not describe a possible hand.
    return density[kept], X_TG, hand.closed(coordinates[kept].clamp(-3, 3))


def _views(data: dg.SceneDataset, per_scene: int | None) -> list[int]:
    """Return indices of items: the first views of each scene."""
    seen: dict[int, int] = {}
    chosen = []
    for index, view in enumerate(data.views):
        scene = int(data.tables["views"]["scene"][view])
        seen[scene] = seen.get(scene, 0) + 1
        if per_scene is None or seen[scene] <= per_scene:
            chosen.append(index)
    return chosen


# Contacts


def predict_contacts(checkpoint: dict[str, Any], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return `grasps` (n, h, 6k) and `confidence` (n, h) for the samples of a split."""
    data = dg.GraspDataset(arguments.data, split=arguments.split)
    weights = checkpoint["weights"]
    network = ContactNetwork(
        len(weights["mean"]), checkpoint["heads"], weights["mean"], weights["scale"]
    )
    network(torch.zeros(1, 4, data.image_size, data.image_size))
    network.load_state_dict(weights)
    network.eval()

    found = []
    with progress_bar("predict", "image") as progress:
        for start in range(0, len(data), BATCH):
            rows = range(start, min(start + BATCH, len(data)))
            images = np.stack([data.value("images", data.row_of(i)) for i in rows])
            found.append(network(as_input(torch.from_numpy(images))))
            progress(rows.stop, len(data))
    grasps, chances = (torch.cat(each).numpy() for each in zip(*found, strict=True))
    return {"grasps": grasps, "confidence": np.exp(chances)}


PREDICT = {"postures": predict_postures, "contacts": predict_contacts}

if __name__ == "__main__":
    sys.exit(main())
