"""The card of a score: everything that others need to compare with the score or to repeat it.

Input: the judged sets and their origin. Output: plain JSON types, and the same content as
Markdown. The card has no times and no number of workers, so equal verdicts give equal cards.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from drakegrasp.config import Config
from drakegrasp.errors import NAMED, counted
from drakegrasp.frames import Array
from drakegrasp.scoring.measures import (
    CURVE_MM,
    LEVEL,
    OF_ARM,
    RESAMPLES,
    Estimate,
    Grouping,
    Judged,
    by_name,
    calibration,
    curve,
    difference,
    diversity,
    estimates,
    penetration,
    resample,
)
from drakegrasp.scoring.references import REFERENCES
from drakegrasp.simulation.attempts import GraspTable

#: Name of the format of the card.
FORM = "drakegrasp-score-1"
#: Number of test objects below which the card has a warning.
FEW_OBJECTS = 20
#: Meanings of the measures if a protocol other than the lift decides.
BY_PROTOCOL = {
    "headline": "success by the protocol of the first wrist pose; best-ranked prediction of each "
    "row; mean over objects",
    "objects": "objects with a row that succeeds",
}
#: Meanings of the measures, in the order of a table.
MEANINGS = {
    "headline": "a sample, lifted by the first wrist pose with every contact within d; best-ranked "
    "prediction of each row; mean over objects",
    "matches": "lifted by the first wrist pose with every contact within d",
    "kept": "all rules of a sample, wherever the fingertips touch",
    "clean": "kept, and no neighbour moves by more than 10 mm or 10 degrees",
    "lifted": "lifted by the first wrist pose, wherever the fingertips touch",
    "precision": "lifted by the fingertips alone",
    "stable": "a precision grasp that moves less than 5 mm and 5 degrees",
    "lifted_any": "any of at most five wrist poses holds: an oracle chose among them",
    "reachable": "an arm reaches the first wrist pose, whether it holds or not",
    "reached": "as the headline, and the arm reaches it",
    "objects": "objects with a row that counts in the headline",
}
#: Measures whose intervals are in the table of all sets.
WITH_INTERVAL = ("headline", "clean")


def card_of(
    sets: Sequence[Judged],
    grouping: Grouping,
    *,
    dataset: Mapping[str, Any],
    config: Config,
    settings: Mapping[str, Any],
    known_objects: int,
    new_classes: bool,
    among: bool,
    benchmark: Mapping[str, Any] | None,
    again: str,
) -> dict[str, Any]:
    """Return the card.

    Args:
        sets: The predictions, if there are any, then the reference rows.
        grouping: Grouping of the scored rows.
        dataset: The scored dataset: file, split, hashes, rows.
        config: Configuration of the verification.
        settings: Everything that decides a verdict, with the versions.
        known_objects: Number of scored objects that are in the training split.
        new_classes: Whether no class of the scored objects is in the training split.
        among: Whether the objects are among others.
        benchmark: Description of the frozen benchmark; None for another dataset.
        again: The command that creates the card again.
    """
    # Draw objects or classes, and describe each set; all sets share the draws.
    clusters = grouping.classes if new_classes else grouping.names
    draws, oracle = resample(clusters), config.verify.max_tries > 1
    left_out = {
        *(() if oracle else ("lifted_any",)),
        *(() if among else ("clean",)),
        *(() if "arm" in settings else OF_ARM),
    }
    measures = {name: words for name, words in MEANINGS.items() if name not in left_out}
    described = {each.name: _set_of(each, grouping, draws, measures) for each in sets}
    tested = [each for each in sets if each.name not in REFERENCES]
    by_protocol = "protocol" in settings

    card: dict[str, Any] = {
        "form": FORM,
        "headline": {each.name: described[each.name]["measures"]["headline"] for each in tested},
        "measures": BY_PROTOCOL if by_protocol else measures,
        "limit_mm": round(1e3 * config.verify.max_contact_error, 3),
        "rows": len(grouping.rows),
        "objects": len(grouping.names),
        "classes": len(set(grouping.classes)),
        "intervals": {
            "level": LEVEL,
            "resamples": RESAMPLES,
            "drawn": "classes" if new_classes else "objects",
            "training_seeds": max((len(each.ranked) for each in tested), default=0),
        },
        "warnings": _warnings(grouping, sets, dataset["split_rows"], known_objects),
        "sets": described,
        "above": _above(sets, tested, grouping, draws),
        "by_class": {each.name: by_name(each, grouping, grouping.classes) for each in sets},
        "by_object": {each.name: by_name(each, grouping, grouping.names) for each in sets},
        "dataset": dict(dataset),
        "settings": dict(settings),
        "again": again,
    }
    return card if benchmark is None else card | {"benchmark": dict(benchmark)}


def _above(
    sets: Sequence[Judged], tested: Sequence[Judged], grouping: Grouping, draws: Array
) -> dict[str, dict[str, Estimate]]:
    """Return by how much each tested set is above every other set; a pair is compared once."""
    found: dict[str, dict[str, Estimate]] = {}
    for one in tested:
        found[one.name] = {
            other.name: _negative(found[other.name][one.name])
            if other.name in found
            else difference(one, other, grouping, draws)
            for other in sets
            if other is not one
        }
    return found


def _negative(of: Estimate) -> Estimate:
    # Subtracting from zero avoids a negative zero.
    return {"value": 0.0 - of["value"], "low": 0.0 - of["high"], "high": 0.0 - of["low"]}


def _set_of(
    judged: Judged,
    grouping: Grouping,
    draws: Array,
    measures: Collection[str],
) -> dict[str, Any]:
    """Return the description of a set on the card."""
    table, reference = judged.table, REFERENCES.get(judged.name)
    of_postures = any(isinstance(ranked, GraspTable) for ranked in judged.ranked)
    return {
        "what": reference.words if reference else "postures" if of_postures else "predictions",
        "files": [{"name": r.file, "sha256": r.sha256} for r in judged.ranked],
        "predictions": table.count,
        "measures": estimates(judged, grouping, draws, measures),
        "lifted_within_mm": dict(zip(map(str, CURVE_MM), curve(judged, grouping), strict=True)),
        "penetration": penetration(judged),
        "diversity": diversity(judged),
        "calibration": calibration(judged),
        "outcomes": dict(sorted(Counter(table.outcome.tolist()).items())),
        "invalid": dict(Counter(filter(None, table.reason.tolist())).most_common(NAMED)),
    }


def _warnings(
    grouping: Grouping, sets: Sequence[Judged], total: int, known_objects: int
) -> list[str]:
    """Return what a reader must know before comparing scores."""
    found = []
    if len(grouping.names) < FEW_OBJECTS:
        found.append(
            f"only {counted(len(grouping.names), 'test object')}: with fewer than "
            f"{FEW_OBJECTS} the intervals are too narrow, and the order of methods may change"
        )
    if len(grouping.rows) < total:
        found.append(f"{len(grouping.rows)} of the {total} rows of the split were scored")
    found += sorted({ranked.left_out for each in sets for ranked in each.ranked} - {""})
    if known_objects:
        found.append(f"{counted(known_objects, 'test object')} also in training, by name")
    if not any(REFERENCES[each.name].trained for each in sets if each.name in REFERENCES):
        found.append(
            "no reference row that ignores the image was scored, so the score says little (--train)"
        )

    # Count verdicts that give no information about the grasp.
    without = ("solver_error", "timeout", "crashed")
    if unknown := sum(int(np.isin(each.table.outcome, without).sum()) for each in sets):
        found.append(f"{unknown} predictions have no verdict (solver error, timeout): they fail")
    return found


# Markdown


def card_text(card: Mapping[str, Any]) -> str:
    """Return a card as Markdown."""
    protocol = card["settings"].get("protocol")
    counts = "sample" if protocol is None else f"by {protocol['protocol']}"
    lines = ["# Score of predicted grasps", ""]
    for name, value in card["headline"].items():
        lines += [f"**{name}: {share_text(value)}** {counts}, success@1, first wrist pose, mean "
                  f"over {counted(card['objects'], 'object')} "
                  f"({counted(card['rows'], 'row')}).", ""]  # fmt: skip
    lines += [f"> Warning: {warning}." for warning in card["warnings"]]
    lines += [""] if card["warnings"] else []

    # A table of all sets.
    measures = [*(name for name in card["measures"] if name != "objects"), "objects"]
    rows = []
    for name, each in card["sets"].items():
        of = {measure: each["measures"][measure] for measure in measures}
        shares = {measure: _percent(value["value"]) for measure, value in of.items()}
        shares |= {measure: share_text(of[measure]) for measure in WITH_INTERVAL if measure in of}
        rows.append([name, *shares.values(), str(each["predictions"])])

    lines += _table(["set", *measures, "predictions"], rows)
    drawn, level = card["intervals"]["drawn"], card["intervals"]["level"]
    within = (
        f"A contact must be within {card['limit_mm']:g} mm of the requested one in the first two "
        "columns."
        if protocol is None
        else f"Of {protocol['source']}."
    )
    lines += [
        "",
        f"Per cent; intervals of {level:.0%} by a paired bootstrap over {drawn}. {within}",
        "",
        *(f"* `{name}`: {words}" for name, words in card["measures"].items()),
        "",
    ]
    lines += _more(card)

    # By class.
    sets, classes = card["by_class"], next(iter(card["by_class"].values()))
    rows = [[name, *(_percent(each[name]) for each in sets.values())] for name in classes]
    lines += ["## By class", "", *_table(["class", *sets], rows), "", *_origin(card)]
    return "\n".join(lines) + "\n"


def _more(card: Mapping[str, Any]) -> list[str]:
    """Return the lines on all measures except the headline."""
    # The curve, and measures of the predictions that count.
    sets, lines = card["sets"], list[str]()
    if "protocol" not in card["settings"]:
        curves = [each["lifted_within_mm"] for each in sets.values()]
        rows = [[d, *(_percent(each[d]) for each in curves)] for d in map(str, CURVE_MM)]
        words = "Lifted with every contact within d of the requested one [%]."
        lines += ["## lifted(d)", "", words, "", *_table(["d [mm]", *sets], rows)]
    rows = []
    for name, each in sets.items():
        depth = "-" if each["penetration"] is None else f"{1e3 * each['penetration']:.2f}"
        variance = " ".join(map(_percent, each["diversity"] or ())) or "-"
        rows.append([name, depth, variance])
    lines += ["", "## Other measures", ""]
    lines += _table(["set", "penetration [mm]", "diversity"], rows)
    lines += [
        "",
        "Diversity: per cent of variance in the first one to five principal components of palm and "
        "joints; lower is more diverse.",
        "",
    ]

    # Success with several predictions per row, and calibration.
    for name, each in sets.items():
        for measure, value in each["measures"].items():
            if measure.startswith("success@"):
                lines.append(f"* {name}, {measure}: {share_text(value)}")
        for group in each["calibration"]:
            share = f"{_percent(group['share'])} % of {group['count']}"
            lines.append(f"* {name}, confidence {group['confidence']:.3g}: {share}")
        lines += [f"* {name}, {n} no grasp: {why}" for why, n in each["invalid"].items()]
    for name, others in card["above"].items():
        for other, value in others.items():
            lines.append(f"* {name} above {other}: {share_text(value)}")
    return [*lines, ""]


def _origin(card: Mapping[str, Any]) -> list[str]:
    """Return the lines on the origin of a card and on how to create it again."""
    lines = ["## Made from", ""]
    lines += [f"* {key}: `{value}`" for key, value in card["dataset"].items()]
    for name, each in card["sets"].items():
        lines += [f"* {name}: `{file['name']}` `{file['sha256'][:16]}`" for file in each["files"]]
    settings = card["settings"]
    versions = settings["versions"] | settings.get("protocol", {}).get("versions", {})
    lines += [f"* {key} {value}" for key, value in versions.items()]
    lines += [f"* benchmark {key}: {value}" for key, value in card.get("benchmark", {}).items()]
    return [*lines, "", "Again:", "", f"    {card['again']}"]


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a table."""
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *rows)]


def _percent(share: float) -> str:
    return f"{100.0 * share:z.0f}"


def share_text(of: Mapping[str, float], decimals: int = 0, unit: str = "") -> str:
    """Return a share and its interval in per cent; equal values, as of one object, have none."""
    value, low, high = (f"{100.0 * of[name]:z.{decimals}f}" for name in ("value", "low", "high"))
    return f"{value}{unit} ({f'{low} to {high}' if of['low'] < of['high'] else 'no interval'})"
