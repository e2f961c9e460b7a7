"""What goes out comes in again: the same postures and the same verdicts, by every command.

The object has several resting poses and a mesh in centimetres, the hand is not the default one, its
grasps are of two preshapes, and friction and mass are not those of the configuration.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from helpers.builds import build
from helpers.commands import run
from helpers.datasets import OTO
from helpers.tiers import in_second_tier

from drakegrasp import registry
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import GraspError
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.exchange.export import export_dataset
from drakegrasp.frames import unpack_pose
from drakegrasp.generation.directory import build_config
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.runtime.executor import run_here
from drakegrasp.scoring.run import VERDICTS
from drakegrasp.simulation.attempts import CONDITIONS

NAME, HAND = "1_brick_a", "allegro_four"
#: What decides verdicts and is in no file that was exported.
RULES = (
    *("camera.size=32", f"hand={HAND}", "lift.stop_when=never"),
    *("lift.max_speed=1", "lift.max_acceleration=4", "lift.hold_time=0.1"),
)
#: What decides the objects; --object has other values.
OBJECTS = ("objects.resting_poses=8", "seed=6", "objects.mass=0.1", "physics.friction_hand=0.8")
#: Every success is a sample.
SAMPLES = (
    *("filters.require=lifted", "filters.outlier_sigma=0", "filters.min_depth_variance=0"),
    *("filters.min_camera_height=-1", "filters.max_surface_distance=1"),
    "filters.max_normal_angle_deg=null",
)

#: Formats of an export that only go out: contacts, meshes, pictures or scenes, from
#: which no posture of the hand is read.
ONLY_OUT = {"hf", "original", "meshes", "mjcf"}
#: Layouts of postures that users write.
OWN = ("npz", "hdf5")


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    trimesh.creation.box([5.5, 8.0, 10.0]).export(folder / f"{NAME}.obj")
    return folder


@pytest.fixture(scope="module")
def out(meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset, all of whose samples train."""
    folder = tmp_path_factory.mktemp("built") / "out"
    few = ("candidates.method=normals", "candidates.max=60")
    config = load_config("fast", [*RULES, *OBJECTS, *SAMPLES, *few])
    build(find_meshes(meshes, units="cm"), folder, config, run_here, show=False)
    return folder


@pytest.fixture(scope="module")
def samples(out: Path) -> Trials:
    """The attempts that are samples, as they were stored."""
    trials = Trials(out)
    kept = trials[np.flatnonzero(trials["outcome"] == Outcome.SUCCESS)]
    assert len(kept) == len(GraspDataset(out / OTO, split="train", fewer_fingers=True))
    assert len(set(kept["resting"].tolist())) >= 3
    assert set(kept["preshape"].tolist()) == {0, 1}
    return kept


@pytest.fixture(scope="module")
def written(
    out: Path, samples: Trials, tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    @cache
    def write(form: str) -> Path:
        folder = tmp_path_factory.mktemp(form)
        if form not in OWN:
            export_dataset(out, folder / "to", form)  # type: ignore[arg-type]
            return folder / "to"
        return write_own(folder / f"p.{form}", samples)

    return write


def write_own(path: Path, samples: Trials) -> Path:
    """Write the samples as a user's file, which says resting pose, row and preshape."""
    hand = load_hand(HAND)
    order, names = hand.joint_order, [hand.preshape_names[k] for k in samples["preshape"]]
    starts = [joint_positions(hand.at(k), 0.0, np.zeros(len(hand.at(k).fingers)))
              for k in samples["preshape"]]  # fmt: skip
    X_OG, q = unpack_pose(samples["X_OG"]), samples["closed_q"]
    opened = np.array([[start[name] for name in order] for start in starts])
    content: dict[str, Any] = {
        "object": [NAME] * len(q), "row": np.arange(len(q)), "resting": samples["resting"],
        "preshape": names, "mass": samples["mass"], "friction_hand": samples["friction_hand"],
    }  # fmt: skip
    content |= {"X_FG": X_OG, "q_grasp": q, "q_pregrasp": opened}
    if path.suffix == ".npz":
        np.savez(path, **content)
    else:
        with h5py.File(path, "w") as file:
            for name, values in content.items():
                file[name] = values
    return path


BACK = (*(form for form in registry.names("exporters") if form not in ONLY_OUT), *OWN)


def test_every_format_is_told(meshes: Path) -> None:
    assert set(BACK) == (set(registry.names("exporters")) | set(OWN)) - ONLY_OUT
    assert set(registry.names("exporters")) >= ONLY_OUT


def verified(written: Path, *where: str | Path | int) -> list[dict[str, Any]]:
    result = run("verify", written, *where, "--quiet", "--workers", 1)
    assert result.exit_code == 0, result.output
    return [json.loads(line) for line in result.stdout.splitlines()]


def in_order(samples: Trials, X_OG: np.ndarray) -> list[int]:
    """The sample of each of some palm poses, every one once."""
    apart = np.abs(unpack_pose(samples["X_OG"])[None] - X_OG[:, None]).max(axis=(2, 3))
    assert apart.min(axis=1).max() < 1e-6
    assert sorted(apart.argmin(axis=1)) == list(range(len(samples)))
    return [int(i) for i in apart.argmin(axis=1)]


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "by_mesh", "whole"),
    [
        *(("dexgraspbench", False, True), ("hdf5", False, False), ("isaac_grasp", True, False)),
        *(in_second_tier((form, True, True)) for form in BACK),
    ],
)
def test_what_goes_out_comes_in_again(
    form: str,
    by_mesh: bool,
    whole: bool,
    meshes: Path,
    out: Path,
    samples: Trials,
    written: Callable[[str], Path],
    tmp_path: Path,
) -> None:
    path, hand = written(form), load_hand(HAND)
    table = read_attempts(path, hand)
    order = in_order(samples, table.X_FG)
    np.testing.assert_allclose(table.q_grasp, samples["closed_q"][order], atol=1e-6)
    if form == "dexgraspbench":
        tried = np.column_stack([samples[name] for name in CONDITIONS])
        np.testing.assert_allclose(table.conditions, tried[order])
    names = [hand.preshape_names[k] for k in samples["preshape"][order]]
    assert list(table.preshape) == names
    if form not in OWN:
        one = next(path.rglob("*.npy"), None) or next(path.rglob("*.yaml"))
        with pytest.raises(GraspError, match=f"hand must be {HAND}, as the file says"):
            read_attempts(one, load_hand())
    stored = [("success", bool(stable), True) for stable in samples["stable"][order]]

    # By the mesh alone, and by the objects or rows of the dataset.
    rules = [word for rule in RULES for word in ("--set", rule)]
    ways: list[tuple[str | Path, ...]] = [("--dataset", out / OTO)]
    if form in OWN:
        ways[0] += ("--split", "train")
    elif by_mesh:
        ways.append(
            ("--object", meshes / f"{NAME}.obj", "--units", "cm", "--config", "fast", *rules)
        )
    for where in ways:
        found = verified(path, *where)
        assert [(v["outcome"], v["stable"], v["lifted"]) for v in found] == stored
        slips = [v["slip"] for v in found]
        # A quaternion and a yaw less are other last digits, and one sample slides far.
        np.testing.assert_allclose(slips, samples["slip"][order], rtol=0.1)

    # As predictions for the rows of the split; whatever the format was, they are postures now.
    if not whole:
        return
    card = tmp_path / "card"
    where = ("--dataset", out / OTO, "--split", "train", "--out", card, "--workers", 1, "--quiet")
    result = run("score", path, *where)
    assert result.exit_code == 0, result.output
    lines = [json.loads(line) for line in (card / VERDICTS).read_text().splitlines()]
    judged = [line for line in lines if "outcome" in line]
    assert [(v["outcome"], v["lifted"]) for v in judged] == [("success", True)] * len(samples)
    assert sorted(v["stable"] for v in judged) == sorted(samples["stable"].tolist())

    # As a dataset of its own.
    config = load_config("fast", [*RULES, *OBJECTS, *SAMPLES])
    config = build_config(config, table)
    again = tmp_path / "out"
    build(find_meshes(meshes, units="cm"), again, config, run_here, postures=table, show=False)
    trials = Trials(again)
    assert len(trials) == len(samples)
    order = in_order(samples, unpack_pose(trials["X_OG"]))
    for name in ("outcome", "stable", "resting", "preshape"):
        assert trials[name].tolist() == samples[name][order].tolist(), name
    np.testing.assert_allclose(trials["slip"], samples["slip"][order], rtol=0.1)


def test_what_names_no_resting_pose_is_tried_in_all_and_the_best_is_told(
    meshes: Path, out: Path, samples: Trials, written: Callable[[str], Path], tmp_path: Path
) -> None:
    path, poses = tmp_path / "p.npz", len(read_manifest(out).objects[0].resting)
    with np.load(written("npz")) as known:
        untold = {n: known[n][:3] for n in known if n not in ("resting", "row", "object")}
        np.savez(path, **untold, object=["other"] * 3)
    samples = samples[:3]
    assert len(set(samples["resting"].tolist())) == 3
    rules = [word for rule in (*RULES, *OBJECTS) for word in ("--set", rule)]
    mesh = ("--object", meshes / f"{NAME}.obj", "--units", "cm", "--config", "fast", *rules)
    result = run("verify", path, *mesh, "--quiet", "--workers", 1)
    assert f"postures of other are tried on {NAME}, the --object" in result.stderr
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert [v["outcome"] for v in found] == ["success"] * len(samples)
    best = [
        f"(the best of {poses} resting poses, as none is named: {k})" for k in samples["resting"]
    ]
    assert [v["reason"].endswith(told) for v, told in zip(found, best, strict=True)].count(True) > 1

    # In a build each is an attempt of the row.
    table = read_attempts(path, load_hand(HAND), of=NAME)
    table = replace(table, objects=(NAME,) * len(table))
    config = build_config(load_config("fast", [*RULES, *OBJECTS, *SAMPLES]), table)
    again = tmp_path / "out"
    build(find_meshes(meshes, units="cm"), again, config, run_here, postures=table, show=False)
    trials = Trials(again)
    rows, rest = trials["posture_row"].astype(int).tolist(), trials["resting"].tolist()
    assert sorted(zip(rows, rest, strict=True)) == [
        (row, k) for row in range(len(samples)) for k in range(poses)
    ]
    assert check_dataset(again) == []
