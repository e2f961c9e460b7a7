"""The pages as files that a browser opens without a server.

In: a dataset. Out: a folder with `index.html`, a page per success, their images and meshes. A page
of a file may load no other file but scripts, styles and pictures, so each mesh is a script that
holds its JSON. Decisions are shown and cannot be changed.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drakegrasp.dataset.rejections import FILE_NAME, Decisions, read_decisions
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.errors import DataError
from drakegrasp.inspection.app import ASSETS
from drakegrasp.inspection.catalog import Catalog, Snapshot
from drakegrasp.inspection.grasp_page import grasp_page
from drakegrasp.inspection.links import FileLinks
from drakegrasp.inspection.pages import Places, gallery_page, render
from drakegrasp.inspection.plots import PLOTS, plot_svg, plots_values
from drakegrasp.inspection.query import Query, select
from drakegrasp.inspection.rows import read_look, read_rows
from drakegrasp.inspection.scene3d import HandView, object_surface, scene_of
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.visualization.thumbnails import strip_png

#: Grasps that are written at most, the most suspicious: a browser must show all cards at once.
MAX_GRASPS = 2000


@dataclass(frozen=True)
class Site:
    """What was written.

    Attributes:
        grasps: Number of successes with a page.
        successes: Number of all successes.
    """

    grasps: int
    successes: int


def write_site(out: Path, folder: Path, *, progress: Report = silent) -> Site:
    """Write the pages of a dataset's successes as files.

    Args:
        out: Directory of the dataset.
        folder: Where to write; it must be new or empty, and appears when it is complete.
        progress: Called with the number of grasps written and to write.

    Raises:
        DataError: If there is no dataset, it has no success, the folder holds other files, or the
            dataset is assembled anew meanwhile.
    """
    # Refuse what cannot be done before anything is written.
    decisions = read_decisions(out / FILE_NAME)
    catalog = Catalog(out)
    snapshot, query = catalog.current(), Query()
    successes = select(snapshot, query, decisions)
    places = successes[:MAX_GRASPS]
    if not len(places):
        raise DataError(f"{out}: must hold at least one success to show, got none")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(f"--static must be a new or empty directory, got {folder}")
    if len(places) < len(successes):
        cut = f"Only the {len(places):,} most suspicious of {len(successes):,} successes are here."
        snapshot = replace(snapshot, missing=(cut, *snapshot.missing))

    with atomic_folder(folder) as unfinished:
        _write_pages(snapshot, decisions, query, places, unfinished, progress)
        snapshot.refuse_replaced()
    return Site(grasps=len(places), successes=len(successes))


def _write_pages(
    snapshot: Snapshot,
    decisions: Decisions,
    query: Query,
    places: Places,
    folder: Path,
    progress: Report,
) -> None:
    """Write the pages of attempts, and all that they need, into an empty folder."""
    # What all pages share.
    hand = HandView(snapshot.config)
    shutil.copytree(ASSETS, folder / "static", ignore=shutil.ignore_patterns("__pycache__"))
    _write_meshes(snapshot, folder, hand, places)
    for name in PLOTS:
        _write(folder / "plot" / f"{name}.svg", plot_svg(snapshot, name) or b"")
    plots = render("plots.html", FileLinks(), token="", **plots_values(snapshot))
    _write_text(folder / "plots.html", plots)

    # The pages of the grasps with their images, and the gallery last.
    links = FileLinks("../")
    for done, i in enumerate(places.tolist(), start=1):
        label = snapshot.label(i)
        (row,) = read_rows(snapshot, [i])
        scene = scene_of(snapshot, i, row, hand)
        page = grasp_page(
            snapshot, decisions, query, places, i, scene, hand.problem, links, token=""
        )
        _write_text(folder / "grasp" / f"{label}.html", page)
        for camera in CAMERAS:
            look = read_look(snapshot, i, camera)
            if look is not None:
                png = strip_png(look.image, look.mask, far=snapshot.config.camera.far)
                _write(folder / "strip" / f"{label}-{camera}.png", png)
        progress(done, len(places))
    gallery = gallery_page(snapshot, decisions, query, places, FileLinks(), token="")
    _write_text(folder / "index.html", gallery)


def _write_meshes(snapshot: Snapshot, folder: Path, hand: HandView, places: Places) -> None:
    """Write the meshes of the hand's links and of the objects of attempts, each as a script."""
    for number in range(len(hand.links)):
        _write_mesh(folder, f"link-{number}", hand.surface(number))
    for number in np.unique(snapshot.table.object[places]).tolist():
        surface = object_surface(snapshot, number)
        if surface is not None:
            _write_mesh(folder, f"object-{snapshot.codes[number]}", surface)


def _write_mesh(folder: Path, name: str, surface: bytes) -> None:
    script = b'window.drakegraspMeshes["%b"] = %b;\n' % (name.encode(), surface)
    _write(folder / "mesh" / f"{name}.js", script)


def _write_text(path: Path, text: str) -> None:
    _write(path, text.encode())


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
