"""Whether a held grasp would be a sample of a dataset, by the filters of its configuration.

In: a trial of a build's kind. Out: the first filter that removes it, as `dataset.filters` decides.
What a filter needs and a verdict lacks (the images, the other grasps of the object) counts as
passed; `unjudged` names those filters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drakegrasp.arithmetic import multiply
from drakegrasp.build.columns import TrialRow
from drakegrasp.config import Config, FilterConfig
from drakegrasp.dataset.assembly.survey import SURVEYED, successes_of
from drakegrasp.dataset.filters import judge_successes
from drakegrasp.dataset.hdf5 import AnyArray
from drakegrasp.dataset.schema import CERTIFICATE_FIELDS, TRIAL_FIELDS, sizes
from drakegrasp.frames import pack_pose
from drakegrasp.objects.contact_fit import fit_contacts
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.simulation.candidates import Attempt
from drakegrasp.simulation.randomization.conditions import usual_conditions
from drakegrasp.simulation.trial import TrialRecord
from drakegrasp.vision.camera import camera_pose_otm, camera_pose_oto, intrinsics


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
    rules = config.filters.model_copy(update={"min_depth_variance": 0.0, "outlier_sigma": 0.0})
    successes = successes_of(
        _trial_columns(model, trial, config),
        _looks(trial, config),
        np.zeros((1, 1, 1)),
        object=0,
        K=intrinsics(config.camera),
    )
    if not views:
        height = np.full(1, np.inf)
        successes = replace(successes, in_view=np.ones(1, dtype=np.bool_), camera_height=height)
    (removal,) = judge_successes(successes, rules, removed_by_own=np.zeros(1, dtype=np.bool_))
    return Removal(int(removal))


def unjudged(rules: FilterConfig) -> tuple[Removal, ...]:
    """Return the filters, of those that are on, about which a verdict knows nothing."""
    on = {
        Removal.NOT_SEEN: True,
        Removal.FLAT_DEPTH: rules.min_depth_variance > 0.0,
        Removal.OUTLIER: rules.outlier_sigma > 0.0,
        Removal.OWN: bool(rules.own),
    }
    return tuple(removal for removal, is_on in on.items() if is_on)


def _trial_columns(model: ObjectModel, trial: TrialRecord, config: Config) -> dict[str, AnyArray]:
    """Return what a row of `/trials` would hold of a trial, of the columns that filters need."""
    assert trial.closed is not None
    closed = trial.closed.contacts
    row = TrialRow(
        attempt=Attempt(
            X_OG=trial.X_OG, spread=0.0, candidate=0, standoff_index=0, standoff=0.0, seed=0
        ),
        conditions=usual_conditions(model, config.physics),
        trial=trial,
        fit=fit_contacts(model, closed.p_OQ, closed.nhat_Q_O),
    )
    shape = sizes(fingers=len(closed.touching), joints=len(trial.closed.q), image=0)
    columns = {}
    for field in TRIAL_FIELDS:
        if field.name in SURVEYED:
            column, value = field.empty(1, shape), field.value_of(row)
            column[0] = pack_pose(value) if field.shape == "12" else value
            columns[field.name] = column
    return columns


def _looks(trial: TrialRecord, config: Config) -> dict[str, AnyArray]:
    """Return the row of `/looks` with the poses of the usual cameras, which see the object."""
    X_TG, size = multiply(trial.X_TO, trial.X_OG), config.camera.size
    looks: dict[str, AnyArray] = {field.name: np.full(1, np.nan) for field in CERTIFICATE_FIELDS}
    for name, pose in (("oto", camera_pose_oto), ("otm", camera_pose_otm)):
        looks[f"X_TC_{name}"] = pack_pose(pose(X_TG, config.camera))[None]
        looks[f"mask_{name}"] = np.ones((1, size, size), dtype=np.uint8)
    return looks
