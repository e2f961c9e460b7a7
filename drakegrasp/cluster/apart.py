"""A separate process that calls functions for a Dask worker: a crash does not kill the worker.

Input: a pickled pair of a function and the `FileTask` to call it with. Output: the pickled result.
If workers do not see the files of the dataset, the journal of a task (`drakegrasp.runtime.journal`)
is in the worker's own directory. So the worker must survive when the process dies. It starts a new
process, which finds the journal and continues.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import psutil

from drakegrasp.errors import MachineError

#: Time between two checks of the memory of the process [s].
LOOK_SECONDS = 0.1
_NAME = "drakegrasp.cluster.apart"


class ApartError(Exception):
    """The process died."""


class ProcessApart:
    """A process that runs one call after the other until it dies or is closed.

    Its caches, e.g. of scenes, are kept between calls.
    """

    def __init__(self, folder: Path) -> None:
        """Start the process.

        Args:
            folder: Working directory of the process.
        """
        self._connection, theirs = Pipe()
        with theirs:
            number = theirs.fileno()
            command = [sys.executable, "-P", "-m", _NAME, str(number)]
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, pass_fds=[number], cwd=folder
            )

    def call(self, request: bytes, folder: Path, memory: float) -> bytes:
        """Return the pickled result of a request.

        Args:
            request: A pickled function and its item.
            folder: Folder with copies of the files that the task reads.
            memory: Maximum memory of the process [byte]. A process that exceeds it is killed, as a
                nanny kills its worker.

        Raises:
            ApartError: If the process died.
            Exception: The error that the function raised.
        """
        try:
            self._connection.send((request, folder))
            while not self._connection.poll(LOOK_SECONDS):
                with suppress(psutil.Error):
                    if psutil.Process(self._process.pid).memory_info().rss > memory:
                        self._process.kill()
            failed, content = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError):
            self.close()
            raise ApartError from None
        if failed:
            raise pickle.loads(content)
        return bytes(content)

    def close(self) -> None:
        """End the process."""
        self._connection.close()
        self._process.kill()
        self._process.wait()


def main(connection: Connection) -> None:
    """Serve the worker's requests until it closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the client stops its workers
    threading.Thread(target=_end_with, args=[connection.fileno()], daemon=True).start()
    with suppress(EOFError, ConnectionError):
        while True:
            connection.send_bytes(pickle.dumps(_answer(*connection.recv())))


def _answer(request: bytes, folder: Path) -> tuple[bool, bytes]:
    """Return whether a call failed, and its pickled result or error."""
    try:
        function, item = pickle.loads(request)
        return False, pickle.dumps(function(item.moved(folder)))
    except Exception as error:
        return True, _pickled_error(error)


def _pickled_error(error: Exception) -> bytes:
    try:
        content = pickle.dumps(error)
        pickle.loads(content)
    except Exception:
        return pickle.dumps(MachineError(f"{type(error).__name__}: {error}"))
    return content


def _end_with(descriptor: int) -> None:
    """End this process when the worker has ended, even during a call."""
    poll = select.poll()
    poll.register(descriptor, 0)
    poll.poll()
    os._exit(1)


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])))
