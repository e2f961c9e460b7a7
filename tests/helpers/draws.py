"""Prints what is drawn, as hashes: run in processes that compute with other kernels.

Run as a script: `python draws.py [MESHES]`, with a directory of the real meshes or without. On
standard output: a JSON object of a hash by name, and under `kernels` what the process ran with.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from threadpoolctl import threadpool_info

from drakegrasp.config import BuiltinConfig, SplitConfig
from drakegrasp.dataset.split import find_homes, split_samples
from drakegrasp.frames import make_pose, transform_points
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.scoring.predicting import propose
from drakegrasp.seeding import Stream
from drakegrasp.shapes.catalog import export_builtin
from drakegrasp.simulation.attempt import (
    PALM_SHIFT,
    PALM_TURN,
    _noise_factor,
    draw_conditions,
    palm_motion,
)
from drakegrasp.simulation.candidates import (
    Drawing,
    normal_candidates,
    palm_attempts,
    rotation_candidates,
)
from drakegrasp.simulation.screen import screen
from drakegrasp.vision.camera import DepthSensor, spoil_depth

#: Of the real meshes: a thin one, one with many faces, one that lies on its side.
REAL = ("24_mug_final", "42_wineglass_final", "110_bunny_final")
#: Attempts whose screenings are hashed.
PREDICTED = 600
#: Palm poses of the sampler `closing` that are hashed.
CLOSING = 60
#: A resting pose of exact numbers: 3, 4, 5 are a right triangle.
R_TO = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])


def digest(*parts: object) -> str:
    """Return a hash of arrays and bytes."""
    found = hashlib.sha256()
    for part in parts:
        found.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    return found.hexdigest()[:16]


def objects(folder: Path, meshes: Path | None) -> Iterator[MeshSource]:
    """Yield a cube, a cylinder, a block, a pipe and, where they are, three real meshes."""
    cube, cylinder = trimesh.creation.box([0.07] * 3), trimesh.creation.cylinder(0.03, 0.12)
    cylinder.vertices = np.round(cylinder.vertices, 6)  # trimesh's own sines
    # So large that the grid of its distance field is not the finest one.
    block = trimesh.creation.box([0.18, 0.13, 0.15])
    for name, mesh in (("1_cube", cube), ("2_cylinder", cylinder), ("3_block", block)):
        mesh.subdivide().subdivide().export(folder / f"{name}.stl")
    # Open at both ends, with two square rims of one size.
    pipe = trimesh.creation.box([0.1, 0.06, 0.06]).subdivide().subdivide()
    pipe.update_faces(np.abs(pipe.face_normals[:, 0]) < 0.5)
    pipe.export(folder / "4_pipe.stl")
    yield from find_meshes(folder)
    if meshes is not None:
        yield from (s for s in find_meshes(meshes, units="cm") if s.name in REAL)


def object_draws(source: MeshSource) -> Iterator[tuple[str, str]]:
    """Yield the draws of one object under the preset `paper`."""
    config = load_config(overrides=["candidates.max=1000"])
    hand = load_hand(config.hand)
    prepared = prepare(source, config)
    model, candidates, rest = prepared.model, prepared.candidates, prepared.resting_poses[0]
    attempts = list(
        palm_attempts(
            candidates, range(len(candidates)), config.candidates, name=source.name, seed=7
        )
    )
    shape = model.visual_vertices, model.visual_faces
    yield "mesh", digest(*shape, model.collision_vertices, model.collision_faces)
    # The resting pose is simulated, so its last bits differ between machines. Of that of the
    # cylinder, which may turn about its axis, only height and upward direction are compared.
    compared = rest[2] if source.name == "2_cylinder" else rest
    yield "X_TO", digest(np.round(compared, 4) + 0.0)
    yield "palm poses", digest(candidates.X_OG, candidates.distance)
    yield (
        "attempts",
        digest(
            np.array([a.X_OG for a in attempts]),
            np.array([a.spread for a in attempts]),
            np.array([a.seed for a in attempts], dtype=np.uint64),
        ),
    )
    drawn = [
        draw_conditions(model, load_config("randomized"), a.candidate, a.standoff_index).values()
        for a in attempts[:PREDICTED]
    ]
    yield "conditions", digest(*(np.array([d[name] for d in drawn]) for name in drawn[0]))
    yield "normals", digest(normal_candidates(model, 1000, Stream(7)))
    X_TO = make_pose(R_TO, [0.1, 0.2, model.half_extents[2]])
    closing = Drawing(model, X_TO, load_config("fast")).candidates(CLOSING)
    yield "closing", digest(closing.X_OG, closing.spread)
    cloud = transform_points(X_TO, model.visual_vertices)
    yield "proposals", digest(propose(cloud, hand).X_FG)
    screenings = screen(model, hand, rest, attempts[:PREDICTED], config.screen)
    yield (
        "predictions",
        digest(
            np.array([-1 if p is None or p.outcome is None else p.outcome for p in screenings]),
            *[p.closing for p in screenings if p is not None],
        ),
    )


def main(meshes: Path | None) -> dict[str, object]:
    """Return all hashes, and what this process computes with."""
    found: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        builtin = export_builtin(folder / "builtin", config=BuiltinConfig(per_class=1))
        found["builtin meshes"] = digest(*(path.read_bytes() for path in builtin))
        for source in objects(folder, meshes):
            for what, value in object_draws(source):
                found[f"{source.name}: {what}"] = value
    jittered = load_config("released", overrides=["candidates.max=1000"]).candidates
    half = np.array([0.03, 0.04, 0.05])
    X_TO = np.eye(4)
    X_TO[2, 3] = half[2]
    poses = rotation_candidates(half, X_TO, jittered, Stream(7, 3))
    found["jittered palm poses"] = digest(poses)
    names = [f"{i}_thing" for i in range(12)]
    homes = find_homes(names, {}, SplitConfig(seed=7))
    for by in ("class", "object"):
        split = split_samples(
            np.repeat(np.arange(12, dtype=np.int32), 40),
            names,
            [f"class {i // 3}" for i in range(12)],
            names,
            homes,
            SplitConfig(by=by),
            7,
        )
        found[f"split by {by}"] = digest(*split.values())
    stream = Stream(7, 1)
    found["noise of repeats"] = digest(
        *(palm_motion(stream.normal(6), PALM_SHIFT, PALM_TURN) for _ in range(100)),
        np.array([_noise_factor(stream) for _ in range(100)]),
    )
    clean = np.full((64, 64), 0.3, dtype=np.float32)
    sensor = DepthSensor(noise=1e-3, baseline=0.02, seed=7)
    spoilt = [spoil_depth(clean, np.eye(3), sensor, c, load_config().camera) for c in range(2)]
    found["depth noise"] = digest(*spoilt)
    found["kernels"] = kernels()
    return found


def kernels() -> dict[str, object]:
    """Return what this process computes with, so that a test sees that a setting took effect."""
    x = np.linspace(-3.0, 3.0, 10_001)
    simd: Any = np.show_config(mode="dicts")
    blas = {str(info["architecture"]) for info in threadpool_info() if "architecture" in info}
    return {
        "blas": sorted(blas),
        "simd": sorted(simd["SIMD Extensions"].get("found", [])),
        "libm": digest(np.array([[math.sin(v), math.exp(v)] for v in x.tolist()])),
    }


if __name__ == "__main__":
    print(json.dumps(main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)))  # noqa: T201
