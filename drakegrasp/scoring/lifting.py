"""Lifts on what a camera saw: grasps are tried in simulation on the object, completed in two ways.

Input: the starts of grasps in {T}, and two solids that were guessed from the object's visible
points (`mesh.cloud`), with or without the view that shows them. Output: for each grasp the share of
its lifts that end as a sample, and the chance that it is a sample on the real object. A grasp is
lifted on both completed solids (`vision.depth_image`); if one of these lifts is a sample, it is
also lifted with the palm aside and with less friction. Mass, friction and filters are those of the
configuration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drakegrasp.arithmetic import Array, multiply
from drakegrasp.config import Config
from drakegrasp.errors import ConfigError
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose, make_pose
from drakegrasp.generation.attempts import judge_sample
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.file_format import hand_names
from drakegrasp.hand.settings import load_config
from drakegrasp.mesh.cloud import Solid
from drakegrasp.objects.model import object_of
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.attempt import Attempt, usual_conditions
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.scene_cache import run_cached
from drakegrasp.vision.depth_image import View, complete

#: Shifts of the palm along Gx and Gy [m], and the factor of the friction, of the further lifts.
SHIFTS, SLIPPERY = 0.004 * np.array([[1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]]), 0.63
#: Logistic weights of the chance of a sample: a constant, for the score by closing, and for the
#: share of lifts. They were fitted to lifts of the Barrett Hand on household meshes, see "Stated
#: chances" in docs/results/choice.md.
WITHOUT_LIFTS, WITH_LIFTS = (-5.6, 8.9), (-5.5, 5.7, 4.1)
#: A grasp is likely from this chance on.
LIKELY = 0.5


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
    solids: Sequence[Solid], view: View | None, config: Config
) -> list[PlacedObject]:
    """Return the object on the table, completed from each of the guessed solids in {T}.

    Args:
        solids: Solids, see `mesh.cloud`.
        view: The image that shows the object; None if it is not known.
        config: The configuration of the lifts, with the mass of the object.

    Raises:
        TooLittleSeenError: If no solid is left.
        MeshError: If a solid cannot be simulated.
    """
    placed = list[PlacedObject]()
    for solid in solids:
        surface = complete(solid.field, view)
        model = object_of(surface, config.objects, name="seen", class_name="seen", mesh_sha256="")
        X_TO = make_pose(np.eye(3), -model.p_OM)
        placed.append(PlacedObject(model=model, X_TO=X_TO, config=config))
    return placed


@one_thread
def lift_shares(completed: Sequence[PlacedObject], starts: Sequence[Attempt]) -> Array:
    """Return the share (n,) of the lifts of each grasp that end as a sample.

    The first grasp all of whose lifts are samples is the last one that is lifted; the rest is NaN.

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
    samples = [_is_sample(placed, start) for placed in completed]
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
    samples += [_is_sample(placed, each) for each in further]
    return float(np.mean(samples))


def _is_sample(placed: PlacedObject, start: Attempt) -> bool:
    """Return whether a lift of the object from a start in {T} ends as a sample."""
    config = placed.config
    attempt = replace(start, X_OG=multiply(invert_pose(placed.X_TO), start.X_OG))
    trial = run_cached(placed.model, placed.X_TO_simulated, attempt, config)
    return judge_sample(placed.model, trial, config) is Removal.KEPT


def chances(score: Array, share: Array) -> Array:
    """Return the chances (n,) that grasps are samples on the real object.

    Args:
        score: (n,), scores by closing.
        share: (n,), shares of their lifts that are samples on the completed object; NaN for a grasp
            that was not lifted.
    """
    constant, of_score = WITHOUT_LIFTS
    logit = constant + of_score * score
    constant, of_score, of_share = WITH_LIFTS
    logit = np.where(np.isnan(share), logit, constant + of_score * score + of_share * share)
    return np.asarray(1.0 / (1.0 + np.exp(-logit)))
