"""The web application: its addresses, its changes, and its protection against others.

Every answer forbids scripts, styles and requests other than to the server itself. The Host header
must name this machine, so a foreign name that resolves to this machine (DNS rebinding) gets
nothing. Files are only changed by a POST with the token of this run, which only our own pages know.
"""

from __future__ import annotations

import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware, RequestResponseEndpoint
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from drakegrasp.dataset.paths import ASSEMBLED_FILES
from drakegrasp.dataset.rejections import (
    REJECT_FILE,
    AttemptKey,
    Decisions,
    read_decisions,
    write_decisions,
)
from drakegrasp.dataset.trials import stamp
from drakegrasp.errors import DataError, DrakegraspError, printable
from drakegrasp.foreign_files import parse_json
from drakegrasp.page.attempts import AttemptGallery
from drakegrasp.page.gallery import Gallery, render
from drakegrasp.page.predictions import Predictions, result_file
from drakegrasp.page.renders import HandView, arm_surface, object_surface, read_render
from drakegrasp.page.scenes import Clutter, Scenes
from drakegrasp.page.snapshot import read_snapshot
from drakegrasp.pictures.style import strip_png

ASSETS = Path(__file__).parent / "static"
#: The only address that the server listens on.
LOOPBACK = "127.0.0.1"
#: Names of this machine that a browser may have requested.
HOSTS = (LOOPBACK, "localhost")
TOKEN_HEADER = "x-drakegrasp-token"
HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}
#: Tables of files that a command makes from a dataset.
MADE: tuple[type[Scenes], ...] = (Scenes, Clutter)
#: Maximum size of a POST [B].
MAX_BODY = 4096
Params: TypeAlias = Mapping[str, str]


class Step(NamedTuple):
    """A change of the decision on an attempt."""

    key: AttemptKey
    before: str
    after: str


class DecisionFile:
    """`reject.json` of a dataset, which is read before each change, and written with it.

    Args:
        out: Directory of the dataset.

    Raises:
        DataError: If the file exists and cannot be read.
    """

    def __init__(self, out: Path) -> None:
        self._path = out / REJECT_FILE
        self._lock = threading.Lock()
        self._last: Step | None = None
        self.read()

    def read(self) -> Decisions:
        """Return the decisions on disk.

        Raises:
            DataError: If the file cannot be read.
        """
        return read_decisions(self._path)

    def decide(self, key: AttemptKey, decision: str) -> Decisions:
        """Write a decision and return all decisions including it.

        Args:
            key: The attempt.
            decision: `rejected`, or empty text to withdraw that.

        Raises:
            ValueError: If the text is not a decision.
            DataError: If the file is no longer a list of rejections.
            OSError: If the file cannot be written.
        """
        with self._lock:
            decisions = self.read()
            before, changed = decisions.of(key), decisions.with_decision(key, decision)
            if decision != before:
                write_decisions(self._path, changed)
                self._last = Step(key, before, decision)
            return changed

    def undo(self) -> Step | None:
        """Withdraw the last decision and return it; None if there is none, or it stands no more.

        Raises:
            DataError: If the file is no longer a list of rejections.
            OSError: If the file cannot be written.
        """
        with self._lock:
            last, self._last = self._last, None
            decisions = self.read()
            if last is None or decisions.of(last.key) != last.after:
                return None
            write_decisions(self._path, decisions.with_decision(last.key, last.before))
            return last


class Inspection:
    """A dataset on the pages: its attempts, its scenes, and predictions for its rows.

    Args:
        out: Directory of the dataset.
        results: File of the verdicts on predictions for the dataset's rows, if there is one.

    Raises:
        DataError: If the directory contains no dataset, if one of its files, its `reject.json` or
            the verdicts cannot be read, or if the verdicts belong to another dataset.
    """

    def __init__(self, out: Path, results: Path | None = None) -> None:
        found = None if results is None else result_file(results)
        made = (kind.FILE for kind in MADE)
        watched = [*(out / name for name in (*ASSEMBLED_FILES, *made)), found]
        self._stamps = {path: stamp(path) for path in watched if path is not None}
        self.snapshot = read_snapshot(out)
        self.decisions = DecisionFile(out)
        self.hand = HandView(self.snapshot.config)
        self.token = secrets.token_urlsafe(24)
        self._fixed: dict[type[Gallery], Gallery] = {}
        if found is not None:
            self._fixed[Predictions] = Predictions(found, self.snapshot)
        self._lock = threading.Lock()

    def galleries(self) -> list[type[Gallery]]:
        """Return the galleries that there are."""
        found: list[type[Gallery]] = [AttemptGallery]
        if Predictions in self._fixed:
            found.append(Predictions)
        return found + [kind for kind in MADE if os.path.lexists(self.snapshot.out / kind.FILE)]

    def table(self, kind: type[Gallery]) -> Gallery:
        """Return the present state of a table.

        Raises:
            HTTPException: If there is no such table.
            DataError: If its file cannot be read, or belongs to another dataset.
        """
        if kind not in self.galleries():
            how = f"drakegrasp {kind.HOME[1:]} makes them" if kind in MADE else "give --predictions"
            raise HTTPException(404, f"there are no {kind.NOUN}s: {how}")
        if kind is AttemptGallery:
            return AttemptGallery(self.snapshot, self.decisions.read(), self.token)
        with self._lock:
            if kind not in self._fixed and issubclass(kind, Scenes):
                self._fixed[kind] = kind(self.snapshot)
            return self._fixed[kind]

    def validate_unchanged(self) -> None:
        """Raise an error if a file is no longer the one that was read.

        Raises:
            DataError: If a file was replaced.
        """
        for path, before in self._stamps.items():
            if stamp(path) != before:
                raise DataError(
                    f"{path}: must stay while it is shown, got another; run inspect again"
                )

    def warm_up(self) -> None:
        """Load everything that the first page would have to wait for."""
        # The hand loads Drake, the first picture Matplotlib, and the first page its templates.
        _ = self.hand.surfaces
        image, mask = np.zeros((4, 2, 2), np.float32), np.zeros((2, 2), np.uint8)
        strip_png(image, mask, far=1.0)
        _gallery(AttemptGallery, self, "", {})


# Answers: pages, pictures and meshes, by the {name} in their addresses.


def _gallery(kind: type[Gallery], inspection: Inspection, name: str, params: Params) -> Response:
    table, query = inspection.table(kind), kind.query(params)
    chosen = table.select(query)
    return HTMLResponse(table.gallery_page(query, chosen, inspection.galleries()))


def _row(kind: type[Gallery], inspection: Inspection, name: str, params: Params) -> Response:
    table, query = inspection.table(kind), kind.query(params)
    i = _there(table.find(name), kind.NOUN)
    page = table.row_page(i, query, table.select(query), inspection.galleries(), inspection.hand)
    return HTMLResponse(page)


def _view(kind: type[Scenes], inspection: Inspection, name: str, params: Params) -> Response:
    scenes = inspection.table(kind)
    assert isinstance(scenes, Scenes)
    scene, _, number = name.partition("-")
    views = scenes.views(_there(scenes.find(scene), "scene"))
    known = {str(k): int(view) for k, view in enumerate(views)}
    png = scenes.picture(_there(known.get(number), "view"))
    return Response(png, media_type="image/png")


def _strip(inspection: Inspection, name: str, params: Params) -> Response:
    snapshot = inspection.snapshot
    number, _, camera = name.rpartition("-")
    i = inspection.table(AttemptGallery).find(number)
    found = _there(None if i is None else read_render(snapshot, i, camera), "image")
    png = strip_png(found.image, found.mask, far=snapshot.config.camera.far)
    return Response(png, media_type="image/png")


def _mesh(inspection: Inspection, name: str, params: Params) -> Response:
    content = None
    kind, _, which = name.partition("-")
    try:
        if kind == "link":
            content = inspection.hand.surfaces[int(which)]
        elif kind == "object":
            content = object_surface(inspection.snapshot, int(which))
    except (IndexError, ValueError, FileNotFoundError):
        pass
    return Response(_there(content, "mesh"), media_type="application/json")


def _arm(inspection: Inspection, name: str, params: Params) -> Response:
    number, _, arm = name.partition("-")
    i = _there(inspection.table(AttemptGallery).find(number), "grasp")
    content = arm_surface(inspection.snapshot, i, arm)
    return Response(_there(content, "arm at this grasp"), media_type="application/json")


def _there(found: Any, noun: str) -> Any:
    """Return `found` unless it is None.

    Raises:
        HTTPException: If it is None.
    """
    if found is None:
        raise HTTPException(404, f"there is no such {noun}")
    return found


Answer: TypeAlias = Callable[[Inspection, str, Params], Response]
#: All tables.
KINDS: tuple[type[Gallery], ...] = (AttemptGallery, Predictions, *MADE)
#: Function that answers each address: galleries and rows of tables, and parts of pages.
PAGES: dict[str, Answer] = {
    **{kind.HOME: partial(_gallery, kind) for kind in KINDS},
    **{f"/{kind.ROW}/{{name}}": partial(_row, kind) for kind in KINDS},
    **{f"{kind.VIEWS}/{{name}}.png": partial(_view, kind) for kind in MADE},
    "/strip/{name}.png": _strip,
    "/mesh/{name}.json": _mesh,
    "/arm/{name}.json": _arm,
}


# Changes.


def _decide(inspection: Inspection, content: dict[str, Any]) -> Response:
    table, decision = inspection.table(AttemptGallery), content.get("decision")
    i = table.find(str(content.get("label")))
    if i is None or not table.table.lifted[i]:
        raise HTTPException(404, "the attempt must be a success of the dataset")
    if decision not in ("rejected", ""):
        raise HTTPException(400, f"decision must be rejected or empty, got {decision!r}")
    found = inspection.decisions.decide(inspection.snapshot.key(i), decision)
    counts = AttemptGallery(inspection.snapshot, found).counts()
    return JSONResponse({"label": i, "decision": decision, "counts": counts})


def _undo(inspection: Inspection, content: dict[str, Any]) -> Response:
    undone = inspection.decisions.undo()
    if undone is None:
        return JSONResponse({"name": None})
    return JSONResponse(
        {
            "name": printable(str(undone.key)),
            "label": inspection.snapshot.find(undone.key),
            "decision": undone.before,
            "counts": AttemptGallery(inspection.snapshot, inspection.decisions.read()).counts(),
        }
    )


# The application.


def make_app(inspection: Inspection) -> Starlette:
    """Return the web application of an inspection."""

    def get(path: str, show: Answer) -> Route:
        async def endpoint(request: Request) -> Response:
            name = request.path_params.get("name", "")
            inspection.validate_unchanged()
            answer = await run_in_threadpool(show, inspection, name, request.query_params)
            inspection.validate_unchanged()
            return answer

        return Route(path, endpoint)

    def post(path: str, change: Callable[[Inspection, dict[str, Any]], Response]) -> Route:
        async def endpoint(request: Request) -> Response:
            content = await _content(request, inspection.token)
            inspection.validate_unchanged()
            return await run_in_threadpool(change, inspection, content)

        return Route(path, endpoint, methods=["POST"])

    app = Starlette(
        routes=[
            *(get(path, show) for path, show in PAGES.items()),
            post("/decide", _decide),
            post("/undo", _undo),
            Mount("/static", StaticFiles(directory=ASSETS)),
        ],
        middleware=[
            Middleware(BaseHTTPMiddleware, dispatch=_secured),
            Middleware(TrustedHostMiddleware, allowed_hosts=list(HOSTS), www_redirect=False),
        ],
        exception_handlers=dict.fromkeys((HTTPException, DrakegraspError, OSError), _error),
    )
    app.state.inspection = inspection
    return app


async def _secured(request: Request, call_next: RequestResponseEndpoint) -> Response:
    """Return the answer to a request, with the HEADERS that it lacks."""
    answer = await call_next(request)
    for name, value in HEADERS.items():
        answer.headers.setdefault(name, value)
    return answer


async def _content(request: Request, token: str) -> dict[str, Any]:
    """Return the JSON of a POST, which must have the token."""
    given = request.headers.get(TOKEN_HEADER, "")
    if not secrets.compare_digest(given.encode(), token.encode()):
        raise HTTPException(403, "the token must be that of this page; load it again")
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MAX_BODY:
            raise HTTPException(413, f"the request must be at most {MAX_BODY} bytes")
    try:
        content = parse_json(body or b"{}")
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise HTTPException(400, "the request must be JSON with names and values")
    return content


def _error(request: Request, error: Exception) -> Response:
    """Return an error as JSON for a script, or as a page for a person."""
    status, text = 400 if isinstance(error, DataError) else 500, str(error)
    if isinstance(error, HTTPException):
        status, text = error.status_code, str(error.detail)
    if request.method == "POST":
        return JSONResponse({"error": text}, status_code=status)
    page = render("error.html", [], title="error", text=text)
    return HTMLResponse(page, status_code=status)


# Serving, to this machine only.


def serve(
    out: Path,
    *,
    results: Path | None = None,
    port: int,
    browser: bool,
    announce: Callable[[str], None],
) -> None:
    """Serve the pages of a dataset until Ctrl-C.

    Args:
        out: Directory of the dataset.
        results: File of the verdicts on predictions for the dataset's rows, if there is one.
        port: TCP port; 0 takes any free port.
        browser: Whether to open a browser.
        announce: Called with the address as soon as the server answers.

    Raises:
        DataError: If there is no dataset, the verdicts belong to another dataset, or the port is
            taken.
    """
    # Check everything first; the page must be fast from its first request on.
    inspection = Inspection(out, results)
    with listen(port) as listener:
        inspection.warm_up()
        page = "" if results is None else "predictions"
        address = f"http://{LOOPBACK}:{listener.getsockname()[1]}/{page}"
        announce(address)
        if browser and has_screen():
            webbrowser.open(address)
        config = uvicorn.Config(make_app(inspection), log_level="warning", access_log=False)
        uvicorn.Server(config).run(sockets=[listener])


def listen(port: int) -> socket.socket:
    """Return a socket that listens on the loopback address.

    Raises:
        DataError: If the port is taken, or needs rights that this process does not have.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise DataError(
            f"--port must be free on this machine, got {port} ({error.strerror}); "
            "--port 0 takes any that is"
        ) from None
    return listener


def has_screen() -> bool:
    """Return whether a browser would open a window instead of taking over the terminal."""
    if sys.platform == "darwin":
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
