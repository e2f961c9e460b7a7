"""The fields of the forms of filters and order, as values for the templates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from drakegrasp.dataset.schema import Shown
from drakegrasp.dataset.trial_files import NONE
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.page.catalog import Snapshot
from drakegrasp.page.query import (
    DECISIONS,
    HOLDS,
    QUANTITIES,
    RANGES,
    SORTS,
    SPLIT_CHOICES,
    Limits,
    Query,
)

#: Choices of the split that say more than their values.
SPLIT_NAMES = {"samples": "any sample", "none": "no sample"}
#: Value and text of a choice, and whether it is chosen.
Option: TypeAlias = tuple[str, str, bool]
#: Name, title and options of a field.
Field: TypeAlias = tuple[str, str, list[Option]]


def attempt_form(snapshot: Snapshot, query: Query, *, failures: bool) -> dict[str, Any]:
    """Return the fields of the form of the gallery of attempts.

    Args:
        snapshot: State of the files.
        query: What is asked for.
        failures: Whether failed attempts can be asked for.
    """
    # Outcomes and reasons that occur.
    table = snapshot.table
    outcomes = [Outcome(int(n)).label for n in np.unique(table.outcome)]
    removals = [Removal(int(n)) for n in np.unique(table.removal) if n != NONE]
    reasons = [removal.label for removal in removals if removal is not Removal.KEPT]

    selects = [
        *object_fields(snapshot, query.object_name, query.class_name),
        ("outcome", "outcome", options(outcomes, query.outcome, any_="any")),
        ("split", "split", options(SPLIT_CHOICES, query.split, SPLIT_NAMES)),
        ("hold", "how it holds", options(HOLDS, query.hold)),
        ("removal", "removed by", options(reasons, query.removal)),
        ("decision", "decision", options(DECISIONS, query.decision)),
    ]

    titles = {name: q.title for name, q in QUANTITIES.items()} | {"row": "row of the dataset"}
    return {
        "selects": [field for field in selects if failures or field[0] != "outcome"],
        "ranges": range_fields(RANGES, QUANTITIES, query.ranges),
        "sorts": [(name, titles[name], name == query.sort) for name in SORTS],
        "ascending": query.ascending,
        "outcome": Query().outcome,
    }


def object_fields(snapshot: Snapshot, object_name: str, class_name: str) -> list[Field]:
    """Return the fields that choose a class and an object, by their names as they are."""
    classes = sorted(set(snapshot.classes))
    return [
        ("class", "class", options(classes, class_name, {c: c for c in classes})),
        ("object", "object", options(snapshot.names, object_name, {n: n for n in snapshot.names})),
    ]


def options(
    values: Sequence[str],
    chosen: str,
    texts: Mapping[str, str] | None = None,
    *,
    any_: str = "",
) -> list[Option]:
    """Return the options of a choice, the first of which is any.

    Args:
        values: That can be chosen.
        chosen: The chosen one; empty for any.
        texts: Of some values; the others are their own, with blanks.
        any_: Value of any.
    """
    known = texts or {}
    named = [(v, known.get(v, v.replace("_", " ")), v == chosen) for v in values]
    return [(any_, "any", not chosen), *named]


def range_fields(
    names: Sequence[str], quantities: Mapping[str, Shown], ranges: Mapping[str, Limits]
) -> list[dict[str, str]]:
    """Return the fields of the least and largest values of quantities."""

    def text(value: float | None) -> str:
        return "" if value is None else f"{value:g}"

    return [
        {
            "name": name,
            "title": quantities[name].title,
            "unit": quantities[name].unit,
            "min": text(ranges.get(name, (None, None))[0]),
            "max": text(ranges.get(name, (None, None))[1]),
        }
        for name in names
    ]
