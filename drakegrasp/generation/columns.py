"""The columns of a shard: `/trials`, a row per attempt, and `/looks`, a row per success.

In: attempts, their records and what was measured of them. Out: arrays by the names of
`drakegrasp.dataset.schema`. This only lays out values; `drakegrasp.generation.attempts` makes
them. A verdict asks the filters of a dataset about the columns that a trial alone has.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.config import Config, FilterConfig
from drakegrasp.dataset.assembly.survey import successes_of
from drakegrasp.dataset.schema import LOOK_FIELDS, NO_PRESHAPE, Field, sizes
from drakegrasp.dataset.shards import trial_columns
from drakegrasp.filters import RULES, Removal, first_removal
from drakegrasp.frames import pack_pose
from drakegrasp.generation.attempts import TrialSetup, View
from drakegrasp.grasp import unused_fingers
from drakegrasp.objects.model import ContactFit, ObjectModel, fit_contacts
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.conditions import Conditions, usual_conditions
from drakegrasp.simulation.scene import hand_joint_names
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.table import AnyArray, Table
from drakegrasp.vision.camera import camera_pose_otm, camera_pose_oto


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
    """Return the columns of `/trials` that the attempts themselves give.

    Args:
        setup: Says how many fingers, joints and pixels there are.
        attempts: What was tried, in the order of the rows.
        records: The result of each attempt.
        fits: How the contacts of each record lie on the surface, if the hand lifted something.
    """
    fields, shape = [f for f in trial_columns() if f.of], array_sizes(setup)
    columns = {field.name: field.empty(len(records), shape) for field in fields}
    usual = usual_conditions(setup.prepared.model, setup.config.physics)
    hand = setup.scene.hand
    # The index of a preshape, of which a posture has none.
    columns["preshape"][:] = NO_PRESHAPE if hand.preshapes else 0
    for i, (attempt, record, fit) in enumerate(zip(attempts, records, fits, strict=True)):
        row = TrialRow(attempt, attempt.conditions or usual, record, fit)
        _fill_row(columns, i, fields, row, hand.num_fingers)
    return columns


def _fill_row(
    columns: dict[str, AnyArray], i: int, fields: Sequence[Field], row: TrialRow, fingers: int
) -> None:
    """Put the values of a row into its place of the columns."""
    used = ~unused_fingers(row.attempt.unused, fingers)
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


def judge_sample(
    model: ObjectModel, trial: TrialRecord, config: Config, *, views: bool = True
) -> Removal | None:
    """Return the first filter that removes a held grasp, `KEPT` if none does.

    The cameras are where a build puts them without randomisation.

    Args:
        model: The object.
        trial: Of the grasp.
        config: With the filters and the camera.
        views: Whether the filters of the view of a camera count: where it is, and whether it sees
            the contacts. They do not where the palm is off, as the picture was taken before.

    Returns:
        The filter; None for a trial that is no success.
    """
    if trial.outcome is not Outcome.SUCCESS:
        return None

    # Its row of /trials, as a build would write it.
    assert trial.closed is not None
    closed = trial.closed.contacts
    fingers = len(closed.touching)
    row = TrialRow(
        attempt=Attempt(
            X_OG=trial.X_OG, spread=0.0, candidate=0, standoff_index=0, standoff=0.0, seed=0
        ),
        conditions=usual_conditions(model, config.physics),
        trial=trial,
        fit=fit_contacts(model, closed.p_OQ, closed.nhat_Q_O),
    )
    fields = [field for field in trial_columns() if field.of]
    shape = sizes(fingers=fingers, joints=len(trial.closed.q), image=0)
    columns = {field.name: field.empty(1, shape) for field in fields}
    _fill_row(columns, 0, fields, row, fingers)

    # And where the cameras would be.
    if views:
        X_TG = multiply(trial.X_TO, trial.X_OG)
        for name, pose in (("oto", camera_pose_oto), ("otm", camera_pose_otm)):
            columns[f"X_TC_{name}"] = pack_pose(pose(X_TG, config.camera))[None]
    successes = successes_of(Table(columns), config.camera)
    return Removal(int(first_removal(successes, config.filters)[0]))


#: Of the filters' columns, those that only pictures of a success show.
_OF_PICTURES = {"seen", "depth_variance"}


def unjudged(rules: FilterConfig) -> tuple[Removal, ...]:
    """Return the filters, of those that are on, about which a verdict knows nothing."""
    of_pictures = (rule for rule in RULES if rule.is_on(rules) and {*rule.needs} & _OF_PICTURES)
    others = {Removal.OUTLIER: rules.outlier_sigma > 0.0, Removal.OWN: bool(rules.own)}
    return (
        *(rule.removal for rule in of_pictures),
        *(reason for reason, on in others.items() if on),
    )
