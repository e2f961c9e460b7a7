"""Serves an inspection on this machine, to this machine only."""

from __future__ import annotations

import os
import socket
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path

import uvicorn

from drakegrasp.errors import DataError
from drakegrasp.page.app import Inspection, make_app

#: The only address that the server listens on.
LOOPBACK = "127.0.0.1"


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
