"""The pages as files that a browser opens without a server: the server's pages, in a folder.

Input: a dataset, and results of predictions for its rows. Output: `index.html` and all pages that
it links to, with the images, meshes and plots that they need. Decisions are shown but cannot be
changed.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from starlette.exceptions import HTTPException

from drakegrasp.errors import DataError
from drakegrasp.page.app import ASSETS, Inspection, answer
from drakegrasp.page.attempts import Attempts
from drakegrasp.page.catalog import Snapshot
from drakegrasp.page.gallery import Gallery, Places, Query, Site, file_of
from drakegrasp.page.predictions import Predictions
from drakegrasp.page.scenes import Scenes
from drakegrasp.runtime.files import atomic_folder
from drakegrasp.runtime.progress import Report, silent

#: Maximum number of grasps and of predictions: a browser must hold all cards at once.
MAX_GRASPS = 2000
#: Maximum number of scenes, each of which has many images.
MAX_SCENES = 100


class Written(NamedTuple):
    """Summary of the written pages.

    Attributes:
        grasps: Number of successes with a page.
        successes: Number of all successes.
    """

    grasps: int
    successes: int


def write_site(
    out: Path, folder: Path, *, results: Path | None = None, progress: Report = silent
) -> Written:
    """Write the pages of a dataset's successes, of predictions and of scenes, as files.

    Scenes that cannot be read are left out, and the pages state why.

    Args:
        out: Directory of the dataset.
        folder: Folder to write to; it must be new or empty, and appears when it is complete.
        results: File of the verdicts on predictions for the dataset's rows, if there is one.
        progress: Called with the number of written pages and the number of all pages.

    Raises:
        DataError: If there is no dataset, if it has no success, if the verdicts belong to another
            dataset, if the folder contains files, or if the dataset is assembled again in the
            meantime.
    """
    # Check everything before anything is written.
    files = _Files(out, results)
    if not files.rows[Attempts]:
        raise DataError(f"{out}: must hold at least one success to show, got none")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(f"--static must be a new or empty directory, got {folder}")

    # Write the pages of rows, then the galleries, then everything that these need.
    rows = [address for addresses in files.rows.values() for address in addresses]
    with atomic_folder(folder) as unfinished:
        shutil.copytree(ASSETS, unfinished / "static", ignore=shutil.ignore_patterns("__pycache__"))
        for done, address in enumerate(rows, start=1):
            files.write(unfinished, [address])
            progress(done, len(rows))
        files.write(unfinished, [kind.HOME for kind in files.rows])
        files.write_asked(unfinished)
        files.snapshot().refuse_replaced()
    return Written(grasps=len(files.rows[Attempts]), successes=files.successes)


class _Files(Inspection):
    """An inspection of one state of the files, whose pages become files.

    Attributes:
        rows: For each table, addresses of the rows that have a page.
        successes: Number of all successes.
    """

    def __init__(self, out: Path, results: Path | None) -> None:
        super().__init__(out, results)
        self._state, self._site = self.catalog.current(), replace(super().site(), up="")
        self.token = ""  # no decisions on pages that are files
        self._chosen: dict[type[Gallery], Places] = {}
        self._written: set[str] = set()
        self.rows: dict[type[Gallery], list[str]] = {}

        # The first rows of each table; the gallery states how many are left out.
        missing = self._state.missing
        self.successes = self._choose(Attempts, MAX_GRASPS)
        if self._site.predicted:
            self._choose(Predictions, MAX_GRASPS)
        try:
            if self._site.scened:
                self._choose(Scenes, MAX_SCENES)
        except DataError as error:
            missing = (f"Scenes are left out: {error}", *missing)
        here = len(self.rows[Attempts])
        if here < self.successes:
            cut = f"Only the {here:,} most suspicious of {self.successes:,} successes are here."
            missing = (cut, *missing)
        self._state = replace(self._state, missing=missing)
        grasps = frozenset(self.rows[Attempts])
        self._site = replace(self._site, scened=Scenes in self.rows, grasps=grasps)

    def snapshot(self) -> Snapshot:
        """Return the state of the files that the pages show."""
        return self._state

    def site(self) -> Site:
        """Return the position of the page that is being written."""
        return self._site

    def select(self, table: Gallery, query: Query) -> Places:
        """Return the rows that have a page."""
        return self._chosen[type(table)]

    def write(self, folder: Path, addresses: Iterable[str]) -> None:
        """Write the pages of addresses into a folder, each once."""
        for address in addresses:
            if address in self._written:
                continue
            self._written.add(address)
            if address.startswith("/static/"):
                continue
            self._site = replace(self._site, up="../" * (address.count("/") - 1))
            try:
                content = bytes(answer(self, address).body)
            except HTTPException:
                continue  # an image or a mesh that does not exist
            path = folder / file_of(address)
            if path.suffix == ".js":
                content = b'window.drakegraspMeshes["%b"] = %b;\n' % (path.stem.encode(), content)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)

    def write_asked(self, folder: Path) -> None:
        """Write everything that the written pages need, and what that needs in turn."""
        while left := self._site.asked - self._written:
            self.write(folder, sorted(left))

    def _choose(self, kind: type[Gallery], most: int) -> int:
        """Choose the rows of a table that get a page; return the number of all rows."""
        table = self.table(kind)
        places = table.select(kind.query())
        self._chosen[kind] = places[:most]
        self.rows[kind] = [f"/{kind.ROW}/{table.label(i)}" for i in places[:most].tolist()]
        return len(places)
