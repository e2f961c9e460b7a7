"""What is counted, as tables for a terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from rich.box import SIMPLE
from rich.markup import escape
from rich.table import Table

from drakegrasp.audit import AuditRow
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome
from drakegrasp.stats import Funnel, SplitCount, Unfinished

#: Short heads of the outcomes, in the order of the funnel.
_OUTCOME_HEADS = {
    Outcome.RAY_MISS: "ray\nmiss",
    Outcome.BELOW_TABLE: "below\ntable",
    Outcome.START_COLLISION: "start\ncollis.",
    Outcome.SCREENED: "screened",
    Outcome.MISSING_FINGERTIP: "missing\ntip",
    Outcome.HAND_CONTACT: "hand\ncontact",
    Outcome.TABLE_CONTACT: "table\ncontact",
    Outcome.DROPPED: "dropped",
    Outcome.SLIPPED: "slipped",
    Outcome.SOLVER_ERROR: "solver\nerror",
    Outcome.TIMEOUT: "timeout",
    Outcome.CRASHED: "crashed",
    Outcome.SUCCESS: "success",
}


#: What the outcomes amount to, for terminals that are too narrow for all of them.
_COMPACT_HEADS = {
    "no ray": (Outcome.RAY_MISS, Outcome.BELOW_TABLE),
    "collis.": (Outcome.START_COLLISION, Outcome.SCREENED),
    "no grip": (Outcome.MISSING_FINGERTIP, Outcome.HAND_CONTACT, Outcome.TABLE_CONTACT),
    "lost": (Outcome.DROPPED, Outcome.SLIPPED),
    "errors": (Outcome.SOLVER_ERROR, Outcome.TIMEOUT, Outcome.CRASHED),
    "success": (Outcome.SUCCESS,),
}


def funnel_table(funnel: Funnel, *, compact: bool = False) -> Table:
    """Return the funnel, a row per object and one of all.

    Args:
        funnel: The counts.
        compact: Whether to put outcomes together; else columns that are all zero are left out.
    """
    shown = [o for o in _OUTCOME_HEADS if funnel.outcomes[:, o].any() or o is Outcome.SUCCESS]
    groups = _COMPACT_HEADS if compact else {_OUTCOME_HEADS[o]: (o,) for o in shown}
    removed = [r for r in Removal if r is not Removal.KEPT and funnel.removals[:, r].any()]
    heads = ["poses", "attempts", *groups]
    heads += [] if compact else [f"- {r.label}".replace("_", "\n") for r in removed]
    table = _table("From palm poses to samples")
    table.add_column("object", no_wrap=True, overflow="ellipsis", max_width=24)
    for head in [*heads, "samples"]:
        table.add_column(head, justify="right", no_wrap=True)

    def row(outcomes: Sequence[int], removals: Sequence[int], poses: int) -> list[str]:
        cells = [poses, sum(outcomes), *(sum(outcomes[o] for o in g) for g in groups.values())]
        cells += [] if compact else [removals[r] for r in removed]
        return [f"{int(cell):,}" for cell in (*cells, removals[Removal.KEPT])]

    for i, name in enumerate(funnel.names):
        counts = (funnel.outcomes[i], funnel.removals[i], int(funnel.candidates[i]))
        table.add_row(escape(name), *row(*counts))
    table.add_section()
    totals = (funnel.outcomes.sum(0), funnel.removals.sum(0), int(funnel.candidates.sum()))
    table.add_row("all", *row(*totals))
    return table


def split_table(counts: Sequence[SplitCount]) -> Table:
    """Return the paper's Table III with a column of objects."""
    table = _table("Samples by split")
    table.add_column("split")
    for head in ("samples", "objects", "classes"):
        table.add_column(head, justify="right")
    for count in counts:
        table.add_row(count.split, f"{count.samples:,}", f"{count.objects:,}", f"{count.classes:,}")
    return table


def unfinished_line(unfinished: Unfinished) -> str:
    """Return how far a build is that runs or was stopped."""
    if not unfinished.total:
        return "not finished: its objects are not prepared yet"
    return (
        f"not finished: {unfinished.done:,} of {unfinished.total:,} work units are done; "
        "samples are chosen at the end"
    )


def audit_table(rows: Sequence[AuditRow]) -> Table:
    """Return what would become of each mesh."""
    table = _table("Meshes")
    table.add_column("object", no_wrap=True)
    table.add_column("class", no_wrap=True)
    table.add_column("status", no_wrap=True)
    table.add_column("faces", justify="right")
    table.add_column(escape("size [mm]"), justify="right", no_wrap=True)
    table.add_column("notes", overflow="fold")
    colours = {"fit": "green", "mended": "yellow", "refused": "red"}
    for row in rows:
        size = "-" if row.extents is None else "x".join(f"{1e3 * e:.0f}" for e in row.extents)
        table.add_row(
            escape(row.name),
            escape(row.class_name),
            f"[{colours[row.status]}]{row.status}[/]",
            "-" if row.faces is None else f"{row.faces:,}",
            size,
            escape("; ".join(row.notes)),
        )
    return table


def verdict_table(outcomes: Sequence[Outcome]) -> Table:
    """Return how many grasps had each outcome, and which share of those that were judged."""
    counts = Counter(outcomes)
    judged = sum(n for outcome, n in counts.items() if not outcome.says_nothing)
    table = _table("Verdicts")
    table.add_column("outcome", no_wrap=True)
    for head in ("grasps", "share"):
        table.add_column(head, justify="right", no_wrap=True)
    others = sorted(counts.keys() - {Outcome.SUCCESS}, key=lambda o: (-counts[o], o))
    for outcome in (Outcome.SUCCESS, *others):
        share = "-" if outcome.says_nothing or not judged else f"{counts[outcome] / judged:.1%}"
        table.add_row(outcome.label, f"{counts[outcome]:,}", share)
    table.add_section()
    table.add_row("all", f"{len(outcomes):,}", "")
    return table


def _table(title: str) -> Table:
    return Table(
        title=title,
        title_justify="left",
        box=SIMPLE,
        pad_edge=False,
        collapse_padding=True,
        padding=(0, 1, 0, 0),
    )
