"""A gallery shows a table of rows, and a page shows one row of the table.

Input: the query of an address. Output: HTML. Each table is a `Gallery`, which defines how it is
filtered and sorted, and the contents of its cards and pages. Jinja escapes every value; no page
contains its own script or style, so the strictest content security policy can be used.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias
from urllib.parse import urlencode

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from drakegrasp.dataset.schema import SPLITS, Shown
from drakegrasp.errors import DataError, counted, printable
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome
from drakegrasp.page.renders import HandView
from drakegrasp.page.snapshot import Snapshot
from drakegrasp.pictures.style import FINGER_COLOURS, PREDICTED, REACHED, TRUE
from drakegrasp.table import AnyArray, Table

Places: TypeAlias = npt.NDArray[np.int32]
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


def render(name: str, galleries: Sequence[type[Gallery]], **values: Any) -> str:
    """Return the page of a template, with links to the galleries that there are."""
    return TEMPLATES.get_template(name).render(galleries=galleries, **values)


@dataclass(frozen=True, kw_only=True)
class Query:
    """Query of a gallery.

    Attributes:
        values: Values by the names of parameters; an empty text means any value.
        default: Default values, which an address need not contain.
    """

    values: Mapping[str, str]
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
        values = {name: str(v) for name, v in {**self.values, **changes}.items()}
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
        QUANTITIES: Numbers for sorting, with their display.
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
    SORTS: ClassVar[Mapping[str, str]]
    OUTCOME: ClassVar[str] = ""
    snapshot: Snapshot
    table: Table

    @abstractmethod
    def summary(self, query: Query, chosen: Places) -> dict[str, Any]:
        """Return the content of the gallery besides its cards."""

    @abstractmethod
    def cards(self, shown: Places) -> list[dict[str, Any]]:
        """Return the content of the cards of rows."""

    @abstractmethod
    def row(self, i: int, hand: HandView) -> dict[str, Any]:
        """Return the content of a row's page."""

    # Methods that a table may override.

    def column(self, name: str) -> AnyArray:
        """Return a column (n,); `row` is the order of the rows if the table has no such column."""
        is_order = name == "row" and name not in self.table
        return np.arange(self.table.count) if is_order else self.table[name]

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

    def of_objects(self, wanted: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Return which rows (n,) are of objects that are wanted, by their numbers."""
        return wanted[self.table.object]

    def identity(self, i: int) -> dict[str, Any]:
        """Return how people name a row: by its object's name and class."""
        number = self.table.object[i]
        return {"title": self.snapshot.names[number], "class_name": self.snapshot.classes[number]}

    # What all tables share.

    def find(self, text: str) -> int | None:
        """Return the row whose number an address has, or None if there is none."""
        there = text.isascii() and text.isdecimal() and len(text) < 10
        return int(text) if there and int(text) < self.table.count else None

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

        default = {"outcome": cls.OUTCOME, "sort": next(iter(cls.SORTS)), "page": "1"}
        names = ("object", "class", "outcome", "sort", "order", "page", *cls.CHOICES)
        values = {name: params.get(name, "") or default.get(name, "") for name in names}
        values["page"] = str(max(1, int(page)))
        values["order"] = values["order"].replace("down", "")
        return Query(values=values, default=default)

    def select(self, query: Query) -> Places:
        """Return the rows that a query selects, in its order.

        Rows without a value of the sorted quantity come last; ties are in the order of the rows.
        """
        # The filters.
        own = zip(self.snapshot.names, self.snapshot.classes, strict=True)
        asked = query["object"], query["class"]
        wanted = [all(a in ("", b) for a, b in zip(asked, names, strict=True)) for names in own]
        chosen = self.of_objects(np.array(wanted, dtype=bool))
        for name in self.CHOICES:
            if query[name]:
                chosen &= self.matches(name, query[name])

        # The order.
        places = np.flatnonzero(chosen).astype(np.int32)
        values = self.column(query["sort"])[places]
        there = ~np.isnan(values)
        few = values[there] if query.ascending else -values[there]
        return np.concatenate([places[there][np.argsort(few, kind="stable")], places[~there]])

    def gallery_page(self, query: Query, chosen: Places, galleries: Sequence[type[Gallery]]) -> str:
        """Return the gallery.

        Args:
            query: The query; a page number beyond the last page means the last page.
            chosen: All rows that the query selects, in order.
            galleries: The galleries that there are.
        """
        pages = max(1, -(-len(chosen) // PAGE))
        page = min(int(query.values["page"]), pages)
        shown = chosen[(page - 1) * PAGE : page * PAGE]

        # The cards, each with the address of its page.
        cards = self.cards(shown)
        for i, card in zip(shown.tolist(), cards, strict=True):
            card |= self.identity(i) | {"label": i, "href": self._address(i, query)}
        return render(
            f"gallery_{self.ROW}.html",
            galleries,
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
            form=self._form(query),
            **self.summary(query, chosen),
        )

    def row_page(
        self,
        i: int,
        query: Query,
        chosen: Places,
        galleries: Sequence[type[Gallery]],
        hand: HandView,
    ) -> str:
        """Return the page of a row.

        Args:
            i: Number of the row.
            query: The query whose rows next and previous step through.
            chosen: All rows that the query selects, in order.
            galleries: The galleries that there are.
            hand: Hand of the dataset.
        """
        values = self.row(i, hand)
        scene, place = values["scene"], np.flatnonzero(chosen == i)
        k = int(place[0]) if len(place) else None

        def address(place: int) -> str:
            return self._address(int(chosen[place]), query)

        return render(
            f"{self.ROW}.html",
            galleries,
            label=i,
            noun=self.ROW,
            position="not in the selection" if k is None else f"{k + 1:,} of {len(chosen):,}",
            previous=address(k - 1) if k else "",
            next=address(k + 1) if k is not None and k + 1 < len(chosen) else "",
            gallery=self._home(query),
            meshes={
                "object": f"/mesh/object-{scene['objectNumber']}.json",
                "links": [f"/mesh/link-{number}.json" for number in range(scene["links"])],
            },
            problem=hand.problem,
            size=self.snapshot.config.camera.size,
            **self.identity(i),
            **values,
        )

    def _address(self, i: int, query: Query) -> str:
        params = query.params()
        return f"/{self.ROW}/{i}" + f"?{params}" * bool(params)

    def _home(self, query: Query, **changes: object) -> str:
        params = query.params(**changes)
        return self.HOME + f"?{params}" * bool(params)

    def _form(self, query: Query) -> dict[str, Any]:
        """Return the fields of the form for filters and order."""
        names = {"object": self.snapshot.names, "class": sorted(set(self.snapshot.classes))}
        # Fields with a list of options.
        selects = []
        for name, title in self.SELECTS.items():
            known = {n: n for n in names[name]} if name in names else self.options(name)
            any_ = "any" if query.default.get(name) else ""
            options = [(value, text, value == query[name]) for value, text in known.items()]
            selects.append((name, title, [(any_, "any", not query[name]), *options]))

        return {
            "selects": selects,
            "sorts": [(name, text, name == query["sort"]) for name, text in self.SORTS.items()],
            "ascending": query.ascending,
            "outcome": self.OUTCOME,
        }
