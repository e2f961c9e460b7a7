"""Compare how close hands come to the table while closing and lifting with the stored values.

\b
    python pipelines/measurements/scraping.py OUT 200 > scraping.json

For N samples, and for up to N hands that were rejected because they scraped the table, the script
runs each trial again and stores the joints after every time step. It computes the heights from the
hand's SDF file with its own kinematics, which use only the poses, joints and shapes in this file
and the corners of its meshes. The part of the motion that a screened attempt skips is a straight
path of the joints. Only hands with worm drives are supported. The script prints JSON: the largest
differences from `clearance_close` and `clearance_lift` [m], and how many trials are on the other
side of `close.scrape_depth`. The exit code is 1 if a sample is.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import numpy.typing as npt
import trimesh
from scipy.spatial.transform import Rotation

from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import TRIALS_FILE
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.filters import Removal
from drakegrasp.frames import X_WT
from drakegrasp.generation.attempts import TrialSetup, find_attempt, try_attempt
from drakegrasp.hand.description import load_hand
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.environment import one_thread
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.simulation import drive
from drakegrasp.simulation.scene import Scene, hand_joint_names, hand_positions
from drakegrasp.simulation.scene_cache import cached_scene

Array = npt.NDArray[np.float64]

#: Number of steps of the motion that a screened attempt skips.
SKIPPED_STEPS = 400


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("number", metavar="N", type=click.IntRange(min=1))
@click.option("--seed", type=click.IntRange(min=0), default=0, show_default=True)
@one_thread
def main(out: Path, number: int, seed: int) -> None:
    """Run the script."""
    kinds = choose_trials(out, number, seed)
    rows, limit = list[dict[str, Any]](), read_manifest(out).config.close.scrape_depth
    if limit is None:
        raise click.UsageError("OUT must have heights, got close.scrape_depth null")
    with progress_bar("measure", "trials") as report:
        for row in measure(out, list(kinds)):
            rows.append(row)
            report(len(rows), len(kinds))
    result = {
        kind: summarise([row for row in rows if kinds[row["trial"]] == kind], limit)
        for kind in ("sample", "scraping")
    }
    click.echo(json.dumps(result, indent=1))
    sys.exit(1 if any(result["sample"]["other_side"].values()) else 0)


def choose_trials(out: Path, number: int, seed: int) -> dict[int, str]:
    """Return the ids of trials to run, each with its kind: sample or scraping.

    Raises:
        UsageError: If there are too few samples.
    """
    with h5py.File(out / TRIALS_FILE, "r") as file:
        kept = file["successes/removal"][:] == Removal.KEPT
        samples = file["successes/trial_id"][:][kept]
        refused = file["trials/outcome"][:] == Outcome.TABLE_CONTACT
        refused &= np.isfinite(file["trials/time_close"][:])
        refused &= ~np.isfinite(file["trials/time_lift"][:])
        refused &= ~file["trials/closed_hand_on_table"][:].astype(bool)
    if len(samples) < number:
        raise click.UsageError(f"samples must be at least {number}, got {len(samples)}")
    rng, scraping = np.random.default_rng(seed), np.flatnonzero(refused)
    chosen = {int(row): "sample" for row in rng.choice(samples, number, replace=False)}
    some = rng.choice(scraping, min(number, len(scraping)), replace=False)
    return dict(sorted((chosen | {int(row): "scraping" for row in some}).items()))


def summarise(rows: list[dict[str, Any]], limit: float) -> dict[str, Any]:
    """Return how measured and stored heights differ, and how often only one is below the limit."""
    found: dict[str, Any] = {"trials": len(rows), "objects": len({row["object"] for row in rows})}
    found |= {"largest_difference": {}, "least": {}, "other_side": {}}
    for when in ("close", "lift"):
        pairs = np.array([row[when] for row in rows if np.isfinite(row[when][1])])
        if len(pairs):
            found["largest_difference"][when] = float(np.abs(pairs[:, 0] - pairs[:, 1]).max())
            found["least"][when] = pairs.min(axis=0).tolist()
            other = (pairs[:, 0] < -limit) != (pairs[:, 1] < -limit)
            found["other_side"][when] = int(other.sum())
    return found


def measure(out: Path, trials: list[int]) -> Iterator[dict[str, Any]]:
    """Yield the computed and stored heights of each trial [m], by "close" and "lift"."""
    manifest, names = read_manifest(out), ("object", "candidate", "standoff_index")
    with h5py.File(out / TRIALS_FILE, "r") as file:
        objects = file["objects/name"].asstr()[:]
        stored = {f"clearance_{w}": file[f"trials/clearance_{w}"][:] for w in ("close", "lift")}
        keys = np.column_stack([file[f"trials/{name}"][:] for name in names])
    for trial in trials:
        k, candidate, standoff = keys[trial].tolist()
        name = str(objects[k])
        config = manifest.config_of(name)
        prepared = load_prepared(out, name, config)
        attempt = find_attempt(prepared, candidate, standoff, config)
        hand = load_hand(config.hand_source)
        if drive.drive_of(hand, config.lift) != "worm":
            raise click.UsageError("the hand must have worm drives")
        scene = cached_scene(prepared.model, config.physics, config.hand_source)
        note = Notes(scene)
        with note:
            record = try_attempt(TrialSetup(prepared=prepared, config=config, scene=scene), attempt)
        assert record.closed is not None
        heights = Kinematics(hand.model.path)
        R_WG = (X_WT @ record.X_TO @ record.X_OG)[:3, :3]
        closing, lifting = note.split(record.closed.duration)
        yield {
            "trial": trial,
            "object": name,
            **{
                when: (
                    heights.least(states, R_WG, note.names, hand.X_BG),
                    float(stored[f"clearance_{when}"][trial]),
                )
                for when, states in (("close", closing), ("lift", lifting))
            },
        }


class Notes:
    """The states of a trial after each time step: time, position of the palm, and joints."""

    def __init__(self, scene: Scene) -> None:
        self.names, self._scene, self._states = hand_joint_names(scene), scene, list[Array]()

    def __enter__(self) -> None:
        # The worm drives replace the monitor when the lift begins.
        turn = self._turn = drive._turn_worms

        def turn_and_note(scene: Scene, _: Any) -> Any:
            self._note(scene)
            return turn(scene, _)

        drive._turn_worms = turn_and_note
        self._scene.simulator.set_monitor(lambda _: self._note(self._scene))

    def __exit__(self, *_: object) -> None:
        drive._turn_worms = self._turn
        self._scene.simulator.clear_monitor()

    def _note(self, scene: Scene) -> None:
        p_WG = [joint.get_translation(scene.context) for joint in scene.wrist_joints]
        self._states.append(np.array([scene.time, *p_WG, *hand_positions(scene)]))

    def split(self, closed: float) -> tuple[Array, Array]:
        """Return the states of closing and of lifting, without times; `closed` separates them.

        The first state is the open hand; the second is the one at which a screened attempt begins.
        """
        states = np.array(self._states)
        begun = np.flatnonzero(states[:, 0] == 0.0)
        share = np.linspace(0.0, 1.0, SKIPPED_STEPS)[:, None]
        opened, start = states[begun[0]], states[begun[-1]]
        states = states[begun[-1] :]
        before = states[:, 0] <= closed + 1e-9
        skipped = opened + share * (start - opened)
        last = states[before][-1:]
        return np.vstack([skipped, states[before]])[:, 1:], np.vstack([last, states[~before]])[
            :, 1:
        ]


@dataclass
class _Link:
    parent: str | None
    X_PL: Array
    axis: Array
    joint: str | None
    shapes: list[tuple[Array, float, Array]]  # corners, and discs by centre, radius and axis


class Kinematics:
    """Kinematics of an SDF file whose link frames coincide with those of their joints."""

    def __init__(self, path: Path) -> None:
        (model,) = ET.parse(path).getroot().iter("model")
        joints = {_text(joint, "child"): joint for joint in model.iter("joint")}
        self._links = {
            link.get("name", ""): _read_link(link, joints.get(link.get("name", "")), path.parent)
            for link in model.iter("link")
        }

    def least(self, states: Array, R_WG: Array, names: list[str], X_BG: Array) -> float:
        """Return the minimum height above the table's top [m] of states (n, 3 + j): p_WG and q."""
        if not len(states):
            return np.nan
        q = dict(zip(names, states[:, 3:].T, strict=True))
        X_GB, lowest, posed = np.linalg.inv(X_BG), np.inf, dict[str, Array]()
        X_WG = np.tile(np.eye(4), (len(states), 1, 1))
        X_WG[:, :3, :3], X_WG[:, :3, 3] = R_WG, states[:, :3]
        for name, link in self._links.items():  # each link comes after its parent
            X = link.X_PL
            if link.joint is not None:
                turn = np.tile(np.eye(4), (len(states), 1, 1))
                turn[:, :3, :3] = Rotation.from_rotvec(
                    q[link.joint][:, None] * link.axis
                ).as_matrix()
                X = X @ turn
            posed[name] = (X_WG @ X_GB if link.parent is None else posed[link.parent]) @ X
            for points, radius, axis in link.shapes:
                up = posed[name][:, 2, :3]
                heights = up @ points.T + posed[name][:, 2, 3:]
                sine = np.sqrt(np.maximum(0.0, 1.0 - (up @ axis) ** 2))
                lowest = min(lowest, float((heights - radius * sine[:, None]).min()))
        return lowest - float(X_WT[2, 3])


def _read_link(link: ET.Element, joint: ET.Element | None, folder: Path) -> _Link:
    pose = link.find("pose")
    parent = None if joint is None else _text(joint, "parent")
    revolute = joint is not None and joint.get("type") == "revolute"
    plain = joint is None or (joint.find("pose") is None and joint.find("axis") is not None)
    stated = None if pose is None else pose.get("relative_to")
    if not plain or stated != parent or (joint is not None and not revolute):
        raise click.UsageError(f"link {link.get('name')}: its frame must be that of its joint")
    return _Link(
        parent=parent,
        X_PL=_pose(pose),
        axis=np.zeros(3) if joint is None else np.fromstring(_text(joint, "axis/xyz"), sep=" "),
        joint=None if joint is None else joint.get("name"),
        shapes=[_shape(collision, folder) for collision in link.findall("collision")],
    )


def _shape(collision: ET.Element, folder: Path) -> tuple[Array, float, Array]:
    """Return the corners of a shape, the radius of the discs about them, and the discs' axis."""
    X, axis, radius = _pose(collision.find("pose")), np.zeros(3), 0.0
    if collision.find("geometry/mesh") is not None:
        mesh = trimesh.load(folder / _text(collision, "geometry/mesh/uri"), force="mesh")
        points = np.array(mesh.vertices)
    elif collision.find("geometry/box") is not None:
        half = np.fromstring(_text(collision, "geometry/box/size"), sep=" ") / 2.0
        points = half * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    elif collision.find("geometry/cylinder") is not None:
        half_length = float(_text(collision, "geometry/cylinder/length")) / 2.0
        radius = float(_text(collision, "geometry/cylinder/radius"))
        points, axis = np.array([[0, 0, half_length], [0, 0, -half_length]]), X[:3, 2]
    else:
        raise click.UsageError("shapes must be meshes, boxes or cylinders")
    return points @ X[:3, :3].T + X[:3, 3], radius, axis


def _pose(element: ET.Element | None) -> Array:
    X = np.eye(4)
    if element is not None:
        values = np.fromstring(element.text or "", sep=" ")
        degrees = element.get("degrees") == "true"
        X[:3, :3] = Rotation.from_euler("xyz", values[3:], degrees=degrees).as_matrix()
        X[:3, 3] = values[:3]
    return X


def _text(element: ET.Element, path: str) -> str:
    found = element.findtext(path)
    if found is None:
        raise click.UsageError(f"{element.tag} {element.get('name')} must have {path}")
    return found


if __name__ == "__main__":
    main()
