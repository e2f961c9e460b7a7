"""A build of postures from outside: attempts, samples, replay, resume; and what is refused."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers.builds import build
from helpers.hands import write_with_preshapes
from helpers.objects import CUBE, STANDOFF, box_model, from_above, standing

from drakegrasp.api.building import known_work
from drakegrasp.config import Config
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.schema import NO_PRESHAPE
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError, DataError, GraspError
from drakegrasp.frames import make_pose
from drakegrasp.generation.directory import build_config
from drakegrasp.generation.prepare import prepare
from drakegrasp.generation.replay import replay_trial
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.hand.settings import load_config
from drakegrasp.mesh.surfaces import obj_text
from drakegrasp.objects.sources import find_meshes
from drakegrasp.outcomes import Outcome
from drakegrasp.simulation.attempt import Source
from drakegrasp.simulation.attempts import GraspTable, make_attempts, unknown_objects
from drakegrasp.simulation.construction import build_scene
from drakegrasp.simulation.placement import place_object
from drakegrasp.simulation.trial import run_attempt
from drakegrasp.verification.placing import place_on_dataset, place_on_object

pytestmark = pytest.mark.sim

NAME = "1_box_a"
HAND = load_hand()
#: Lifts are quick.
QUICK = ("lift.max_speed=2", "lift.max_acceleration=10", "lift.hold_time=0.1")
CONFIG = load_config(overrides=QUICK)


@pytest.fixture(scope="module")
def meshes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    box_model(folder, [CUBE] * 3, NAME)
    return folder


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> GraspTable:
    """Rows of the cube: held by the hand's motors, held by own ones, inside it, below the table."""
    model = box_model(tmp_path_factory.mktemp("cube"), [CUBE] * 3, NAME)
    attempt = from_above(model, STANDOFF)
    scene = build_scene(model, CONFIG.physics, HAND)
    held = run_attempt(scene, standing(model), attempt, CONFIG)
    start = joint_positions(HAND, 0.0, np.zeros(3))
    opened = np.array([start[name] for name in HAND.joint_order])

    coupled, bent = held.closed.q, held.closed.q.copy()
    for finger in HAND.fingers:
        bent[HAND.joint_order.index(finger.coupled[0].joint)] += 0.1
        bent[HAND.joint_order.index(finger.closing_joint)] -= 0.04
    inside = attempt.X_OG @ make_pose(np.eye(3), [0.0, 0.0, 0.05])
    below = make_pose(np.eye(3), [0.0, 0.0, -0.2])
    nothing = np.full(8, np.nan)
    return make_attempts(
        HAND,
        [NAME] * 4,
        [attempt.X_OG, attempt.X_OG, inside, below],
        [coupled, bent, coupled, coupled],
        q_pregrasp=[opened, bent - 0.3 * (bent - opened), nothing, nothing],
        said=["mine", "", "", ""],
    )


def built(meshes: Path, out: Path, table: GraspTable, config: Config | None = None) -> Path:
    config = build_config(config or CONFIG, table)
    build(meshes, out, config, postures=table)
    return out


@pytest.fixture(scope="module")
def dataset(meshes: Path, table: GraspTable, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(meshes, tmp_path_factory.mktemp("built") / "out", table)


def test_each_row_is_an_attempt_with_its_outcome(dataset):
    trials = Trials(dataset)
    names = ("outcome", "candidate", "standoff_index", "posture_row", "own_motors", "source")
    rows = zip(*(trials[name].tolist() for name in names), strict=True)
    assert list(rows) == [
        (Outcome.SUCCESS, 0, 0, 0.0, False, Source.POSTURES),
        (Outcome.SUCCESS, 1, 0, 1.0, True, Source.POSTURES),
        (Outcome.START_COLLISION, 2, 0, 2.0, False, Source.POSTURES),
        (Outcome.BELOW_TABLE, 3, 0, 3.0, False, Source.POSTURES),
    ]
    assert not trials["preshape"].any()  # the hand has none
    assert check_dataset(dataset) == []


@pytest.mark.parametrize("row", range(4))
def test_trial_of_a_posture_is_replayed_from_the_dataset_alone(dataset, row):
    assert replay_trial(dataset, row).same


def test_dataset_of_other_postures_is_not_continued(meshes, table, dataset, tmp_path):
    out = Path(shutil.copytree(dataset, tmp_path / "out"))
    other = replace(table, q_grasp=table.q_grasp + 1e-9)
    with pytest.raises(DataError, match=r"differs in candidates\.postures"):
        built(meshes, out, other)


def test_rows_that_are_no_posture_are_told_and_spoil_no_other(meshes, table, dataset, tmp_path):
    """The good rows 0 and 3 of the file, with bad ones between and after them."""
    rows = [0, 0, 0, 3, 0, 0, 0, 0, 0]
    X_FG, q, objects = table.X_FG[rows], table.q_grasp[rows], [NAME] * len(rows)
    q[1, 2] = np.nan
    X_FG[2, :3, 3] = 1e6
    X_FG[4, :3, :3] = 0.0
    resting, scale = np.zeros(len(rows)), np.full(len(rows), np.nan)
    resting[5], scale[6], resting[7], objects[8] = 1.0, 0.1, -1.0, "cup"
    mixed = make_attempts(
        *(HAND, objects, X_FG, q),
        q_pregrasp=table.q_pregrasp[rows],
        q_squeeze=table.q_squeeze[rows],
        resting=resting,
        scale=scale,
    )
    mixed = mixed.refuse(unknown_objects(mixed, [NAME]))
    config = build_config(CONFIG, mixed)
    report = build(meshes, tmp_path, config, postures=mixed)
    trials, alone = Trials(tmp_path), Trials(dataset)
    assert trials["posture_row"].tolist() == [0.0, 3.0]
    for name in ("outcome", "closed_q", "slip"):
        np.testing.assert_array_equal(trials[name], alone[name][[0, 3]])
    (told,) = (each for each in report.notices if "postures" in each)
    assert told.startswith("7 of 9 rows of the postures are not tried: row 1: q_grasp must be fin")
    for part in (
        "row 2: the palm's pose must be within 1000 m, got 1e+06 m",
        "row 4: the palm's pose must hold a rotation",
        "row 5: resting pose of 1_box_a must be 0, the only one",
        "row 6: scale must be that of 1_box_a, 1",
        "row 7: resting must be the index of a resting pose, got -1",
        "row 8: object must be one of 1_box_a, got 'cup'",
    ):
        assert part in told
    assert check_dataset(tmp_path) == []


def test_file_without_any_posture_is_refused(meshes, table, tmp_path):
    with pytest.raises(GraspError, match=r"4 of 4 rows .* row 0, 1, 2, 3: scale must be that of"):
        built(meshes, tmp_path / "out", replace(table, scale=np.full(4, 0.1)))
    with pytest.raises(
        GraspError, match=r"must be of an object that is built: 4 of 4 rows .*got 'cup'"
    ):
        known_work(meshes, config=CONFIG, postures=replace(table, objects=("cup",) * 4))


#: Closing positions at which the fingers of a posture begin [rad].
BEGUN = 0.05


@pytest.fixture(scope="module")
def of_preshapes(meshes: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    """The cube held by two fingers, given back with its preshape, without, and begun."""
    folder = tmp_path_factory.mktemp("shaped")
    config = load_config(
        overrides=[*QUICK, f"hand={write_with_preshapes(folder, all='F1 F2 F3', pair='F1 F3')}"]
    )
    hand, model = load_hand(config.hand), box_model(folder, [CUBE] * 3, NAME)
    attempt, pair = from_above(model, STANDOFF), hand.at(1)
    held = run_attempt(build_scene(model, config.physics, pair), standing(model), attempt, config)
    assert held.outcome is Outcome.SUCCESS
    starts = [joint_positions(pair, 0.0, np.full(2, at)) for at in (0.0, 0.0, BEGUN)]
    table = make_attempts(
        hand,
        [NAME] * 3,
        [attempt.X_OG] * 3,
        [held.closed.q] * 3,
        q_pregrasp=[[start[name] for name in hand.joint_order] for start in starts],
        preshape=["pair", "", "pair"],
    )
    return built(meshes, folder / "out", table, config), held.closed.q


def test_a_posture_of_a_preshape_is_the_attempt_that_it_was(of_preshapes):
    """Without one, the third finger closes as well."""
    out, q = of_preshapes
    trials = Trials(out)
    assert trials["preshape"].tolist() == [1, NO_PRESHAPE, 1]
    assert trials["unused"].tolist() == [0b010, 0, 0b010]
    assert trials["outcome"].tolist() == [Outcome.SUCCESS] * 3
    two = [True, False, True]
    assert trials["closed_touching"].tolist() == [two, [True] * 3, two]
    np.testing.assert_allclose(trials["closed_q"][0], q, atol=1e-9)
    assert not trials["own_motors"][0]


def test_scenes_have_the_hand_from_which_a_posture_of_a_preshape_closed(of_preshapes, tmp_path):
    out = Path(shutil.copytree(of_preshapes[0], tmp_path / "out"))
    make_scenes(out, overrides=["scenes.views=1", "scenes.width=64", "scenes.height=48"])
    with h5py.File(out / "scenes.hdf5") as file:
        by_trial = np.argsort(file["grasps/trial_id"][:])
        q_open = file["grasps/q_open"][:][by_trial]
    pair = load_hand(read_manifest(out).config.hand_source).at(1)
    order = pair.joint_order
    for row, at in ((0, 0.0), (2, BEGUN)):
        start = joint_positions(pair, 0.0, np.full(2, at))
        np.testing.assert_allclose(q_open[row], [start[name] for name in order], atol=1e-6)


def test_settings_that_name_other_postures_are_refused(table):
    config = load_config(overrides=["candidates.postures='0123456789abcdef'"])
    with pytest.raises(ConfigError, match=r"candidates\.postures must be given with postures"):
        build_config(config, None)
    with pytest.raises(ConfigError, match="must be left out; the postures that are given decide"):
        build_config(config, table)


def test_postures_in_the_frame_of_the_mesh_file_are_moved_to_the_object(tmp_path, table):
    # The file's origin is a corner of the cube, its unit a centimetre.
    box = box_model(tmp_path, [CUBE] * 3, NAME)
    vertices = 100.0 * (box.visual_vertices + CUBE / 2.0)
    (tmp_path / f"{NAME}.obj").write_text(obj_text(vertices, box.visual_faces, normals=False))
    (source,) = find_meshes(tmp_path, units="cm")
    there = table.X_FG.copy()
    there[:, :3, 3] += CUBE / 2.0
    moved = replace(table, X_FG=there, frame="mesh")
    prepared = prepare(source, build_config(CONFIG, moved), moved)
    np.testing.assert_allclose(prepared.candidates.X_OG, table.X_FG, atol=1e-9)

    # The object knows the frame; a dataset, whose meshes are exported in {O}, does not guess.
    placed = place_object(tmp_path / f"{NAME}.obj", units="cm", X_TO=standing(box))
    own, again = (place_on_object(each, placed) for each in (table, moved))
    assert not any(grasp.invalid for grasp in (*own, *again))
    for one, other in zip(own, again, strict=True):
        poses = [each.postures[0].X_OG for each in (one, other)]
        np.testing.assert_allclose(*poses, atol=1e-9)
    with pytest.raises(GraspError, match="for its exported meshes use --frame object, or give"):
        place_on_dataset(moved, tmp_path)
