"""A made-up trial, for tests of what is said and written about verdicts."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from helpers.objects import standing

from drakegrasp.filters import Removal
from drakegrasp.frames import Array, make_pose
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import ObjectModel
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.contacts import Contacts
from drakegrasp.simulation.lift import Lift
from drakegrasp.simulation.placement import PlacedObject
from drakegrasp.simulation.trial import Closed, TrialRecord
from drakegrasp.verification.placing import PlacedGrasp
from drakegrasp.verification.result import PoseTrial, Verification
from drakegrasp.verification.wrist_solver import WristFit


def some_contacts(**values: Any) -> Contacts:
    """Return contacts of three fingertips, all of which touch, with other values where given."""
    usual: dict[str, Any] = {
        "touching": np.ones(3, dtype=bool), "p_OQ": np.zeros((3, 3)), "nhat_Q_O": np.eye(3),
        "f_Q_O": np.eye(3), "area": np.ones(3), "penetration": np.zeros(3), "other_links": 0,
        "hand_on_table": False, "object_on_table": False, "table_force": np.zeros(3),
        "point_contacts": 0,
    }  # fmt: skip
    return Contacts(**usual | values)


def some_trial(
    X_TO: Array, closed: Contacts, lifted: Contacts, *, outcome: Outcome, slip: float, turn: float
) -> TrialRecord:
    """Return the record of a trial that lifted, with these contacts and motions [m], [rad]."""
    X_OG, rng = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.1]), np.random.default_rng(1)
    lift = Lift(
        contacts=lifted,
        q=rng.random(8),
        duration=2.5,
        X_TO=make_pose(np.eye(3), [0.0, 0.0, 0.5]),
        X_OG=X_OG,
        slip=slip,
        turn=turn,
        slip_released=0.5 * slip,
        turn_released=0.5 * turn,
        moved=False,
    )
    closing = Closed(contacts=closed, q=rng.random(8), duration=1.5)
    return TrialRecord(outcome=outcome, X_TO=X_TO, X_OG=X_OG, closed=closing, lift=lift)


def some_fit(X_OG: Array, **values: Any) -> WristFit:
    """Return a solution of the wrist problem, with other values where given."""
    usual: dict[str, Any] = {
        "spread": 0.25, "closing": np.array([0.5, 0.6, 0.7]), "objective": 1e-6,
        "residual": np.array([0.0, 1e-3, 1 / 3]), "normal_error": np.deg2rad([1.0, 2.0, 60.0]),
    }  # fmt: skip
    return WristFit(X_OG=X_OG, **usual | values)


def some_try(trial: TrialRecord, **values: Any) -> PoseTrial:
    """Return the trial of a wrist pose whose contacts are a few millimetres off."""
    held = trial.outcome is Outcome.SUCCESS
    start = Attempt(X_OG=trial.X_OG, spread=0.25, closing=np.array([0.1, 0.2, 0.3]))
    usual: dict[str, Any] = {
        "fit": some_fit(trial.X_OG), "pregrasp": start, "trial": trial,
        "contact_error": np.array([0.001, 0.002, 0.003]),
        "normal_error": np.deg2rad([3.0, 4.0, 5.0]), "removal": Removal.KEPT if held else None,
    }  # fmt: skip
    return PoseTrial(**usual | values)


def some_verdict(model: ObjectModel, **values: Any) -> Verification:
    """Return a verdict on contacts of three fingertips on an object, with other values where given.

    Fields of the grasp may be among the values. Epsilon and hints are none, unless given.
    """
    nothing = np.full((3, 3), np.nan)
    grasp: dict[str, Any] = {
        "index": 0, "stands": (PlacedObject(model=model, X_TO=standing(model)),),
        "config": load_config(), "p_AQ": nothing, "nhat_Q_A": nothing,
    }  # fmt: skip
    names = {f.name for f in fields(PlacedGrasp)}
    grasp |= {name: values.pop(name) for name in names & values.keys()}
    usual: dict[str, Any] = {
        "outcome": Outcome.DROPPED, "reason": "so it is", "p_OQ": np.zeros((3, 3)),
        "nhat_Q_O": np.eye(3), "surface_distance": np.zeros(3), "margin": np.nan,
        "told": (),
    }  # fmt: skip
    return Verification(grasp=PlacedGrasp(**grasp), **usual | values)


def asked_otherwise(verdict: Verification, **values: Any) -> Verification:
    """Return a verdict on a grasp with other values."""
    return replace(verdict, grasp=replace(verdict.grasp, **values))
