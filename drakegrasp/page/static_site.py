"""The pages as files that a browser opens without a server.

In: a dataset, and results of predictions for its rows. Out: a folder with `index.html`, a page per
success, their images and meshes; `predictions.html` and a page per prediction; `scenes.html` and a
page per scene. A page of a file may
load no other file but scripts, styles and pictures, so each mesh is a script that holds its JSON.
Decisions are shown and cannot be changed.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drakegrasp.dataset.rejections import FILE_NAME, Decisions, read_decisions
from drakegrasp.dataset.schema import CAMERAS
from drakegrasp.errors import DataError
from drakegrasp.page.app import ASSETS
from drakegrasp.page.catalog import Catalog, Snapshot
from drakegrasp.page.grasp_page import grasp_page
from drakegrasp.page.links import FileLinks
from drakegrasp.page.pages import Places, gallery_page, render
from drakegrasp.page.plots import PLOTS, plot_svg, plots_values
from drakegrasp.page.predictions.pages import prediction_page, predictions_page
from drakegrasp.page.predictions.query import PredictionQuery, select_predictions
from drakegrasp.page.predictions.results import Predictions, ResultFile
from drakegrasp.page.query import Query, select
from drakegrasp.page.rows import read_look, read_rows
from drakegrasp.page.scene3d import HandView, object_surface, scene_of
from drakegrasp.page.scenes.file import SceneFile, Scenes
from drakegrasp.page.scenes.pages import scene_page, scenes_page
from drakegrasp.page.scenes.query import SceneQuery, select_scenes
from drakegrasp.pictures.thumbnails import strip_png
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.runtime.progress import Report, silent

#: Grasps, and predictions, that are written at most: a browser must hold all cards at once.
MAX_GRASPS = 2000
#: Scenes that are written at most: each has many images.
MAX_SCENES = 100


@dataclass(frozen=True)
class Site:
    """What was written.

    Attributes:
        grasps: Number of successes with a page.
        successes: Number of all successes.
    """

    grasps: int
    successes: int


def write_site(
    out: Path, folder: Path, *, results: Path | None = None, progress: Report = silent
) -> Site:
    """Write the pages of a dataset's successes, of predictions and of scenes, as files.

    Scenes that cannot be read are left out, and the pages say why.

    Args:
        out: Directory of the dataset.
        folder: Where to write; it must be new or empty, and appears when it is complete.
        results: File of the verdicts on predictions for its rows, if there is one.
        progress: Called with the number of pages written and to write.

    Raises:
        DataError: If there is no dataset, it has no success, the verdicts are not of it, the folder
            holds other files, or the dataset is assembled anew meanwhile.
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
    predictions = None if results is None else ResultFile(results).current(snapshot)
    scenes, why = _scenes_of(snapshot)
    snapshot = replace(snapshot, missing=(*why, *snapshot.missing))
    if len(places) < len(successes):
        cut = f"Only the {len(places):,} most suspicious of {len(successes):,} successes are here."
        snapshot = replace(snapshot, missing=(cut, *snapshot.missing))

    with atomic_folder(folder) as unfinished:
        site = _Writer(snapshot, unfinished, predictions, scenes)
        total = len(places) + len(site.worst) + len(site.richest)
        site.write_grasps(decisions, query, places, lambda done: progress(done, total))
        if predictions is not None:
            site.write_predictions(predictions, lambda done: progress(len(places) + done, total))
        if scenes is not None:
            before = total - len(site.richest)
            site.write_scenes(scenes, lambda done: progress(before + done, total))
        snapshot.refuse_replaced()
    return Site(grasps=len(places), successes=len(successes))


def _scenes_of(snapshot: Snapshot) -> tuple[Scenes | None, tuple[str, ...]]:
    """Return the scenes of a dataset, if there are any, and why they are not shown."""
    file = SceneFile(snapshot.out)
    try:
        return file.current(snapshot) if file.is_there else None, ()
    except DataError as error:
        return None, (f"Scenes are left out: {error}",)


class _Writer:
    """Writes pages, and all that they need, into an empty folder.

    Args:
        snapshot: State of the files.
        folder: Where to write.
        predictions: Beside its rows, if there are any.
        scenes: Likewise.
    """

    def __init__(
        self,
        snapshot: Snapshot,
        folder: Path,
        predictions: Predictions | None,
        scenes: Scenes | None,
    ) -> None:
        self._snapshot, self._folder = snapshot, folder
        self._there = predictions is not None
        self._hand = HandView(snapshot.config)
        self._seen: set[int] = set()
        self._meshes: set[int] = set()
        #: The predictions that are written, in their order.
        self.worst = np.zeros(0, dtype=np.int32)
        if predictions is not None:
            self.worst = select_predictions(predictions, PredictionQuery())[:MAX_GRASPS]
        #: The scenes that are written, in their order.
        self.richest = np.zeros(0, dtype=np.int32)
        if scenes is not None:
            self.richest = select_scenes(scenes, SceneQuery())[:MAX_SCENES]

        # What all pages share.
        shutil.copytree(ASSETS, folder / "static", ignore=shutil.ignore_patterns("__pycache__"))
        for number in range(len(self._hand.links)):
            _write_mesh(folder, f"link-{number}", self._hand.surface(number))
        for name in PLOTS:
            _write(folder / "plot" / f"{name}.svg", plot_svg(snapshot, name) or b"")
        plots = render("plots.html", self._links(), token="", **plots_values(snapshot))
        _write_text(folder / "plots.html", plots)

    def write_grasps(
        self, decisions: Decisions, query: Query, places: Places, wrote: Callable[[int], None]
    ) -> None:
        """Write the pages of attempts with their images, and the gallery last."""
        snapshot, links = self._snapshot, self._links("../")
        for done, i in enumerate(places.tolist(), start=1):
            (row,) = read_rows(snapshot, [i])
            scene = scene_of(snapshot, i, row, self._hand)
            page = grasp_page(
                *(snapshot, decisions, query, places, i, scene, self._hand.problem, links),
                token="",
            )
            _write_text(self._folder / "grasp" / f"{snapshot.label(i)}.html", page)
            self._write_look(i)
            wrote(done)
        gallery = gallery_page(snapshot, decisions, query, places, self._links(), token="")
        _write_text(self._folder / "index.html", gallery)

    def write_predictions(self, predictions: Predictions, wrote: Callable[[int], None]) -> None:
        """Write the pages of predictions with the images of their rows, and their gallery last."""
        query, links = PredictionQuery(), self._links("../")
        with_pages = frozenset(self._seen)
        for done, i in enumerate(self.worst.tolist(), start=1):
            at = int(predictions.places[i])
            page = prediction_page(
                *(predictions, query, self.worst, i, self._hand, links), row_link=at in with_pages
            )
            _write_text(self._folder / "prediction" / f"{predictions.label(i)}.html", page)
            self._write_look(at)
            wrote(done)
        gallery = predictions_page(predictions, query, self.worst, self._links())
        _write_text(self._folder / "predictions.html", gallery)

    def write_scenes(self, scenes: Scenes, wrote: Callable[[int], None]) -> None:
        """Write the pages of scenes with their images, and their gallery last."""
        query, links = SceneQuery(), self._links("../")
        with_pages = frozenset(self._seen)
        for done, i in enumerate(self.richest.tolist(), start=1):
            page = scene_page(
                *(scenes, query, self.richest, i, self._hand, links), with_pages=with_pages
            )
            _write_text(self._folder / "scene" / f"{scenes.labels[i]}.html", page)
            for k, view in enumerate(scenes.views(i).tolist()):
                _write(self._folder / "view" / f"{scenes.labels[i]}-{k}.png", scenes.png(view))
            self._write_object(int(scenes.objects[i]))
            wrote(done)
        _write_text(
            self._folder / "scenes.html", scenes_page(scenes, query, self.richest, self._links())
        )

    def _links(self, up: str = "") -> FileLinks:
        return FileLinks(up, predicted=self._there, scened=len(self.richest) > 0)

    def _write_look(self, i: int) -> None:
        """Write the images of an attempt and the mesh of its object, once."""
        snapshot = self._snapshot
        if i not in self._seen:
            for camera in CAMERAS:
                look = read_look(snapshot, i, camera)
                if look is not None:
                    png = strip_png(look.image, look.mask, far=snapshot.config.camera.far)
                    _write(self._folder / "strip" / f"{snapshot.label(i)}-{camera}.png", png)
        self._seen.add(i)
        self._write_object(int(snapshot.table.object[i]))

    def _write_object(self, number: int) -> None:
        """Write the mesh of an object, once."""
        if number not in self._meshes:
            surface = object_surface(self._snapshot, number)
            if surface is not None:
                code = self._snapshot.codes[number]
                _write_mesh(self._folder, f"object-{code}", surface)
        self._meshes.add(number)


def _write_mesh(folder: Path, name: str, surface: bytes) -> None:
    script = b'window.drakegraspMeshes["%b"] = %b;\n' % (name.encode(), surface)
    _write(folder / "mesh" / f"{name}.js", script)


def _write_text(path: Path, text: str) -> None:
    _write(path, text.encode())


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
