"""What the gallery of scenes and the page of one say: values for the templates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from drakegrasp.dataset.schema import SPLITS, VIEW_KINDS, Shown
from drakegrasp.frames import unpack_pose
from drakegrasp.outcomes import Outcome
from drakegrasp.page.forms import object_fields, options
from drakegrasp.page.links import Links
from drakegrasp.page.pages import neighbours, paged, render
from drakegrasp.page.rows import ARROW, Dot, dots_of
from drakegrasp.page.scene3d import HandView, contacts_in_table, make_scene
from drakegrasp.page.scenes.file import Rows, Scenes
from drakegrasp.page.scenes.query import SORTS, SceneQuery
from drakegrasp.pictures.style import REACHED, TRUE

#: Palms that the 3D view shows, and how many of these with the hand; lines of the table.
PALMS, HANDS, LINES = 100, 8, 100
#: Length of the line along +Gz from a palm's origin on an image [m].
PALM = 0.06
#: What the label of a grasp says of it: the word, its look, and the colour of its palm.
HOLDS, FAILS, UNKNOWN = (
    ("holds", "held", TRUE),
    ("fails", "failed", REACHED),
    ("not tested", "", "#F0E442"),
)


def scenes_page(
    scenes: Scenes, query: SceneQuery, chosen: npt.NDArray[np.int32], links: Links
) -> str:
    """Return the gallery of scenes.

    Args:
        scenes: All of them.
        query: What is asked for.
        chosen: Numbers of all scenes that the query selects, in order.
        links: Addresses.
    """
    shown, turning = paged(query, chosen, links.scenes, static=links.static)
    snapshot = scenes.snapshot
    splits = [SPLITS[number] for number in np.unique(scenes.split)]

    # The cards, and the form beside them.
    return render(
        "scenes.html",
        links,
        token="",
        title=snapshot.out.name or str(snapshot.out),
        cards=[_card(scenes, query, i, links) for i in shown.tolist()],
        total=len(chosen),
        all=len(scenes),
        views=int(scenes.counts["views"][chosen].sum()),
        **turning,
        form={
            "selects": [
                *object_fields(snapshot, query.object_name, query.class_name),
                ("split", "split", options(splits, query.split)),
            ],
            "ranges": [],
            "sorts": [(name, title, name == query.sort) for name, title in SORTS.items()],
            "ascending": query.ascending,
            "outcome": "",
        },
    )


def scene_page(
    scenes: Scenes,
    query: SceneQuery,
    chosen: npt.NDArray[np.int32],
    i: int,
    hand: HandView,
    links: Links,
    *,
    with_pages: frozenset[int] | None = None,
) -> str:
    """Return the page of one scene.

    Args:
        scenes: All of them.
        query: What next and previous go through.
        chosen: Numbers of all scenes that the query selects, in order.
        i: Number of the scene.
        hand: Of the dataset.
        links: Addresses.
        with_pages: Trials that have a page of their own; all if None.

    Raises:
        DataError: If a file was replaced meanwhile.
    """

    def address(number: int) -> str:
        return links.scene(scenes.labels[number], query.params())

    grasps, views = scenes.grasps(i), scenes.views(i)
    drawn = _drawn(scenes, grasps)
    scene = _scene3d(scenes, i, grasps, hand)
    return render(
        "scene.html",
        links,
        token="",
        **_identity(scenes, i),
        **neighbours(chosen, i, address),
        gallery=links.scenes(query.params()),
        drawn=None if drawn is None else int(scenes.data.tables["grasps"]["trial_id"][drawn]),
        views=[_seen(scenes, i, k, drawn, links) for k in range(len(views))],
        grasps=_lines(scenes, i, grasps[:LINES], links, with_pages),
        more=max(0, len(grasps) - LINES),
        facts=_facts(scenes, i),
        looks=[HOLDS, FAILS, UNKNOWN],
        scene=scene,
        meshes={
            "object": links.mesh("object", scene["objectCode"]),
            "links": [links.mesh("link", str(number)) for number in range(scene["links"])],
        },
        problem=hand.problem,
    )


def _identity(scenes: Scenes, i: int) -> dict[str, Any]:
    """Return how people name a scene, and how many grasps it has."""
    number = scenes.objects[i]
    counts = {name: int(values[i]) for name, values in scenes.counts.items()}
    return {
        "title": scenes.snapshot.names[number],
        "class_name": scenes.snapshot.classes[number],
        "resting": int(scenes.data.tables["scenes"]["resting"][i, 0]),
        "split": SPLITS[scenes.split[i]],
        "counts": counts,
    }


def _card(scenes: Scenes, query: SceneQuery, i: int, links: Links) -> dict[str, Any]:
    """Return the values of a scene's card, with the view that sees its grasp best."""
    label, identity = scenes.labels[i], _identity(scenes, i)
    grasps, views = scenes.grasps(i), scenes.views(i)
    drawn, best = _drawn(scenes, grasps), 0
    if drawn is not None and len(views):
        best = int(np.argmax(_visible(scenes, i, np.array([drawn])).sum(axis=(1, 2))))
    # What a page without a server filters and sorts by are attributes of the card.
    values = {
        "object": identity["title"],
        "class": identity["class_name"],
        "split": identity["split"],
        **{name: f"{count}" for name, count in identity["counts"].items()},
        "row": f"{i}",
    }
    return {
        **identity,
        "label": label,
        "href": links.scene(label, query.params()),
        "view": _seen(scenes, i, best, drawn, links) if len(views) else None,
        "values": values if links.static else {},
    }


def _drawn(scenes: Scenes, grasps: Rows) -> int | None:
    """Return the row of the grasp that is drawn into the views: the best, if it holds."""
    held = scenes.data.tables["grasps"]["held"]
    return int(grasps[0]) if len(grasps) and held[grasps[0]] else None


def _seen(scenes: Scenes, i: int, k: int, drawn: int | None, links: Links) -> dict[str, Any]:
    """Return a view of a scene, the k-th, and where it sees a grasp's palm and contacts."""
    view = int(scenes.views(i)[k])
    dots, palm = [], []
    if drawn is not None:
        grasps, row = scenes.data.grasps_in(view, frame="camera"), drawn - scenes.data.rows_in(i)[0]
        K = scenes.data.tables["views"]["K"][view].reshape(3, 3)
        p_CQ, nhat, X_CG = (
            grasps[name][row].astype(float) for name in ("p_AQ", "nhat_Q_A", "X_AG")
        )
        visible, near = grasps["visible"][row], scenes.data.near
        dots = dots_of(K, p_CQ, nhat, near, lambda finger, u, v: not visible[finger])
        # A dot with a line, too, in the place of a contact.
        along = PALM / ARROW * X_CG[None, :3, 2]
        palm = dots_of(K, X_CG[None, :3, 3], along, near, lambda finger, u, v: False)
    return {
        "href": links.view(scenes.labels[i], k),
        "size": scenes.data.image_size,
        "kind": VIEW_KINDS[scenes.data.tables["views"]["kind"][view]],
        "dots": [dot for dot in dots if _is_finite(dot)],
        "palm": [dot for dot in palm if _is_finite(dot)],
    }


def _is_finite(dot: Dot) -> bool:
    return bool(np.isfinite([dot.u, dot.v, dot.tip_u, dot.tip_v]).all())


def _visible(scenes: Scenes, i: int, grasps: Rows) -> npt.NDArray[np.bool_]:
    """Return which views (v,) of a scene see the contacts (v, g, k) of some of its grasps (g,)."""
    places = grasps - scenes.data.rows_in(i)[:1]
    return np.array([scenes.data.visible_in(view)[places] for view in scenes.views(i).tolist()])


def _lines(
    scenes: Scenes, i: int, grasps: Rows, links: Links, with_pages: frozenset[int] | None
) -> list[dict[str, Any]]:
    """Return the lines of the table of grasps."""
    table, lines = scenes.data.tables["grasps"], []
    seen = _visible(scenes, i, grasps).sum(axis=0) if len(grasps) else np.zeros((0, 0))
    for row, views in zip(grasps.tolist(), seen.tolist(), strict=True):
        trial, weight = int(table["trial_id"][row]), float(table["weight"][row])
        page = with_pages is None or trial in with_pages
        # As on the pages of grasps: how it holds, else why it does not.
        words = [name for name in ("stable", "precision", "held") if table[name][row]][:1]
        words = words or [Outcome(int(table["outcome"][row])).label.replace("_", " ")]
        words += ["sample"] * bool(table["sample"][row])
        lines.append(
            {
                "trial": trial,
                "href": links.grasp(scenes.snapshot.label(trial)) if page else "",
                "holds": _holds(table, row),
                "outcome": ", ".join(words),
                "weight": f"{weight:.2f}" if table["sample"][row] else "–",
                "seen": views,
            }
        )
    return lines


def _holds(table: Mapping[str, npt.NDArray[Any]], row: int) -> tuple[str, str, str]:
    """Return what the labels of a grasp say of it: HOLDS, FAILS or UNKNOWN."""
    if table["held"][row]:
        return HOLDS
    return FAILS if table["tested"][row] else UNKNOWN


def _facts(scenes: Scenes, i: int) -> list[tuple[str, str]]:
    """Return lines of name and value of what lies on the table."""
    values = {name: column[i] for name, column in scenes.data.tables["scenes"].items()}
    x, y = unpack_pose(values["X_TO"][0])[:2, 3]
    return [
        ("mass", Shown("", "kg", 3).text(values["mass"][0])),
        ("friction with the hand", f"{values['friction_hand'][0]:.3f}"),
        ("friction with the table", f"{values['friction_table'][0]:.3f}"),
        ("share of the drops that end so", f"{100.0 * values['probability'][0]:.0f} %"),
        ("place on the table", f"({1e3 * x:.0f}, {1e3 * y:.0f}) mm"),
    ]


def _scene3d(scenes: Scenes, i: int, grasps: Rows, hand: HandView) -> dict[str, Any]:
    """Return the 3D view: the hands of the best grasps, and more palms, in {T}."""
    table = scenes.data.tables["grasps"]
    X_TO = unpack_pose(scenes.data.tables["scenes"]["X_TO"][i, 0])
    X_TG = unpack_pose(table["X_TG"][grasps].astype(float))
    known = np.isfinite(X_TG).all(axis=(1, 2)) & np.isfinite(table["q"][grasps]).all(axis=1)

    # The hands of the best ones, with their contacts.
    states: dict[str, Any] = {}
    for row, X in zip(grasps[known][:HANDS].tolist(), X_TG[known], strict=False):
        points, normals, forces = (
            table[name][row].astype(float) for name in ("p_TQ", "nhat_Q_T", "f_Q_T")
        )
        states[f"trial {table['trial_id'][row]}"] = {
            "links": hand.poses(X, table["q"][row].astype(float), 0.0),
            "contacts": contacts_in_table(points, normals, forces, np.eye(4)),
        }

    # The palms of more.
    palms = [
        {"p": X[:3, 3].tolist(), "z": X[:3, 2].tolist(), "colour": _holds(table, row)[2]}
        for row, X in zip(grasps[known][:PALMS].tolist(), X_TG[known], strict=False)
    ]
    if not states:
        states["no grasp"] = {"links": [], "contacts": []}
    found = make_scene(scenes.snapshot, int(scenes.objects[i]), X_TO, states, hand)
    return found | {"palms": palms}
