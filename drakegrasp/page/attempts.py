"""The attempts of a dataset on the page: which ones are shown, their cards, and their pages."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import quote

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.paths import DATA_FILES, reach_names
from drakegrasp.dataset.quality import PARTS
from drakegrasp.dataset.reach import IDENTITY, is_reachable
from drakegrasp.dataset.rejections import REJECT_FILE, AttemptKey, Decisions
from drakegrasp.dataset.schema import CAMERAS, SPLITS, TRIAL_FIELDS, Shown
from drakegrasp.dataset.successes import own_setting
from drakegrasp.dataset.trials import NONE
from drakegrasp.filters import Removal
from drakegrasp.outcomes import Outcome
from drakegrasp.page.gallery import Gallery, Places, Query
from drakegrasp.page.renders import (
    THUMBNAIL,
    HandView,
    attempt_scene,
    contact_dots,
    read_render,
    read_rows,
)
from drakegrasp.page.snapshot import Snapshot
from drakegrasp.simulation.attempt import Source

#: Features of an attempt for sorting, with their display.
QUANTITIES = {
    "anomaly": Shown("anomaly", digits=2),
    **{part.name: part.shown for part in PARTS},
}
#: Texts of two choices of the split: all samples, and all attempts that are not samples.
SPLIT_NAMES = {"samples": "any sample", "none": "no sample"}
#: The removal that no success has: successes kept by the filters are called samples.
KEPT = ("removal", Removal.KEPT.label)
#: Maximum number of reasons of anomaly on a card, and the smallest part that is a reason.
REASONS, REASON_SHARE = 2, 0.75


class AttemptGallery(Gallery):
    """The attempts of a dataset.

    Args:
        snapshot: State of the files.
        decisions: Attempts that were rejected.
        token: Token with which a page decides; empty if it cannot.
    """

    HOME, ROW, NOUN = "/", "grasp", "attempt"
    CHOICES: ClassVar = {
        "outcome": ("any", *(outcome.label for outcome in Outcome)),
        "split": ("samples", *SPLITS, "none"),
        "hold": ("lifted", "precision", "stable"),
        "removal": tuple(removal.label for removal in Removal),
        "decision": ("rejected", "open"),
    }
    SELECTS: ClassVar = {
        **{name: name for name in ("class", "object", "outcome", "split")},
        "hold": "how it holds",
        "removal": "removed by",
        "decision": "decision",
    }
    QUANTITIES = QUANTITIES
    SORTS: ClassVar = {
        **{name: quantity.title for name, quantity in QUANTITIES.items()},
        "row": "row of the dataset",
    }
    OUTCOME = "success"

    def __init__(self, snapshot: Snapshot, decisions: Decisions, token: str = "") -> None:
        self.snapshot, self.decisions, self.token = snapshot, decisions, token
        self.table = snapshot.table

    def matches(self, name: str, value: str) -> npt.NDArray[np.bool_]:
        """Return which attempts (n,) match a value of the filter `name`."""
        if name == "decision":
            rejected = self._rejected()
            return rejected if value == "rejected" else self.table.lifted & ~rejected
        if name == "split" and value in SPLIT_NAMES:
            return np.asarray((self.table.split == NONE) == (value == "none"))
        return super().matches(name, value)

    def options(self, name: str) -> Mapping[str, str]:
        """Return the options of a field of the form: all decisions, else values that occur."""
        found = super().options(name)
        if name == "decision":
            found = {value: value for value in self.CHOICES[name]}
        if name == "split":
            found = {"samples": SPLIT_NAMES["samples"], **found, "none": SPLIT_NAMES["none"]}
        return {value: text for value, text in found.items() if (name, value) != KEPT}

    # Decisions.

    def counts(self) -> dict[str, int]:
        """Return the numbers of rejected attempts, and of those of them that are samples now."""
        samples = self._rejected() & (self.table.split != NONE)
        return {"rejected": len(self.decisions.rejected), "samples": int(samples.sum())}

    def _rejected(self) -> npt.NDArray[np.bool_]:
        """Return which attempts (n,) are rejected."""
        found = np.zeros(self.table.count, dtype=bool)
        for key in self.decisions.rejected:
            if (place := self.snapshot.find(key)) is not None:
                found[place] = True
        return found

    def _decisions(self) -> dict[str, Any]:
        """Return counts of decisions, and the command that removes rejected grasps, as values.

        The command names user-defined filters again, since a dataset stores only their names.
        """
        out = self.snapshot.out
        words = ["drakegrasp", "assemble", str(out), "--reject", str(out / REJECT_FILE)]
        if own := own_setting(self.snapshot.config.filters):
            words += ["--set", own]
        return {"token": self.token, "counts": self.counts(), "assemble": shlex.join(words)}

    # Contents of pages.

    def identity(self, i: int) -> dict[str, Any]:
        """Return how people name an attempt: by object, class and row of trials.hdf5."""
        return {**super().identity(i), "number": f"trial {i}"}

    def summary(self, query: Query, chosen: Places) -> dict[str, Any]:
        """Return the content of the gallery besides its cards."""
        snapshot = self.snapshot
        return {
            "title": snapshot.out.name or str(snapshot.out),
            "samples": int(np.count_nonzero(snapshot.table.split != NONE)),
            "only_samples": self._home(query, split="samples", page=1),
            **self._decisions(),
        }

    def cards(self, shown: Places) -> list[dict[str, Any]]:
        """Return the content of the cards of attempts."""
        # Read only the columns that the dots need, and no images: a page must be fast.
        snapshot, cards = self.snapshot, []
        rows = read_rows(snapshot, shown.tolist(), THUMBNAIL)
        for i, row in zip(shown.tolist(), rows, strict=True):
            outcome = Outcome(int(snapshot.table.outcome[i]))
            sample = snapshot.table.split[i] != NONE
            cards.append(
                {
                    "outcome": outcome.label.replace("_", " "),
                    "success": outcome is Outcome.SUCCESS,
                    "sample": sample,
                    "size": snapshot.config.camera.size,
                    "strip": f"/strip/{i}-oto.png",
                    # Other attempts have no images.
                    "dots": contact_dots(snapshot, row, "oto") if sample else [],
                    "words": words_of(snapshot, i),
                    "anomaly": _text(snapshot, "anomaly", i),
                    "reasons": _reasons(snapshot, i),
                    "decision": self.decisions.of(snapshot.key(i)),
                }
            )
        return cards

    def row(self, i: int, hand: HandView) -> dict[str, Any]:
        """Return the content of an attempt's page."""
        # The row of the attempt, and where both cameras see its contacts.
        snapshot = self.snapshot
        (row,) = read_rows(snapshot, [i])
        outcome = Outcome(int(snapshot.table.outcome[i]))
        views = []
        for camera in CAMERAS if snapshot.table.split[i] != NONE else ():
            unread = DATA_FILES[camera] if read_render(snapshot, i, camera) is None else ""
            strip = f"/strip/{i}-{camera}.png"
            dots = contact_dots(snapshot, row, camera)
            views.append({"camera": camera, "strip": strip, "unread": unread, "dots": dots})

        again = ("--trial", str(i), "--html", "trial.html")
        arms = [name for name, reachable in _arms(snapshot.out, snapshot.key(i)) if reachable]
        return {
            "replay": shlex.join(["drakegrasp", "replay", str(snapshot.out), *again]),
            **self._decisions(),
            "outcome": outcome.label.replace("_", " "),
            "words": words_of(snapshot, i),
            "success": outcome is Outcome.SUCCESS,
            "decision": self.decisions.of(snapshot.key(i)),
            "views": views,
            "score": _text(snapshot, "anomaly", i),
            "parts": [(part.shown.title, _text(snapshot, part.name, i)) for part in PARTS],
            "facts": _facts(snapshot, i, row),
            "scene": attempt_scene(snapshot, i, row, hand)
            | {"arms": {f"arm {name}": f"/arm/{i}-{quote(name)}.json" for name in arms}},
        }


def _text(snapshot: Snapshot, name: str, i: int) -> str:
    """Return a feature of an attempt as text."""
    return QUANTITIES[name].text(snapshot.table[name][i])


def words_of(snapshot: Snapshot, i: int) -> list[str]:
    """Return words about an attempt: how it holds, and its split or why it is not a sample."""
    table = snapshot.table
    words = []
    if table.lifted[i]:
        still = "precision" if table.precision[i] else "lifted"
        words.append("stable" if table.stable[i] else still)
    if table.outcome[i] == Outcome.MOVED:
        words.append("lift ended, not judged")
    if table.split[i] != NONE:
        words.append(SPLITS[table.split[i]])
    if table.removal[i] not in (NONE, Removal.KEPT):
        words.append("no sample: " + Removal(int(table.removal[i])).label.replace("_", " "))
    return words


def _reasons(snapshot: Snapshot, i: int) -> list[str]:
    """Return the largest parts of an attempt's anomaly, as text."""
    shares = [(snapshot.table[part.name][i] / part.scale, part.name) for part in PARTS]
    large = sorted((s for s in shares if s[0] >= REASON_SHARE), reverse=True)[:REASONS]
    # A contact without a normal has no normal angle, so this part is infinite.
    return [
        f"{QUANTITIES[name].title}{'' if np.isfinite(share) else ':'} {_text(snapshot, name, i)}"
        for share, name in large
    ]


def _facts(snapshot: Snapshot, i: int, row: dict[str, Any]) -> list[tuple[str, str]]:
    """Return names and values, as strings, of an attempt's numbers that are not shown elsewhere."""
    key, rules = snapshot.key(i), snapshot.config.candidates
    s, standoffs = key.standoff_index, rules.standoffs
    standoff = f"{1e3 * standoffs[s]:.0f} mm" if s < len(standoffs) else str(s)
    if rules.postures is not None:
        standoff = "none, a given posture"
    if row["source"] == Source.CLOSING:
        standoff = "none, tried as it is"
    in_parts, closed = {part.name for part in PARTS}, np.isfinite(row["time_close"])

    return [
        ("palm pose, stand-off", f"{key.candidate}, {standoff}"),
        *(
            (field.shown.title, " ".join(map(field.shown.text, np.ravel(row[field.name]).tolist())))
            for field in TRIAL_FIELDS
            if field.shown is not None and field.name not in in_parts
        ),
        ("other links after closing", str(int(row["closed_other_links"])) if closed else "–"),
        *(
            (f"arm {name}", "reaches it" if reachable else "does not reach it")
            for name, reachable in _arms(snapshot.out, key)
        ),
    ]


def _arms(out: Path, key: AttemptKey) -> Iterator[tuple[str, bool]]:
    """Yield each arm that was asked for an attempt, and whether it reaches it."""
    values = (key.object, key.candidate, key.standoff_index)
    columns = {name: np.array([v]) for name, v in zip(IDENTITY, values, strict=True)}
    for name in reach_names(out):
        (asked,), (reachable,) = is_reachable(out, name, columns)
        if asked:
            yield name, bool(reachable)
