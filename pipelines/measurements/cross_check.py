"""Try stored lifts of a dataset again in MuJoCo, and count how often both simulators agree.

    python pipelines/measurements/cross_check.py OUT 600 --out report.json

The lifts are drawn with the dataset's seed, so that every machine draws the same. They are drawn in
turn from samples, from lifted grasps that the filters removed, and from lost lifts, and within each
group in turn from all objects. Each lift is tried from the stored palm pose and spread, with the
dataset's configuration and drive. The script needs the extra `[peer]`. It prints JSON for each
group: how many lifts were drawn, how many are tried in MuJoCo (after closing all pads touch, and
nothing else), how many hold there, the fractions with their 95 % confidence intervals, and why the
others had no lift. The report also has one row per lift.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from importlib import metadata
from itertools import chain, groupby, islice, zip_longest
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import click
import numpy as np
from scipy.stats import binomtest

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import installed_versions, read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.frames import unpack_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import LOST, Outcome
from drakegrasp.runtime.environment import one_thread, require_mujoco
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.seeding import Stream, object_key
from drakegrasp.simulation.attempt import Attempt, Materials, usual_conditions
from drakegrasp.simulation.drive import drive_of

T = TypeVar("T")
#: Result of a lift in the dataset: a sample, lifted but removed by the filters, or lost.
Group = Literal["sample", "removed", "lost"]
GROUPS: tuple[Group, ...] = get_args(Group)
#: Outcomes of lifts that were lost. `table_contact` after closing is not a lift. An attempt that
#: `moved` has no verdict to compare, and belongs to no group.
ENDS = (*LOST, Outcome.TABLE_CONTACT)
#: Last number of the key of the random stream that draws lifts; the split's number is 1.
_PLACE = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class StoredLift:
    """A lift of a dataset.

    Attributes:
        trial_id: Row of the trial.
        object_name: Name of the object.
        group: Result of the lift in the dataset.
        outcome: Outcome of the lift in the dataset.
        resting: Index of the object's resting pose.
        pregrasp: Palm pose and spread from which the hand closed.
        materials: Friction and mass with which the lift was tried.
    """

    trial_id: int
    object_name: str
    group: Group
    outcome: Outcome
    resting: int
    pregrasp: Attempt
    materials: Materials


def draw_lifts(out: Path, count: int) -> list[StoredLift]:
    """Return lifts of a dataset, in equal numbers of each group and object as far as available.

    The selection depends only on the dataset and its seed.

    Args:
        out: Directory of the dataset.
        count: Number of lifts; all lifts are returned if there are fewer.

    Raises:
        DataError: If there is no dataset, or no lift in it.
    """
    manifest = read_manifest(out)
    seed = manifest.config.seed
    lifts = _read_lifts(out)
    if not lifts:
        raise DataError(f"{out}: must be a dataset with lifts, got one in which no lift was tried")

    # Each group takes its objects in turn, and the groups are taken in turn.
    piles = []
    for number, group in enumerate(GROUPS):
        members = [lift for lift in lifts if lift.group == group]
        by_object = []
        for name, same in groupby(members, key=lambda lift: lift.object_name):
            pile = list(same)
            order = Stream(seed, object_key(name), number, _PLACE).permutation(len(pile))
            by_object.append([pile[i] for i in order])
        piles.append(_in_turns(by_object))
    return list(islice(_in_turns(piles), count))


@one_thread
def cross_check(out: Path, count: int) -> dict[str, Any]:
    """Try lifts of a dataset again in MuJoCo and return the report.

    Args:
        out: Directory of the dataset.
        count: Number of lifts, see `draw_lifts`.
    """
    manifest = read_manifest(out)
    config, lifts, rows = manifest.config, draw_lifts(out, count), list[dict[str, Any]]()

    # Each object is cut into convex parts only once.
    with progress_bar("cross-check", "lifts") as progress:
        for name, same in groupby(sorted(lifts, key=_by_object), key=lambda x: x.object_name):
            for row in _try_object(out, name, list(same), manifest.config):
                rows.append(row)
                progress(len(rows), len(lifts), lifted=sum(_holds(row) for row in rows))
    return {
        "drive": drive_of(load_hand(config.hand_source), config.lift),
        "groups": {
            group: agreement([row for row in rows if row["group"] == group]) for group in GROUPS
        },
        "lifts": sorted(rows, key=lambda row: row["trial_id"]),
        "versions": {
            **installed_versions(config),
            **{name: metadata.version(name) for name in ("mujoco", "coacd")},
        },
    }


def agreement(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return how many lifts of a group are tried in MuJoCo, and how many of these hold.

    Args:
        rows: Rows of the report of `cross_check`, under "lifts".

    Returns:
        Numbers of lifts that were drawn, tried and lifted; the fractions that hold of all drawn
        lifts and of those tried in MuJoCo, with their intervals (None if there are no lifts); and
        the outcomes of the others.
    """
    tried = [row for row in rows if row["tried"]]
    lifted = sum(_holds(row) for row in tried)
    return {
        "drawn": len(rows),
        "tried": len(tried),
        "lifted": lifted,
        "of_all": _share(lifted, len(rows)),
        "of_tried": _share(lifted, len(tried)),
        "not_tried": dict(Counter(row["there"] for row in rows if not row["tried"])),
    }


def _share(hits: int, count: int) -> dict[str, float] | None:
    """Return a fraction with its interval, or None if `count` is 0."""
    if not count:
        return None
    low, high = binomtest(hits, count).proportion_ci(method="wilson")
    return {"share": hits / count, "low": low, "high": high}


def _read_lifts(out: Path) -> list[StoredLift]:
    """Return all lifts of a dataset in the order of its rows: lifts of an object are together."""
    # Only attempts in which a lift was tried have a lift time.
    trials = Trials(out).where(outcome=[Outcome.SUCCESS, *ENDS])
    # The MuJoCo model does not support hands with a motor for each joint.
    trials = trials[np.isfinite(trials["time_lift"]) & ~trials["own_motors"]]
    names = [field.name for field in fields(Materials)]
    columns = ("outcome", "object_name", "removal", "X_OG", "spread", "resting", *names)

    # Assign each lift to its group.
    lifts = []
    for trial_id, *values in zip(
        trials.trial_ids.tolist(), *trials.columns(columns).values(), strict=True
    ):
        row = dict(zip(columns, values, strict=True))
        outcome = Outcome(int(row["outcome"]))
        group: Group = "sample" if row["removal"] == Removal.KEPT else "removed"
        lifts.append(
            StoredLift(
                trial_id=trial_id,
                object_name=row["object_name"],
                group=group if outcome is Outcome.SUCCESS else "lost",
                outcome=outcome,
                resting=int(row["resting"]),
                pregrasp=Attempt(X_OG=unpack_pose(row["X_OG"]), spread=float(row["spread"])),
                materials=Materials(**{name: float(row[name]) for name in names}),
            )
        )
    return lifts


def _in_turns(piles: Iterable[Iterable[T]]) -> Iterator[T]:
    """Yield the first item of each pile, then the second of each, until all are empty."""
    nothing = object()
    every = chain.from_iterable(zip_longest(*piles, fillvalue=nothing))
    return (item for item in every if item is not nothing)  # type: ignore[misc]


def _try_object(
    out: Path, name: str, lifts: Sequence[StoredLift], config: Config
) -> Iterator[dict[str, Any]]:
    """Yield a row of the report for each lift of one object."""
    # Imported here, so that lifts can be drawn without the extra.
    from mujoco_baseline import MujocoBaseline

    prepared = load_prepared(out, name, config)
    peer = MujocoBaseline(prepared.model, prepared.resting_poses[0], config)
    usual = usual_conditions(prepared.model, config.physics)
    for lift in lifts:
        peer.place(prepared.resting_poses[lift.resting])
        conditions = replace(usual, materials=lift.materials)
        trial = peer.run(replace(lift.pregrasp, conditions=conditions))
        yield {
            "trial_id": lift.trial_id,
            "object": lift.object_name,
            "group": lift.group,
            "outcome": lift.outcome.label,
            "there": trial.outcome.label,
            "tried": trial.tried,
            # JSON has no NaN.
            "slip": trial.slip if trial.tried else None,
            "turn": trial.turn if trial.tried else None,
        }


def _holds(row: dict[str, Any]) -> bool:
    return bool(row["there"] == Outcome.SUCCESS.label)


def _by_object(lift: StoredLift) -> tuple[str, int]:
    return lift.object_name, lift.trial_id


@click.command(help=__doc__)
@click.argument("dataset", type=click.Path(path_type=Path))
@click.argument("count", type=click.IntRange(min=1))
@click.option("--out", type=click.Path(path_type=Path), help="File of the report.")
def main(dataset: Path, count: int, out: Path | None) -> None:
    """Run the script."""
    require_mujoco("mujoco", "coacd")
    report = cross_check(dataset, count)
    if out is not None:
        out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    click.echo(json.dumps({k: v for k, v in report.items() if k != "lifts"}, indent=1))


if __name__ == "__main__":
    main()
