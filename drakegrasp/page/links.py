"""Addresses of pages, pictures and meshes: of the server, and of files that open without one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Links(Protocol):
    """Where a page finds the others."""

    @property
    def static(self) -> bool:
        """Whether the pages are files, without a server."""

    def asset(self, name: str) -> str:
        """Return the address of a script or style sheet."""

    def gallery(self, params: str = "") -> str:
        """Return that of the gallery, with a query."""

    def grasp(self, label: str, params: str = "") -> str:
        """Return that of an attempt's page, with the query that next and previous go through."""

    @property
    def predicted(self) -> bool:
        """Whether there are pages of predictions."""

    def predictions(self, params: str = "") -> str:
        """Return that of the gallery of predictions, with a query."""

    def prediction(self, label: str, params: str = "") -> str:
        """Return that of a prediction's page, with the query that next and previous go through."""

    @property
    def scened(self) -> bool:
        """Whether there are pages of scenes."""

    def scenes(self, params: str = "") -> str:
        """Return that of the gallery of scenes, with a query."""

    def scene(self, label: str, params: str = "") -> str:
        """Return that of a scene's page, with the query that next and previous go through."""

    def view(self, label: str, number: int) -> str:
        """Return that of the image of a scene by one of its cameras."""

    def strip(self, label: str, camera: str) -> str:
        """Return that of an attempt's images."""

    def mesh(self, kind: str, name: str) -> str:
        """Return that of a mesh: an `object` by its code, or a `link` by its number."""

    def plots(self) -> str:
        """Return that of the page of plots."""

    def plot(self, name: str) -> str:
        """Return that of a plot."""


@dataclass(frozen=True)
class ServerLinks:
    """Addresses of the server.

    Attributes:
        predicted, scened: See `Links`.
    """

    predicted: bool = False
    scened: bool = False
    static: bool = False

    def asset(self, name: str) -> str:
        """See `Links`."""
        return f"/static/{name}"

    def gallery(self, params: str = "") -> str:
        """See `Links`."""
        return f"/?{params}" if params else "/"

    def grasp(self, label: str, params: str = "") -> str:
        """See `Links`."""
        return f"/grasp/{label}" + f"?{params}" * bool(params)

    def predictions(self, params: str = "") -> str:
        """See `Links`."""
        return "/predictions" + f"?{params}" * bool(params)

    def prediction(self, label: str, params: str = "") -> str:
        """See `Links`."""
        return f"/prediction/{label}" + f"?{params}" * bool(params)

    def scenes(self, params: str = "") -> str:
        """See `Links`."""
        return "/scenes" + f"?{params}" * bool(params)

    def scene(self, label: str, params: str = "") -> str:
        """See `Links`."""
        return f"/scene/{label}" + f"?{params}" * bool(params)

    def view(self, label: str, number: int) -> str:
        """See `Links`."""
        return f"/view/{label}-{number}.png"

    def strip(self, label: str, camera: str) -> str:
        """See `Links`."""
        return f"/strip/{label}-{camera}.png"

    def mesh(self, kind: str, name: str) -> str:
        """See `Links`."""
        return f"/mesh/{kind}-{name}.json"

    def plots(self) -> str:
        """See `Links`."""
        return "/plots"

    def plot(self, name: str) -> str:
        """See `Links`."""
        return f"/plot/{name}.svg"


@dataclass(frozen=True)
class FileLinks:
    """Addresses among files, relative to the page.

    Attributes:
        up: From the page to the folder of all: empty, or "../".
        predicted, scened: See `Links`.
    """

    up: str = ""
    predicted: bool = False
    scened: bool = False
    static: bool = True

    def asset(self, name: str) -> str:
        """See `Links`."""
        return f"{self.up}static/{name}"

    def gallery(self, params: str = "") -> str:
        """See `Links`; without a server a query has no effect."""
        return f"{self.up}index.html"

    def grasp(self, label: str, params: str = "") -> str:
        """See `Links`; without a server next and previous go through the order of the files."""
        return f"{self.up}grasp/{label}.html"

    def predictions(self, params: str = "") -> str:
        """See `Links`; without a server a query has no effect."""
        return f"{self.up}predictions.html"

    def prediction(self, label: str, params: str = "") -> str:
        """See `Links`."""
        return f"{self.up}prediction/{label}.html"

    def scenes(self, params: str = "") -> str:
        """See `Links`; without a server a query has no effect."""
        return f"{self.up}scenes.html"

    def scene(self, label: str, params: str = "") -> str:
        """See `Links`."""
        return f"{self.up}scene/{label}.html"

    def view(self, label: str, number: int) -> str:
        """See `Links`."""
        return f"{self.up}view/{label}-{number}.png"

    def strip(self, label: str, camera: str) -> str:
        """See `Links`."""
        return f"{self.up}strip/{label}-{camera}.png"

    def mesh(self, kind: str, name: str) -> str:
        """See `Links`: a script that holds the mesh, since a page of a file may read no file."""
        return f"{self.up}mesh/{kind}-{name}.js"

    def plots(self) -> str:
        """See `Links`."""
        return f"{self.up}plots.html"

    def plot(self, name: str) -> str:
        """See `Links`."""
        return f"{self.up}plot/{name}.svg"
