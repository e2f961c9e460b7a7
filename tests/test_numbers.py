"""The numbers that the rooms make of fixed inputs are those in `tests/golden/numbers`.

Other tests say why a number must be so; these notice whatever else changes. Numbers are compared to
a thousandth, or to 1e-6, because other CPUs simulate others, see docs/explanation/determinism.md.
Pages, figures, commands and job scripts have golden tests of their own.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import trimesh
from helpers.arms import write_arm
from helpers.datasets import OTO, make_dataset
from helpers.depth_images import X_TC, K, box_view, cloud_of, image
from helpers.golden import DECIMAL, Golden, told
from helpers.meshes import box, flipped, open_box, solid_of
from helpers.objects import box_model, drawn_attempts, standing

import drakegrasp as dg
from drakegrasp import registry
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.statistics import count_clutter, counts_as_dict
from drakegrasp.exchange.export import export_dataset, options_of
from drakegrasp.frames import make_pose, rotation_about, transform_points
from drakegrasp.generation.scenes import make_scenes
from drakegrasp.hand.finger_sweep import find_opposition, find_pinch, hand_paths, link_points
from drakegrasp.hand.kinematics import (
    closed_positions,
    closing_levers,
    coordinate_limits,
    fingertip_forces,
    fingertip_poses,
    joint_positions,
)
from drakegrasp.hand.shapes import link_rims, link_shapes, pad_surfaces
from drakegrasp.mesh.cloud import column_solid, hull_solid
from drakegrasp.mesh.distance_field import make_distance_field
from drakegrasp.mesh.remeshing import decimate, resting_hull, subdivide
from drakegrasp.mesh.surfaces import overlap_share, whole_windings, winding_numbers
from drakegrasp.objects.audit import audit
from drakegrasp.objects.model import ObjectModel
from drakegrasp.seeding import Stream
from drakegrasp.simulation.attempt import Attempt, draw_conditions
from drakegrasp.simulation.candidates import R_OG0
from drakegrasp.simulation.closing import centred, closing_features, closing_positions
from drakegrasp.simulation.screen import screen
from drakegrasp.verification.placing import dataset_config
from drakegrasp.verification.result import json_line
from drakegrasp.verification.wrist_problem import hand_constants
from drakegrasp.verification.wrist_solver import make_postures
from drakegrasp.vision import camera
from drakegrasp.vision.depth_image import (
    cloud_from_depth,
    complete,
    fit_table,
    read_lens,
    table_share,
)

pytestmark = pytest.mark.sim
#: Points around an object, in units of its half extents.
AROUND = 1.4 * np.random.default_rng(0).uniform(-1.0, 1.0, (200, 3))


def read(path: Path) -> dict[str, Any]:
    """Return the arrays of an HDF5 file by their paths."""
    found: dict[str, Any] = {}

    def take(name: str, node: object) -> None:
        if isinstance(node, h5py.Dataset):
            text = h5py.check_string_dtype(node.dtype)
            found[name] = node.asstr()[()] if text else node[()]

    with h5py.File(path) as file:
        file.visititems(take)
    return found


def spoilt_meshes() -> Iterator[tuple[str, trimesh.Trimesh]]:
    """Yield meshes that need repair: open, inside out, in parts, coarse, fine or thin."""
    yield "open", open_box()
    yield "inside_out", flipped(box())
    two = [box((0.06, 0.05, 0.04)), box((0.04,) * 3, (0.03, 0.02, 0.01))]
    yield "overlapping", trimesh.util.concatenate(two)
    yield "hollow", trimesh.util.concatenate([box((0.06,) * 3), flipped(box((0.05,) * 3))])
    tube = trimesh.creation.annulus(0.03, 0.035, height=0.1, sections=48)
    yield "tube", trimesh.Trimesh(tube.vertices, tube.faces[tube.face_normals[:, 2] < 0.9])
    yield "fine", trimesh.creation.icosphere(subdivisions=5, radius=0.04)
    yield "thin", trimesh.creation.box([0.1, 0.08, 0.002]).subdivide()


@pytest.fixture(scope="module")
def block(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    """A box without equal edges."""
    return box_model(tmp_path_factory.mktemp("block"), [0.05, 0.06, 0.1])


def test_meshes(tmp_path: Path, golden: Golden) -> None:
    for name, mesh in spoilt_meshes():
        mesh.export(tmp_path / f"{name}.obj")
    rows = audit(tmp_path)
    found = {row.name: {"row": row, "around": around(row.model)} for row in rows}
    golden("numbers/meshes", told(found))


def around(model: ObjectModel | None) -> dict[str, Any] | None:
    """Return what is known of points around an object."""
    if model is None:
        return None
    shape, p = (model.visual_vertices, model.visual_faces), AROUND * model.half_extents
    field = make_distance_field(model.collision_vertices, model.collision_faces)
    return {
        "field": (field.error, field.blur),
        "nearest": field.nearest(*p.T.astype(np.float32)),
        "between": field.interpolate(*p.T.astype(np.float32)),
        "winding": (winding_numbers(p, *shape), whole_windings(p, *shape)),
        "overlap": overlap_share(*shape),
    }


def test_solids(golden: Golden) -> None:
    """Of points that a camera saw, and with other triangles."""
    view = box_view()
    seen = cloud_of(view)
    ball = solid_of(trimesh.creation.icosphere(subdivisions=4, radius=0.04))
    found = {
        "hull": hull_solid(seen),
        "columns": column_solid(seen),
        "completed": complete(hull_solid(seen).field, view),
        "fewer": decimate(ball, 300),
        "more": subdivide(solid_of(box()), 0.02, 2000),
        "resting": resting_hull(ball.vertices),
    }
    golden("numbers/solids", told(found))


@pytest.mark.parametrize("name", ["barrett", "franka", "allegro", "leap"])
def test_hands(name: str, golden: Golden) -> None:
    hand = dg.load_hand(name)
    limits, spread = coordinate_limits(hand), float(np.deg2rad(hand.spreads_deg[-1]))
    closing = limits[1:] @ [0.6, 0.4]
    found = {
        "limits": limits,
        "joints": joint_positions(hand, spread, closing),
        "closed": closed_positions(hand),
        "X_GF": fingertip_poses(hand, spread=spread, closing=closing),
        "forces": fingertip_forces(hand, hand.drive),
        "levers": closing_levers(hand, closing),
        "opposition": find_opposition(hand),
        "pinch": find_pinch(hand, 0.05),
        "paths": hand_paths(hand, spread),
        "points": link_points(hand),
        "shapes": link_shapes(hand.model),
        "rims": link_rims(hand.model),
        "pads": pad_surfaces(hand.model, hand.fingers),
        "postures": make_postures(hand),
        "constants": hand_constants(hand),
    }
    golden(f"numbers/hands/{name}", told(found))


def test_cameras(golden: Golden) -> None:
    config, stream, X_TG = dg.load_config("randomized"), Stream(3), standing_palm()
    (depth, mask), lens = image(), read_lens(K)
    clean = np.where(np.isfinite(depth) & (depth > 0.0), depth, 2.0).astype(np.float32)
    p_TQ = cloud_from_depth(depth, K, mask, X_TC)[::50]
    # Every second normal points down, away from the camera.
    nhat_Q_T = np.where(np.arange(len(p_TQ))[:, None] % 2, [0.0, 0.0, -1.0], [0.0, 0.0, 1.0])
    sensor = camera.DepthSensor(noise=1e-3, baseline=0.02, seed=7)
    found = {
        "K": camera.intrinsics(config.camera),
        "oto": camera.camera_pose_oto(X_TG, config.camera),
        "otm": camera.camera_pose_otm(X_TG, config.camera),
        "fixed": camera.fixed_viewpoints(),
        "drawn": [camera.draw_viewpoint(stream, X_TG[:3, 3], config.scenes) for _ in range(3)],
        "image frame": camera.image_frame(K, mask, depth),
        "visible": camera.visible_contacts(p_TQ, nhat_Q_T, X_TC, K, clean, mask),
        "spoilt": camera.spoil_depth(clean, K, sensor, 1, config.camera),
        "shadow": camera.shadow(clean, K, 0.02),
        "colours": [camera.usual_appearance(name) for name in ("1_mug", "2_box")],
        "table": fit_table(depth, K, mask),
        "share": table_share(depth, K, mask, X_TC),
        "lens": lens,
    }
    golden("numbers/cameras", told(found))


def standing_palm() -> np.ndarray:
    """Return a palm pose X_TG that is aligned with no axis."""
    R = rotation_about([0.3, -0.5, 0.8], 2.1)
    return make_pose(R, [0.02, -0.03, 0.15])


def test_palms(block: ObjectModel, golden: Golden) -> None:
    """Attempts as drawn, and what geometry says of them."""
    found: dict[str, Any] = {}
    for preset, hand in (("fast", "barrett"), ("paper", "franka"), ("randomized", "allegro")):
        config = dg.load_config(preset, ["candidates.max=24"], hand=hand)
        X_TO = standing(block)
        attempts = list(drawn_attempts(block, X_TO, config))
        screened = screen(block, dg.load_hand(hand), X_TO, attempts, config.screen)
        drawn = [draw_conditions(block, config, each.candidate, 0) for each in attempts[:4]]
        found[preset] = {
            "X_OG": np.array([each.X_OG for each in attempts]),
            "rest": [(each.spread, each.standoff, each.preshape) for each in attempts[:6]],
            "outcome": [None if s is None or s.outcome is None else s.outcome for s in screened],
            "closing": [s.closing for s in screened if s is not None][:20],
            "last": [s.last for s in screened if s is not None][:20],
            "conditions": drawn,
        }
    golden("numbers/palms", told(found))


def test_closing_by_geometry(block: ObjectModel, golden: Golden) -> None:
    solid, found = hull_solid(block.visual_vertices), {}
    for name in ("barrett", "allegro", "franka"):
        hand, turn = dg.load_hand(name), rotation_about([0.1, 0.2, 1.0], 0.7)
        X_SG = np.array([make_pose(R_OG0, [0.0, y, 0.05 + hand.standoffs[0]]) for y in (0.0, 0.01)])
        X_SG[1, :3, :3] = X_SG[1, :3, :3] @ turn
        X_TS = standing(block)
        found[name] = {
            "features": closing_features(solid, hand, 0.2, X_SG, X_TS=X_TS),
            "positions": closing_positions(solid, hand, 0.2, X_SG),
            "centred": centred(block, hand, [Attempt(X_OG=X, spread=0.2) for X in X_SG]),
        }
    golden("numbers/closing", told(found))


@pytest.mark.parametrize("name", ["barrett", "franka", "allegro", "leap"])
def test_trials(name: str, block: ObjectModel, golden: Golden) -> None:
    """The best proposals for an object, as trials."""
    config = dg.load_config("fast", hand=name)
    placed = dg.place_object(trimesh.creation.box([0.05, 0.06, 0.1]), config=config)
    cloud = transform_points(placed.X_TO, block.visual_vertices)
    proposed = dg.propose(cloud, name)
    ranking = dg.rank(proposed, cloud, name)
    chosen = proposed.at(ranking.order[:2].tolist())
    records = [
        dg.run_trial(placed, chosen.posture(i, placed.X_TO), config=config) for i in range(2)
    ]
    found = {"ranking": ranking, "chosen": chosen, "records": records, "X_TO": placed.X_TO}
    golden(f"numbers/trials/{name}", told(found))


# Files


def test_datasets(small_dataset: Path, golden: Golden) -> None:
    """The attempts of a build, its samples, and its counts."""
    found = {path.stem: read(path) for path in sorted(small_dataset.glob("*.hdf5"))}
    counts = counts_as_dict(small_dataset) | {"path": None}
    golden("numbers/datasets", told(found | {"counts": counts}))


def test_scenes(sound: Path, tmp_path: Path, golden: Golden) -> None:
    """Of a dataset that nobody simulated."""
    out = Path(shutil.copytree(sound, tmp_path / "out"))
    make_scenes(out, overrides=["scenes.width=64", "scenes.height=48", "scenes.views=2"])
    golden("numbers/scenes", told(read(out / "scenes.hdf5")))


def test_scenes_of_several_objects(small_clutter: Path, golden: Golden) -> None:
    found = read(small_clutter / "clutter.hdf5") | {"counts": count_clutter(small_clutter)}
    golden("numbers/clutter", told(found))


def test_reach(sound: Path, tmp_path: Path, golden: Golden) -> None:
    out = Path(shutil.copytree(sound, tmp_path / "out"))
    arm = dg.load_arm(write_arm(tmp_path), (-0.45, 0.25, 0.0, 0.3))
    golden("numbers/reach", told({"arm": arm, "rows": dg.reach_dataset(out, arm)}))


def test_exports(sound: Path, tmp_path: Path, golden: Golden) -> None:
    """Every format: the arrays of its files, and the numbers with decimals in their texts."""
    found: dict[str, Any] = {}
    for form in sorted(registry.names("exporters")):
        said = {"licence": "cc-by-4.0"} if "licence" in options_of(form) else {}
        export_dataset(sound, tmp_path / form, form, **said)
        files = sorted(path for path in (tmp_path / form).rglob("*") if path.is_file())
        found[form] = {str(path.relative_to(tmp_path / form)): content(path) for path in files}
    golden("numbers/exports", told(found))


def content(path: Path) -> Any:
    """Return the arrays of a file of an export, or the numbers of a text; None for other files."""
    if path.suffix in (".npy", ".npz"):
        arrays = np.load(path, allow_pickle=True)
        return arrays.item() if isinstance(arrays, np.ndarray) else dict(arrays)
    if path.suffix in (".h5", ".hdf5"):
        return read(path)
    if path.suffix in (".parquet", ".png"):
        return None
    return [float(word) for word in DECIMAL.findall(path.read_text())]


# Verdicts


#: What differs on another CPU in the verdict on contacts that fit badly.
FITTED = (
    *("X_OG", "spread", "closing", "fit_residual", "fit_normal_error", "slip", "turn"),
    *("X_TO_lifted", "contact_error", "normal_error", "outcomes", "tries", "explain"),
)


def test_verdicts(small_dataset: Path, golden: Golden) -> None:
    """On contacts as they are, and with the faults that hints name."""
    data, found = GraspDataset(small_dataset / OTO, split="test"), {}
    config = dataset_config(data, overrides=["verify.max_tries=1"])
    points, normals = data[0].grasp.astype(float).reshape(2, -1, 3)
    spoilt = {
        "as stored": (points, normals),
        "moved": (points + np.array([0.004, 0.0, 0.002]), normals),
        "millimetres": (1e3 * points, normals),
        "inward": (points, -normals),
        "turned": (points[[1, 2, 0]], normals[[1, 2, 0]]),
        "long": (points, 3.0 * normals),
    }
    for name, parts in spoilt.items():
        grasp = np.concatenate([part.ravel() for part in parts])
        verdict = dg.verify_grasp(grasp, data, row=0, config=config)
        line = json.loads(json_line(0, verdict)) | {"seconds": None}
        if name != "as stored":
            rough = [k for k in line if k in FITTED or k.startswith(("time", "closed", "lifted_"))]
            line |= dict.fromkeys(rough)
        found[name] = line
    golden("numbers/verdicts", told(found))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> GraspDataset:
    """Rows that nobody simulated."""
    folder = tmp_path_factory.mktemp("data")
    out = make_dataset(folder / "out", folder / "meshes", overrides=["split.by=class"])
    return GraspDataset(out / OTO, split="test")


def test_scores(data: GraspDataset, golden: Golden) -> None:
    """A card of all reference rows."""
    card = dg.score([], data, per_object=1, workers=1).card
    sets = {name: each | {"files": None} for name, each in card["sets"].items()}
    golden("numbers/scores", told({"sets": sets, "headline": card["headline"]}))


def test_predictions(small_clutter: Path, golden: Golden) -> None:
    found, blind = dg.predict_scenes(small_clutter / "clutter.hdf5", workers=1)
    golden("numbers/predictions", told({"grasps": found, "blind": blind}))
