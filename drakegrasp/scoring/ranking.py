"""Ranking: the order in which to try grasps, by closing the hand on points that a camera saw.

Input: grasps that anybody proposes, and an object's visible points in {T}, where the table is z =
0. Output: a score of each, and the chance that it is a sample on the real object. The points become
solids (`mesh.cloud`), and the hand's geometry determines where each finger stops
(`simulation.closing`). A score is a mean over the solids and over small moves of the palm.

If the caller asks for it, the first grasps are also tried by lifts in simulation, which decide
better than geometry: on the object completed from both solids, with or without the view that shows
it (`vision.depth_image`). If one of these lifts is a sample, the grasp is also tried with the palm
aside and with less friction. Mass, friction and filters are those of the configuration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import Config
from drakegrasp.errors import ConfigError, GraspError, TooLittleSeenError
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose, make_pose, read_pose
from drakegrasp.generation.attempts import judge_sample
from drakegrasp.grasp import unused_fingers
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import hand_names
from drakegrasp.hand.kinematics import coordinate_limits
from drakegrasp.hand.settings import load_config
from drakegrasp.mesh.cloud import Solid, column_solid, hull_solid, read_cloud
from drakegrasp.objects.model import object_of
from drakegrasp.objects.surroundings import Neighbourhood, Wall
from drakegrasp.reach.arm import Arm
from drakegrasp.reach.reaching import Reach, reach_attempt
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.attempt import Attempt, usual_conditions
from drakegrasp.simulation.attempts import GraspTable
from drakegrasp.simulation.closing import closing_features
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.posture import start_of
from drakegrasp.simulation.scene_cache import run_cached
from drakegrasp.table import Table
from drakegrasp.vision.depth_image import View, cloud_from_depth, complete

#: Moves of the palm along its axes [m] over which a score is averaged; the first is no move.
MOVES = 0.005 * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
#: Spreads are rounded to multiples of this [rad], because the paths of a hand take half a second.
SPREAD_STEP = np.deg2rad(2.5)
#: Scores that are equal to this number of decimals keep the order of their rows.
DECIMALS = 9
#: Columns of a ranking, see `Ranking`.
COLUMNS = ("clearance", "table", "touch", "gap", "push", "opposition", "arm", "robust")
#: Shifts of the palm along Gx and Gy [m], and the factor of the friction, of the further lifts.
SHIFTS, SLIPPERY = 0.004 * np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]]), 0.63
#: Logistic weights of the chance of a sample: a constant, for the score by closing, and for the
#: share of lifts; and the largest chance, since no score knows the unseen side. They were fitted to
#: lifts of the Barrett Hand on household meshes, see "Stated chances" in docs/results/choice.md.
WITHOUT_LIFTS, WITH_LIFTS, CEILING = (-5.6, 10.5), (-5.5, 6.7, 4.8), 0.92
#: A grasp is likely from this chance on.
LIKELY = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class Ranking:
    """The scores of n proposals, and what determines them.

    Attributes:
        score: (n,), 0 to 1, by closing, greater is better, an order only; -1 for a row that is not
            a posture.
        order: (n,), indices of the proposals, the largest chance first; of equal ones the earlier
            is first. Those that an arm does not reach are last.
        features: Columns, each a mean over solids and moves; NaN for a row that is not a posture:
            `clearance` (n,), distance of the open hand from the object [m], negative inside, at
            most 20 mm;
            `table` (n,), distance of the open hand from the table [m], negative inside, at most
            20 mm;
            `touch` (n, k), whether each finger's pad is at the object when the finger stops; NaN
            for a finger that the preshape does not use;
            `gap` (n,), distance of the farthest required pad from the object then [m], at most
            20 mm;
            `push` (n,), smallest cosine between the motion of a required pad and the surface's
            inward normal there;
            `opposition` (n,), how well the contacts' normals balance, 0 to 1;
            `arm` (n,), horizontal distance of the contacts' centre from the object's [m];
            `robust` (n,), fraction in which the open hand is free and all required pads touch.
        chance: (n,), chance that the grasp would be a sample of a dataset; 0 for a row that is not
            a posture. It was fitted for the Barrett Hand; for another hand it is an order only.
        share: (n,), share of the lifts that end as a sample; NaN if no lift was tried.
        height: Height of the highest point above the table [m].
        completion: On what lifts were tried: "view", solids from which the free space of a view is
            cut, "cloud", solids without a view, or empty if no lift was tried.
        reach: (n,), what an arm can do about each proposal, None for a row that is not a posture;
            empty if no arm was asked.
    """

    score: Array
    order: npt.NDArray[np.int64]
    features: Table
    chance: Array
    share: Array
    height: float
    completion: str = ""
    reach: tuple[Reach | None, ...] = ()

    @property
    def reachable(self) -> npt.NDArray[np.bool_]:
        """(n,), whether the arm reaches each proposal; empty if no arm was asked."""
        found = [each is not None and each.reachable for each in self.reach]
        return np.array(found, dtype=np.bool_)

    @property
    def likely(self) -> bool:
        """Whether the first grasp is likely to be a sample, and within reach of the arm if any."""
        first = self.order[0]
        reached = not self.reach or self.reachable[first]
        return bool(reached and self.chance[first] >= LIKELY)

    def explain(self) -> str:
        """Return in a sentence what to expect of the first grasp."""
        if self.reach and not self.reachable.any():
            return f"no grasp is within reach of the arm, of {len(self.reach)}"
        tried = int(np.isfinite(self.share).sum())
        where = f"on the object completed from the {self.completion}"
        how = f"{tried} tried {where}" if tried else "no lift was tried"
        chance = f"is a sample with a chance of {self.chance[self.order[0]]:.0%} ({how})"
        if self.likely:
            return f"the first grasp {chance}"
        high = f"the object is {1e3 * self.height:.0f} mm high"
        return f"no grasp is likely: the best one {chance}; {high}"


def rank(
    proposals: GraspTable | npt.ArrayLike,
    cloud: npt.ArrayLike,
    hand: Hand | str | None = None,
    *,
    spread: float = 0.0,
    simulate: int = 0,
    view: View | Sequence[npt.ArrayLike] | None = None,
    config: Config | None = None,
    arm: Arm | None = None,
    around: Neighbourhood | None = None,
) -> Ranking:
    """Return the order in which to try proposals, by closing the hand on what a camera saw.

    Palm pose, spread and pregrasp of a posture are used. From there each finger closes as the hand
    file specifies, until it meets the object or the table.

    Args:
        proposals: Postures of `propose` or `make_attempts`, in {T} or with their X_TO; or palm
            poses X_TG (n, 4, 4) or (4, 4), for which the hand starts open.
        cloud: (n, 3), points of the object only, in {T} [m]; the table is z = 0.
        hand: A hand, or an argument of `load_hand`; None for the hand of `config`, or else the
            default hand.
        spread: Spread of palm poses [rad].
        simulate: Largest number of proposals that are tried on the completed object, in the order
            of their scores, until all lifts of one are samples; 0 for none.
        view: Depth image (h, w) [m], mask (h, w), camera matrix K (3, 3) [px] and camera pose X_TC
            (4, 4) of the cloud, as in `cloud_from_depth`. They show what beside the object is
            free.
        config: Mass of the object, friction and all rules of the lifts; None for the preset `fast`.
        arm: An arm, see `load_arm`. It is asked for all proposals, with the convex hull of the
            points as the object, which takes about 0.1 s each.
        around: Neighbours and walls in {T}, see `seen_neighbours`, among which lifts are tried and
            the arm is asked; closing on points does not know them.

    Raises:
        GraspError: If the cloud, the poses, the spread or the view are invalid, postures are in {O}
            without X_TO or have other joints than the hand, or `simulate` is negative.
        HandError: If the hand cannot be used, or several of its fingers move one link.
        ConfigError: If `config` is of another hand.
        MeshError: If the completed object cannot be simulated.
    """
    if simulate < 0:
        raise GraspError(f"simulate must be a whole number, 0 or more, got {simulate}")
    seen = None if view is None else _read_view(view)
    points = read_cloud(cloud)
    hand = load_hand(config.hand_source) if hand is None and config else chosen_hand(hand)
    proposals = _read_proposals(proposals, hand, spread)
    starts = _starts(proposals, hand, spread)
    solids = hull_solid(points), column_solid(points)
    columns = measured(len(proposals), starts, solids, hand)
    # The last bits of a score depend on the other rows, and must not decide.
    score = np.round(columns.pop("score"), DECIMALS)
    known = ~np.isnan(score)
    score = np.where(known, score, -1.0)
    order = np.argsort(-score, kind="stable")

    # Lift the first ones.
    share, completion = np.full(len(score), np.nan), ""
    if tried := [i for i in order[:simulate].tolist() if known[i]]:
        completed = place_completed(solids, seen, lifting_config(hand, config), around)
        share[tried] = lift_shares(completed, [starts[i] for i in tried])
        completion = "cloud" if seen is None else "view"
    chance = np.where(known, chances(score, share), 0.0)

    # What the arm does not reach comes last.
    reach, behind = tuple[Reach | None, ...](), np.zeros(len(score), dtype=np.bool_)
    if arm is not None:
        rules = lifting_config(hand, config)
        reach = _reaches(arm, proposals, starts, solids[0], rules, around)
        behind = np.array([each is None or not each.reachable for each in reach])
    return Ranking(
        score=score,
        order=np.lexsort((-chance, behind)),
        reach=reach,
        features=Table(columns),
        chance=chance,
        share=share,
        height=float(points[:, 2].max()),
        completion=completion,
    )


def _read_view(view: View | Sequence[npt.ArrayLike]) -> View:
    """Return a view, as it is given, whose depth image, mask and camera fit together.

    Raises:
        GraspError: If they do not.
    """
    if len(view) != len(View._fields):
        raise GraspError(f"view must be {', '.join(View._fields)}, got {len(view)} values")
    read = View(*view)
    # It raises the errors; what it returns is not needed.
    cloud_from_depth(read.depth, read.K, read.mask, read.X_TC)
    return read


def _reaches(
    arm: Arm,
    proposals: GraspTable | Array,
    starts: Mapping[int, Attempt],
    solid: Solid,
    config: Config,
    around: Neighbourhood | None,
) -> tuple[Reach | None, ...]:
    """Return what an arm can do about each proposal, on the solid in {T}; None without a start."""
    q_closed = dict[int, Array]()
    if isinstance(proposals, GraspTable):
        q_closed = {i: q for i, q in enumerate(proposals.q_grasp) if not np.isnan(q).any()}
    middle = make_pose(np.eye(3), [-solid.middle[0], -solid.middle[1], 0.0])
    ask = partial(reach_attempt, arm, solid.field, X_TO_simulated=middle, around=around)
    found = {i: ask(s, np.eye(4), config, q_closed=q_closed.get(i)) for i, s in starts.items()}
    return tuple(found.get(i) for i in range(len(proposals)))


def measured(
    count: int, starts: Mapping[int, Attempt], solids: Sequence[Solid], hand: Hand
) -> dict[str, Array]:
    """Return the score and the features (n, ...) of n proposals by their names.

    Args:
        count: Number of proposals, n.
        starts: The start of each valid proposal by its index, in {T}; the others are NaN.
        solids: What the points are filled to.
        hand: The hand.
    """
    # The paths of the fingers depend on preshape and spread.
    groups: dict[tuple[int | None, float], list[int]] = {}
    for i, start in starts.items():
        near = round(start.spread / SPREAD_STEP) * SPREAD_STEP
        groups.setdefault((start.preshape, near), []).append(i)
    columns = {name: np.full(count, np.nan) for name in ("score", *COLUMNS)}
    columns["touch"] = np.full((count, hand.num_fingers), np.nan)
    for (preshape, near), rows in groups.items():
        closings = _closed(solids, hand.at(preshape), near, [starts[i] for i in rows])
        found = {name: values.mean(axis=(0, 2)) for name, values in closings.items()}
        used = ~unused_fingers(hand.unused_in(preshape), hand.num_fingers)
        columns["touch"][np.array(rows)[:, None], np.flatnonzero(used)] = found.pop("touch")
        for name, values in found.items():
            columns[name][rows] = values
    return columns


def _read_proposals(
    proposals: GraspTable | npt.ArrayLike, hand: Hand, spread: float
) -> GraspTable | Array:
    """Return postures, or palm poses (n, 4, 4), that fit a hand.

    Raises:
        GraspError: If they or the spread do not.
    """
    if isinstance(proposals, GraspTable):
        joints, expected = proposals.q_grasp.shape[1], len(hand.joint_names)
        if joints != expected:
            raise GraspError(
                f"proposals must be of the hand {hand.name} with {expected} joints, got {joints}"
            )
        return proposals
    low, high = coordinate_limits(hand)[0]
    if not low <= spread <= high:
        raise GraspError(
            f"spread must be {low:.3g} to {high:.3g} rad for the hand {hand.name}, got {spread:g}"
        )
    return read_pose(proposals, "proposals").reshape(-1, 4, 4)


def chosen_hand(hand: Hand | str | None) -> Hand:
    """Return a given hand, the hand of a name or a file, or the default hand."""
    if isinstance(hand, Hand):
        return hand
    return load_hand() if hand is None else load_hand(hand)


def _starts(proposals: GraspTable | Array, hand: Hand, spread: float) -> dict[int, Attempt]:
    """Return the start of each valid proposal, by its index, with {T} as its object's frame."""
    if not isinstance(proposals, GraspTable):
        preshape = 0 if hand.preshapes else None
        made = (Attempt(X_OG=X, spread=spread, preshape=preshape) for X in proposals)
        return dict(enumerate(made))
    starts = {}
    for i in np.flatnonzero([not reason for reason in proposals.invalid]).tolist():
        X_TO = proposals.X_TO[i]
        if np.isnan(X_TO).any():
            if proposals.frame in ("object", "mesh"):
                raise GraspError(
                    f"proposals must be in the frame table, or say X_TO, got {proposals.frame}"
                )
            X_TO = np.eye(4)
        start = start_of(proposals.posture(i, X_TO), hand)
        starts[i] = replace(start, X_OG=multiply(X_TO, start.X_OG))
    return starts


def _closed(
    solids: Sequence[Solid], hand: Hand, spread: float, starts: Sequence[Attempt]
) -> dict[str, Array]:
    """Return score and features (s, n, m, ...) of n starts on s solids, with m moves of each."""
    # Apply each move to each start.
    X_TG = np.array([start.X_OG for start in starts])
    moved = np.repeat(X_TG, len(MOVES), axis=0)
    moved[:, :3, 3] += multiply(MOVES, np.swapaxes(X_TG[:, :3, :3], 1, 2)).reshape(-1, 3)
    opened = np.zeros(hand.num_fingers)
    closing = np.array([opened if s.closing is None else s.closing for s in starts])
    closing = np.repeat(closing, len(MOVES), axis=0)

    found = [closing_features(solid, hand, spread, moved, closing=closing) for solid in solids]
    shape = len(solids), len(starts), len(MOVES)
    return {
        name: np.reshape([each[name] for each in found], (*shape, *values.shape[1:]))
        for name, values in found[0].items()
    }


# Lifts


def lifting_config(hand: Hand, config: Config | None) -> Config:
    """Return the configuration of the lifts of a hand; None stands for the preset `fast`.

    Raises:
        ConfigError: If the configuration is of another hand, or none is given for a hand that does
            not come with the package.
    """
    if config is None:
        if hand.name not in hand_names():
            raise ConfigError(f"config must be given with the hand {hand.name}, got None")
        return load_config("fast", hand=hand.name)
    if (other := load_hand(config.hand_source).name) != hand.name:
        raise ConfigError(f"config must be of the hand {hand.name}, got one of {other}")
    return config


def place_completed(
    solids: Sequence[Solid],
    view: View | None,
    config: Config,
    around: Neighbourhood | None = None,
) -> list[PlacedObject]:
    """Return the object on the table, completed from each of the guessed solids in {T}.

    Args:
        solids: Solids, see `mesh.cloud`.
        view: The image that shows the object; None if it is not known.
        config: The configuration of the lifts, with the mass of the object.
        around: What is around it, in {T}.

    Raises:
        TooLittleSeenError: If no solid is left.
        MeshError: If a solid cannot be simulated.
    """
    placed = list[PlacedObject]()
    for solid in solids:
        surface = complete(solid.field, view)
        model = object_of(surface, config.objects, name="seen", class_name="seen", mesh_sha256="")
        X_TO = make_pose(np.eye(3), -model.p_OM)
        placed.append(PlacedObject(model=model, X_TO=X_TO, config=config, around=around))
    return placed


def seen_neighbours(
    view: View | Sequence[npt.ArrayLike],
    instances: npt.ArrayLike,
    *,
    walls: Sequence[Wall] = (),
    config: Config | None = None,
) -> Neighbourhood:
    """Return what is around an object, as far as an image shows it, in {T}, for `rank`.

    A neighbour of which the image shows too little is left out.

    Args:
        view: As for `rank`; its mask shows the object.
        instances: (h, w), another whole number on each object, 0 beside all. The object is the one
            that covers most of the mask.
        walls: Walls that are known.
        config: The configuration of the lifts, with the mass of a neighbour; None for the preset
            `fast`.

    Raises:
        GraspError: If the view or the instances are invalid, or a neighbour is not on the table.
        MeshError: If a neighbour cannot be simulated.
    """
    seen, labels = _read_view(view), np.asarray(instances)
    if labels.shape != (size := np.shape(seen.depth)) or labels.dtype.kind not in "iub":
        must = f"instances must be whole numbers of the size {size} of the depth image"
        raise GraspError(f"{must}, got {labels.dtype} of {labels.shape}")
    config = load_config("fast") if config is None else config

    # The neighbours; the object itself may reach beyond its mask.
    there = np.atleast_3d(seen.mask).any(axis=2)
    values, counts = np.unique(labels[there], return_counts=True)
    others = np.unique(labels[(labels != 0) & ~there])

    # Each is completed as if it was the object.
    found = list[PlacedObject]()
    for value in others[others != values[counts.argmax()]].tolist():
        own = seen._replace(mask=(labels == value).astype(np.uint8))
        try:
            solid = hull_solid(read_cloud(cloud_from_depth(own.depth, own.K, own.mask, own.X_TC)))
            found += place_completed([solid], own, config)
        except TooLittleSeenError:
            continue  # then it is not known
        except GraspError as error:
            raise GraspError(f"neighbour {value} of the mask: {error}") from None
    return Neighbourhood(
        models=tuple(each.model for each in found),
        X_TN=np.array([each.X_TO for each in found]).reshape(-1, 4, 4),
        walls=tuple(walls),
    )


@one_thread
def lift_shares(completed: Sequence[PlacedObject], starts: Sequence[Attempt]) -> Array:
    """Return the share (n,) of the lifts of each grasp that end as a sample.

    The first grasp all of whose lifts are samples is the last one that is tried; the rest is NaN.

    Args:
        completed: The completed objects; the further lifts are on the first one.
        starts: (n,), the starts of the grasps in the order of their scores; their X_OG is X_TG.
    """
    shares = np.full(len(starts), np.nan)
    for i, start in enumerate(starts):
        shares[i] = _share(completed, start)
        if shares[i] == 1.0:
            break
    return shares


def _share(completed: Sequence[PlacedObject], start: Attempt) -> float:
    """Return the share of a grasp's lifts that end as a sample."""
    samples = [_lifts_to_sample(placed, start) for placed in completed]
    if not any(samples):
        return 0.0
    placed = completed[0]
    usual = usual_conditions(placed.model, placed.config.physics)
    friction = usual.materials.friction_hand, usual.materials.friction_table
    hand, table = (SLIPPERY * each for each in friction)
    slippery = replace(usual.materials, friction_hand=hand, friction_table=table)
    further = [
        replace(start, X_OG=multiply(start.X_OG, make_pose(np.eye(3), p_GH))) for p_GH in SHIFTS
    ]
    further.append(replace(start, conditions=replace(usual, materials=slippery)))
    samples += [_lifts_to_sample(placed, each) for each in further]
    return float(np.mean(samples))


def _lifts_to_sample(placed: PlacedObject, start: Attempt) -> bool:
    """Return whether a lift of the object from a start in {T} ends as a sample."""
    config = placed.config
    attempt = replace(start, X_OG=multiply(invert_pose(placed.X_TO), start.X_OG))
    around = placed.around_simulated
    trial = run_cached(placed.model, placed.X_TO_simulated, attempt, config, around)
    views = around is None  # the cameras of a build see one object
    return judge_sample(placed.model, trial, config, views=views) is Removal.KEPT


def chances(score: Array, share: Array) -> Array:
    """Return the chances (n,) that grasps are samples on the real object.

    Args:
        score: (n,), scores by closing.
        share: (n,), shares of their lifts that are samples on the completed object; NaN for a grasp
            that was not tried by a lift.
    """
    constant, of_score = WITHOUT_LIFTS
    logit = constant + of_score * score
    constant, of_score, of_share = WITH_LIFTS
    logit = np.where(np.isnan(share), logit, constant + of_score * score + of_share * share)
    return np.asarray(CEILING / (1.0 + np.exp(-logit)))
