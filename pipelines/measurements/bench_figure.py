"""Draw a report of `drakegrasp bench`: outcomes of attempts, and what they cost.

\b
    python pipelines/measurements/bench_figure.py bench.json bench.png
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from drakegrasp.outcomes import Outcome

#: What decided an attempt, the outcomes that it decides, and their colour.
DECIDED: dict[str, tuple[tuple[Outcome, ...], str]] = {
    "palm ray": ((Outcome.RAY_MISS, Outcome.BELOW_TABLE), "#c9ced6"),
    "start": ((Outcome.START_COLLISION,), "#98a3b3"),
    "screen": ((Outcome.SCREENED,), "#5f6f86"),
    "closing": (
        (
            *(Outcome.MISSING_FINGERTIP, Outcome.HAND_CONTACT, Outcome.TABLE_CONTACT),
            Outcome.NOT_LIFTED,
        ),
        "#e3b23c",
    ),
    "lift": ((Outcome.DROPPED, Outcome.SLIPPED, Outcome.PARTLY_HELD, Outcome.MOVED), "#d9722e"),
    "success": ((Outcome.SUCCESS,), "#2f8f5b"),
}
STAGES = {"screen": "#5f6f86", "try": "#d9722e", "look": "#2f8f5b", "scene": "#c9ced6"}
#: Stages that run once per object.
ONCE = ("scene", "field")


def draw(report: Mapping[str, Any], png: Path) -> None:
    """Write the figure."""
    objects = report["objects"]
    figure = Figure(figsize=(10.0, 1.2 + 0.3 * len(objects)), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, sharey=True)
    left.invert_yaxis()
    names = [rates["name"].removesuffix("_final").replace("_", " ") for rates in objects]

    # Left: what decides the attempts of each object.
    shares = {
        what: [100.0 * _count(rates, outcomes) / rates["attempts"] for rates in objects]
        for what, (outcomes, _) in DECIDED.items()
    }
    colours = {what: colour for what, (_, colour) in DECIDED.items()}
    _stack(left, names, shares, colours, "of 100 attempts, decided by")

    # Right: their cost by stage.
    costs = {
        stage: [1e3 * _seconds(rates, stage) / rates["attempts"] for rates in objects]
        for stage in STAGES
    }
    _stack(right, names, costs, STAGES, "CPU milliseconds per attempt")
    figure.savefig(png)


def _count(rates: Mapping[str, Any], outcomes: Sequence[Outcome]) -> int:
    return sum(int(rates["outcomes"].get(outcome.label, 0)) for outcome in outcomes)


def _seconds(rates: Mapping[str, Any], stage: str) -> float:
    stages = ONCE if stage in ONCE else (stage,)
    return sum(float(rates["seconds"][name]) for name in stages)


def _stack(
    axes: Axes,
    names: Sequence[str],
    values: Mapping[str, Sequence[float]],
    colours: Mapping[str, str],
    title: str,
) -> None:
    start = [0.0] * len(names)
    for what, widths in values.items():
        axes.barh(names, widths, left=start, color=colours[what], label=what, height=0.72)
        start = [a + b for a, b in zip(start, widths, strict=True)]
    axes.set_xlim(0.0, max(start))
    axes.set_xlabel(title)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.legend(
        loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(values), frameon=False,
        fontsize="small", handlelength=1.0, columnspacing=1.0,
    )  # fmt: skip


@click.command(help=__doc__)
@click.argument("report", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.argument("png", type=click.Path(path_type=Path, dir_okay=False))
def main(report: Path, png: Path) -> None:
    """Run the script."""
    draw(json.loads(report.read_text(encoding="utf-8")), png)


if __name__ == "__main__":
    main()
