"""The columns of a shard: `/trials`, a row per attempt, and `/looks`, a row per success.

In: attempts, their records and what was measured of them. Out: arrays by the names of
`drakegrasp.dataset.schema`. This only lays out values; `drakegrasp.build.attempts` makes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from drakegrasp.build.attempts import TrialSetup, View
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.schema import CONTACT_NAMES, LINEAGE_NAMES, LOOK_FIELDS, sizes
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.frames import pack_pose
from drakegrasp.objects.contact_fit import ContactFit
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.lift import Lift
from drakegrasp.simulation.randomization.conditions import usual_conditions
from drakegrasp.simulation.scene import hand_joint_names
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.simulation.verdict import is_precision, is_stable

_FIELD_NAMES = frozenset(field.name for field in trial_columns())


def trial_rows(
    setup: TrialSetup,
    attempts: Sequence[Attempt],
    records: Sequence[TrialRecord],
    fits: Sequence[ContactFit | None],
) -> dict[str, AnyArray]:
    """Return the columns of `/trials`.

    Args:
        setup: Says how many fingers, joints and pixels there are.
        attempts: What was tried, in the order of the rows.
        records: The result of each attempt.
        fits: How the contacts of each record lie on the surface, if the hand lifted something.
    """
    shape = array_sizes(setup)
    columns = {f.name: f.empty(len(records), shape) for f in trial_columns()}
    usual = usual_conditions(setup.prepared.model, setup.config.physics)
    for row, (attempt, record, fit) in enumerate(zip(attempts, records, fits, strict=True)):
        conditions = attempt.conditions or usual
        values = _trial_values(attempt, record, fit) | conditions.values()
        for name, value in values.items():
            columns[name][row] = value
    return columns


def empty_looks(setup: TrialSetup, count: int) -> dict[str, AnyArray]:
    """Return the columns of `/looks` for a number of successes, without their values."""
    shape = array_sizes(setup)
    return {f.name: f.empty(count, shape) for f in LOOK_FIELDS}


def fill_look(looks: dict[str, AnyArray], k: int, views: dict[str, View]) -> None:
    """Put the views of the k-th success into the columns of `/looks`."""
    for camera, view in views.items():
        looks[f"image_{camera}"][k] = view.image
        looks[f"mask_{camera}"][k] = view.mask
        looks[f"X_TC_{camera}"][k] = pack_pose(view.X_TC)
        # Where the object is out of sight the frame stays NaN, and a filter removes the sample.
        if view.X_CI is not None:
            looks[f"X_CI_{camera}"][k] = pack_pose(view.X_CI)


def array_sizes(setup: TrialSetup) -> dict[str, int]:
    """Return the array lengths that `schema` leaves open: fingers, joints and pixels."""
    handles = setup.scene.handles
    assert handles is not None
    return sizes(
        fingers=handles.hand.num_fingers,
        joints=len(hand_joint_names(setup.scene)),
        image=setup.config.camera.size,
    )


def _trial_values(attempt: Attempt, record: TrialRecord, fit: ContactFit | None) -> dict[str, Any]:
    # Every attempt has its start.
    values: dict[str, Any] = {
        "candidate": attempt.candidate,
        "standoff_index": attempt.standoff_index,
        **{name: getattr(attempt, name) for name in LINEAGE_NAMES},
        "spread": attempt.spread,
        "seed": attempt.seed,
        "audited": attempt.audited,
        "chance": record.chance,
        "outcome": record.outcome,
        "X_TO": pack_pose(record.X_TO),
        "X_OG": pack_pose(record.X_OG),
    }

    # What a stage did not reach keeps the column's fill value.
    if (closed := record.closed) is not None:
        values |= {"time_close": closed.duration, "closed_q": closed.q}
        values |= _contact_values("closed", closed.contacts)
    if (lift := record.lift) is not None:
        values |= {"time_lift": lift.duration, "lifted_q": lift.q}
        values |= _contact_values("lifted", lift.contacts)
        values |= {"X_TO_lifted": pack_pose(lift.X_TO), "X_OG_lifted": pack_pose(lift.X_OG)}
        values |= _hold_values(record.outcome, lift)
    if fit is not None:
        values |= {"surface_distance": fit.distance, "normal_angle": fit.normal_angle}
    return values


def _hold_values(outcome: Outcome, lift: Lift) -> dict[str, Any]:
    """Return how the object moved in the hand, and the labels that follow from it."""
    names = ("slip", "turn", "slip_released", "turn_released")
    other_links = lift.contacts.other_links
    return {name: getattr(lift, name) for name in names} | {
        "precision": is_precision(outcome, other_links),
        "stable": is_stable(outcome, other_links, lift.slip, lift.turn),
    }


def _contact_values(prefix: str, contacts: Contacts) -> dict[str, Any]:
    names = {f"{prefix}_{name}": name for name in CONTACT_NAMES}
    return {key: getattr(contacts, name) for key, name in names.items() if key in _FIELD_NAMES}
