"""What the gallery of predictions and the page of one say: values for the templates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import CAMERAS, Shown
from drakegrasp.frames import Array
from drakegrasp.outcomes import Outcome
from drakegrasp.page.forms import object_fields, options, range_fields
from drakegrasp.page.links import Links
from drakegrasp.page.pages import neighbours, number_text, paged, render, words_of
from drakegrasp.page.predictions.query import (
    RANGES,
    SORTS,
    PredictionQuery,
    order_values,
)
from drakegrasp.page.predictions.results import (
    QUANTITIES,
    VERDICTS,
    WORDS,
    Predictions,
)
from drakegrasp.page.predictions.scene import prediction_scene
from drakegrasp.page.rows import THUMBNAIL, Dot, Look, contact_dots, read_look, read_rows
from drakegrasp.page.scene3d import HandView

Numbers = npt.NDArray[np.int32]
#: Kinds of contacts with the columns of a verdict that hold them.
_CONTACTS = {"asked": ("p_OQ", "nhat_Q_O"), "reached": ("closed_p_OQ", "closed_nhat_Q_O")}
#: Fields of a verdict that its card needs.
ON_CARDS = ("reason", *(name for names in _CONTACTS.values() for name in names))
#: Width of the part of an image that is shown over that of its marks, and the least share of it.
LOOSE, LEAST_SHOWN = 1.7, 0.4
#: Numbers that a verdict and the row's own trial both have.
_BOTH = {
    "slip": Shown("slip", "mm"),
    "turn": Shown("turn", "°"),
    "time_close": Shown("time of closing", "s", 2),
    "time_lift": Shown("time of the lift", "s", 2),
}
#: Numbers of a verdict alone, of the fingers the largest.
_OWN = {
    "contact_error": Shown("asked to reached", "mm"),
    "normal_error": Shown("asked to reached normal", "°"),
    "surface_distance": Shown("asked to surface", "mm"),
    "fit_residual": Shown("asked to fingertip of the fit", "mm"),
    "fit_normal_error": Shown("asked normal to pad of the fit", "°"),
    "tries": Shown("wrist poses tried", digits=0),
    "smallest_friction": Shown("least friction at the asked contacts", digits=2),
    "epsilon": Shown("epsilon of the asked contacts", digits=3),
}


def predictions_page(
    predictions: Predictions, query: PredictionQuery, chosen: Numbers, links: Links
) -> str:
    """Return the gallery of predictions.

    Args:
        predictions: All of them.
        query: What is asked for.
        chosen: Numbers of all predictions that the query selects, in order.
        links: Addresses.
    """
    shown, turning = paged(query, chosen, links.predictions, static=links.static)
    held = int(np.count_nonzero(predictions.words["held"][chosen]))

    return render(
        "predictions.html",
        links,
        token="",
        title=predictions.path.name,
        dataset=predictions.snapshot.out.name or str(predictions.snapshot.out),
        split=predictions.rows.split,
        rows=len(np.unique(predictions.rows.row)),
        cards=_cards(predictions, query, shown, links),
        total=len(chosen),
        all=len(predictions),
        held=held,
        **turning,
        form=_form(predictions, query),
    )


def prediction_page(
    predictions: Predictions,
    query: PredictionQuery,
    chosen: Numbers,
    i: int,
    hand: HandView,
    links: Links,
    *,
    row_link: bool = True,
) -> str:
    """Return the page of one prediction.

    Args:
        predictions: All of them.
        query: What next and previous go through.
        chosen: Numbers of all predictions that the query selects, in order.
        i: Number of the prediction.
        hand: Of the dataset.
        links: Addresses.
        row_link: Whether the row has a page of its own.

    Raises:
        DataError: If a file was replaced meanwhile.
    """

    def address(number: int) -> str:
        return links.prediction(predictions.label(number), query.params())

    # The verdict, the row, and where both cameras see the contacts; first that of the data file.
    snapshot, at = predictions.snapshot, int(predictions.places[i])
    (verdict,), (row,) = predictions.read([i]), read_rows(snapshot, [at])
    views = []
    for camera in sorted(CAMERAS, key=lambda name: name != predictions.rows.camera):
        look = read_look(snapshot, at, camera)
        strip = links.strip(snapshot.label(at), camera)
        marks = _marks(predictions, verdict, row, camera, look)
        window = _window(marks, snapshot.config.camera.size, wide=camera != predictions.rows.camera)
        views.append({"camera": camera, "strip": strip, "marks": marks, "window": window})
    scene = prediction_scene(predictions, i, verdict, row, hand)
    return render(
        "prediction.html",
        links,
        token="",
        **_identity(predictions, i),
        verdict=_verdict(predictions, i),
        reason=verdict.get("reason") or "",
        hints=verdict.get("hints") or "",
        row_words=[_outcome(row["outcome"]), *words_of(snapshot, at)],
        row_page=links.grasp(snapshot.label(at)) if row_link else "",
        **neighbours(chosen, i, address),
        gallery=links.predictions(query.params()),
        views=views,
        size=snapshot.config.camera.size,
        numbers=_numbers(predictions, i, verdict, row),
        fingers=_fingers(verdict, row),
        scene=scene,
        meshes={
            "object": links.mesh("object", scene["objectCode"]),
            "links": [links.mesh("link", str(number)) for number in range(scene["links"])],
        },
        problem=hand.problem,
    )


def _identity(predictions: Predictions, i: int) -> dict[str, Any]:
    """Return how people name a prediction, its object and its row."""
    snapshot, at = predictions.snapshot, int(predictions.places[i])
    number = snapshot.table.object[at]
    return {
        "title": snapshot.names[number],
        "class_name": snapshot.classes[number],
        "number": f"prediction {i}",
        "row": f"row {predictions.rows.row[i]} of {predictions.rows.split}",
        "trial": number_text(snapshot, at),
    }


def _verdict(predictions: Predictions, i: int) -> list[tuple[str, str]]:
    """Return the words of a verdict, each with the name of its look."""
    words = {word for word, those in predictions.words.items() if those[i]}
    if "held" in words:
        return [("held", word) for word in WORDS if word in words]
    by_another = [("", "held by another wrist pose")] if "held_any" in words else []
    return [("failed", _outcome(predictions.outcome[i])), *by_another]


def _outcome(outcome: int) -> str:
    return Outcome(int(outcome)).label.replace("_", " ")


def _marks(
    predictions: Predictions,
    verdict: Mapping[str, Any],
    row: dict[str, Any],
    camera: str,
    look: Look | None = None,
) -> dict[str, list[Dot]]:
    """Return where a camera sees the contacts of each kind."""
    marks = {"true": contact_dots(predictions.snapshot, row, camera, look)}
    for kind, names in _CONTACTS.items():
        points, normals = (verdict[name] for name in names)
        marks[kind] = []
        if points is not None and normals is not None:
            contacts = (points, normals)
            marks[kind] = contact_dots(predictions.snapshot, row, camera, look, contacts=contacts)
    return marks


def _window(
    marks: Mapping[str, list[Dot]], size: int, *, wide: bool = False
) -> tuple[float, float, float]:
    """Return the square of an image that shows its marks: left, top, and width [px].

    Args:
        marks: By kind.
        size: Width of the image [px].
        wide: Whether to show the whole image.
    """
    dots = [(dot.u, dot.v) for of_kind in marks.values() for dot in of_kind]
    if wide or not dots:
        return -0.5, -0.5, float(size)
    low, high = np.min(dots, axis=0), np.max(dots, axis=0)
    width = min(max(LOOSE * float((high - low).max()), LEAST_SHOWN * size), float(size))
    left, top = np.clip((low + high - width) / 2.0, -0.5, size - width - 0.5).tolist()
    return left, top, width


def _cards(
    predictions: Predictions, query: PredictionQuery, shown: Numbers, links: Links
) -> list[dict[str, Any]]:
    """Return the values of the cards of predictions."""
    snapshot, camera = predictions.snapshot, predictions.rows.camera
    order, cards = order_values(predictions, "worst"), []
    places = predictions.places[shown].tolist()
    rows = read_rows(snapshot, places, THUMBNAIL)
    verdicts = predictions.read(shown.tolist(), ON_CARDS)

    # What a page without a server filters and sorts by are attributes of the card.
    for i, at, row, verdict in zip(shown.tolist(), places, rows, verdicts, strict=True):
        numbers = {name: float(values[i]) for name, values in predictions.features.items()}
        values = {
            "object": snapshot.names[snapshot.table.object[at]],
            "class": snapshot.classes[snapshot.table.object[at]],
            "outcome": Outcome(int(predictions.outcome[i])).label,
            "verdict": " ".join(word for word, those in predictions.words.items() if those[i]),
            **{n: f"{v * QUANTITIES[n].factor:.6g}" for n, v in numbers.items()},
            "worst": f"{order[i]:.9g}",
            "row": f"{predictions.rows.row[i]}",
        }

        # What the card shows.
        marks, size = _marks(predictions, verdict, row, camera), snapshot.config.camera.size
        cards.append(
            {
                **_identity(predictions, i),
                "label": predictions.label(i),
                "href": links.prediction(predictions.label(i), query.params()),
                "strip": links.strip(snapshot.label(at), camera),
                "marks": marks,
                "window": _window(marks, size),
                "size": size,
                "verdict": _verdict(predictions, i),
                "reason": verdict["reason"] or "",
                "numbers": [
                    (QUANTITIES[n].title, QUANTITIES[n].text(numbers[n]))
                    for n in ("error", "true_error", "slip", "turn")
                ],
                "values": values if links.static else {},
            }
        )
    return cards


def _numbers(
    predictions: Predictions, i: int, verdict: Mapping[str, Any], row: Mapping[str, Any]
) -> list[tuple[str, str, str | None]]:
    """Return lines of title, the prediction's value and the row's own; None for no such value."""
    true = QUANTITIES["true_error"]
    lines: list[tuple[str, str, str | None]] = [
        (true.title, true.text(float(predictions.features["true_error"][i])), None)
    ]
    for name, shown in _OWN.items():
        lines.append((shown.title, shown.text(_largest(verdict.get(name))), None))
    for name, shown in _BOTH.items():
        lines.append((shown.title, shown.text(_largest(verdict.get(name))), shown.text(row[name])))
    force = Shown("largest force after closing", "N")
    forces = [_lengths(source.get("closed_f_Q_O")) for source in (verdict, row)]
    own, other = (force.text(_largest(values)) for values in forces)
    return [*lines, (force.title, own, other)]


def _fingers(verdict: Mapping[str, Any], row: Mapping[str, Any]) -> list[list[str]]:
    """Return the distances and forces of each finger as text."""
    asked, reached, true = verdict["p_OQ"], verdict["closed_p_OQ"], row["closed_p_OQ"]
    count = len(asked)
    columns = [
        (1e3, _lengths(None if reached is None else asked - reached)),
        (1e3, _lengths(asked - true) if true.shape == asked.shape else None),
        (1e3, verdict["surface_distance"]),
        (1.0, _lengths(verdict["closed_f_Q_O"])),
        (1.0, _lengths(row["closed_f_Q_O"])),
    ]
    known = [np.full(count, np.nan) if v is None else factor * v for factor, v in columns]
    return [[f"{v[k]:.1f}" if np.isfinite(v[k]) else "–" for v in known] for k in range(count)]


def _lengths(vectors: Array | None) -> Array | None:
    return None if vectors is None else np.linalg.norm(vectors, axis=-1)


def _largest(value: Any) -> float:
    """Return the largest of some numbers, NaN if there is none."""
    numbers = np.asarray(np.nan if value is None else value, dtype=float).ravel()
    return float(np.fmax.reduce(numbers, initial=np.nan))


def _form(predictions: Predictions, query: PredictionQuery) -> dict[str, Any]:
    """Return the fields of the form of filters and order."""
    verdicts = [verdict for verdict in VERDICTS if verdict in predictions.words]
    outcomes = [Outcome(int(n)).label for n in np.unique(predictions.outcome)]
    titles = {name: q.title for name, q in QUANTITIES.items()}
    titles |= {"worst": "worst verdict", "row": "row of the dataset"}
    return {
        "selects": [
            ("verdict", "verdict", options(verdicts, query.verdict)),
            ("outcome", "outcome", options(outcomes, query.outcome)),
            *object_fields(predictions.snapshot, query.object_name, query.class_name),
        ],
        "ranges": range_fields(RANGES, QUANTITIES, query.ranges),
        "sorts": [(name, titles[name], name == query.sort) for name in SORTS],
        "ascending": query.ascending,
        "outcome": "",
    }
