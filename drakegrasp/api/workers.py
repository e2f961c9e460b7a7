"""What all public calls do with the workers that they are given."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from drakegrasp.cluster.certificates import chosen_security
from drakegrasp.cluster.connect import connect, dashboard_line, has_dashboard
from drakegrasp.errors import ConfigError
from drakegrasp.runtime.executor import count_workers

if TYPE_CHECKING:
    from distributed import Client


@contextmanager
def announced(cluster: AbstractContextManager[Client], show: bool) -> Iterator[Client]:
    """Enter a cluster and print the link to its dashboard, if it has one."""
    with cluster as client:
        if show and has_dashboard() and client.dashboard_link:
            sys.stderr.write(f"{dashboard_line(client)}\n")
        yield client


def end_imported_script() -> None:
    """End this process if it was started as a worker, and only imports the caller's script.

    Python imports the script into each process that it starts: a call that is not under
    `if __name__ == "__main__"` would begin there, too.
    """
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(1)


def connection(
    workers: int | None,
    scheduler: str | None,
    scheduler_file: str | Path | None,
    tls: bool,
    tls_files: tuple[Path, Path, Path] | None,
) -> AbstractContextManager[Client]:
    """Return what connects to the workers that a caller asks for, when it is entered.

    Args:
        workers: Processes on this machine; one per core if None.
        scheduler: Address of a running scheduler.
        scheduler_file: Its JSON file, instead of the address.
        tls: Whether the scheduler must want a certificate.
        tls_files: Certificate authority, certificate and private key (PEM).

    Raises:
        ConfigError: If the number of workers is below one or given with a scheduler, the address
            is empty, or the choice of TLS contradicts itself.
    """
    if scheduler is not None and not scheduler.strip():
        raise ConfigError(f"scheduler must be an address like tls://host:8786, got {scheduler!r}")
    if workers is not None and (scheduler or scheduler_file):
        raise ConfigError("workers must not be given with a scheduler, which has its own")
    count_workers(workers)
    security = chosen_security(tls, tls_files, elsewhere=bool(scheduler or scheduler_file))
    return connect(workers, scheduler, scheduler_file, security=security, tls=tls)
