"""HTML pages and their 3D data, read as a browser reads them."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from starlette.testclient import TestClient

from drakegrasp.page.app import Inspection, make_app
from drakegrasp.page.snapshot import IDENTITY, Snapshot

#: A name that must stay text.
ATTACK = "<script>alert(1)</script>"


def inspection_of(client: TestClient) -> Inspection:
    """What an application shows."""
    found: Inspection = client.app.state.inspection  # type: ignore[attr-defined]
    return found


def state_of(client: TestClient) -> Snapshot:
    """The dataset that an application shows."""
    return inspection_of(client).snapshot


def coded(snapshot: Snapshot, text: str) -> str:
    """Return an address or a label with rows of attempts for object, palm pose and stand-off.

    `/grasp/0-3-2` is the page of object 0, palm pose 3, stand-off 2.
    """

    def row(found: re.Match[str]) -> str:
        identities = np.column_stack([snapshot.table[name] for name in IDENTITY])
        (rows,) = np.nonzero((identities == [int(n) for n in found[0].split("-")]).all(axis=1))
        return str(rows[0]) if len(rows) else "999999"

    return re.sub(r"\b\d+-\d+-\d+\b", row, text)


def numbered(snapshot: Snapshot, text: str) -> str:
    """Return a label, or the address of an attempt's page, as `coded` was given it."""

    def label(found: re.Match[str]) -> str:
        i = int(found[0])
        key = snapshot.key(i)
        return f"{snapshot.table.object[i]}-{key.candidate}-{key.standoff_index}"

    return re.sub(r"^\d+$|(?<=^/grasp/)\d+", label, text)


def get(client: TestClient, address: str) -> Any:
    """Return the answer to an address, see `coded`."""
    return client.get(coded(state_of(client), address))


def open_pages(out: Path, results: Path | None = None) -> TestClient:
    """Return the application that shows a dataset, and results for it, as they are now."""
    return TestClient(make_app(Inspection(out, results)), base_url="http://127.0.0.1:8321")


def surface_of(content: bytes | str) -> trimesh.Trimesh:
    """Return the parts of an object or a link that the 3D view draws, as one mesh."""
    parts = []
    for part in json.loads(content):
        assert re.fullmatch("#[0-9a-f]{6}", part["colour"])
        vertices = np.frombuffer(base64.b64decode(part["vertices"]), dtype="<f4").reshape(-1, 3)
        faces = np.frombuffer(base64.b64decode(part["faces"]), dtype="<u4").reshape(-1, 3)
        parts.append(trimesh.Trimesh(vertices, faces, process=False))
    return trimesh.util.concatenate(parts)


def scene_in(page: str) -> dict[str, Any]:
    """Return the scene that the 3D view of a page shows."""
    (text,) = re.findall(r'<script type="application/json" id="scene">(.*?)</script>', page, re.S)
    return dict(json.loads(text)["scene"])


class Tags(HTMLParser):
    """The tags of a page with their attributes, and its text."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data
