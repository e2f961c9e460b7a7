"""Measure how firmly a dataset's held grasps hold: slip, turn, and whether they balance gravity.

\b
    python pipelines/measurements/hold_quality.py OUT > hold_quality.json

For every held grasp the script determines, without a simulation, whether forces in the friction
cones can support the object's weight: at the contacts after closing, in the resting pose, and at
the contacts after the lift, in the pose at that time. A contact is a point, or a patch: a disc of
the stored area whose rim transmits the force. The friction is that of the dataset. The script
prints JSON.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog

from drakegrasp.dataset.paths import TRIALS_FILE, model_path
from drakegrasp.frames import unpack_pose
from drakegrasp.objects.model import load_object
from drakegrasp.outcomes import Outcome

#: Number of edges of a linearised friction cone, and of points on the rim of a patch.
EDGES, RIM = 16, 8
#: Maximum normal forces of a fingertip for which balance is tested [N].
LIMITS = (20.0, 40.0, np.inf)
GRAVITY = 9.81

Array = npt.NDArray[np.float64]


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
def main(out: Path) -> None:
    """Run the script."""
    with h5py.File(out / TRIALS_FILE) as file:
        trials = {name: column[()] for name, column in file["trials"].items()}
        names = file["objects/name"].asstr()[()]
        removal = file["successes/removal"][()]
    click.echo(json.dumps(figures(out, trials, names, removal), indent=1))


def figures(
    out: Path, trials: dict[str, Any], names: npt.NDArray[Any], removal: Any
) -> dict[str, Any]:
    """Return all figures of a dataset."""
    attempts = len(trials["outcome"])
    held = np.flatnonzero(trials["outcome"] == Outcome.SUCCESS)
    alone = trials["lifted_other_links"][held] == 0
    slip, turn = trials["slip"][held], np.degrees(trials["turn"][held])
    stable = alone & (slip < 0.005) & (turn < 5.0)
    sample = removal == 0

    # Balance of gravity for each grasp: after closing and after the lift, as points and patches.
    balance: dict[str, dict[str, npt.NDArray[np.bool_]]] = {}
    models = {
        name: load_object(model_path(out, name)) for name in set(names[trials["object"][held]])
    }
    for stage, pose in (("closed", "X_TO"), ("lifted", "X_TO_lifted")):
        for kind in ("points", "patches"):
            answers = [
                _balances(trials, row, stage, pose, models[names[trials["object"][row]]], kind)
                for row in held.tolist()
            ]
            balance[f"{stage}, {kind}"] = {
                f"{limit:g} N" if np.isfinite(limit) else "any force": np.array(
                    [answer <= limit and np.isfinite(answer) for answer in answers], dtype=bool
                )
                for limit in LIMITS
            }

    groups = {
        "held": np.ones(len(held), dtype=bool),
        "precision": alone,
        "stable": stable,
        "samples": sample,
    }
    return {
        "attempts": attempts,
        "lifts": int(np.isfinite(trials["slip"]).sum()),
        "objects with a held grasp": len(np.unique(trials["object"][held])),
        "samples per 1,000 attempts": round(1e3 * float(sample.sum()) / attempts, 2),
        **{
            name: {
                "count": int(rows.sum()),
                "share of held": _share(rows),
                "slip, median and 90 % [mm]": _quantiles(1e3 * slip[rows]),
                "turn, median and 90 % [deg]": _quantiles(turn[rows]),
                "on other links at the end": _share(~alone[rows]),
                "balance gravity": {
                    key: {limit: _share(answer[rows]) for limit, answer in by_limit.items()}
                    for key, by_limit in balance.items()
                },
            }
            for name, rows in groups.items()
        },
    }


def _balances(
    trials: dict[str, Any], row: int, stage: str, pose: str, model: Any, kind: str
) -> float:
    """Return the smallest limit of the fingertips' normal forces [N] that supports the weight.

    The result is inf if no forces support it.
    """
    p, n = trials[f"{stage}_p_OQ"][row], trials[f"{stage}_nhat_Q_O"][row]
    if not (np.isfinite(p).all() and np.isfinite(n).all()):
        return np.inf
    radius = (
        np.sqrt(trials[f"{stage}_area"][row] / np.pi) if kind == "patches" else np.zeros(len(p))
    )

    # The edges of all cones as wrenches about the centre of mass, with a normal force of 1 N.
    friction, mass = trials["friction_hand"][row], trials["mass"][row]
    forces, points, finger = [], [], []
    angles = 2.0 * np.pi * np.arange(EDGES) / EDGES
    rims = 2.0 * np.pi * np.arange(RIM) / RIM if kind == "patches" else np.zeros(1)
    for i in range(len(p)):
        u = np.cross(n[i], np.eye(3)[np.argmin(np.abs(n[i]))])
        u /= np.linalg.norm(u)
        v = np.cross(n[i], u)
        for rim in rims:
            point = p[i] + radius[i] * (np.cos(rim) * u + np.sin(rim) * v)
            for angle in angles:
                forces.append(-n[i] + friction * (np.cos(angle) * u + np.sin(angle) * v))
                points.append(point)
                finger.append(i)
    f = np.array(forces)
    wrenches = np.vstack([f.T, np.cross(np.array(points) - model.p_OOcm, f).T * 10.0])

    # Minimize t such that the sum of each finger's normal forces is at most t.
    R_TO = unpack_pose(trials[pose][row])[:3, :3]
    weight = np.concatenate([R_TO.T @ [0.0, 0.0, mass * GRAVITY], np.zeros(3)])
    fingers = np.eye(len(p))[np.array(finger)].T
    result = linprog(
        np.append(np.zeros(len(f)), 1.0),
        A_ub=np.column_stack([fingers, -np.ones(len(p))]),
        b_ub=np.zeros(len(p)),
        A_eq=np.column_stack([wrenches, np.zeros(6)]),
        b_eq=weight,
    )
    return float(result.x[-1]) if result.status == 0 else np.inf


def _share(rows: npt.NDArray[np.bool_]) -> float | None:
    return round(float(rows.mean()), 3) if len(rows) else None


def _quantiles(values: Array) -> list[float] | None:
    return [round(float(v), 2) for v in np.quantile(values, [0.5, 0.9])] if len(values) else None


if __name__ == "__main__":
    main()
