"""Reference rows: predictions of the program itself, with which a network is compared.

Input: the rows to score, and training rows. Output: a grasp per row, as contacts in the camera's
frame or postures in {T}. `constant` and `random` never look at the image. The camera is at a fixed
place relative to the palm, so a grasp in its frame reveals the wrist pose. A network that is not
far above these two has learned nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import GraspError, HandError
from drakegrasp.frames import Array, invert_pose, rotate_vectors, transform_points, unpack_pose
from drakegrasp.grasp import pack_grasp
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.scoring.predicting import propose
from drakegrasp.scoring.ranking import rank
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempts import GraspTable, make_attempts
from drakegrasp.verification.placing import dataset_config
from drakegrasp.vision.camera import unproject

#: Number of cells along each edge of the image descriptor.
CELLS = 16
#: Value of an object pixel in the descriptor, to compare with depths [m].
MASK_DEPTH = 0.1
#: Maximum number of training images that are compared; drawn if there are more.
MOST_IMAGES = 5000
#: Length of a unit normal in the distance between grasps, to compare with points [m].
NORMAL_LENGTH = 0.05
#: Depth of a grasp from above below the object's highest visible point [m]; at most half its
#: height.
DEPTH_OF_GRASP = 0.03
#: Distance between neighbouring fingers of a grasp from above [m].
FINGER_SPACING = 0.04
#: Seed of the draws.
SEED = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceInput:
    """The rows to score, and the training rows.

    Attributes:
        data: The dataset; its split has the rows.
        rows: The rows to score.
        train: The training split; it may be empty.
    """

    data: GraspDataset
    rows: Sequence[int]
    train: GraspDataset

    @cached_property
    def train_grasps(self) -> Array:
        """(n, 6k), grasps of the training rows."""
        return np.asarray(self.train.column("grasps"), dtype=float)

    @cached_property
    def constant(self) -> Array:
        """(6k,), the training grasp that is closest to their mean."""
        scaled = self.train_grasps.copy()
        scaled[:, scaled.shape[1] // 2 :] *= NORMAL_LENGTH
        return self.train_grasps[np.argmin(((scaled - scaled.mean(axis=0)) ** 2).sum(axis=1))]

    @cached_property
    def thumb(self) -> int:
        """The finger whose normal is most opposed to the mean of the others, in most grasps."""
        grasps = self.train_grasps if len(self.train_grasps) else self.data.column("grasps")
        normals = grasps.reshape(len(grasps), 2, -1, 3)[:, 1]
        against = np.einsum("nki,ni->nk", normals, normals.sum(axis=1)).argmin(axis=1)
        return int(np.bincount(against).argmax())

    def stream(self, name: str, row: int) -> Stream:
        """Return the stream of a reference for a row, seeded by the trial of the row."""
        return Stream(SEED, object_key(name), int(self.data.value("trial_id", row)))

    def visible(self, row: int) -> Array:
        """Return the object's points p_CQ (n, 3) that the image of a row shows [m]."""
        image, mask = self.data.value("images", row), self.data.value("masks", row)
        v, u = np.nonzero(mask)
        return unproject(self.data.K, np.column_stack([u, v]), image[3][v, u])


def own(inputs: ReferenceInput) -> Array:
    """Return the stored grasps of the rows: the upper bound."""
    return np.asarray(inputs.data.column("grasps")[list(inputs.rows)], dtype=float)


def nearest_image(inputs: ReferenceInput) -> Array:
    """Return the grasp of the training image with the closest descriptor.

    The descriptor has two values for each cell of a grid of 16 by 16: the mean depth [m], cut at
    the far plane, and 0.1 times the fraction of object pixels. The distance is Euclidean.
    """
    count = len(inputs.train)
    known = np.arange(count)
    if count > MOST_IMAGES:
        drawn = Stream(SEED, object_key("nearest image")).permutation(count)
        known = np.sort(drawn[:MOST_IMAGES])
    table = np.array([_descriptor(inputs.train, int(row)) for row in known])
    nearest = []
    for row in inputs.rows:
        distance = ((table - _descriptor(inputs.data, row)) ** 2).sum(axis=1)
        nearest.append(known[np.argmin(distance)])
    return inputs.train_grasps[nearest]


def _descriptor(data: GraspDataset, row: int) -> Array:
    """Return the descriptor (2 * CELLS^2,) of a row's image."""
    depth = np.asarray(data.value("images", row)[3], dtype=float)
    mask = np.asarray(data.value("masks", row), dtype=float)
    down, across = (
        np.linspace(0, size, min(CELLS, size) + 1).astype(int)[:-1] for size in depth.shape
    )
    high, wide = (
        np.diff([*edges, size]) for edges, size in zip((down, across), depth.shape, strict=True)
    )
    cells = []
    for image in (depth, MASK_DEPTH * mask):
        sums = np.add.reduceat(np.add.reduceat(image, down, axis=0), across, axis=1)
        cells.append((sums / np.outer(high, wide)).ravel())
    return np.concatenate(cells)


def constant(inputs: ReferenceInput) -> Array:
    """Return one grasp for all rows: the training grasp closest to the mean, in the camera's frame.

    A normal of length 1 is treated as equal to 50 mm in the distance.
    """
    return np.tile(inputs.constant, (len(inputs.rows), 1))


def random_train(inputs: ReferenceInput) -> Array:
    """Return a training grasp for each row, drawn at random, in the camera's frame."""
    count = len(inputs.train)
    drawn = [int(inputs.stream("random", row).integers(count, 1)[0]) for row in inputs.rows]
    return inputs.train_grasps[drawn]


def top_down(inputs: ReferenceInput) -> Array:
    """Return a grasp from above at the visible centroid, which closes across the minor axis.

    The axes are principal axes of the visible points, seen from above. The finger that opposes the
    others in most training grasps is on one side, and the other fingers on the other side. They are
    30 mm below the highest visible point, or half-way down if that is higher.
    """
    poses = inputs.data.column(f"object_props/frame_work2cam_{inputs.data.camera}")
    return np.array([_from_above(inputs, row, unpack_pose(poses[row])) for row in inputs.rows])


def _from_above(inputs: ReferenceInput, row: int, X_TC: Array) -> Array:
    """Return the grasp (6k,) of `top_down` for a row, with the pose of its camera."""
    # Visible points seen from above, and their axes.
    p_TQ = transform_points(X_TC, inputs.visible(row))
    centroid = p_TQ[:, :2].mean(axis=0)
    centred = p_TQ[:, :2] - centroid
    major, minor = np.linalg.svd(centred.T @ centred)[0].T
    low, high = np.quantile(centred @ minor, [0.02, 0.98])
    top = float(np.quantile(p_TQ[:, 2], 0.98))
    height = max(top - DEPTH_OF_GRASP, top / 2.0)

    # The thumb is on one side, the other fingers are side by side on the other.
    fingers, others = inputs.data.column("grasps").shape[1] // 6, 0
    points, normals = np.zeros((fingers, 3)), np.zeros((fingers, 3))
    for finger in range(fingers):
        if finger == inputs.thumb:
            side, reach, along = 1.0, high, 0.0
        else:
            side, reach = -1.0, low
            along = FINGER_SPACING * (others - (fingers - 2) / 2.0)
            others += 1
        points[finger] = [*(centroid + reach * minor + along * major), height]
        normals[finger] = [*(side * minor), 0.0]
    X_CT = invert_pose(X_TC)
    return pack_grasp(transform_points(X_CT, points), rotate_vectors(X_CT, normals))


def closing(inputs: ReferenceInput) -> GraspTable:
    """Return for each row the grasp of `propose` that `rank` puts first, for the visible points.

    A row for which no grasp can be proposed is invalid, with the reason.
    """
    # A row is NaN until a grasp is proposed.
    hand = load_hand(dataset_config(inputs.data).hand_source)
    poses = unpack_pose(inputs.data.column(f"object_props/frame_work2cam_{inputs.data.camera}"))
    count, joints = len(inputs.rows), len(hand.joint_names)
    X_TG = np.full((count, 4, 4), np.nan)
    q, reasons = np.full((2, count, joints), np.nan), [""] * count

    for i, row in enumerate(inputs.rows):
        try:
            best = _chosen(transform_points(poses[row], inputs.visible(row)), hand)
        except (GraspError, HandError) as reason:
            reasons[i] = str(reason)
        else:
            X_TG[i], q[:, i] = best.X_FG[0], [best.q_grasp[0], best.q_pregrasp[0]]

    return make_attempts(
        hand,
        inputs.data.column("object_props/object_name")[list(inputs.rows)].tolist(),
        X_TG,
        q[0],
        q_pregrasp=q[1],
        frame="table",
        invalid=reasons,
        of_row=np.array(inputs.rows, dtype=np.int64),
    )


def _chosen(p_TQ: Array, hand: Hand) -> GraspTable:
    """Return the one grasp for points (n, 3) in {T} that `rank` puts first."""
    grasps = propose(p_TQ, hand)
    return grasps.at([int(rank(grasps, p_TQ, hand).order[0])])


@dataclass(frozen=True, kw_only=True)
class Reference:
    """A reference: the function that makes its rows, a description, whether it needs training."""

    make: Callable[[ReferenceInput], Array | GraspTable]
    words: str
    trained: bool = True


#: References by name, in the order of a card: upper bound, network's rivals, blind rows, geometry.
REFERENCES = {
    "own": Reference(make=own, words="the rows' own grasps: the ceiling", trained=False),
    "nearest image": Reference(make=nearest_image, words="grasp of the nearest training image"),
    "constant": Reference(make=constant, words="one grasp for all rows (blind)"),
    "random": Reference(make=random_train, words="a random training grasp (blind)"),
    "top-down": Reference(
        make=top_down, words="from above, across the minor axis of what is seen", trained=False
    ),
    "closing": Reference(
        make=closing, words="proposed and chosen by closing on what is seen", trained=False
    ),
}
