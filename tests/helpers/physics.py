"""What must hold of every attempt of a simulated dataset: its verdict, its motion, its draws."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import model_path
from drakegrasp.dataset.schema import CONDITION_FIELDS
from drakegrasp.dataset.trials import Trials
from drakegrasp.frames import invert_pose, unpack_pose
from drakegrasp.grasp import unused_fingers
from drakegrasp.objects.model import load_object
from drakegrasp.outcomes import Outcome, Stage
from drakegrasp.simulation.attempt import draw_conditions
from drakegrasp.simulation.contacts import scrapes
from drakegrasp.simulation.trial import STABLE_SLIP, STABLE_TURN, judge_closed, judge_lifted

#: As exact as the poses: the angle of a rotation close to the identity is less exact than a matrix.
MOTION = 1e-4  # [m], [rad]
#: Largest outward force [N] of a fingertip on the object: mean normal and force of a patch are
#: separate averages, and may disagree by the smallest force that counts as a contact.
PULL = 0.05


def broken_physics(out: Path) -> dict[str, list[int]]:
    """Return the rows of /trials that break a rule, by the rules that are broken."""
    manifest, trials = read_manifest(out), Trials(out).columns()
    config, outcome = manifest.config, trials["outcome"]

    # The verdict follows from contacts, clearance and motion.
    required = np.array([*json.loads(Trials(out).attributes["fingers"]).values()] or [True])
    required = required & ~unused_fingers(trials["unused"], trials["closed_touching"].shape[1])
    judges = {
        "close": (judge_closed, ("closed_touching", "closed_other_links", "closed_hand_on_table")),
        "lift": (judge_lifted, ("lifted_touching", "lifted_other_links", "lifted_object_on_table")),
    }
    closed, due = (
        np.array(
            [
                judge(*of_row, required=fingers, scraped=scrapes(clearance, config.close))
                for *of_row, fingers, clearance in zip(
                    *(trials[name] for name in names),
                    required,
                    trials[f"clearance_{when}"],
                    strict=True,
                )
            ]
        )
        for when, (judge, names) in judges.items()
    )
    slipped, turned = trials["slip"], np.degrees(trials["turn"])
    lost = (slipped > config.lift.stop_slip) | (turned > config.lift.stop_turn_deg)
    lost &= config.lift.stop_when == "lost_sample"
    due = np.where((outcome == Outcome.MOVED) & lost, outcome, due)
    due = np.where(closed != Outcome.SUCCESS, closed, due)
    stage = np.array([Outcome(code).stage for code in outcome.tolist()])
    lifted = np.isfinite(trials["time_lift"])
    rules = {"verdict": (stage >= Stage.CLOSED) & (due != outcome)}

    # The object's motion in the hand follows from the two poses of the palm.
    before, after = (invert_pose(unpack_pose(trials[name])) for name in ("X_OG", "X_OG_lifted"))
    slip = np.linalg.norm(after[:, :3, 3] - before[:, :3, 3], axis=1)
    cosine = (np.einsum("nij,nij->n", before[:, :3, :3], after[:, :3, :3]) - 1.0) / 2.0
    turn = np.arccos(np.clip(cosine, -1.0, 1.0))
    for name, motion in (("slip", slip), ("turn", turn)):
        rules[name] = lifted & ~(np.abs(trials[name] - motion) <= MOTION)
    precision = (outcome == Outcome.SUCCESS) & (trials["lifted_other_links"] == 0)
    stable = precision & (trials["slip"] < STABLE_SLIP) & (trials["turn"] < STABLE_TURN)
    rules["precision"] = lifted & (trials["precision"] != precision)
    rules["stable"] = lifted & (trials["stable"] != stable)

    # Fingertips that hold an object push into it.
    for when in ("closed", "lifted"):
        push = (trials[f"{when}_nhat_Q_O"] * trials[f"{when}_f_Q_O"]).sum(axis=2)
        touching = trials[f"{when}_touching"] & (outcome == Outcome.SUCCESS)[:, None]
        rules[f"force {when}"] = (touching & ~(push < PULL)).any(axis=1)

    # Resting poses are those of the manifest, and conditions those that the seed draws.
    rules |= {name: np.zeros(len(outcome), dtype=bool) for name in ("resting", "conditions")}
    for i, entry in enumerate(manifest.objects):
        model, own = load_object(model_path(out, entry.name)), manifest.config
        for row in np.flatnonzero(trials["object"] == i).tolist():
            X_TO = entry.resting[int(trials["resting"][row])].X_TO
            rules["resting"][row] = np.abs(trials["X_TO"][row] - X_TO).max() > 1e-9
            number = (int(trials[name][row]) for name in ("candidate", "standoff_index"))
            drawn = draw_conditions(model, own, *number).values()
            same = (np.array_equal(trials[f.name][row], drawn[f.name]) for f in CONDITION_FIELDS)
            rules["conditions"][row] = not all(same)
    return {name: np.flatnonzero(bad).tolist() for name, bad in rules.items() if bad.any()}
