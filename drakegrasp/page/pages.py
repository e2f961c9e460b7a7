"""What the gallery says: values for the templates, as text that people read.

In: a snapshot, decisions and a query. Out: HTML. Jinja escapes every value; no page holds a script
or a style of its own, so the strictest content security policy fits.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from drakegrasp.dataset.filtering import own_setting
from drakegrasp.dataset.rejections import FILE_NAME, Decisions
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.suspicion import PARTS
from drakegrasp.dataset.trial_files import NONE
from drakegrasp.errors import counted, printable
from drakegrasp.outcomes import Outcome, Removal
from drakegrasp.page.catalog import Snapshot
from drakegrasp.page.forms import attempt_form
from drakegrasp.page.links import Links
from drakegrasp.page.query import PAGE, QUANTITIES, GalleryQuery, Query, count_decisions
from drakegrasp.page.rows import THUMBNAIL, contact_dots, read_rows
from drakegrasp.pictures.style import FINGER_COLOURS, PREDICTED, REACHED, TRUE

Places = npt.NDArray[np.int32]
#: Reasons of suspicion that a card names, and the share from which on it names one.
REASONS, REASON_SHARE = 2, 0.75


def _shown(value: Any) -> Any:
    """Return a value of a template as it is shown: texts without control characters."""
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
TEMPLATES.globals["counted"] = counted
TEMPLATES.globals["kinds"] = {"true": TRUE, "asked": PREDICTED, "reached": REACHED}


def render(name: str, links: Links, **values: Any) -> str:
    """Return a page of a template."""
    return TEMPLATES.get_template(name).render(links=links, **values)


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
    shown, turning = paged(query, places, links.gallery, static=links.static)
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
        samples=int(np.count_nonzero(snapshot.table.split != NONE)),
        only_samples=links.gallery(query.params(split="samples", page=1)),
        **decision_values(snapshot, decisions),
        **turning,
        form=attempt_form(snapshot, query, failures=not links.static),
    )


def paged(
    query: GalleryQuery, chosen: Places, address: Callable[[str], str], *, static: bool
) -> tuple[Places, dict[str, Any]]:
    """Return those of one page of a gallery, and what the template turns pages by.

    Args:
        query: What is asked for; a page beyond the last is the last.
        chosen: Numbers of all that the query selects, in order.
        address: Returns that of the gallery with a query.
        static: Whether the pages are files, which hold all cards.
    """
    pages = max(1, -(-len(chosen) // PAGE))
    page = min(query.page, pages)
    return chosen if static else chosen[(page - 1) * PAGE : page * PAGE], {
        "page": page,
        "pages": pages,
        "previous": address(query.params(page=page - 1)) if page > 1 else "",
        "next": address(query.params(page=page + 1)) if page < pages else "",
        "address": address(query.params()),
    }


def neighbours(chosen: Places, i: int, address: Callable[[int], str]) -> dict[str, str]:
    """Return where something is in a selection, and the addresses before and after it.

    Args:
        chosen: Numbers of all that is selected, in order.
        i: Its number.
        address: Returns that of a number.
    """
    (found,) = np.nonzero(chosen == i)
    if not len(found):
        return {"position": "not in the selection", "previous": "", "next": ""}
    k = int(found[0])
    return {
        "position": f"{k + 1:,} of {len(chosen):,}",
        "previous": address(int(chosen[k - 1])) if k else "",
        "next": address(int(chosen[k + 1])) if k + 1 < len(chosen) else "",
    }


def decision_values(snapshot: Snapshot, decisions: Decisions) -> dict[str, Any]:
    """Return how much is decided, and the command that takes rejected grasps out.

    Filters of the user's own are given to it again: a dataset has their names alone.
    """
    out = snapshot.out
    words = ["drakegrasp", "assemble", str(out), "--reject", str(out / FILE_NAME)]
    if own := own_setting(snapshot.config.filters):
        words += ["--set", own]
    return {
        "counts": count_decisions(snapshot, decisions),
        "assemble": shlex.join(words),
        "assembled": snapshot.assembled,
    }


def make_cards(
    snapshot: Snapshot, decisions: Decisions, query: Query, places: Places, links: Links
) -> list[dict[str, Any]]:
    """Return the values of the cards of attempts."""
    # Only the columns of the dots are read, and no images: a page must be quick.
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
    refined = f", refined {key.child}" if key.child else ""
    return f"pose {key.candidate}, stand-off {key.standoff_index}{refined}"


def words_of(snapshot: Snapshot, i: int) -> list[str]:
    """Return the words that describe an attempt: how it holds, its split or why it is no sample."""
    table = snapshot.table
    words = []
    if table.outcome[i] == Outcome.SUCCESS:
        words.append("stable" if table.stable[i] else "precision" if table.precision[i] else "held")
    if table.outcome[i] == Outcome.MOVED:
        words.append("lift ended, not judged")
    if table.outcome[i] == Outcome.NOT_LIFTED:
        words.append("not lifted, not judged")
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
    # A contact without a normal has no angle of it: an infinite share.
    return [
        f"{QUANTITIES[name].title}{'' if np.isfinite(share) else ':'} "
        f"{QUANTITIES[name].text(table.value(name, i))}"
        for share, name in large
    ]


def _plain_values(snapshot: Snapshot, i: int) -> dict[str, str]:
    """Return what a page without a server filters and sorts by, as attributes of its card."""
    table = snapshot.table
    holds = {"held", words_of(snapshot, i)[0]} | ({"precision"} if table.precision[i] else set())
    numbers = {name: table.value(name, i) * q.factor for name, q in QUANTITIES.items()}
    values = {n: "Infinity" if np.isposinf(v) else f"{v:.6g}" for n, v in numbers.items()}
    return values | {
        "object": snapshot.names[table.object[i]],
        "class": snapshot.classes[table.object[i]],
        "split": SPLITS[table.split[i]] if table.split[i] != NONE else "none",
        "hold": " ".join(sorted(holds)),
        "removal": Removal(int(table.removal[i])).label if table.removal[i] != NONE else "",
        "row": str(i),
    }
