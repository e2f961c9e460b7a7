"""A gallery shows a table of rows, and a page shows one row of the table.

Input: the query of an address. Output: HTML. Each table is a `Gallery`, which defines how it is
filtered and sorted, and the contents of its cards and pages. Jinja escapes every value; no page
contains its own script or style, so the strictest content security policy can be used.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeAlias
from urllib.parse import urlencode

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from drakegrasp.dataset.schema import SPLITS, Shown
from drakegrasp.errors import DataError, counted, printable
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import Snapshot
from drakegrasp.page.looks import HandView
from drakegrasp.pictures.style import FINGER_COLOURS, PREDICTED, REACHED, TRUE
from drakegrasp.table import AnyArray, Table

Places: TypeAlias = npt.NDArray[np.int32]
#: Smallest and largest value; None for no limit.
Limits: TypeAlias = tuple[float | None, float | None]
#: Number of cards on a page of a gallery.
PAGE = 24
#: Codes of the numbers in columns, by the names of the columns.
CODES: Mapping[str, Mapping[str, int]] = {
    "outcome": {outcome.label: outcome.value for outcome in Outcome},
    "split": {split: number for number, split in enumerate(SPLITS)},
    "removal": {removal.label: removal.value for removal in Removal},
}


def _shown(value: Any) -> Any:
    """Return a template's value for display: strings without control characters."""
    return printable(value) if type(value) is str else value


TEMPLATES = Environment(
    loader=PackageLoader("drakegrasp.page"),
    autoescape=select_autoescape(default=True, default_for_string=True),
    undefined=StrictUndefined,
    finalize=_shown,
    trim_blocks=True,
    lstrip_blocks=True,
)
#: Colours of fingers, and of kinds of contacts in the order in which they are drawn.
TEMPLATES.globals["colours"] = FINGER_COLOURS
TEMPLATES.globals["kinds"] = {"true": TRUE, "requested": PREDICTED, "reached": REACHED}
TEMPLATES.globals["counted"] = counted


@dataclass(frozen=True, kw_only=True)
class Site:
    """Location of the pages: at a server, or as files that open without a server.

    Attributes:
        predicted, scened: Whether there are pages of predictions, and pages of scenes.
        up: For files, the path from the page to the common folder: empty, or "../"; None for a
            server.
        grasps: For files, the addresses of the grasps that have a page.
        asked: The addresses that pages have requested.
    """

    predicted: bool = False
    scened: bool = False
    up: str | None = None
    grasps: frozenset[str] = frozenset()
    asked: set[str] = field(default_factory=set)

    @property
    def static(self) -> bool:
        """Whether the pages are files, without a server."""
        return self.up is not None

    def at(self, address: str) -> str:
        """Return where a page finds an address of the server; empty if there is no such file."""
        path = address.partition("?")[0]
        if self.up is None or not path:
            return address
        if path.startswith("/grasp/") and path not in self.grasps:
            return ""
        self.asked.add(path)
        return self.up + file_of(path)


def file_of(path: str) -> str:
    """Return the file of an address; the query of the address has no effect without a server.

    A mesh becomes a script that contains it, since a page opened as a file may not read files.
    """
    name = path.strip("/") or "index"
    if name.endswith(".json"):
        return name.removesuffix("json") + "js"
    return name if "." in name else f"{name}.html"


def render(name: str, site: Site, **values: Any) -> str:
    """Return the page of a template."""
    return TEMPLATES.get_template(name).render(site=site, **values)


@dataclass(frozen=True, kw_only=True)
class Query:
    """Query of a gallery.

    Attributes:
        values: Values by the names of parameters; an empty text means any value.
        ranges: Smallest and largest value of quantities, in the units that are shown.
        default: Default values, which an address need not contain.
    """

    values: Mapping[str, str]
    ranges: Mapping[str, Limits]
    default: Mapping[str, str]

    def __getitem__(self, name: str) -> str:
        """Return the chosen value of a parameter; empty for any value."""
        value = self.values.get(name, "")
        return "" if value == "any" and name in self.default else value

    @property
    def ascending(self) -> bool:
        """Whether the smallest values come first."""
        return self["order"] == "up"

    def params(self, **changes: object) -> str:
        """Return the query as part of an address, with some values changed and without defaults.

        Args:
            changes: New values by the names of the parameters.
        """
        bounds = {
            f"{bound}_{name}": f"{value:g}"
            for name, limits in self.ranges.items()
            for bound, value in zip(("min", "max"), limits, strict=True)
            if value is not None
        }
        values = {name: str(v) for name, v in {**self.values, **bounds, **changes}.items()}
        return urlencode({n: v for n, v in values.items() if v not in ("", self.default.get(n))})


class Gallery(ABC):
    """A table whose rows have cards and pages.

    Attributes:
        HOME, ROW: Address of the gallery, and folder of the addresses of its rows; the templates
            are `gallery_ROW.html` and `ROW.html`.
        NOUN: Name of a row.
        CHOICES: By the names of parameters, the values that can be chosen, besides class and
            object.
        SELECTS: Titles of the fields of the form, in order.
        QUANTITIES: Numbers for filtering and sorting, with their display.
        RANGES: Names of the quantities with a range among the filters.
        SORTS: Orders with their titles; the first is the default.
        OUTCOME: Outcome that is selected by default.
        snapshot: State of the dataset.
        table: The rows: `object` (n,), numbers of their objects; columns of CODES; a column of bool
            for each other choice; QUANTITIES in SI; and further columns for sorting.
    """

    HOME: ClassVar[str]
    ROW: ClassVar[str]
    NOUN: ClassVar[str]
    CHOICES: ClassVar[Mapping[str, Sequence[str]]]
    SELECTS: ClassVar[Mapping[str, str]]
    QUANTITIES: ClassVar[Mapping[str, Shown]] = {}
    RANGES: ClassVar[Sequence[str]] = ()
    SORTS: ClassVar[Mapping[str, str]]
    OUTCOME: ClassVar[str] = ""
    snapshot: Snapshot
    table: Table

    @abstractmethod
    def label(self, i: int) -> str:
        """Return the name of a row in addresses."""

    @abstractmethod
    def find(self, label: str) -> int | None:
        """Return the row with a label, or None if there is none."""

    @abstractmethod
    def summary(self, query: Query, chosen: Places) -> dict[str, Any]:
        """Return the content of the gallery besides its cards."""

    @abstractmethod
    def cards(self, shown: Places) -> list[dict[str, Any]]:
        """Return the content of the cards of rows."""

    @abstractmethod
    def row(self, i: int, hand: HandView) -> dict[str, Any]:
        """Return the content of a row's page.

        Raises:
            DataError: If a file was replaced in the meantime.
        """

    # Methods that a table may override.

    def column(self, name: str) -> AnyArray:
        """Return a column (n,), or the order of the rows if the table has no such column."""
        return self.table[name] if name in self.table else np.arange(self.table.count)

    def matches(self, name: str, value: str) -> npt.NDArray[np.bool_]:
        """Return which rows (n,) have a value of a choice."""
        if name in CODES:
            return np.asarray(self.table[name] == CODES[name][value])
        return self.table[value] if value in self.table else np.zeros(self.table.count, dtype=bool)

    def options(self, name: str) -> Mapping[str, str]:
        """Return the options of a choice in the form, with their texts: values that occur."""
        there = set(self.table)
        if name in CODES:
            used = np.unique(self.table[name])
            there = {label for label, code in CODES[name].items() if code in used}
        return {v: v.replace("_", " ") for v in self.CHOICES[name] if v in there}

    def identity(self, i: int) -> dict[str, Any]:
        """Return how people name a row: by its object's name and class."""
        number = self.table.object[i]
        return {"title": self.snapshot.names[number], "class_name": self.snapshot.classes[number]}

    # What all tables share.

    @classmethod
    def query(cls, params: Mapping[str, str] | None = None) -> Query:
        """Return the query of an address.

        Raises:
            DataError: If a value is not valid.
        """
        # Texts that must be one of a few values; names of objects may be any text.
        params = params or {}
        for name, allowed in {**cls.CHOICES, "sort": cls.SORTS, "order": ("up", "down")}.items():
            if params.get(name, "") not in ("", *allowed):
                raise DataError(f"{name} must be one of {', '.join(allowed)}, got {params[name]!r}")
        page = params.get("page", "") or "1"
        if not (page.isascii() and page.isdecimal() and len(page) < 9):
            raise DataError(f"page must be a number, got {page!r}")
        limits = {n: (_number(params, f"min_{n}"), _number(params, f"max_{n}")) for n in cls.RANGES}

        default = {"outcome": cls.OUTCOME, "sort": next(iter(cls.SORTS)), "page": "1"}
        names = ("object", "class", "outcome", "sort", "order", "page", *cls.CHOICES)
        values = {name: params.get(name, "") or default.get(name, "") for name in names}
        values["page"] = str(max(1, int(page)))
        values["order"] = values["order"].replace("down", "")
        ranges = {name: both for name, both in limits.items() if both != (None, None)}
        return Query(values=values, ranges=ranges, default=default)

    def select(self, query: Query) -> Places:
        """Return the rows that a query selects, in its order.

        Rows without a value of the sorted quantity come last; ties are in the order of the rows.
        """
        # The filters; a row without a value is in no range.
        own = zip(self.snapshot.names, self.snapshot.classes, strict=True)
        asked = query["object"], query["class"]
        wanted = [all(a in ("", b) for a, b in zip(asked, names, strict=True)) for names in own]
        chosen = np.array(wanted, dtype=bool)[self.table.object]
        for name in self.CHOICES:
            if query[name]:
                chosen &= self.matches(name, query[name])
        for name, (least, largest) in query.ranges.items():
            values = self.column(name) * self.QUANTITIES[name].factor
            if least is not None:
                chosen &= values >= least
            if largest is not None:
                chosen &= values <= largest

        # The order.
        places = np.flatnonzero(chosen).astype(np.int32)
        values = self.column(query["sort"])[places]
        there = ~np.isnan(values)
        few = values[there] if query.ascending else -values[there]
        return np.concatenate([places[there][np.argsort(few, kind="stable")], places[~there]])

    def gallery_page(self, query: Query, chosen: Places, site: Site) -> str:
        """Return the gallery.

        Args:
            query: The query; a page number beyond the last page means the last page.
            chosen: All rows that the query selects, in order.
            site: Location of the pages; a file contains all cards, with the values for its script
                to filter and sort by.
        """
        pages = max(1, -(-len(chosen) // PAGE))
        page = min(int(query.values["page"]), pages)
        shown = chosen if site.static else chosen[(page - 1) * PAGE : page * PAGE]

        # The cards, each with the address of its page.
        cards = self.cards(shown)
        values = self._values(shown) if site.static else [{}] * len(cards)
        for i, card, own in zip(shown.tolist(), cards, values, strict=True):
            card |= self.identity(i) | {"label": self.label(i), "href": self._address(i, query)}
            named = {"object": card["title"], "class": card["class_name"]}
            card["values"] = named | own if site.static else {}
        return render(
            f"gallery_{self.ROW}.html",
            site,
            cards=cards,
            total=len(chosen),
            all=self.table.count,
            page=page,
            pages=pages,
            home=self.HOME,
            noun=self.NOUN,
            previous=self._home(query, page=page - 1) if page > 1 else "",
            next=self._home(query, page=page + 1) if page < pages else "",
            address=self._home(query),
            form=self._form(query, site),
            **self.summary(query, chosen),
        )

    def row_page(self, i: int, query: Query, chosen: Places, site: Site, hand: HandView) -> str:
        """Return the page of a row.

        Args:
            i: Number of the row.
            query: The query whose rows next and previous step through.
            chosen: All rows that the query selects, in order.
            site: Location of the other pages.
            hand: Hand of the dataset.

        Raises:
            DataError: If a file was replaced in the meantime.
        """
        values = self.row(i, hand)
        scene, place = values["scene"], np.flatnonzero(chosen == i)
        k = int(place[0]) if len(place) else None
        meshes = (f"link-{number}" for number in range(scene["links"]))

        def address(place: int) -> str:
            return self._address(int(chosen[place]), query)

        return render(
            f"{self.ROW}.html",
            site,
            label=self.label(i),
            noun=self.ROW,
            position="not in the selection" if k is None else f"{k + 1:,} of {len(chosen):,}",
            previous=address(k - 1) if k else "",
            next=address(k + 1) if k is not None and k + 1 < len(chosen) else "",
            gallery=self._home(query),
            meshes={
                "object": site.at(f"/mesh/object-{scene['objectCode']}.json"),
                "links": [site.at(f"/mesh/{name}.json") for name in meshes],
            },
            problem=hand.problem,
            size=self.snapshot.config.camera.size,
            **self.identity(i),
            **values,
        )

    def _values(self, shown: Places) -> list[dict[str, str]]:
        """Return the numbers and words by which a page without a server filters and sorts."""
        columns = {}
        for name in (
            *self.QUANTITIES,
            *(name for name in self.SORTS if name not in self.QUANTITIES),
        ):
            factor = self.QUANTITIES[name].factor if name in self.QUANTITIES else 1
            numbers = self.column(name)[shown] * factor
            columns[name] = [f"{x:.9g}".replace("inf", "Infinity") for x in numbers.tolist()]
        for name, values in self.CHOICES.items():
            words = [""] * len(shown)
            for value in values:
                if value != "any":
                    those = self.matches(name, value)[shown].tolist()
                    words = [f"{w} {value}" if t else w for w, t in zip(words, those, strict=True)]
            columns[name] = [word.strip() for word in words]
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]

    def _address(self, i: int, query: Query) -> str:
        params = query.params()
        return f"/{self.ROW}/{self.label(i)}" + f"?{params}" * bool(params)

    def _home(self, query: Query, **changes: object) -> str:
        params = query.params(**changes)
        return self.HOME + f"?{params}" * bool(params)

    def _form(self, query: Query, site: Site) -> dict[str, Any]:
        """Return the fields of the form for filters and order; files have a single outcome."""
        names = {"object": self.snapshot.names, "class": sorted(set(self.snapshot.classes))}
        # Fields with a list of options.
        selects = []
        for name, title in self.SELECTS.items():
            known = {n: n for n in names[name]} if name in names else self.options(name)
            any_ = "any" if query.default.get(name) else ""
            options = [(value, text, value == query[name]) for value, text in known.items()]
            if not (any_ and site.static):
                selects.append((name, title, [(any_, "any", not query[name]), *options]))

        # Numbers between two limits.
        ranges = []
        for name in self.RANGES:
            bounds = query.ranges.get(name, (None, None))
            least, largest = ("" if value is None else f"{value:g}" for value in bounds)
            quantity = self.QUANTITIES[name]
            ranges.append((name, quantity.title, quantity.unit, least, largest))
        return {
            "selects": selects,
            "ranges": ranges,
            "sorts": [(name, text, name == query["sort"]) for name, text in self.SORTS.items()],
            "ascending": query.ascending,
            "outcome": self.OUTCOME,
        }


def _number(params: Mapping[str, str], name: str) -> float | None:
    """Return a number from an address; None if it has none."""
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
