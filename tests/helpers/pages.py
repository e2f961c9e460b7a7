"""HTML pages and their 3D data, read as a browser reads them."""

from __future__ import annotations

import base64
import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import trimesh
from starlette.testclient import TestClient

from drakegrasp.page.catalog import Snapshot

#: A name that must stay text.
ATTACK = "<script>alert(1)</script>"


def state_of(client: TestClient) -> Snapshot:
    """The state of the files that an application shows."""
    found: Snapshot = client.app.state.inspection.catalog.current()  # type: ignore[attr-defined]
    return found


def coded(snapshot: Snapshot, text: str) -> str:
    """Return an address or a label with the codes of objects where it has their numbers.

    `/grasp/0-3-2` is the page of object 0, palm pose 3, stand-off 2.
    """

    def code(found: re.Match[str]) -> str:
        number = int(found[1])
        return snapshot.codes[number] if number < len(snapshot.codes) else found[0]

    return re.sub(r"\b(\d+)(?=-\d+-\d)", code, text)


def get(client: TestClient, address: str) -> Any:
    """Return the answer to an address with numbers for the codes of objects, see `coded`."""
    return client.get(coded(state_of(client), address))


def surface_of(content: bytes | str) -> trimesh.Trimesh:
    """Return the parts of an object or a link that the 3D view draws, as one mesh."""
    parts = []
    for part in json.loads(content):
        assert re.fullmatch("#[0-9a-f]{6}", part["colour"])
        vertices = np.frombuffer(base64.b64decode(part["vertices"]), dtype="<f4").reshape(-1, 3)
        faces = np.frombuffer(base64.b64decode(part["faces"]), dtype="<u4").reshape(-1, 3)
        parts.append(trimesh.Trimesh(vertices, faces, process=False))
    return trimesh.util.concatenate(parts)


def numbered(snapshot: Snapshot, text: str) -> str:
    """Return a text with the numbers of objects for their codes: what `coded` was given."""
    for number, code in enumerate(snapshot.codes):
        text = text.replace(code, str(number))
    return text


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
