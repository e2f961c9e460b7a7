"""The cluster that a user asks for: found by its name, described, and entered."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

from distributed import Client

from drakegrasp import registry
from drakegrasp.cluster.connect import dashboard_line
from drakegrasp.cluster.jobqueue import jobs_of
from drakegrasp.cluster.kinds import Local
from drakegrasp.errors import ConfigError


def cluster_of(kind: str, own: Sequence[str] = (), **options: Any) -> Local:
    """Return the requested cluster, without starting anything.

    Args:
        kind: Name of the kind in the registry.
        own: `KEY=VALUE` texts of settings that only this kind has.
        options: Options of all kinds, see the attributes of `Local`.

    Raises:
        ConfigError: If options contradict each other, or an option is missing.
        MachineError: If a package is missing.
    """
    found = registry.find("clusters", kind)
    if hasattr(found, "job_cls"):  # of dask-jobqueue, which may not be installed
        found = jobs_of(found)
    if not (isinstance(found, type) and issubclass(found, Local)):
        raise ConfigError(f"clusters: {kind} must be a subclass of Local, got {found!r}")
    given = {}
    for text in own:
        key, _, value = text.partition("=")
        if key not in found.settings or not value:
            known = ", ".join(found.settings)
            wanted = f"KEY=VALUE with KEY one of {known}" if known else "left out"
            raise ConfigError(f"--with must be {wanted} for --cluster {kind}, got {text!r}")
        given[key] = value
    cluster: Local = found(kind=kind, own=given, **options)
    return cluster


def describe(cluster: Local) -> list[str]:
    """Return lines for the user that describe the cluster, with a warning about an open port."""
    lines = [cluster.line(), f"connections: {'TLS' if cluster.tls else 'not encrypted'}"]
    if not cluster.tls:
        lines.append(
            "warning: anybody who reaches the scheduler's port can run programs as you; leave out "
            "--no-tls"
        )
    return lines


@contextmanager
def present(cluster: AbstractContextManager[Client], show: bool) -> Iterator[Client]:
    """Enter a cluster, print the address of its dashboard, and wait for its first worker."""
    with cluster as client:
        if show and client.dashboard_link:  # workers on this machine have none
            sys.stderr.write(f"{dashboard_line(client)}\n")
        if not client.nthreads():
            sys.stderr.write("waiting for the first worker\n")
            client.wait_for_workers(1)
        yield client
