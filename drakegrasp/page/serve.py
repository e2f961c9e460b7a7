"""Serves an inspection on this machine, to this machine only."""

from __future__ import annotations

import asyncio
import os
import socket
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

from drakegrasp.errors import DataError
from drakegrasp.page.app import Inspection, make_app

#: The only address that the server listens on.
LOOPBACK = "127.0.0.1"
#: Time limit for a request to arrive completely [s].
REQUEST_SECONDS = 30.0


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
        config = server_config(make_app(inspection))
        announce(address)
        if browser and has_screen():
            webbrowser.open(address)
        uvicorn.Server(config).run(sockets=[listener])


def server_config(app: Any) -> uvicorn.Config:
    """Return the server's configuration for an ASGI app."""
    return uvicorn.Config(app, http=_TimedProtocol, log_level="warning", access_log=False)


class _TimedProtocol(H11Protocol):
    """HTTP that closes a connection if a request does not arrive completely in time.

    uvicorn (0.54) would wait for the rest of a request forever.
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request."""
        super().connection_made(transport)
        self._await_request()

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        super().on_response_complete()
        self._await_request()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._stop_waiting()
        super().connection_lost(exc)

    def _await_request(self) -> None:
        self._stop_waiting()
        self._deadline = self.loop.call_later(REQUEST_SECONDS, self._close_if_unfinished)

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()

    def _close_if_unfinished(self) -> None:
        # A complete request is being answered.
        if self.conn.their_state in (h11.IDLE, h11.SEND_BODY):
            self.transport.close()


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
