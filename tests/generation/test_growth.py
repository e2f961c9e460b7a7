"""A dataset only grows: more meshes and a larger target add rows and change none."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
import trimesh
from helpers.builds import build
from helpers.meshes import write

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import FIELDS, GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.hand.settings import load_config

#: An attempt in any dataset: its object, resting pose, palm pose and stand-off.
Identity: TypeAlias = tuple[str, int, int, int]
#: The bytes of each column of a row.
Row: TypeAlias = dict[str, bytes]
#: Full extents [m].
BOXES = {"1_box_a": [0.05, 0.06, 0.12], "2_can_b": [0.06, 0.05, 0.1], "3_jar_c": [0.05, 0.05, 0.08]}
SMALL = ["objects.resting_poses=1", "camera.size=16", "seed=3"]


def grown(folder: Path, out: Path, names: list[str], samples: int) -> None:
    folder.mkdir(exist_ok=True)
    for name in names:
        write(folder / f"{name}.obj", trimesh.creation.box(BOXES[name]).subdivide())
    config = load_config("fast", [*SMALL, f"samples={samples}"])
    build(folder, out, config)


def rows(out: Path) -> tuple[dict[Identity, Row], dict[tuple[str, Identity], tuple[str, Row]]]:
    """Return the attempts by identity; and the split and row of each sample, by file too."""

    def taken(columns: Mapping[str, np.ndarray], i: int) -> Row:
        own = (name for name in columns if name not in ("trial_id", "object"))
        return {name: np.asarray(columns[name][i]).tobytes() for name in own}

    trials = Trials(out)
    columns = trials.columns()
    names = ("object_name", "resting", "candidate", "standoff_index")
    identity = list(zip(*(trials[name].tolist() for name in names), strict=True))
    attempts = {key: taken(columns, i) for i, key in enumerate(identity)}
    samples = {}
    for camera, name in DATA_FILES.items():
        for split in SPLITS:
            data = GraspDataset(out / name, split=split)
            own = {field: data.column(field) for field in FIELDS}
            for i, trial in enumerate(data.column("trial_id").tolist()):
                samples[camera, identity[trial]] = split, taken(own, i)
    return attempts, samples


@pytest.mark.sim
def test_more_meshes_and_a_larger_target_only_add_rows(tmp_path: Path) -> None:
    meshes, out = tmp_path / "meshes", tmp_path / "out"
    grown(meshes, out, ["1_box_a", "2_can_b"], 6)
    attempts, samples = rows(out)
    assert len(samples) == 2 * 6
    grown(meshes, out, [*BOXES], 7)
    more_attempts, more_samples = rows(out)
    assert len(more_samples) == 2 * 7
    assert {k: more_attempts.get(k) for k in attempts} == attempts
    assert {k: more_samples.get(k) for k in samples} == samples
