"""The trial of one posture of the user's own.

In: an object on the table and a posture. Out: a `TrialRecord`, as of every attempt.
"""

from __future__ import annotations

from drakegrasp.config import Config, with_whole_lifts
from drakegrasp.errors import GraspError
from drakegrasp.hand.description import load_hand
from drakegrasp.runtime.environment import one_thread
from drakegrasp.simulation.placement import PlacedObject, config_for, refuse_other_objects
from drakegrasp.simulation.postures.posture import Posture, make_posture, start_of
from drakegrasp.simulation.scene_cache import cached_scene, forget_scenes
from drakegrasp.simulation.trial import TrialRecord, run_attempt


@one_thread
def run_trial(placed: PlacedObject, posture: Posture, config: Config | None = None) -> TrialRecord:
    """Close a simulated hand by a posture, lift the object, and return what happened.

    The object is simulated at `PlacedObject.X_TO_simulated`. A closed hand that may lift always
    does, and until it is certain whether it holds, whatever `lift` says. Contacts are those of the
    fingers of the posture's preshape.

    Args:
        placed: The object on the table, see `place_object`.
        posture: Wrist and joints, see `make_posture`.
        config: Hand, physics and lift; that of the placed object if None.

    Raises:
        GraspError: If the posture is none of the hand, or `placed` is no placed object.
        ConfigError: If the object was placed with other values, or the hand cannot have the drive.
        HandError: If the hand cannot be used.
    """
    if not isinstance(placed, PlacedObject):
        raise GraspError(f"placed must be of place_object, got a {type(placed).__name__}")
    if not isinstance(posture, Posture):
        raise GraspError(f"posture must be a Posture, got a {type(posture).__name__}")
    config = with_whole_lifts(config_for(placed, config))
    refuse_other_objects(config, placed.config, "as the object was placed with")
    hand = load_hand(config.hand_source)
    vectors = posture.q_grasp, posture.q_pregrasp, posture.q_squeeze
    start = start_of(make_posture(hand, posture.X_OG, *vectors, preshape=posture.preshape), hand)
    scene = cached_scene(placed.model, config.physics, config.hand_source, start.preshape)
    trial = run_attempt(scene, placed.X_TO_simulated, start, config)

    # A scene in which Drake failed is never used again.
    if trial.outcome.inconclusive:
        forget_scenes()
    return trial
