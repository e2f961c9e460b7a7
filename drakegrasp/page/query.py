"""Which attempts a page shows, and in which order.

In: the parameters of an address. Out: a `Query`, and the places of the attempts that it selects.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias
from urllib.parse import urlencode

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.rejections import Decisions
from drakegrasp.dataset.schema import SPLITS, Shown
from drakegrasp.dataset.suspicion import PARTS
from drakegrasp.dataset.trial_files import NONE
from drakegrasp.errors import DataError
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.page.catalog import Snapshot

#: Least and largest value; None for no limit.
Limits: TypeAlias = tuple[float | None, float | None]
#: Features of an attempt that can be filtered and sorted by, as people read them.
QUANTITIES = {
    "suspicion": Shown("suspicion", digits=2),
    "force": Shown("largest force", "N"),
    "p_hold": Shown("p_hold: share of disturbed repeats that would be samples", digits=2),
    **{part.name: part.shown for part in PARTS},
}
#: Quantities with a range among the filters.
RANGES = ("suspicion", "penetration", "slip", "turn", "force", "normal_angle", "p_hold")
#: Orders by name: the quantities, and the order of the rows.
SORTS = (*QUANTITIES, "row")
HOLDS = ("held", "precision", "stable")
DECISIONS = ("rejected", "kept", "open")
#: Choices of the split: all samples, those of one split, what is no sample.
SPLIT_CHOICES = ("samples", *SPLITS, "none")
#: Cards on a page of the gallery.
PAGE = 24


@dataclass(frozen=True, kw_only=True)
class GalleryQuery:
    """What all galleries can be asked for; an empty text asks for anything.

    Attributes:
        object_name, class_name, outcome: Filters.
        ranges: Least and largest value of quantities, in the units that are shown.
        sort: Name of an order.
        ascending: Whether the smallest come first.
        page: Number of the gallery's page, from 1.
    """

    object_name: str = ""
    class_name: str = ""
    outcome: str = ""
    ranges: Mapping[str, Limits] = field(default_factory=dict)
    sort: str = ""
    ascending: bool = False
    page: int = 1

    @property
    def shared(self) -> dict[str, object]:
        """The values by the names of their parameters, without ranges."""
        return {
            "object": self.object_name,
            "class": self.class_name,
            "outcome": self.outcome,
            "sort": self.sort,
            "order": "up" if self.ascending else "",
            "page": self.page,
        }

    def params(self, **changes: object) -> str:
        """Return the query as part of an address, with some values changed; see `address_of`."""
        return address_of(self.shared, self.ranges, changes, {"page": 1})


@dataclass(frozen=True, kw_only=True)
class Query(GalleryQuery):
    """What is asked for.

    Attributes:
        split, hold, removal, decision: More filters.
        sort: One of SORTS.
    """

    outcome: str = "success"
    split: str = ""
    hold: str = ""
    removal: str = ""
    decision: str = ""
    sort: str = "suspicion"

    def params(self, **changes: object) -> str:
        """Return the query as part of an address, with some values changed; defaults are left out.

        Args:
            changes: Values by the names of the parameters.
        """
        names = ("split", "hold", "removal", "decision")
        own = {"outcome": self.outcome or "any", **{name: getattr(self, name) for name in names}}
        values = self.shared | own
        default = {"outcome": "success", "sort": "suspicion", "page": 1}
        return address_of(values, self.ranges, changes, default)

    @property
    def identity(self) -> str:
        """The query without its page, as text."""
        return self.params(page=1)


def parse_query(params: Mapping[str, str]) -> Query:
    """Return the query of an address.

    Raises:
        DataError: If a value is none that can be asked for.
    """
    # Texts that must be one of a few; names of objects may be any.
    choices = {
        "outcome": ("any", *(o.label for o in Outcome)),
        "split": SPLIT_CHOICES,
        "hold": HOLDS,
        "removal": tuple(r.label for r in Removal),
        "decision": DECISIONS,
        "sort": SORTS,
    }
    shared = read_shared(params, choices, RANGES)
    outcome = shared["outcome"] or "success"
    own = {name: params.get(name, "") for name in ("split", "hold", "removal", "decision")}
    changed = {
        "outcome": "" if outcome == "any" else outcome,
        "sort": shared["sort"] or "suspicion",
    }
    return Query(**(shared | own | changed))


# What the queries of all galleries share.


def address_of(
    values: Mapping[str, object],
    ranges: Mapping[str, Limits],
    changes: Mapping[str, object],
    default: Mapping[str, object],
) -> str:
    """Return a query as part of an address; empty values and defaults are left out.

    Args:
        values: By the names of the parameters.
        ranges: Least and largest value of quantities.
        changes: Values in place of others.
        default: Values that need not be said.
    """
    all_values = dict(values)
    for name, limits in ranges.items():
        for bound, value in zip(("min", "max"), limits, strict=True):
            all_values[f"{bound}_{name}"] = "" if value is None else f"{value:g}"
    all_values |= changes
    return urlencode({k: v for k, v in all_values.items() if v != "" and v != default.get(k)})


def read_shared(
    params: Mapping[str, str], choices: Mapping[str, Sequence[str]], ranges: Sequence[str]
) -> dict[str, Any]:
    """Return what every gallery can be asked for, by the names of `GalleryQuery`.

    Args:
        params: Of the address.
        choices: By the names of parameters what they can be.
        ranges: Quantities that have a range.

    Raises:
        DataError: If a value is none that can be asked for.
    """
    refuse_other_choices(params, {**choices, "order": ("up", "down")})
    return {
        "object_name": params.get("object", ""),
        "class_name": params.get("class", ""),
        "outcome": params.get("outcome", ""),
        "ranges": read_ranges(params, ranges),
        "sort": params.get("sort", ""),
        "ascending": params.get("order", "") == "up",
        "page": read_page(params),
    }


def refuse_other_choices(params: Mapping[str, str], choices: Mapping[str, Sequence[str]]) -> None:
    """Refuse a value of an address that is none of those that can be asked for.

    Raises:
        DataError: If there is one.
    """
    for name, allowed in choices.items():
        if params.get(name, "") not in ("", *allowed):
            raise DataError(f"{name} must be one of {', '.join(allowed)}, got {params[name]!r}")


def read_ranges(params: Mapping[str, str], names: Sequence[str]) -> dict[str, Limits]:
    """Return the least and largest values of quantities that an address asks for.

    Raises:
        DataError: If one of them is no number.
    """
    ranges = {name: (_number(params, f"min_{name}"), _number(params, f"max_{name}"))
              for name in names}  # fmt: skip
    return {name: limits for name, limits in ranges.items() if limits != (None, None)}


def read_page(params: Mapping[str, str]) -> int:
    """Return the number of the gallery's page, from 1.

    Raises:
        DataError: If it is no number.
    """
    page = params.get("page", "") or "1"
    if not (page.isascii() and page.isdecimal() and len(page) < 9):
        raise DataError(f"page must be a number, got {page!r}")
    return max(1, int(page))


def _number(params: Mapping[str, str], name: str) -> float | None:
    text = params.get(name, "").strip()
    if not text:
        return None
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise DataError(f"{name} must be a number, got {text!r}")
    return value


def in_ranges(
    ranges: Mapping[str, Limits],
    quantities: Mapping[str, Shown],
    feature: Callable[[str], npt.NDArray[Any]],
    count: int,
) -> npt.NDArray[np.bool_]:
    """Return which of `count` things are in all ranges; one without a value is in none.

    Args:
        ranges: Least and largest value of quantities, in the units that are shown.
        quantities: By name.
        feature: Returns the values (n,) of a quantity in SI.
        count: n.
    """
    chosen = np.ones(count, dtype=bool)
    for name, (least, largest) in ranges.items():
        values = feature(name) * quantities[name].factor
        if least is not None:
            chosen &= values >= least
        if largest is not None:
            chosen &= values <= largest
    return chosen


def of_objects(snapshot: Snapshot, object_name: str, class_name: str) -> npt.NDArray[np.bool_]:
    """Return which objects (m,) have a name and a class; an empty text is any."""
    named = zip(snapshot.names, snapshot.classes, strict=True)
    wanted = [object_name in ("", name) and class_name in ("", of) for name, of in named]
    return np.array(wanted, dtype=bool)


# Attempts


def select(snapshot: Snapshot, query: Query, decisions: Decisions) -> npt.NDArray[np.int32]:
    """Return the places of the attempts that a query asks for, in its order.

    Attempts without a value of what is sorted by come last; ties are in the order of the rows.
    """
    chosen = _matches(snapshot, query)
    if query.decision:
        chosen &= _decided(snapshot, query.decision, decisions)
    places = np.flatnonzero(chosen).astype(np.int32)
    if query.sort == "row":
        return places if query.ascending else places[::-1]
    # Most attempts have no values: they need no sorting.
    values = snapshot.table.feature(query.sort)[places]
    there = ~np.isnan(values)
    few = values[there] if query.ascending else -values[there]
    ordered = places[there][np.argsort(few, kind="stable")]
    return np.concatenate([ordered, places[~there]])


def _matches(snapshot: Snapshot, query: Query) -> npt.NDArray[np.bool_]:
    """Return which attempts (n,) the filters let through, but for that of decisions."""
    # Names first: a class is all of its objects.
    table = snapshot.table
    wanted = of_objects(snapshot, query.object_name, query.class_name)
    chosen = wanted[table.object] if len(wanted) else np.zeros(len(table), dtype=bool)

    # Verdicts.
    if query.outcome:
        chosen &= table.outcome == Outcome[query.outcome.upper()]
    if query.split == "samples":
        chosen &= table.split != NONE
    elif query.split:
        number = NONE if query.split == "none" else SPLITS.index(query.split)
        chosen &= table.split == number
    if query.hold:
        held = table.outcome == Outcome.SUCCESS
        chosen &= {"held": held, "precision": table.precision, "stable": table.stable}[query.hold]
    if query.removal:
        chosen &= table.removal == Removal[query.removal.upper()]

    return chosen & in_ranges(query.ranges, QUANTITIES, table.feature, len(table))


def count_decisions(snapshot: Snapshot, decisions: Decisions) -> dict[str, int]:
    """Return how many attempts are rejected, and kept, and how many rejected are samples now."""
    samples = 0
    if decisions.rejected:
        rejected = _decided(snapshot, "rejected", decisions)
        samples = int(np.count_nonzero(rejected & (snapshot.table.split != NONE)))
    return {
        "rejected": len(decisions.rejected),
        "kept": len(decisions.kept),
        "samples": samples,
    }


def _decided(snapshot: Snapshot, decision: str, decisions: Decisions) -> npt.NDArray[np.bool_]:
    """Return which attempts (n,) are rejected, kept, or still open; only successes are decided."""
    keys = {"rejected": decisions.rejected, "kept": decisions.kept}.get(
        decision, decisions.rejected | decisions.kept
    )
    numbers = {name: i for i, name in enumerate(snapshot.names)}
    wanted = [
        (numbers[key.object], key.candidate, key.standoff_index, key.child)
        for key in keys
        if key.object in numbers
    ]

    # Compare identities as single numbers: there may be thousands of decisions.
    table = snapshot.table
    (hits,) = np.nonzero(table.outcome == Outcome.SUCCESS)
    columns = (table.object, table.candidate, table.standoff_index, table.child)
    own = np.stack([column[hits] for column in columns], axis=1).astype(np.int64)
    both = np.concatenate([np.array(wanted, dtype=np.int64).reshape(-1, 4), own])
    _, codes = np.unique(both, axis=0, return_inverse=True)
    decided = np.isin(codes[len(wanted) :], codes[: len(wanted)])
    found = np.zeros(len(table), dtype=bool)
    found[hits[~decided if decision == "open" else decided]] = True
    return found
