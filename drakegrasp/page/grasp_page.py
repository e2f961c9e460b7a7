"""What the page of one attempt says: numbers, parts of the suspicion, fingers, text to copy."""

from __future__ import annotations

import json
import shlex
from typing import Any

import numpy as np

from drakegrasp.dataset.card.holding import share_text
from drakegrasp.dataset.rejections import Decisions
from drakegrasp.dataset.schema import CAMERAS, TRIAL_FIELDS
from drakegrasp.dataset.suspicion import PARTS, suspicion
from drakegrasp.frames import unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import Snapshot
from drakegrasp.page.links import Links
from drakegrasp.page.pages import (
    Places,
    decision_values,
    neighbours,
    number_text,
    render,
    words_of,
)
from drakegrasp.page.query import QUANTITIES, Query
from drakegrasp.page.rows import (
    contact_dots,
    look_source,
    read_certificate,
    read_look,
    read_rows,
)


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

    def address(place: int) -> str:
        return links.grasp(snapshot.label(place), query.params())

    # Its row, and where both cameras see its contacts.
    (row,) = read_rows(snapshot, [i])
    table, label, key = snapshot.table, snapshot.label(i), snapshot.key(i)
    success, trial = bool(table.outcome[i] == Outcome.SUCCESS), snapshot.trial_id(i)
    views = []
    for camera in CAMERAS if success else ():
        look = read_look(snapshot, i, camera)
        view = {"camera": camera, "strip": links.strip(label, camera)}
        view["unread"] = look_source(snapshot, i, camera) if look is None else ""
        views.append({**view, "dots": contact_dots(snapshot, row, camera, look)})
    return render(
        "grasp.html",
        links,
        token=token,
        title=key.object,
        label=label,
        class_name=snapshot.classes[table.object[i]],
        number=number_text(snapshot, i),
        trial=trial,
        replay=shlex.join(["drakegrasp", "replay", str(snapshot.out), "--trial", f"{trial}"]),
        **decision_values(snapshot, decisions),
        outcome=Outcome(int(table.outcome[i])).label.replace("_", " "),
        words=words_of(snapshot, i),
        success=success,
        decision=decisions.of(key),
        **neighbours(places, i, address),
        gallery=links.gallery(query.params()),
        views=views,
        size=snapshot.config.camera.size,
        score=QUANTITIES["suspicion"].text(table.value("suspicion", i)),
        parts=_parts(snapshot, i, row),
        facts=_facts(snapshot, i, row),
        pose=_pose_lines(key.object, row),
        fingers=_fingers(row),
        scene=scene,
        meshes={
            "object": links.mesh("object", scene["objectCode"]),
            "links": [links.mesh("link", str(number)) for number in range(scene["links"])],
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
        if np.isnan(value) and np.isfinite(share):
            value = np.inf  # a contact without a normal
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
    standoffs = snapshot.config.candidates.standoffs
    s = key.standoff_index
    standoff = f"{1e3 * standoffs[s]:.0f} mm" if s < len(standoffs) else str(s)
    if snapshot.config.candidates.postures is not None:
        standoff = "none, a given posture"

    # What no other part of the page shows.
    in_parts = {part.name for part in PARTS}
    return [
        ("palm pose, stand-off", f"{key.candidate}, {standoff}"),
        *(
            (field.shown.title, field.shown.text(float(row[field.name])))
            for field in TRIAL_FIELDS
            if field.shown is not None and field.name not in in_parts
        ),
        (
            "other links after closing",
            str(int(row["closed_other_links"])) if np.isfinite(row["time_close"]) else "–",
        ),
        *_bears(row),
        *_certificate(snapshot, i),
    ]


def _bears(row: dict[str, Any]) -> list[tuple[str, str]]:
    """Return how much an attempt bears; nothing where that was not tried."""
    probability, half = row["p_hold_probability"], row["p_hold_half_step"]
    if np.isnan(probability):
        return []
    repeats = int(row["p_hold_repeats"])
    lines = [
        (f"disturbed repeats that {what}", share_text(int(row[f"p_hold_{name}"]), repeats))
        for name, what in (("samples", "would be samples"), ("held", "hold"))
    ]
    step = {0.0: "no", 1.0: "yes"}.get(float(half), "not known")
    return [*lines, ("would be a sample at half the time step", step)]


def _certificate(snapshot: Snapshot, i: int) -> list[tuple[str, str]]:
    """Return how robust a success is; nothing where that was not tried."""
    if snapshot.table.outcome[i] != Outcome.SUCCESS:
        return []
    found, lines = read_certificate(snapshot, i), []
    share, friction = found["certified_share"], found["certified_friction"]
    if np.isfinite(share):
        lines.append(("repeats with noise that hold", f"{100.0 * share:.0f} %"))
    if not np.isnan(friction):
        least = f"{friction:.3g}" if np.isfinite(friction) else "more than it has"
        lines.append(("least friction with the hand that holds", least))
    return lines


def _pose_lines(name: str, row: dict[str, Any]) -> list[str]:
    """Return palm poses and joints of an attempt as lines of JSON to copy, as far as it got."""
    values: dict[str, Any] = {"object": name}
    for key in ("X_TO", "X_OG", "closed_q", "X_OG_lifted", "lifted_q"):
        value = unpack_pose(row[key]) if key.startswith("X_") else row[key]
        if np.isfinite(value).all():
            values[key] = value.tolist()
    lines = [f" {json.dumps(key)}: {json.dumps(value)}" for key, value in values.items()]
    return ["{", *(f"{line}," for line in lines[:-1]), lines[-1], "}"]


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
            text(np.rad2deg(float(row["normal_angle"][k])), 1),
            text(1e3 * float(row["surface_distance"][k]), 2),
        ]
        fingers.append({"closed": instants[0], "lifted": instants[1], "fit": fit})
    return fingers
