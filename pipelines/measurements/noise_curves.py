"""Measure how many grasps still hold when their points or normals have errors.

\b
    python pipelines/measurements/noise_curves.py OUT noise.jsonl --number 60 > noise.json
    python pipelines/measurements/noise_curves.py OUT noise.jsonl --figure docs/images/noise.png

OUT is an assembled dataset. The script moves the contact points of samples by Gaussian noise of
several sizes (per coordinate), and verifies them unchanged and with `snap_points`. It also tilts
normals by a given angle in a random direction. Each line of noise.jsonl is a verdict: a run that
was stopped continues with the missing verdicts, and a run with a larger number adds more. The
script prints JSON: the fraction of grasps that hold with the first wrist pose, and its 95 %
interval.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
import numpy.typing as npt
from scipy.stats import binomtest

from drakegrasp.api.verifying import verify_grasps
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.hand.settings import override_config

#: Standard deviations of each coordinate of a point [mm], and angles of the normals [deg].
POINTS, NORMALS = (0.0, 2.5, 5.0, 10.0, 15.0, 20.0), (10.0, 20.0, 30.0, 40.0)
#: Distances d of the curve held(d) [mm]: a grasp counts if it holds within d of the request.
WITHIN = (5.0, 10.0, 20.0, 40.0, np.inf)

Array = npt.NDArray[np.float64]


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.argument("lines", type=click.Path(path_type=Path, dir_okay=False))
@click.option("--number", type=int, default=0, help="Grasps to verify; 0: only those in the file.")
@click.option("--tries", type=int, default=1, show_default=True, help="Wrist poses per grasp.")
@click.option("--figure", type=click.Path(path_type=Path), help="Draw the curves to this file.")
def main(out: Path, lines: Path, number: int, tries: int, figure: Path | None) -> None:
    """Run the script."""
    done = read(lines)
    if number:
        config = override_config(read_manifest(out).config, [f"verify.max_tries={tries}"])
        with lines.open("a", encoding="utf-8") as file:
            for line in verdicts(out, config, number, {key_of(line) for line in done}):
                file.write(json.dumps(line) + "\n")
                file.flush()
        done = read(lines)
    curves = summary(done)
    if figure:
        draw(curves, figure)
    click.echo(json.dumps(curves, indent=1))


def read(lines: Path) -> list[dict[str, Any]]:
    """Return the verdicts in a file; none if the file does not exist."""
    if not lines.exists():
        return []
    return [json.loads(line) for line in lines.read_text(encoding="utf-8").splitlines()]


def key_of(line: dict[str, Any]) -> tuple[int, str, float]:
    """Return the key of a verdict: the attempt, the kind of noise and its size."""
    return line["trial"], line["kind"], line["noise"]


def verdicts(
    out: Path, config: Config, number: int, done: set[tuple[int, str, float]]
) -> Iterator[dict[str, Any]]:
    """Yield the missing verdicts, grasp by grasp."""
    for data, row, trial, p, n in some_grasps(out, number):
        # The directions are the same at every size, so that a curve shows one growing error.
        rng = np.random.default_rng(trial)
        away, beside = rng.normal(size=p.shape), np.cross(n, rng.normal(size=n.shape))
        beside /= np.linalg.norm(beside, axis=1, keepdims=True)
        asked = {("raw", size): (p + 1e-3 * size * away, n) for size in POINTS}
        asked |= {("snapped", size): (p + 1e-3 * size * away, n) for size in POINTS[1:]}
        for size in NORMALS:
            angle = np.deg2rad(size)
            asked["normals", size] = (p, np.cos(angle) * n + np.sin(angle) * beside)

        for (kind, size), contacts in asked.items():
            if (trial, kind, size) in done:
                continue
            (verdict,) = verify_grasps(
                np.concatenate([part.ravel() for part in contacts])[None],
                data,
                rows=[row],
                frame="object",
                snap_points=kind == "snapped",
                config=config,
            )
            error = verdict.farthest_contact
            yield {
                "trial": trial,
                "object": verdict.placed.model.name,
                "kind": kind,
                "noise": size,
                "outcome": verdict.outcome.label,
                "held": verdict.held,
                "held_any": verdict.held_any,
                "success": verdict.success,
                "error_mm": None if np.isnan(error) else round(1e3 * error, 2),
                "seconds": round(sum(verdict.seconds.values()), 3),
            }


def some_grasps(out: Path, number: int) -> Iterator[tuple[GraspDataset, int, int, Array, Array]]:
    """Yield data file, row, attempt, points and normals (k, 3) in {O} of samples.

    The first sample of each object comes first, then the second sample of each.
    """
    trials = Trials(out)
    contacts = trials.contacts(frame="object")
    names = trials.objects["name"][trials["object"]]
    found, count = [], dict[str, int]()
    for split in SPLITS:
        data = GraspDataset(out / DATA_FILES["oto"], split=split)
        for row, trial in enumerate(data.column("trial_id").tolist() if len(data) else []):
            turn = count[names[trial]] = count.get(names[trial], -1) + 1
            found.append((turn, trial, data, row))
    for _, trial, data, row in sorted(found, key=lambda each: each[:2])[:number]:
        yield data, row, trial, contacts.points[trial], contacts.normals[trial]


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the curves: how many grasps hold at each size of noise, in total and by distance."""
    figures: dict[str, Any] = {
        "grasps": len({line["trial"] for line in lines}),
        "objects": len({line["object"] for line in lines}),
        "verdicts": len(lines),
    }
    for kind in ("raw", "snapped", "normals"):
        # The unchanged grasps are also the grasps with normals tilted by zero.
        same = {kind, "raw"} if kind == "normals" else {kind}
        sizes = (0.0, *NORMALS) if kind == "normals" else POINTS
        figures[kind] = [
            _point(size, group)
            for size in sizes
            if (
                group := [
                    line
                    for line in lines
                    if line["noise"] == size and line["kind"] in (same if size == 0.0 else {kind})
                ]
            )
        ]
    return figures


def _point(size: float, group: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures at one size of noise."""
    held = sum(line["held"] for line in group)
    interval = binomtest(held, len(group)).proportion_ci(method="wilson")
    errors = np.array([_far(line) for line in group if line["held"]])
    return {
        "noise": size,
        "grasps": len(group),
        "held": held,
        "interval": [round(interval.low, 3), round(interval.high, 3)],
        "success": sum(line["success"] for line in group),
        "held within d": {f"{d:g} mm": int((errors <= d).sum()) for d in WITHIN},
        "outcomes": {
            outcome: sum(line["outcome"] == outcome for line in group)
            for outcome in sorted({line["outcome"] for line in group})
        },
    }


def _far(line: dict[str, Any]) -> float:
    """Return the largest distance of a contact from the requested one [mm]; inf if unknown."""
    return np.inf if line["error_mm"] is None else float(line["error_mm"])


def draw(curves: dict[str, Any], path: Path) -> None:
    """Draw held(noise) with intervals, and held within d at each noise of the raw points."""
    import matplotlib.pyplot as plt

    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure, (points, normals, within) = plt.subplots(
        1, 3, figsize=(11.0, 3.6), sharey=True, layout="constrained"
    )
    for axes, kind, colour, label in (
        (points, "raw", "#1f4e79", "as predicted"),
        (points, "snapped", "#c55a11", "points snapped to the surface"),
        (normals, "normals", "#1f4e79", "normals tilted"),
    ):
        each = curves[kind] if kind != "snapped" else [*curves["raw"][:1], *curves["snapped"]]
        if not each:
            continue
        noise = [point["noise"] for point in each]
        low, high = np.array([point["interval"] for point in each]).T
        share = np.array([point["held"] / point["grasps"] for point in each])
        axes.fill_between(noise, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(noise, share, "o-", color=colour, label=label)
    points.set(xlabel="noise of each coordinate, σ [mm]", ylabel="share that holds", ylim=(0, 1.02))
    points.legend(frameon=False, loc="lower left")
    normals.set(xlabel="tilt of every normal [°]")

    shades = plt.get_cmap("viridis")(np.linspace(0.0, 0.9, len(curves["raw"])))
    for point, colour in zip(curves["raw"], shades, strict=True):
        d = [*WITHIN[:-1], 60.0]
        each_d = [count / point["grasps"] for count in point["held within d"].values()]
        within.plot(d, each_d, "o-", markersize=3, color=colour, label=f"{point['noise']:g} mm")
    within.set(xlabel="distance d of the contacts reached [mm]")
    within.set_xticks([5, 10, 20, 40, 60], ["5", "10", "20", "40", "any"])
    within.legend(
        frameon=False, title="σ", fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5)
    )
    for axes, title in (
        (points, "points"), (normals, "normals"), (within, "held within d, as predicted"),
    ):  # fmt: skip
        axes.set_title(title, loc="left", fontsize=10)
        axes.grid(alpha=0.25)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
