"""Counts and measurements as tables for a terminal."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from drakegrasp.cli.console import say
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.paths import BENCHMARK_FILE, BUILTIN_FOLDER
from drakegrasp.dataset.statistics import (
    NO_NAME,
    Funnel,
    PreshapeCount,
    SplitCount,
    Unfinished,
    count_funnel,
    count_splits,
    count_unfinished,
    held_note,
    objects_without_samples,
    preshapes_of,
    split_shortfall,
)
from drakegrasp.distinct import BANDS
from drakegrasp.errors import counted, printable
from drakegrasp.filters import Removal
from drakegrasp.objects.audit import AuditRow
from drakegrasp.outcomes import GROUPS, Outcome

if TYPE_CHECKING:
    from drakegrasp.verification.result import Verification

#: Outcomes in the order of the funnel. Outcomes that only verdicts have are not among them.
_FUNNEL = [o for group in GROUPS for o in Outcome if o.group == group]
#: Maximum number of objects without samples whose reasons are printed.
BARREN = 10
#: Smallest width of a terminal for which the audit has all of its columns [characters].
ROOMY = 110
#: Maximum width of the notes of an audit [characters].
NOTES = 60
#: Width of the console if standard output is not a terminal [characters]: every table fits.
WIDTH = 1000


def make_table(
    title: str,
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    *totals: Sequence[Sequence[str]],
    caption: str = "",
) -> Table:
    """Return a table with a column of names and columns of numbers.

    Args:
        title: Title of the table.
        heads: Heads of the columns.
        rows: Cells of each row. Names are shown literally: they can neither style the table nor
            control the terminal.
        totals: Groups of further rows, each group below a line.
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
    for group in (rows, *totals):
        for name, *cells in group:
            table.add_row(_safe(name), *cells)
        table.add_section()
    return table


def _table_of_objects(
    title: str,
    heads: Sequence[str],
    funnel: Funnel,
    row: Callable[[slice], list[str]],
    caption: str = "",
) -> Table:
    """Return a table with a row per object and a row for all objects.

    `row` returns the cells for a range of objects.
    """
    rows = ([name, *row(slice(i, i + 1))] for i, name in enumerate(funnel.names))
    total = ["all", *row(slice(None))]
    return make_table(title, ("object", *heads), rows, [total], caption=caption)


def _head(outcome: Outcome) -> str:
    """Return the short head of an outcome's column."""
    short = outcome.label.replace("collision", "collis.").replace("fingertip", "tip")
    return short.replace("_", "\n")


def funnel_table(funnel: Funnel, *, compact: bool = False) -> Table:
    """Return the funnel, with a row per object and a row for all objects.

    Args:
        funnel: The counts.
        compact: Whether to group outcomes; if not, columns that contain only zeros are left out.
    """
    shown = [o for o in _FUNNEL if funnel.outcomes[:, o].any() or o is Outcome.SUCCESS]
    groups = {_head(o): [o] for o in shown}
    removed = [r for r in Removal if r is not Removal.KEPT and funnel.removals[:, r].any()]
    if compact:
        # Space is scarce, and few datasets have lifts that were ended early.
        there, removed = funnel.outcomes.sum(axis=0), []
        groups = {name: [o for o in _FUNNEL if o.group == name] for name in GROUPS}
        groups = {h: g for h, g in groups.items() if h != "moved" or there[g].any()}
    heads = ["poses", "attempts", *groups]
    heads += [f"- {r.label}".replace("_", "\n") for r in removed] + ["samples", "distinct"]

    def row(objects: slice) -> list[str]:
        outcomes = funnel.outcomes[objects].sum(axis=0).tolist()
        cells = [funnel.candidates[objects].sum(), sum(outcomes)]
        cells += [sum(outcomes[o] for o in group) for group in groups.values()]
        cells += [funnel.removals[objects, r].sum() for r in removed]
        cells += [funnel.samples[objects].sum(), funnel.distinct[objects].sum()]
        return list(map(_count, cells))

    caption = "distinct: samples whose palms are within 20 mm and 30° of each other count as one"
    return _table_of_objects("From palm poses to samples", heads, funnel, row, caption)


def hold_table(funnel: Funnel) -> Table:
    """Return how well the successes hold, with a row per object and a row for all objects."""
    notes = [
        "held: the outcome success; precision: held with the fingertips alone; stable: precision, "
        "and the object moved by less than 5 mm and 5° in the hand"
    ]
    held, stable = funnel.outcomes[:, Outcome.SUCCESS], funnel.stable
    if note := held_note(funnel):
        notes.append(note)

    def row(objects: slice) -> list[str]:
        counts = (funnel.outcomes.sum(axis=1), held, funnel.precision, stable)
        samples = _count(funnel.samples[objects].sum())
        all_held, all_stable = int(held[objects].sum()), int(stable[objects].sum())
        share = f"{all_stable / all_held:.0%}" if all_held else "-"
        return [*(_count(count[objects].sum()) for count in counts), share, samples]

    heads = ["attempts", "held", "precision", "stable", "stable\nof held", "samples"]
    return _table_of_objects("How well the hand holds", heads, funnel, row, "\n".join(notes))


def preshape_table(counts: Sequence[PreshapeCount]) -> Table:
    """Return how the attempts of each preshape ended, with one row per preshape."""
    heads = ("preshape", "attempts", "held", "stable", "samples")
    rows = ([c.preshape, *(_count(getattr(c, name)) for name in heads[1:])] for c in counts)
    nameless = any(count.preshape == NO_NAME for count in counts)
    caption = f"{NO_NAME}: postures for which all fingers close" if nameless else ""
    return make_table("Preshapes", heads, rows, caption=caption)


def split_table(counts: Sequence[SplitCount]) -> Table:
    """Return the paper's Table III with an additional column of objects."""
    heads = ("split", "samples", "distinct", "objects", "classes")
    rows = ([c.split, *(_count(getattr(c, name)) for name in heads[1:])] for c in counts)
    return make_table("Samples by split", heads, rows)


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


def split_line(rule: str, funnel: Funnel, counts: Sequence[SplitCount]) -> str:
    """Return a line with the rule of the split and the number of tested objects."""
    objects = {count.split: count.objects for count in counts}
    total = np.count_nonzero(funnel.samples)
    # In a split by class, the objects for validation are those for training.
    valid = f", {objects['valid']:,} valid" if rule == "object" else ""
    some = counted(int(total), "object")
    return f"split by {rule}: {some} with samples, {objects['test']:,} of them test{valid}"


def barren_lines(funnel: Funnel, config: Config) -> list[str]:
    """Return why objects have no sample: a line for each of the first, and one for the others."""
    why = [
        f"no sample of {_safe(name)}: {found.reason}. What may help: {found.advice}"
        for name, found in objects_without_samples(funnel, config).items()
    ]
    left = len(why) - BARREN
    return why[:BARREN] + ([f"no sample of {counted(left, 'other object')}"] if left > 0 else [])


def unfinished_line(unfinished: Unfinished) -> str:
    """Return a line on the progress of a build that is running or was stopped."""
    if unfinished.total is None:
        units = counted(unfinished.done, "work unit")
        verb = "is" if unfinished.done == 1 else "are"
        return f"not finished: {units} {verb} done; samples are chosen at the end"
    if not unfinished.total:
        return "not finished: its objects are not prepared yet"
    if unfinished.done == unfinished.total:
        return (
            "all work units are done, but the files are missing or of another state: "
            "`drakegrasp assemble` writes them"
        )
    return (
        f"not finished: {unfinished.done:,} of {unfinished.total:,} work units are done; "
        "samples are chosen at the end"
    )


#: Columns of the audit: head, cell, and whether a narrow terminal also shows it.
_AUDIT: tuple[tuple[str, Callable[[AuditRow], str], bool], ...] = (
    ("faces", lambda row: _number(row.faces, ","), True),
    ("size [mm]", lambda row: "x".join(f"{1e3 * e:.0f}" for e in row.extents or ()) or "-", True),
    ("bodies", lambda row: _number(row.bodies, ","), False),
    ("water-\ntight", lambda row: {True: "yes", False: "no", None: "-"}[row.watertight], False),
    ("contact\n[mm]", lambda row: _number(row.collision_error, ".1f", 1e3), False),
)


def audit_table(rows: Sequence[AuditRow], *, compact: bool = False) -> Table:
    """Return the findings of an audit, with one row per mesh.

    Args:
        rows: The findings.
        compact: Whether to leave out columns whose unusual values also appear in warnings.
    """
    # A narrow terminal has few columns; unusual values are reported in words in any case.
    columns = [column for column in _AUDIT if column[2] or not compact]
    heads = ("object", "status", *(head for head, _, _ in columns))
    table = make_table("Meshes", heads, ())
    table.columns[0].max_width, table.columns[1].justify = 24 if compact else 40, "left"
    table.add_column("notes, and what may be wrong (!)", overflow="fold", max_width=NOTES)
    colours = {"fit": "green", "repaired": "yellow", "refused": "red"}
    for row in rows:
        status = f"[{colours[row.status]}]{row.status}[/]"
        words = [*row.notes, *(f"! {text}" for text in row.warnings)]
        cells = (cell(row) for _, cell, _ in columns)
        table.add_row(_safe(row.name), status, *cells, "\n".join(map(_safe, words)))
    return table


def _count(number: int) -> str:
    return f"{int(number):,}"


def _number(value: float | None, form: str, unit: float = 1) -> str:
    """Return a number times a unit as text, or a dash if it is unknown."""
    return "-" if value is None or np.isnan(value) else f"{unit * value:{form}}"


def _safe(text: str) -> str:
    """Return a text that neither styles the table nor controls the terminal."""
    return escape(printable(text))


def audit_line(rows: Sequence[AuditRow]) -> str:
    """Return how many meshes are fit, repaired and refused, and how many have a warning."""
    counts = Counter(row.status for row in rows)
    told = ", ".join(f"{counts[status]} {status}" for status in ("fit", "repaired", "refused"))
    warned = sum(bool(row.warnings) for row in rows)
    return f"{counted(len(rows), 'mesh', 'meshes')}: {told}; {warned} with a warning (!)"


def verdict_table(results: Sequence[Verification]) -> Table:
    """Return the outcomes of grasps, with fractions of the grasps that could be judged."""
    counts = Counter(result.outcome for result in results)
    judged = sum(n for outcome, n in counts.items() if not outcome.inconclusive)
    others = sorted(counts.keys() - {Outcome.SUCCESS}, key=lambda o: (-counts[o], o))

    def row(label: str, count: int, known: bool = True) -> list[str]:
        return [label, _count(count), f"{count / judged:.1%}" if known and judged else "-"]

    # The outcomes of the first trials; then stricter and weaker criteria than held.
    ended = [row("held", counts[Outcome.SUCCESS])]
    ended += [row(o.label, counts[o], not o.inconclusive) for o in others]
    more = [row(words, sum(getattr(r, n) for r in results)) for n, words in _VERDICTS.items()]
    total = ["all", _count(len(results)), ""]
    table = make_table("Verdicts", ("outcome", "grasps", "share"), ended, [total], more)
    table.columns[0].max_width = None  # our own labels, which are whole
    return table


#: Labels in a table for the attributes of a verdict.
_VERDICTS = {
    "success": "success: contacts as requested",
    "precision": "precision",
    "stable": "stable",
    "sample": "sample (images not judged)",
    "held_any": "held by any of the wrist poses",
}


def score_table(card: Mapping[str, Any], seconds: Mapping[str, float]) -> Table:
    """Return the sets of a score card, one row per set, with seconds per verdict of the lift."""
    names = [name for name in card["measures"] if name != "headline"]
    protocol = card["settings"].get("protocol")
    counts = "Sample" if protocol is None else f"By {protocol['protocol']}"
    objects = counted(card["objects"], "object")
    title = f"{counts}, success@1, first wrist pose, mean over {objects} [%]"
    drawn = card["intervals"]["drawn"]
    timed = ["s per\nverdict"] * (protocol is None)

    def row(name: str, values: Mapping[str, Mapping[str, float]]) -> list[str]:
        value, low, high = (100 * values["headline"][key] for key in ("value", "low", "high"))
        cells = [name, f"{value:.1f}", f"{low:.0f} to {high:.0f}" if low < high else "-"]
        cells += [f"{100 * values[measure]['value']:.0f}" for measure in names]
        return cells + [f"{seconds[name]:.2f}" for _ in timed]

    heads = ("set", "headline", "95 %\ninterval", *names, *timed)
    rows = (row(name, each["measures"]) for name, each in card["sets"].items())
    return make_table(title, heads, rows, caption=f"intervals: bootstrap over {drawn}")


def make_console(*, stderr: bool = False) -> Console:
    """Return a console for tables; if the output is not a terminal, every table fits."""
    console = Console(stderr=stderr)
    return console if console.is_terminal else Console(width=WIDTH, stderr=stderr)


def print_table(table: Table) -> None:
    """Print a table to standard output."""
    make_console().print(table)


def print_stats(out: Path) -> None:
    """Print the tables of a dataset: outcomes, how well the hand holds, samples by split."""
    console, unfinished = make_console(), count_unfinished(out)
    funnel = count_funnel(out) if unfinished is None else unfinished.funnel
    table = funnel_table(funnel)
    # Rich would truncate numbers in a narrow terminal; the compact table has fewer columns.
    natural = Measurement.get(console, console.options.update(max_width=WIDTH), table).maximum
    if natural > console.width:
        table = funnel_table(funnel, compact=True)
    console.print(table)
    console.print(hold_table(funnel))
    manifest = read_manifest(out)
    config, rule = manifest.config, manifest.config.split.by
    if preshapes := preshapes_of(funnel, config):
        console.print(preshape_table(preshapes))
    console.print()
    if unfinished is None:
        splits = count_splits(out)
        console.print(split_table(splits))
        say(split_line(rule, funnel, splits))
        if line := approach_line(funnel):
            say(line)
        for line in barren_lines(funnel, config):
            say(line)
        of_benchmark = (out / BUILTIN_FOLDER / BENCHMARK_FILE).is_file()
        for line in [] if of_benchmark else split_shortfall(splits, rule, config.split):
            say(line)
    else:
        say(f"{out}: {unfinished_line(unfinished)}")
