"""Counts and measurements as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from drakegrasp.cli.console import say
from drakegrasp.dataset.assemble import validate_assembled
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.reach import count_reach
from drakegrasp.dataset.statistics import (
    Funnel,
    SplitCount,
    count_clutter,
    count_funnel,
    lifted_note,
)
from drakegrasp.errors import DataError, counted, printable
from drakegrasp.filters import Removal
from drakegrasp.grasp import BANDS
from drakegrasp.outcomes import GROUPS, Outcome

#: Outcomes in the order of the funnel. Outcomes that only verdicts have are not among them.
_FUNNEL = [o for group in GROUPS for o in Outcome if o.group == group]
#: Width of the console [characters]: every table fits.
WIDTH = 1000


def make_table(
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    total: Sequence[str] = (),
    *,
    caption: str = "",
) -> Table:
    """Return a table with a column of names and columns of numbers.

    Args:
        title: Title of the table.
        heads: Heads of the columns.
        rows: Cells of each row. Names are shown literally: they can neither style the table nor
            control the terminal.
        total: Cells of a last row, below a line; none if empty.
        caption: Text below the table.
    """
    table = Table(
        title=title,
        title_justify="left",
        caption=caption or None,
        caption_justify="left",
        box=SIMPLE,
        pad_edge=False,
        collapse_padding=True,
        padding=(0, 1, 0, 0),
    )
    table.add_column(heads[0], no_wrap=True, overflow="ellipsis", max_width=24)
    for head in heads[1:]:
        table.add_column(escape(head), justify="right", no_wrap=True)
    for name, *cells in rows:
        table.add_row(_safe(name), *cells)
    if total:
        table.add_section()
        table.add_row(*total)
    return table


def _head(outcome: Outcome) -> str:
    """Return the short head of an outcome's column."""
    short = outcome.label.replace("collision", "collis.").replace("fingertip", "tip")
    return short.replace("_", "\n")


def funnel_table(funnel: Funnel) -> Table:
    """Return the funnel, with a row per object and a row for all objects.

    Columns that contain only zeros are left out.
    """
    shown = [o for o in _FUNNEL if funnel.outcomes[:, o].any() or o is Outcome.SUCCESS]
    removed = [r for r in Removal if r is not Removal.KEPT and funnel.removals[:, r].any()]
    heads = ["poses", "attempts", *map(_head, shown), "precision", "stable"]
    heads += [f"- {r.label}".replace("_", "\n") for r in removed] + ["samples", "distinct"]

    def row(objects: slice) -> list[str]:
        """Return the cells for a range of objects."""
        outcomes = funnel.outcomes[objects].sum(axis=0).tolist()
        cells = [funnel.candidates[objects].sum(), sum(outcomes)]
        cells += [outcomes[o] for o in shown]
        cells += [funnel.precision[objects].sum(), funnel.stable[objects].sum()]
        cells += [funnel.removals[objects, r].sum() for r in removed]
        cells += [funnel.samples[objects].sum(), funnel.distinct[objects].sum()]
        return list(map(_count, cells))

    notes = [
        "precision: successes that the fingertips alone hold; stable: precision, and the object "
        "moved by less than 5 mm and 5° in the hand",
        "distinct: samples whose palms are within 20 mm and 30° of each other count as one",
        lifted_note(funnel),
    ]
    caption = "\n".join(filter(None, notes))
    rows = ([name, *row(slice(i, i + 1))] for i, name in enumerate(funnel.names))
    total = ["all", *row(slice(None))]
    title = "From palm poses to samples"
    return make_table(title, ("object", *heads), rows, total, caption=caption)


def split_table(counts: Sequence[SplitCount], rule: str) -> Table:
    """Return the paper's Table III with an additional column of objects."""
    heads = ("split", "samples", "distinct", "objects", "classes")
    rows = ([c.split, *(_count(getattr(c, name)) for name in heads[1:])] for c in counts)
    return make_table(f"Samples by split (by {rule})", heads, rows)


def approach_line(funnel: Funnel) -> str:
    """Return how many grasps are distinct, and from where their palms approach; "" if none is."""
    distinct = int(funnel.distinct.sum())
    if not distinct:
        return ""
    found = counted(distinct, "distinct grasp")
    cells = counted(int(funnel.approach_cells.sum()), "approach cell")
    bands = zip(BANDS, funnel.elevations.sum(axis=0).tolist(), strict=True)
    shares = ", ".join(f"{low}-{high}° {number / distinct:.0%}" for (low, high), number in bands)
    return f"{found} in {cells}; above the table they come from {shares}"


def _count(number: int) -> str:
    return f"{int(number):,}"


def _safe(text: str) -> str:
    """Return a text that neither styles the table nor controls the terminal."""
    return escape(printable(text))


def make_console() -> Console:
    """Return a console for tables, in which every table fits; a terminal wraps long lines."""
    return Console(width=WIDTH)


def print_stats(out: Path) -> None:
    """Print the tables of a dataset: outcomes, how well the hand holds, samples by split."""
    validate_assembled(out)
    console, funnel = make_console(), count_funnel(out)
    console.print(funnel_table(funnel))
    console.print()
    console.print(split_table(funnel.splits, read_manifest(out).config.split.by))
    if line := approach_line(funnel):
        say(line)
    for count in count_reach(out):
        say(escape(count.explain()))
    # A file of scenes may be older than the other files.
    try:
        for among in count_clutter(out):
            say(escape(among.explain()))
    except DataError as error:
        say(escape(f"not counted: {error}"))
