"""The page of plots: funnel, samples by split, grasps by object, distributions."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any
from weakref import WeakKeyDictionary

import numpy as np

from drakegrasp.dataset.statistics import count_splits
from drakegrasp.dataset.trials import NONE
from drakegrasp.errors import DataError
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome
from drakegrasp.page.attempts import QUANTITIES
from drakegrasp.page.catalog import Snapshot
from drakegrasp.pictures.charts import draw_codes, draw_distributions, draw_objects
from drakegrasp.pictures.style import svg_bytes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Plots by name, with descriptions.
PLOTS = {
    "outcomes": "How the attempts ended.",
    "removals": "What became of the successes: samples, or the filter that removed them.",
    "objects": "Grasps by object: held at the end of the lift; of these with the fingertips alone "
    "(precision); of these moved by less than 5 mm and 5° in the hand (stable).",
    "distributions": "Held grasps by quantity. Each last bin holds all larger values. What each "
    "quantity is stands on the page of a grasp.",
}
_LOCK = threading.Lock()
#: Plots that were drawn for states of the files that are still in use.
_DRAWN: WeakKeyDictionary[Snapshot, dict[str, bytes]] = WeakKeyDictionary()


def plots_values(snapshot: Snapshot) -> dict[str, Any]:
    """Return the values of the page of plots."""
    try:
        splits = count_splits(snapshot.out) if snapshot.assembled else []
    except DataError:
        splits = []
    shown = [name for name in PLOTS if snapshot.assembled or name != "removals"]
    return {
        "title": snapshot.out.name or str(snapshot.out),
        "missing": snapshot.missing,
        "splits": splits,
        "plots": [{"name": name, "title": PLOTS[name]} for name in shown],
    }


def plot_svg(snapshot: Snapshot, name: str) -> bytes:
    """Return one of the PLOTS as SVG."""
    # Matplotlib's settings are global to the process, so plots are drawn one at a time.
    with _LOCK:
        drawn = _DRAWN.setdefault(snapshot, {})
        if name not in drawn:
            drawn[name] = svg_bytes(_draw(snapshot, name))
        return drawn[name]


def _draw(snapshot: Snapshot, name: str) -> Figure:
    table = snapshot.table
    if name == "outcomes":
        counts = np.bincount(table.outcome, minlength=1 + max(Outcome))
        return draw_codes(counts, Outcome.SUCCESS, "attempts")[0]
    if name == "removals":
        decided = table.removal[table.removal != NONE]
        counts = np.bincount(decided, minlength=1 + max(Removal))
        return draw_codes(counts, Removal.KEPT, "successes")[0]

    # The other plots distinguish held grasps, and the better ones among these.
    held, size = table.held, len(snapshot.names)
    groups = {"held": held, "precision": table.precision, "stable": table.stable}
    if name == "objects":
        objects = {group: table.object[members] for group, members in groups.items()}
        return draw_objects(
            snapshot.names,
            {group: np.bincount(o, minlength=size).tolist() for group, o in objects.items()},
        )
    quantities = [
        (quantity.label, snapshot.feature(feature)[held].astype(float) * quantity.factor)
        for feature, quantity in QUANTITIES.items()
    ]
    return draw_distributions(quantities, {group: m[held] for group, m in groups.items()})
