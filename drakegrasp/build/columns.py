"""The columns of a shard: `/trials`, a row per attempt, and `/looks`, a row per success.

In: attempts, their records and what was measured of them. Out: arrays by the names of
`drakegrasp.dataset.schema`. This only lays out values; `drakegrasp.build.attempts` makes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drakegrasp.build.attempts import TrialSetup, View
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.schema import LOOK_FIELDS, NO_PRESHAPE, sizes
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.frames import pack_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.objects.contact_fit import ContactFit
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.randomization.conditions import Conditions, usual_conditions
from drakegrasp.simulation.scene import hand_joint_names
from drakegrasp.simulation.trial import TrialRecord


class TrialRow(NamedTuple):
    """What a row of `/trials` is made of; `Field.of` in the schema says of which part.

    Attributes:
        attempt: What was tried.
        conditions: Its friction, mass, looks and cameras.
        trial: What happened.
        fit: How the contacts after closing lie on the surface, if the hand lifted something.
    """

    attempt: Attempt
    conditions: Conditions
    trial: TrialRecord
    fit: ContactFit | None


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
    fields, shape = trial_columns(), array_sizes(setup)
    columns = {field.name: field.empty(len(records), shape) for field in fields}
    usual = usual_conditions(setup.prepared.model, setup.config.physics)
    hand = setup.scene.hand
    # The index of a preshape, of which a posture has none.
    columns["preshape"][:] = NO_PRESHAPE if hand.preshapes else 0
    for i, (attempt, record, fit) in enumerate(zip(attempts, records, fits, strict=True)):
        row = TrialRow(attempt, attempt.conditions or usual, record, fit)
        used = ~unused_fingers(attempt.unused, hand.num_fingers)
        for field in fields:
            # What a stage did not reach keeps the column's fill value.
            value = field.value_of(row)
            if value is None:
                continue
            if field.shape.startswith("k"):
                # A finger that a preshape does not use has no contact, and no force.
                columns[field.name][i] = np.nan if field.per_finger else 0
                columns[field.name][i][used] = value
            else:
                columns[field.name][i] = pack_pose(value) if field.shape == "12" else value
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
    return sizes(
        fingers=setup.scene.hand.num_fingers,
        joints=len(hand_joint_names(setup.scene)),
        image=setup.config.camera.size,
    )
