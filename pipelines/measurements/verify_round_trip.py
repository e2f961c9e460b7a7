"""Verify the grasps of a dataset, and corrupted grasps that must fail.

\b
    python pipelines/measurements/verify_round_trip.py OUT [OUT ...] --workers 2 > round_trip.json

The script verifies the grasp of every sample in the frames of both cameras and of the object, with
both methods, at the dataset's own friction. Then it verifies the contacts at the end of the lift
(`grasps_held`), and grasps that are corrupted in three ways. It prints JSON.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import numpy.typing as npt

from drakegrasp.api.verifying import verify_grasps
from drakegrasp.cluster.connect import connect
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.prepared_objects import load_prepared
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import CAMERAS, SPLITS
from drakegrasp.verification.result import Verification

#: Distance of corrupted contacts from the surface, and between contacts on one side [m].
OFF, APART = 0.03, 0.02

#: Key of the contacts at the end of the lift.
HELD = "at the end of the lift"

Array = npt.NDArray[np.float64]


@click.command(help=__doc__)
@click.argument("outs", type=click.Path(path_type=Path, exists=True), nargs=-1, required=True)
@click.option("--workers", type=int, default=2, show_default=True)
@click.option("--every", type=int, default=1, show_default=True, help="Verify each n-th sample.")
def main(outs: tuple[Path, ...], workers: int, every: int) -> None:
    """Run the script."""
    # Reject datasets that cannot be read before anything is simulated.
    for out in outs:
        GraspDataset(out / DATA_FILES["oto"])

    results: dict[str, dict[str, list[Verification]]] = {}
    with connect(workers) as client:

        def verify(
            key: str, method: str, grasps: Array, data: GraspDataset, rows: list[int], **where: Any
        ) -> None:
            if len(grasps):
                verdicts = verify_grasps(
                    grasps, data, rows=rows, client=client, method=method, show=True, **where
                )
                results.setdefault(method, {}).setdefault(key, []).extend(verdicts)

        for out in outs:
            for split in SPLITS:
                data = {c: GraspDataset(out / DATA_FILES[c], split=split) for c in CAMERAS}
                rows = list(range(0, len(data["oto"]), every))
                if not rows:
                    continue
                spoilt = spoil(out, data["oto"], rows)
                for method in ("hand", "forces"):
                    for camera in CAMERAS:
                        grasps = data[camera].column("grasps")[rows].astype(float)
                        verify(camera, method, grasps, data[camera], rows)
                    held = data["oto"].column("grasps_held")[rows].astype(float)
                    verify(HELD, method, held, data["oto"], rows)
                    for key, grasps in spoilt.items():
                        verify(key, method, grasps, data["oto"], rows, frame="object")
    click.echo(json.dumps({m: figures(by_key) for m, by_key in results.items()}, indent=1))


def spoil(out: Path, data: GraspDataset, rows: list[int]) -> dict[str, Array]:
    """Return the grasps of rows in {O}, (n, 6k), unchanged and corrupted in three ways."""
    # The stored contacts, and the meshes of their objects.
    config = read_manifest(out).config
    with h5py.File(out / TRIALS_FILE, "r") as file:
        trials = data.column("trial_id")[rows]
        p = file["trials/closed_p_OQ"][:][trials]
        n = file["trials/closed_nhat_Q_O"][:][trials]
    names = data.column("object_props/object_name")[rows]
    meshes = {name: load_prepared(out, name, config).model.collision for name in set(names)}

    # Reverse two normals; put all contacts on one side, beside the first.
    backwards = n.copy()
    backwards[:, :2] *= -1.0
    one_side_p, one_side_n = p.copy(), n.copy()
    for i, name in enumerate(names):
        # Two directions along the surface at the first contact.
        _, _, (_, along, across) = np.linalg.svd(n[i, :1])
        beside = [p[i, 0] + APART * along, p[i, 0] + APART * across]
        points, _, faces = meshes[name].nearest.on_surface(beside)
        one_side_p[i, 1:], one_side_n[i, 1:] = points, meshes[name].face_normals[faces]

    contacts = {
        "object": (p, n),
        "off the surface": (p + OFF * n, n),
        "two normals reversed": (p, backwards),
        "on one side": (one_side_p, one_side_n),
    }
    return {
        key: np.concatenate([a.reshape(len(rows), -1), b.reshape(len(rows), -1)], axis=1)
        for key, (a, b) in contacts.items()
    }


def figures(by_key: dict[str, list[Verification]]) -> dict[str, Any]:
    """Return the figures of one method."""
    # Outcomes by frame, and errors of the fitted palm poses.
    plain = by_key["object"]
    frames = [[v.outcome for v in by_key[key]] for key in ("object", *CAMERAS)]
    fits = [v.fit for v in plain if v.fit is not None]
    residual = [1e3 * float(fit.residual.max()) for fit in fits]
    angle = [float(np.rad2deg(fit.normal_error).max()) for fit in fits]
    failed = [v for v in plain if not v.success]

    return {
        "grasps": len(plain),
        "objects": len({v.placed.model.name for v in plain}),
        "shares": {
            word: float(np.mean([getattr(v, word) for v in plain]))
            for word in ("success", "held", "precision", "stable", "sample", "held_any")
        },
        "contacts at the end of the lift": {
            "success": share(by_key[HELD]),
            "outcomes": dict(Counter(v.outcome.label for v in by_key[HELD])),
        },
        "same outcome in all frames": float(
            np.mean([len(set(o)) == 1 for o in zip(*frames, strict=True)])
        ),
        "residual [mm] median, 95 %": percentiles(residual, (50, 95)),
        "normal error [deg] median, 95 %": percentiles(angle, (50, 95)),
        "seconds median": {
            stage: percentiles([v.seconds.get(stage, np.nan) for v in plain], (50,))
            for stage in ("margin", "fit", "simulate")
        },
        "outcomes of failures": dict(Counter(v.outcome.label for v in failed)),
        "failures": [f"{v.placed.model.name}: {v.outcome.label}: {v.reason}" for v in failed],
        "spoilt": {
            key: {
                "success": share(verdicts),
                "outcomes": dict(Counter(v.outcome.label for v in verdicts)),
            }
            for key, verdicts in by_key.items()
            if key not in ("object", HELD, *CAMERAS)
        },
    }


def share(verdicts: list[Verification]) -> float:
    """Return the fraction of successes."""
    return float(np.mean([v.success for v in verdicts]))


def percentiles(values: list[float], which: tuple[int, ...]) -> list[float]:
    """Return percentiles of the finite values, rounded; an empty list if there are none."""
    finite = [v for v in values if np.isfinite(v)]
    return np.percentile(finite, which).round(4).tolist() if finite else []


if __name__ == "__main__":
    main()
