"""The web application: addresses, and what keeps other sites and machines out.

Every answer forbids scripts, styles and requests other than to the server itself. The Host header
must name this machine, so a foreign name that resolves to it (DNS rebinding) gets nothing. What
changes a file is a POST with the token of this run, which only our own pages know.
"""

from __future__ import annotations

import secrets
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from drakegrasp.errors import DataError, DrakegraspError, printable
from drakegrasp.foreign_files import parse_json
from drakegrasp.outcomes import Outcome
from drakegrasp.page.catalog import Catalog, Snapshot
from drakegrasp.page.decisions import DecisionFile
from drakegrasp.page.grasp_page import grasp_page
from drakegrasp.page.links import ServerLinks
from drakegrasp.page.pages import gallery_page, render
from drakegrasp.page.plots import plot_svg, plots_values
from drakegrasp.page.predictions.pages import prediction_page, predictions_page
from drakegrasp.page.predictions.query import parse_prediction_query, select_predictions
from drakegrasp.page.predictions.results import Predictions, ResultFile
from drakegrasp.page.query import Query, count_decisions, parse_query, select
from drakegrasp.page.recording import Recordings
from drakegrasp.page.rows import read_look, read_rows
from drakegrasp.page.scene3d import HandView, object_surface, scene_of
from drakegrasp.page.scenes.file import SceneFile, Scenes
from drakegrasp.page.scenes.pages import scene_page, scenes_page
from drakegrasp.page.scenes.query import parse_scene_query, select_scenes
from drakegrasp.pictures.thumbnails import strip_png

ASSETS = Path(__file__).parent / "static"
#: Names of this machine that a browser may have asked for.
HOSTS = ("127.0.0.1", "localhost")
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
#: A recording holds its own scripts; it runs without access to this server or any other.
RECORDING_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'unsafe-eval' data: blob:; style-src "
    "'unsafe-inline'; img-src data: blob:; connect-src data: blob:; worker-src blob:; "
    "sandbox allow-scripts"
)
#: Longest text that a POST may have [B].
MAX_BODY = 4096
#: Selections that are kept in memory, and attempts in all of them together: four bytes each.
KEPT_SELECTIONS, KEPT_PLACES = 16, 10_000_000


class Inspection:
    """The state of a running inspection.

    Args:
        out: Directory of the dataset.
        results: File of the verdicts on predictions for its rows, if there is one.

    Raises:
        DataError: If the directory holds no dataset, its `reject.json` or the verdicts cannot be
            read, or the verdicts are not of this dataset.
    """

    def __init__(self, out: Path, results: Path | None = None) -> None:
        self.catalog = Catalog(out)
        self.results = None if results is None else ResultFile(results)
        if self.results is not None:
            self.results.current(self.catalog.current())
        self.decisions = DecisionFile(out)
        self.hand = HandView(self.catalog.current().config)
        self.recordings = Recordings(out)
        self.scenes = SceneFile(out)
        self.token = secrets.token_urlsafe(24)
        self._lock = threading.Lock()
        self._selections: OrderedDict[Any, npt.NDArray[np.int32]] = OrderedDict()
        self._selected_from: Snapshot | None = None

    @property
    def links(self) -> ServerLinks:
        """Addresses; scenes may be made while the pages are looked at."""
        return ServerLinks(predicted=self.results is not None, scened=self.scenes.is_there)

    def selection(self, snapshot: Snapshot, query: Query) -> npt.NDArray[np.int32]:
        """Return the attempts that a query selects; the last selections are remembered."""
        decisions = self.decisions.read()
        key = (query.identity, decisions if query.decision else None)
        with self._lock:
            if self._selected_from is not snapshot:
                self._selections.clear()
                self._selected_from = snapshot
            if key in self._selections:
                self._selections.move_to_end(key)
                return self._selections[key]
        places = select(snapshot, query, decisions)
        with self._lock:
            if self._selected_from is snapshot:
                self._selections[key] = places
            while len(self._selections) > KEPT_SELECTIONS or (
                len(self._selections) > 1 and sum(map(len, self._selections.values())) > KEPT_PLACES
            ):
                self._selections.popitem(last=False)
        return places

    def warm_up(self) -> None:
        """Load what the first page would have to wait for."""
        # The hand loads Drake, the first picture Matplotlib, the first page its templates.
        _ = self.hand.links
        image, mask = np.zeros((4, 2, 2), np.float32), np.zeros((2, 2), np.uint8)
        strip_png(image, mask, far=1.0)
        snapshot, query = self.catalog.current(), Query()
        places, decisions = self.selection(snapshot, query), self.decisions.read()
        gallery_page(snapshot, decisions, query, places, self.links, self.token)


def make_app(inspection: Inspection) -> Starlette:
    """Return the web application of an inspection."""

    def route(path: str, answer: Callable[[Inspection, Request], Response]) -> Route:
        async def endpoint(request: Request) -> Response:
            return await run_in_threadpool(answer, inspection, request)

        return Route(path, endpoint)

    def post(path: str, answer: Callable[[Inspection, dict[str, Any]], Response]) -> Route:
        return Route(path, partial(_post, inspection, answer), methods=["POST"])

    @asynccontextmanager
    async def lifespan(app: Starlette) -> AsyncIterator[None]:
        yield
        inspection.recordings.close()

    app = Starlette(
        lifespan=lifespan,
        routes=[
            route("/", _gallery),
            route("/grasp/{label}", _grasp),
            route("/strip/{label}-{camera:str}.png", _strip),
            route("/mesh/{kind}-{name}.json", _mesh),
            route("/predictions", _predictions),
            route("/prediction/{label}", _prediction),
            route("/scenes", _scenes),
            route("/scene/{label}", _scene),
            route("/view/{label}-{number:int}.png", _view),
            route("/plots", _plots),
            route("/plot/{name}.svg", _plot),
            route("/recording/{label}.html", _recording),
            post("/decide", _decide),
            post("/undo", _undo),
            post("/record", _record),
            Mount("/static", StaticFiles(directory=ASSETS)),
        ],
        middleware=[
            Middleware(SecurityHeaders),
            Middleware(TrustedHostMiddleware, allowed_hosts=list(HOSTS), www_redirect=False),
        ],
        exception_handlers={
            HTTPException: _http_error,
            DrakegraspError: _data_error,
            OSError: _data_error,
        },
    )
    app.state.inspection = inspection
    return app


class SecurityHeaders:
    """Adds HEADERS to every answer that does not have them."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""

        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                there = {name.lower() for name, _ in message["headers"]}
                new = [(k.encode(), v.encode()) for k, v in HEADERS.items()]
                message["headers"] = [*message["headers"], *(h for h in new if h[0] not in there)]
            await send(message)

        await self._app(scope, receive, send_with_headers)


# Pages


def _gallery(inspection: Inspection, request: Request) -> Response:
    snapshot, query = inspection.catalog.current(), parse_query(request.query_params)
    places = inspection.selection(snapshot, query)
    decisions = inspection.decisions.read()
    return HTMLResponse(
        gallery_page(snapshot, decisions, query, places, inspection.links, inspection.token)
    )


def _grasp(inspection: Inspection, request: Request) -> Response:
    snapshot, query = inspection.catalog.current(), parse_query(request.query_params)
    i = _place(snapshot, request)
    places = inspection.selection(snapshot, query)
    (row,) = read_rows(snapshot, [i])
    scene = scene_of(snapshot, i, row, inspection.hand)
    return HTMLResponse(
        grasp_page(
            snapshot,
            inspection.decisions.read(),
            query,
            places,
            i,
            scene,
            inspection.hand.problem,
            inspection.links,
            inspection.token,
        )
    )


def _plots(inspection: Inspection, request: Request) -> Response:
    snapshot = inspection.catalog.current()
    values = plots_values(snapshot)
    return HTMLResponse(render("plots.html", inspection.links, token="", **values))


def _predictions(inspection: Inspection, request: Request) -> Response:
    predictions = _predicted(inspection)
    query = parse_prediction_query(request.query_params)
    chosen = select_predictions(predictions, query)
    return HTMLResponse(predictions_page(predictions, query, chosen, inspection.links))


def _prediction(inspection: Inspection, request: Request) -> Response:
    predictions = _predicted(inspection)
    i = predictions.find(request.path_params["label"])
    if i is None:
        raise HTTPException(404, "there is no such prediction")
    query = parse_prediction_query(request.query_params)
    chosen = select_predictions(predictions, query)
    page = prediction_page(predictions, query, chosen, i, inspection.hand, inspection.links)
    return HTMLResponse(page)


def _predicted(inspection: Inspection) -> Predictions:
    if inspection.results is None:
        raise HTTPException(404, "there are no predictions; give drakegrasp inspect --predictions")
    return inspection.results.current(inspection.catalog.current())


def _scenes(inspection: Inspection, request: Request) -> Response:
    scenes, query = _scened(inspection), parse_scene_query(request.query_params)
    chosen = select_scenes(scenes, query)
    return HTMLResponse(scenes_page(scenes, query, chosen, inspection.links))


def _scene(inspection: Inspection, request: Request) -> Response:
    scenes, i = _found_scene(inspection, request)
    query = parse_scene_query(request.query_params)
    chosen = select_scenes(scenes, query)
    return HTMLResponse(scene_page(scenes, query, chosen, i, inspection.hand, inspection.links))


def _found_scene(inspection: Inspection, request: Request) -> tuple[Scenes, int]:
    """Return the scenes, and the number of the one that a request names."""
    scenes = _scened(inspection)
    i = scenes.numbers.get(request.path_params["label"])
    if i is None:
        raise HTTPException(404, "there is no such scene")
    return scenes, i


def _scened(inspection: Inspection) -> Scenes:
    if not inspection.scenes.is_there:
        raise HTTPException(404, "there are no scenes; drakegrasp scenes makes them")
    return inspection.scenes.current(inspection.catalog.current())


# Pictures and meshes


def _view(inspection: Inspection, request: Request) -> Response:
    scenes, i = _found_scene(inspection, request)
    views, number = scenes.views(i), request.path_params["number"]
    if number >= len(views):
        raise HTTPException(404, "there is no such view")
    return Response(scenes.png(int(views[number])), media_type="image/png")


def _strip(inspection: Inspection, request: Request) -> Response:
    snapshot = inspection.catalog.current()
    label, _, camera = f"{request.path_params['label']}-{request.path_params['camera']}".rpartition(
        "-"
    )
    i = snapshot.find(label)
    look = None if i is None else read_look(snapshot, i, camera)
    if look is None:
        raise HTTPException(404, "there is no such image")
    png = strip_png(look.image, look.mask, far=snapshot.config.camera.far)
    return Response(png, media_type="image/png")


def _mesh(inspection: Inspection, request: Request) -> Response:
    snapshot = inspection.catalog.current()
    kind, name = request.path_params["kind"], request.path_params["name"]
    content = None
    try:
        if kind == "link":
            content = inspection.hand.surface(int(name))
        elif kind == "object":
            content = object_surface(snapshot, snapshot.numbers[name])
    except (IndexError, KeyError, ValueError, FileNotFoundError):
        pass
    if content is None:
        raise HTTPException(404, "there is no such mesh")
    return Response(content, media_type="application/json")


def _plot(inspection: Inspection, request: Request) -> Response:
    svg = plot_svg(inspection.catalog.current(), request.path_params["name"])
    if svg is None:
        raise HTTPException(404, "there is no such plot")
    # A standalone SVG: inline styles only.
    policy = "default-src 'none'; style-src 'unsafe-inline'"
    return Response(svg, media_type="image/svg+xml", headers={"content-security-policy": policy})


def _recording(inspection: Inspection, request: Request) -> Response:
    content = inspection.recordings.read(request.path_params["label"])
    if content is None:
        raise HTTPException(404, "there is no such recording")
    return HTMLResponse(content, headers={"content-security-policy": RECORDING_POLICY})


# Decisions


async def _post(
    inspection: Inspection,
    answer: Callable[[Inspection, dict[str, Any]], Response],
    request: Request,
) -> Response:
    """Answer a POST of JSON that has the token."""
    given = request.headers.get(TOKEN_HEADER, "")
    if not secrets.compare_digest(given.encode(), inspection.token.encode()):
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
    return await run_in_threadpool(answer, inspection, content)


def _decide(inspection: Inspection, content: dict[str, Any]) -> Response:
    snapshot = inspection.catalog.current()
    i, decision = _success(snapshot, content), content.get("decision")
    try:
        decisions = inspection.decisions.decide(snapshot.key(i), str(decision), _page(content))
    except ValueError as error:
        raise HTTPException(400, str(error)) from None
    counts = count_decisions(snapshot, decisions)
    return JSONResponse({"label": snapshot.label(i), "decision": decision, "counts": counts})


def _undo(inspection: Inspection, content: dict[str, Any]) -> Response:
    undo = inspection.decisions.undo(_page(content))
    if undo is None:
        return JSONResponse({"name": None})
    snapshot = inspection.catalog.current()
    place = snapshot.find_key(undo.key)
    return JSONResponse(
        {
            "name": printable(str(undo.key)),
            "label": None if place is None else snapshot.label(place),
            "decision": undo.decision,
            "done": undo.done,
            "counts": count_decisions(snapshot, inspection.decisions.read()),
        }
    )


def _record(inspection: Inspection, content: dict[str, Any]) -> Response:
    snapshot = inspection.catalog.current()
    i = snapshot.find(str(content.get("label")))
    trial = None if i is None else snapshot.trial_id(i)
    if trial is None:
        raise HTTPException(404, "the attempt must be a row of trials.hdf5")
    label = str(content.get("label"))
    found = inspection.recordings.make(label, trial)
    return JSONResponse({"url": f"/recording/{label}.html", "same": found.same, "text": found.text})


def _page(content: dict[str, Any]) -> str:
    """Return which page of a browser sends a request: its decisions are undone together."""
    return str(content.get("page", ""))[:64]


def _success(snapshot: Snapshot, content: dict[str, Any]) -> int:
    """Return the place of a success that a request names."""
    i = snapshot.find(str(content.get("label")))
    if i is None or snapshot.table.outcome[i] != Outcome.SUCCESS:
        raise HTTPException(404, "the attempt must be a success of the dataset")
    return i


def _place(snapshot: Snapshot, request: Request) -> int:
    i = snapshot.find(request.path_params["label"])
    if i is None:
        raise HTTPException(404, "there is no such attempt")
    return i


# Errors


def _http_error(request: Request, error: Exception) -> Response | Awaitable[Response]:
    assert isinstance(error, HTTPException)
    return _error(request, error.status_code, str(error.detail))


def _data_error(request: Request, error: Exception) -> Response | Awaitable[Response]:
    return _error(request, 400 if isinstance(error, DataError) else 500, str(error))


def _error(request: Request, status: int, text: str) -> Response:
    """Return an error as JSON to a script, and as a page to a person."""
    if request.method == "POST":
        return JSONResponse({"error": text}, status_code=status)
    page = render("error.html", ServerLinks(), token="", title="error", text=text)
    return HTMLResponse(page, status_code=status)
