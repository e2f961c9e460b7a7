"""Show lifts whose verdicts differ in Drake and MuJoCo, and print the motion in both.

    python pipelines/measurements/peer_pictures.py lines.jsonl --dataset OUT --sheet sheet.png
    python pipelines/measurements/peer_pictures.py lines.jsonl --dataset OUT --set lift.hold_time=1

`lines.jsonl` is the output of peer_settings.py. Half of the lifts are samples that fall in MuJoCo,
as far as available; the others are lost lifts that hold there. Both are drawn at random. The sheet
shows each lift in Drake and beside it in MuJoCo, in the palm's frame: the closed hand, and the last
instant at which a fingertip touches. Without a sheet only Drake tries the lifts again, with the
given settings.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import mujoco
import numpy as np
from cross_check import StoredLift, draw_lifts
from mujoco_baseline import MujocoBaseline, PeerContacts
from PIL import Image, ImageDraw

from drakegrasp.arithmetic import norm
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.frames import X_WT, Array, invert_pose, make_pose, rotation_angle
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import override_config
from drakegrasp.outcomes import Outcome
from drakegrasp.pictures.still_scene import NO_SHADOWS, Poses, StillScene
from drakegrasp.seeding import Stream
from drakegrasp.simulation import lift as lifting
from drakegrasp.simulation.conditions import usual_conditions
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.contacts import read_contacts
from drakegrasp.simulation.scene import Scene, hand_positions, palm_pose
from drakegrasp.simulation.trial import run_attempt

#: Last number of the key of the random stream that draws the lifts.
PLACE = 26


@dataclass(frozen=True)
class Instant:
    """Time [s], X_GO, joints, force [N] per fingertip, deepest contact [m], other links."""

    time: float
    X_GO: Array
    q: Array
    force: Array
    depth: float
    others: int


class Watched(MujocoBaseline):
    """MuJoCo baseline that stores the closed hand and the state at each check of a lift."""

    seen: list[Instant]

    def _contacts(self) -> PeerContacts:
        found, d, m = super()._contacts(), self._data, self._model
        force, depth = np.zeros((len(self._tips), 3)), 0.0
        for i, contact in enumerate(d.contact[: d.ncon]):
            bodies = [m.geom_bodyid[geom] for geom in (contact.geom1, contact.geom2)]
            if self._object in bodies and (tip := set(bodies) & set(self._tips)):
                wrench, sign = np.zeros(6), 1.0 if bodies[0] == self._object else -1.0
                mujoco.mj_contactForce(m, d, i, wrench)
                force[self._tips.index(*tip)] += sign * contact.frame.reshape(3, 3).T @ wrench[:3]
                depth = max(depth, -contact.dist)
        joints = {m.joint(i).name: d.qpos[m.joint(i).qposadr[0]] for i in range(m.njnt)}
        q = np.array([joints.get(name, np.nan) for name in self._hand.joint_names])
        values = norm(force) * found.touching, depth, found.other_links
        self.seen.append(Instant(d.time, self._object_in_hand(), q, *values))
        return found


class Monitor(lifting._Monitor):
    """Drake's monitor of a lift, which also stores the closed hand and the state at each check."""

    seen: ClassVar[list[Instant]] = []

    def __init__(self, scene: Scene) -> None:
        super().__init__(scene)
        self.seen[:] = [self._instant(scene)]

    def update(self, scene: Scene, elapsed: float, stop_speed: float) -> bool:
        """See the base class."""
        self.seen.append(self._instant(scene))
        return super().update(scene, elapsed, stop_speed)

    def _instant(self, scene: Scene) -> Instant:
        now, X_GO = read_contacts(scene), invert_pose(palm_pose(scene)) @ scene.pose(scene.object)
        values = norm(now.f_Q_O), float(now.penetration.max()), now.other_links
        return Instant(scene.time, X_GO, hand_positions(scene), *values)


def chosen(out: Path, lines: Path, count: int) -> list[StoredLift]:
    """Return lifts whose verdicts differ, sorted by object."""
    rows = [json.loads(line) for line in lines.read_text(encoding="utf-8").splitlines()]
    held = {row["trial_id"]: row["there"]["usual"] == Outcome.SUCCESS.label for row in rows}
    lifts = [lift for lift in draw_lifts(out, 1 << 62) if lift.trial_id in held]
    order = Stream(read_manifest(out).config.seed, PLACE).permutation(len(lifts)).tolist()
    lifts = [lifts[i] for i in order]
    fallen = [x for x in lifts if x.group == "sample" and not held[x.trial_id]][: count // 2]
    kept = [x for x in lifts if x.group == "lost" and held[x.trial_id]][: count - len(fallen)]
    return sorted(fallen + kept, key=lambda lift: (lift.object_name, lift.trial_id))


def said(name: str, seen: Sequence[Instant]) -> Iterator[str]:
    """Yield the stored states of a simulator as lines of text, instant by instant."""
    for now in seen:
        motion = invert_pose(seen[0].X_GO) @ now.X_GO
        slip, turn = 1e3 * norm(motion[:3, 3]), np.rad2deg(rotation_angle(motion[:3, :3]))
        force = " ".join(f"{each:5.1f}" for each in now.force)
        yield (
            f"  {name} {now.time - seen[0].time:4.1f} s: {slip:5.1f} mm {turn:5.1f} deg, {force} N,"
            f" {1e3 * now.depth:.2f} mm deep, {now.others} other links\n"
        )


def pictures(
    scene: StillScene, spread: float, seen: Sequence[Sequence[Instant]], edge: int
) -> list[Any]:
    """Return pictures of the closed hand and of the last touch in each simulator."""
    X_WG, X_WC, found = X_WT @ make_pose(np.eye(3), [0.0, 0.0, 1.0]), None, []
    for instants in seen:
        # An attempt that ended before the hand was closed has no stored states.
        if not instants:
            found += 2 * [Image.new("RGB", (edge, edge), "white")]
            continue
        last = max(i for i, now in enumerate(instants) if i == 0 or now.force.any())
        for i in (0, last):
            q = np.where(np.isnan(instants[i].q), scene.positions(spread), instants[i].q)
            poses = Poses(X_WG=X_WG, q=q, X_WO=X_WG @ instants[i].X_GO)
            X_WC = scene.choose_view(scene.outline(poses), fill=1.5) if X_WC is None else X_WC
            scene.pose(poses)
            found.append(Image.fromarray(scene.picture(X_WC, (edge, edge), NO_SHADOWS).image))
    return found


def watch(lifts: Sequence[StoredLift], arguments: argparse.Namespace) -> Iterator[str]:
    """Yield the motion of lifts as text, in both simulators and in pictures if there is a sheet."""
    out, edge, before, drawn = arguments.dataset, arguments.edge, "", list[Any]()
    manifest = read_manifest(out)
    for number, lift in enumerate(lifts, 1):
        if lift.object_name != before:
            before = lift.object_name
            stored = manifest.config_of(before)
            config = override_config(stored, arguments.overrides)
            prepared = load_prepared(out, before, stored)
            model, hand = prepared.model, load_hand(config.hand_source)
            scene = build_scene(model, config.physics, hand)
            if arguments.sheet:
                peer = Watched(model, prepared.X_TO, config)
                still = StillScene(hand, model, table_size=1e-3)
        X_TO, usual = prepared.resting_poses[lift.resting], usual_conditions(model, config.physics)
        # Given settings hold for all lifts, and replace the drawn values.
        own = usual if arguments.overrides else replace(usual, materials=lift.materials)
        attempt = replace(lift.pregrasp, conditions=own)
        Monitor.seen.clear()
        with mock.patch.object(lifting, "_Monitor", Monitor):
            outcome = run_attempt(scene, X_TO, attempt, config).outcome
        yield f"{number} {before}, trial {lift.trial_id}, {lift.outcome.label}: {outcome.label}\n"
        yield from said("Drake ", Monitor.seen)
        if not arguments.sheet:
            continue

        peer.seen = []
        peer.place(X_TO)
        yield f"  {peer.run(attempt).outcome.label} in MuJoCo\n"
        yield from said("MuJoCo", peer.seen)
        both = Monitor.seen, peer.seen
        drawn += pictures(still, lift.pregrasp.spread, both, edge)
        for image, text in zip(drawn[-4::2], (f"{number} {lift.group}", "MuJoCo"), strict=True):
            ImageDraw.Draw(image).text((4, 2), text, fill="black", font_size=edge // 9)
    if arguments.sheet:
        # Two lifts in a line, with a gap between them.
        lines, gap = -(-len(drawn) // 8), edge // 8
        sheet = Image.new("RGB", (8 * edge + gap, lines * edge), "white")
        for i, image in enumerate(drawn):
            sheet.paste(image, (i % 8 * edge + gap * (i % 8 // 4), i // 8 * edge))
        sheet.quantize(128).save(arguments.sheet, optimize=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("lines", type=Path, help="file with a line per lift")
    parser.add_argument("--dataset", type=Path, required=True, help="dataset of these lifts")
    parser.add_argument("--sheet", type=Path, help="PNG to write")
    parser.add_argument("--count", type=int, default=20, help="number of lifts (default: 20)")
    parser.add_argument(
        "--edge", type=int, default=150, help="edge of a picture [px] (default: 150)"
    )
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    arguments = parser.parse_args(argv)
    lifts = chosen(arguments.dataset, arguments.lines, arguments.count)
    if not lifts:
        print(f"{arguments.lines}: no lift has another verdict in MuJoCo")  # noqa: T201
        return 1
    sys.stdout.writelines(watch(lifts, arguments))
    return 0


if __name__ == "__main__":
    sys.exit(main())
