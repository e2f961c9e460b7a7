"""Compare the inverse kinematics of `drakegrasp reach` with another solver, and time it.

The other solver is written without it: damped Newton with the Jacobians of Drake, one start after
the other, from 200 starts. Poses are those of drawn configurations, and of the palms of a dataset.

Usage: python pipelines/measurements/reach.py [OUT] --arm panda --poses 200
"""

from __future__ import annotations

import time
from pathlib import Path

import click
import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable

from drakegrasp.dataset.trials import Trials
from drakegrasp.filters import Removal
from drakegrasp.frames import Array, invert_pose, unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.reach.arm import load_arm, mount_of
from drakegrasp.reach.branches import find_branches, flange_poses
from drakegrasp.reach.cell import Cell, make_cell

STARTS, STEPS = 200, 100


def newton(cell: Cell, X_TF: Array, q: Array) -> Array | None:
    """Return a configuration (a,) of a pose from a start (a,), or None."""
    plant, context = cell.checker.plant(), cell.checker.plant_context()
    flange, world = plant.GetFrameByName(cell.arm.flange), plant.world_frame()
    q, closed = q.copy(), np.zeros(len(cell.hand_columns))
    for _ in range(STEPS):
        cell.checker.UpdatePositions(cell.positions(q, closed))
        X = flange.CalcPoseInWorld(context).GetAsMatrix4()
        R = X_TF[:3, :3] @ X[:3, :3].T
        axis = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        cosine = np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0)
        turn = axis * np.arccos(cosine) / max(float(np.linalg.norm(axis)), 1e-9)
        error = np.concatenate([turn, X_TF[:3, 3] - X[:3, 3]])
        if np.linalg.norm(error[:3]) < 1e-4 and np.linalg.norm(error[3:]) < 1e-5:
            return q
        J = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kQDot, flange, np.zeros(3), world, world
        )[:, cell.arm_columns]
        damping = 1e-4 + 0.05 * float(error @ error)
        step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)
        q = np.clip(q + np.clip(step, -0.4, 0.4), cell.limits[:, 0], cell.limits[:, 1])
    return None


def _apart(found: Array, q: Array) -> float:
    """Return by how much a configuration (a,) differs from the nearest of (n, a), without turns."""
    return float(np.abs(2.0 * np.sin((found - q) / 2.0)).max(axis=1).min()) if len(found) else np.pi


def drawn_poses(cell: Cell, count: int, rng: np.random.Generator) -> Array:
    """Return flange poses (n, 4, 4) of drawn configurations."""
    q = cell.limits[:, 0] + rng.random((count, len(cell.limits))) * np.ptp(cell.limits, axis=1)
    return flange_poses(cell.chain, q)[0]


def palm_poses(cell: Cell, out: Path, count: int) -> Array:
    """Return flange poses (n, 4, 4) of samples of a dataset."""
    trials = Trials(out)
    samples = trials[trials["removal"] == Removal.KEPT]
    chosen = samples[np.linspace(0, len(samples) - 1, min(count, len(samples))).astype(int)]
    X_TO, X_OG = (unpack_pose(chosen[name]) for name in ("X_TO", "X_OG"))
    return X_TO @ X_OG @ invert_pose(cell.X_FG)


@click.command()
@click.argument("out", type=click.Path(path_type=Path), required=False)
@click.option("--arm", "name", default="panda")
@click.option("--hand", default="barrett")
@click.option("--poses", default=200)
def main(out: Path | None, name: str, hand: str, poses: int) -> None:
    """Print who finds configurations that the other does not, and the time of a pose."""
    arm, rng = load_arm(name, (-0.5, 0.0, 0.0, 0.0)), np.random.default_rng(0)
    cell = make_cell(arm, hand, mount_of(arm, load_hand(hand)))
    goals = drawn_poses(cell, poses, rng) if out is None else palm_poses(cell, out, poses)
    both, ours_only, theirs_only, seconds, missed, found_branches = 0, 0, 0, 0.0, 0, 0
    for X_TF in goals:
        begin = time.process_time()
        ours = find_branches(cell.chain, cell.limits, X_TF)
        seconds += time.process_time() - begin
        lower, upper = np.clip(cell.limits, -np.pi, np.pi).T
        starts = lower + rng.random((STARTS, len(lower))) * (upper - lower)
        theirs = [q for start in starts if (q := newton(cell, X_TF, start)) is not None]
        both += bool(len(ours)) and bool(theirs)
        ours_only += bool(len(ours)) and not theirs
        theirs_only += bool(theirs) and not len(ours)
        # For six joints: how many of their branches, without whole turns, are not among ours?
        if len(lower) == 6:
            apart = [_apart(ours, q) for q in theirs]
            missed += sum(each > 0.05 for each in apart)
            found_branches += len(theirs)
    click.echo(f"{len(goals)} poses: both {both}, only ours {ours_only}, only theirs {theirs_only}")
    click.echo(f"{1e3 * seconds / len(goals):.1f} ms a pose; {missed} of {found_branches} missed")


if __name__ == "__main__":
    main()
