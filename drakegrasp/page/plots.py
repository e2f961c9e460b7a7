"""The page of plots: funnel, Table III, grasps by object, distributions."""

from __future__ import annotations

import threading
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from drakegrasp.dataset.statistics import count_splits
from drakegrasp.dataset.trial_files import NONE
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.page.catalog import Snapshot
from drakegrasp.page.query import QUANTITIES
from drakegrasp.pictures.distributions import (
    draw_counts,
    draw_distributions,
    draw_objects,
    svg_bytes,
)

#: Plots by name, with what they show.
PLOTS = {
    "outcomes": "How the attempts ended.",
    "removals": "What became of the successes: samples, or the filter that removed them.",
    "objects": "Grasps by object: held at the end of the lift; of these with the fingertips alone "
    "(precision); of these moved by less than 5 mm and 5° in the hand (stable).",
    "distributions": "Held grasps by quantity. Each last bin holds all larger values. What each "
    "quantity is stands on the page of a grasp.",
}
_LOCK = threading.Lock()
#: What was drawn of states of the files that are still in use.
_DRAWN: WeakKeyDictionary[Snapshot, dict[str, bytes]] = WeakKeyDictionary()


def plots_values(snapshot: Snapshot) -> dict[str, Any]:
    """Return the values of the page of plots."""
    try:
        splits = count_splits(snapshot.out) if snapshot.assembled else []
    except DataError:
        splits = []
    return {
        "title": snapshot.out.name or str(snapshot.out),
        "missing": snapshot.missing,
        "splits": splits,
        "plots": [
            {"name": name, "title": title}
            for name, title in PLOTS.items()
            if snapshot.assembled or name != "removals"
        ],
    }


def plot_svg(snapshot: Snapshot, name: str) -> bytes | None:
    """Return a plot as SVG, or None if there is none of that name."""
    drawings = {
        "outcomes": _outcomes,
        "removals": _removals,
        "objects": _objects,
        "distributions": _distributions,
    }
    if name not in drawings:
        return None
    draw = drawings[name]
    # Matplotlib's settings belong to the process: one plot at a time.
    with _LOCK:
        drawn = _DRAWN.setdefault(snapshot, {})
        if name not in drawn:
            drawn[name] = svg_bytes(draw(snapshot))
        return drawn[name]


def _outcomes(snapshot: Snapshot) -> Any:
    counts = np.bincount(snapshot.table.outcome, minlength=1 + max(Outcome))
    shown = [o for o in Outcome if counts[o] or o is Outcome.SUCCESS]
    shown.sort(key=lambda o: (o is not Outcome.SUCCESS, -counts[o]))
    return draw_counts({o.label: int(counts[o]) for o in shown}, "attempts")


def _removals(snapshot: Snapshot) -> Any:
    decided = snapshot.table.removal[snapshot.table.removal != NONE]
    counts = np.bincount(decided, minlength=1 + max(Removal))
    shown = [r for r in Removal if counts[r] or r is Removal.KEPT]
    shown.sort(key=lambda r: (r is not Removal.KEPT, -counts[r]))
    names = {r: "samples" if r is Removal.KEPT else r.label for r in shown}
    return draw_counts({names[r]: int(counts[r]) for r in shown}, "successes")


def _objects(snapshot: Snapshot) -> Any:
    table = snapshot.table
    groups = {
        "held": table.outcome == Outcome.SUCCESS,
        "precision": table.precision,
        "stable": table.stable,
    }
    size = len(snapshot.names)
    counts = {
        name: np.bincount(table.object[which], minlength=size).tolist()
        for name, which in groups.items()
    }
    return draw_objects(snapshot.names, counts)


def _distributions(snapshot: Snapshot) -> Any:
    table = snapshot.table
    held = table.outcome == Outcome.SUCCESS
    quantities = []
    for name, quantity in QUANTITIES.items():
        values = table.feature(name)[held].astype(float) * quantity.factor
        quantities.append((quantity.label, values))
    groups = {
        "held": np.ones(int(held.sum()), dtype=bool),
        "precision": table.precision[held],
        "stable": table.stable[held],
    }
    return draw_distributions(quantities, groups)
