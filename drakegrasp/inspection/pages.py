"""What the pages say: values for the templates, as text that people read.

In: a snapshot, decisions and a query. Out: HTML. Jinja escapes every value; no page holds a script
or a style of its own, so the strictest content security policy fits.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from drakegrasp.dataset.filters import Removal
from drakegrasp.dataset.rejections import Decisions
from drakegrasp.dataset.schema import CAMERAS, SPLITS
from drakegrasp.dataset.suspicion import PARTS, suspicion
from drakegrasp.errors import printable
from drakegrasp.inspection.catalog import Snapshot
from drakegrasp.inspection.links import Links
from drakegrasp.inspection.query import (
    DECISIONS,
    DEGREES,
    HOLDS,
    PAGE,
    QUANTITIES,
    RANGES,
    SORTS,
    Query,
)
from drakegrasp.inspection.rows import THUMBNAIL, contact_dots, read_rows
from drakegrasp.inspection.table import NONE
from drakegrasp.outcomes import Outcome
from drakegrasp.visualization.style import FINGER_COLOURS

Places = npt.NDArray[np.int32]
#: Reasons of suspicion that a card names, and the share from which on it names one.
REASONS, REASON_SHARE = 2, 0.75


def _shown(value: Any) -> Any:
    """Return a value of a template as it is shown: texts without control characters."""
    return printable(value) if type(value) is str else value


TEMPLATES = Environment(
    loader=PackageLoader("drakegrasp.inspection"),
    autoescape=select_autoescape(default=True, default_for_string=True),
    undefined=StrictUndefined,
    finalize=_shown,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(name: str, links: Links, **values: Any) -> str:
    """Return a page of a template."""
    return TEMPLATES.get_template(name).render(links=links, colours=FINGER_COLOURS, **values)


def gallery_page(
    snapshot: Snapshot,
    decisions: Decisions,
    query: Query,
    places: Places,
    links: Links,
    token: str,
) -> str:
    """Return the gallery.

    Args:
        snapshot: State of the files.
        decisions: What was rejected and kept.
        query: What is asked for.
        places: Of all attempts that the query selects, in order.
        links: Addresses.
        token: Of this server; empty without one.
    """
    # The cards of one page; a page beyond the last is the last. Files hold all of them.
    pages = max(1, -(-len(places) // PAGE))
    page = min(query.page, pages)
    shown = places if links.static else places[(page - 1) * PAGE : page * PAGE]
    cards = make_cards(snapshot, decisions, query, shown, links)

    return render(
        "gallery.html",
        links,
        token=token,
        title=snapshot.out.name or str(snapshot.out),
        missing=snapshot.missing,
        cards=cards,
        total=len(places),
        all=len(snapshot.table),
        rejected=len(decisions.rejected),
        kept=len(decisions.kept),
        page=page,
        pages=pages,
        previous=links.gallery(query.params(page=page - 1)) if page > 1 else "",
        next=links.gallery(query.params(page=page + 1)) if page < pages else "",
        query=query,
        form=_form(snapshot, query),
    )


def make_cards(
    snapshot: Snapshot, decisions: Decisions, query: Query, places: Places, links: Links
) -> list[dict[str, Any]]:
    """Return the values of the cards of attempts."""
    # Only the columns of the dots are read: a page must be quick.
    table, cards = snapshot.table, []
    rows = read_rows(snapshot, places.tolist(), THUMBNAIL)

    # Failures have no images.
    for i, row in zip(places.tolist(), rows, strict=True):
        label, key = snapshot.label(i), snapshot.key(i)
        outcome = Outcome(int(table.outcome[i]))
        success = outcome is Outcome.SUCCESS
        cards.append(
            {
                "label": label,
                "href": links.grasp(label, query.params()),
                "object": key.object,
                "class_name": snapshot.classes[table.object[i]],
                "outcome": outcome.label.replace("_", " "),
                "success": success,
                "number": number_text(snapshot, i),
                "size": snapshot.config.camera.size,
                "strip": links.strip(label, "oto") if success else "",
                "dots": contact_dots(snapshot, row, "oto") if success else [],
                "words": words_of(snapshot, i),
                "suspicion": QUANTITIES["suspicion"].text(table.value("suspicion", i)),
                "reasons": _reasons(snapshot, i),
                "decision": decisions.of(key),
                "values": _plain_values(snapshot, i) if links.static else {},
            }
        )
    return cards


def number_text(snapshot: Snapshot, i: int) -> str:
    """Return how people name an attempt: its trial id, or its palm pose before there is one."""
    trial = snapshot.trial_id(i)
    if trial is not None:
        return f"trial {trial}"
    key = snapshot.key(i)
    return f"pose {key.candidate}, stand-off {key.standoff_index}"


def words_of(snapshot: Snapshot, i: int) -> list[str]:
    """Return the words that describe an attempt: how it holds, its split or why it is no sample."""
    table = snapshot.table
    words = []
    if table.outcome[i] == Outcome.SUCCESS:
        words.append("stable" if table.stable[i] else "precision" if table.precision[i] else "held")
    if table.split[i] != NONE:
        words.append(SPLITS[table.split[i]])
    if table.removal[i] not in (NONE, Removal.KEPT):
        words.append("no sample: " + Removal(int(table.removal[i])).label.replace("_", " "))
    return words


def _reasons(snapshot: Snapshot, i: int) -> list[str]:
    """Return the largest parts of an attempt's suspicion, as text."""
    table = snapshot.table
    shares = [(table.value(part.name, i) / part.scale, part.name) for part in PARTS]
    large = sorted((s for s in shares if s[0] >= REASON_SHARE), reverse=True)[:REASONS]
    return [
        f"{QUANTITIES[name].title} {QUANTITIES[name].text(table.value(name, i))}"
        for _, name in large
    ]


def _plain_values(snapshot: Snapshot, i: int) -> dict[str, str]:
    """Return what a page without a server filters and sorts by, as attributes of its card."""
    table = snapshot.table
    holds = {"held", words_of(snapshot, i)[0]} | ({"precision"} if table.precision[i] else set())
    values = {name: f"{table.value(name, i) * q.factor:.6g}" for name, q in
              QUANTITIES.items()}  # fmt: skip
    return values | {
        "object": snapshot.names[table.object[i]],
        "class": snapshot.classes[table.object[i]],
        "split": SPLITS[table.split[i]] if table.split[i] != NONE else "none",
        "hold": " ".join(sorted(holds)),
        "removal": Removal(int(table.removal[i])).label if table.removal[i] != NONE else "",
        "row": str(i),
    }


def _form(snapshot: Snapshot, query: Query) -> dict[str, Any]:
    """Return the fields of the form of filters."""

    def options(values: Sequence[str], chosen: str, any_: str = "any") -> list[Any]:
        """Return value, text and whether it is chosen."""
        named = [(value, value.replace("_", " "), value == chosen) for value in values]
        return [("", any_, not chosen), *named]

    # Outcomes and reasons that occur; names as they are.
    table = snapshot.table
    outcomes = [Outcome(int(n)).label for n in np.unique(table.outcome)]
    reasons = [Removal(int(n)).label for n in np.unique(table.removal) if n != NONE]
    named = [(name, name, name == query.object_name) for name in snapshot.names]
    classes = sorted(set(snapshot.classes))
    selects = [
        ("class", "class", [("", "any", not query.class_name),
                            *((c, c, c == query.class_name) for c in classes)]),
        ("object", "object", [("", "any", not query.object_name), *named]),
        ("outcome", "outcome", [("any", "any", not query.outcome),
                                *options(outcomes, query.outcome)[1:]]),
        ("split", "split", options((*SPLITS, "none"), query.split)),
        ("hold", "how it holds", options(HOLDS, query.hold)),
        ("removal", "removed by", options(reasons, query.removal)),
        ("decision", "decision", options(DECISIONS, query.decision)),
    ]  # fmt: skip

    def text(value: float | None) -> str:
        return "" if value is None else f"{value:g}"

    ranges = [
        {
            "name": name,
            "title": QUANTITIES[name].title,
            "unit": QUANTITIES[name].unit,
            "min": text(query.ranges.get(name, (None, None))[0]),
            "max": text(query.ranges.get(name, (None, None))[1]),
        }
        for name in RANGES
    ]
    titles = {name: q.title for name, q in QUANTITIES.items()} | {"row": "row of the dataset"}
    sorts = [(name, titles[name], name == query.sort) for name in SORTS]
    return {"selects": selects, "ranges": ranges, "sorts": sorts, "ascending": query.ascending}


def grasp_page(
    snapshot: Snapshot,
    decisions: Decisions,
    query: Query,
    places: Places,
    i: int,
    scene: dict[str, Any],
    problem: str,
    links: Links,
    token: str,
) -> str:
    """Return the page of one attempt.

    Args:
        snapshot: State of the files.
        decisions: What was rejected and kept.
        query: What next and previous go through.
        places: Of all attempts that the query selects, in order.
        i: Place of the attempt.
        scene: Its 3D view.
        problem: Why the hand cannot be shown; empty if it can.
        links: Addresses.
        token: Of this server; empty without one.

    Raises:
        DataError: If a file was replaced meanwhile.
    """
    # Its neighbours in the selection.
    (found,) = np.nonzero(places == i)
    place = int(found[0]) if len(found) else None
    before = after = ""
    if place is not None and place > 0:
        before = links.grasp(snapshot.label(int(places[place - 1])), query.params())
    if place is not None and place + 1 < len(places):
        after = links.grasp(snapshot.label(int(places[place + 1])), query.params())

    # Its row, and where both cameras see its contacts.
    (row,) = read_rows(snapshot, [i])
    table, label, key = snapshot.table, snapshot.label(i), snapshot.key(i)
    success = bool(table.outcome[i] == Outcome.SUCCESS)
    views = [
        {
            "camera": camera,
            "strip": links.strip(label, camera),
            "dots": contact_dots(snapshot, row, camera),
        }
        for camera in CAMERAS
    ]
    position = "not in the selection" if place is None else f"{place + 1:,} of {len(places):,}"
    return render(
        "grasp.html",
        links,
        token=token,
        title=key.object,
        label=label,
        class_name=snapshot.classes[table.object[i]],
        number=number_text(snapshot, i),
        trial=snapshot.trial_id(i),
        out=str(snapshot.out),
        outcome=Outcome(int(table.outcome[i])).label.replace("_", " "),
        words=words_of(snapshot, i),
        success=success,
        decision=decisions.of(key),
        position=position,
        previous=before,
        next=after,
        gallery=links.gallery(query.params()),
        views=views if success else [],
        size=snapshot.config.camera.size,
        score=QUANTITIES["suspicion"].text(table.value("suspicion", i)),
        parts=_parts(snapshot, i, row),
        facts=_facts(snapshot, i, row),
        fingers=_fingers(row),
        scene=scene,
        meshes={
            "object": links.mesh("object", scene["objectNumber"]),
            "links": [links.mesh("link", number) for number in range(scene["links"])],
        },
        problem=problem,
    )


def _parts(snapshot: Snapshot, i: int, row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the parts of an attempt's suspicion with their shares."""
    columns = {name: np.asarray(value)[None] for name, value in row.items()}
    found = suspicion(columns)
    parts = []
    for part in PARTS:
        value, share = float(found.values[part.name][0]), float(found.shares[part.name][0])
        quantity = QUANTITIES[part.name]
        parts.append(
            {
                "title": quantity.title,
                "meaning": part.meaning,
                "value": quantity.text(value),
                "scale": quantity.text(part.scale),
                "share": None if np.isnan(share) else round(share, 3),
            }
        )
    return parts


def _facts(snapshot: Snapshot, i: int, row: dict[str, Any]) -> list[tuple[str, str]]:
    """Return further numbers of an attempt as names and texts."""
    key = snapshot.key(i)

    def number(name: str, factor: float, unit: str, digits: int = 1) -> str:
        value = float(row[name]) * factor
        space = "" if unit == "°" else " "
        return f"{value:.{digits}f}{space}{unit}" if np.isfinite(value) else "–"

    standoffs = snapshot.config.candidates.drawn_standoffs
    s = key.standoff_index
    standoff = f"{1e3 * standoffs[s]:.0f} mm" if s < len(standoffs) else str(s)
    return [
        ("palm pose, stand-off", f"{key.candidate}, {standoff}"),
        ("spread", number("spread", DEGREES, "°")),
        ("time of closing, of the lift",
         f"{number('time_close', 1.0, 's', 2)}, {number('time_lift', 1.0, 's', 2)}"),
        ("slip before the wrist moves", number("slip_released", 1e3, "mm")),
        ("turn before the wrist moves", number("turn_released", DEGREES, "°")),
        ("other links after closing", str(int(row["closed_other_links"]))),
        ("mass", f"{float(row['mass']):.4g} kg"),
    ]  # fmt: skip


def _fingers(row: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a row per finger: forces, depths, areas, fit to the mesh; a dash for no value."""

    def text(value: float, digits: int) -> str:
        return f"{value:.{digits}f}" if np.isfinite(value) else "–"

    fingers = []
    for k in range(len(row["closed_touching"])):
        instants = []
        for when in ("closed", "lifted"):
            touching = bool(row[f"{when}_touching"][k])
            force = float(np.linalg.norm(row[f"{when}_f_Q_O"][k])) if touching else np.nan
            depth = float(row[f"{when}_penetration"][k]) if touching else np.nan
            area = float(row[f"{when}_area"][k]) if touching else np.nan
            instants.append([text(force, 1), text(1e3 * depth, 2), text(1e6 * area, 0)])
        fit = [
            text(float(row["normal_angle"][k]) * DEGREES, 1),
            text(1e3 * float(row["surface_distance"][k]), 2),
        ]
        fingers.append({"closed": instants[0], "lifted": instants[1], "fit": fit})
    return fingers
