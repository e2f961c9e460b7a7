"""Kinds of clusters by name, as `drakegrasp submit --cluster` takes them.

Input: the options of a kind. Output: lines for the user, and a Dask client while a block runs. A
kind is a class in its own module and a line in pyproject.toml; the kinds for this machine and for a
running scheduler are in this module. Workers on other machines do not inherit settings, so each
kind sends them `dask_settings`. Other machines can connect only if `host` or `interface` allows it.
"""

from __future__ import annotations

import ipaddress
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import dask
from dask.utils import parse_bytes
from distributed import Client, SpecCluster
from distributed.security import Security

from drakegrasp import registry
from drakegrasp.cluster.certificates import (
    chosen_security,
    make_certificates,
    private_directory,
    security_of,
)
from drakegrasp.cluster.connect import (
    LOOPBACK,
    closing_cluster,
    connect,
    dashboard_line,
    dask_settings,
    refuse_open,
)
from drakegrasp.errors import ConfigError, MachineError, counted

#: Largest number of workers or cores, more than any cluster has.
MOST = 1_000_000
#: Options of a cluster on other machines.
REMOTE = ("workers", "cores", "memory", "host", "interface")
#: Maximum memory of a worker [B], more than any machine has.
MOST_MEMORY = 10**15
#: Names of hosts and interfaces, and addresses; they become words of a shell on other machines.
_PLAIN = re.compile(r"[A-Za-z0-9_:\[][A-Za-z0-9_.:%@\[\]-]*")


class AddressMissingError(ConfigError):
    """The address at which a scheduler for workers on other machines listens is not stated."""


@dataclass(kw_only=True)
class Local:
    """Workers on this machine, as on the command line; the base class of all kinds.

    Attributes:
        follow: How many words follow the name of the kind on the command line (minimum, maximum),
            and what they are.
        options: Names of the options that the kind has.
        kind: Name of the kind in the registry.
        where: Names of hosts, the address of a scheduler, or the path of a scheduler's file.
        workers: Total number of processes.
        cores: Number of cores of each host or job, with a worker on each.
        memory: Memory of each worker, e.g. "2GB".
        walltime: Time limit of each job, as SLURM writes it: [D-]HH:MM:SS.
        host: Address on which the scheduler listens.
        interface: Name of the network interface on which scheduler and workers listen.
        tls: Whether connections need a certificate.
        tls_files: Files in PEM format that every machine sees: authority, certificate and
            private key. Without them, certificates are created for this run if workers are started.
    """

    follow: ClassVar[tuple[int, float, str]] = (0, 0, "nothing")
    options: ClassVar[tuple[str, ...]] = ("workers", "memory")
    kind: str
    where: tuple[str, ...] = ()
    workers: int | None = None
    cores: int | None = None
    memory: str | None = None
    walltime: str | None = None
    host: str | None = None
    interface: str | None = None
    tls: bool = True
    tls_files: tuple[Path, Path, Path] | None = None

    def __post_init__(self) -> None:
        """Reject options that are not possible for this kind.

        Raises:
            ConfigError: If options contradict each other, or an option is missing.
            MachineError: If a package is missing.
        """
        least, most, what = self.follow
        if not least <= len(self.where) <= most:
            got = " ".join(self.where) or "nothing"
            raise ConfigError(f"--cluster {self.kind} must be followed by {what}, got {got}")
        for name in (*REMOTE, "walltime"):
            value = getattr(self, name)
            if value is not None and name not in self.options:
                raise ConfigError(f"--{name} must not be given with --cluster {self.kind}")
            if name in ("workers", "cores") and value is not None and value < 1:
                raise ConfigError(f"{name} must be at least 1, got {value}")
            if name in ("workers", "cores") and value is not None and value > MOST:
                raise ConfigError(f"{name} must be at most {MOST:,}, got {value}")
            if name in ("host", "interface") and value is not None:
                refuse_unplain(name, value)
        chosen_security(self.tls, self.tls_files, elsewhere=type(self) is not Local)
        if self.memory is not None:
            memory_bytes(self.memory)

    @classmethod
    def elsewhere(cls) -> str:
        """Return where the user states what no option states, as the end of an error message."""
        return ""

    def line(self) -> str:
        """Return a description of what will be started."""
        count = self.workers
        return f"{counted(count, 'worker')} on this machine" if count else "workers on this machine"

    def is_open(self) -> bool:
        """Return whether other machines can reach the scheduler that is started."""
        return False

    def script(self, out: Path) -> str:
        """Return the script of a job that starts workers; empty if there is none.

        Args:
            out: Directory of the dataset.
        """
        return ""

    def submission(self) -> str:
        """Return the command that submits the script."""
        return ""

    def connected(self, out: Path) -> AbstractContextManager[Client]:
        """Return a context manager that starts the workers and yields a client.

        Args:
            out: Directory that all machines see; certificates for this run are written there.
        """
        return connect(self.workers, tls_files=self.tls_files, memory=self.memory)


class Running(Local):
    """The workers of a running scheduler, given by its address."""

    follow, options, how = (1, 1, "its address"), (), "scheduler"

    def __post_init__(self) -> None:
        """Reject options that are not possible, and an address that wants no certificate."""
        super().__post_init__()
        if self.how == "scheduler":
            refuse_open(self.where[0], self.tls)

    def line(self) -> str:
        """Return a description of the workers that will be used."""
        return f"the workers of {' '.join(self.where)}"

    def connected(self, out: Path) -> AbstractContextManager[Client]:
        """Return a context manager that connects to the scheduler and yields a client."""
        found: dict[str, Any] = {self.how: self.where[0]}
        return connect(**found, tls=self.tls, tls_files=self.tls_files)


class RunningFile(Running):
    """The workers of a running scheduler, given by the file that it wrote."""

    follow, how = (1, 1, "its path"), "scheduler_file"


class Remote(Local):
    """Workers that are started on other machines, by the method `start` of each kind."""

    options: ClassVar[tuple[str, ...]] = REMOTE

    def start(self, security: Security | None) -> SpecCluster:
        """Start scheduler and workers."""
        raise NotImplementedError

    def listens(self) -> bool:
        """Return whether the user's settings state where the scheduler listens."""
        return False

    def listening(self) -> dict[str, str]:
        """Return the options that state where a scheduler listens; empty if user settings do.

        Raises:
            AddressMissingError: If neither options nor user settings state where to listen.
        """
        for name in ("host", "interface"):
            if (value := getattr(self, name)) is not None:
                return {name: value}
        if self.where and all(map(is_loopback, self.where)):
            return {"host": LOOPBACK}
        if self.listens():
            return {}
        raise AddressMissingError(
            "--interface NAME or --host ADDRESS must be given for workers on other machines: "
            "without them, the scheduler listens on this machine only"
        )

    def workers_listening(self) -> dict[str, str]:
        """Return the options that state where workers listen."""
        listening = self.listening()
        # Without options, a worker chooses an address at which other machines reach it.
        here = "interface" in listening or is_loopback(listening.get("host", ""))
        return listening if here else {}

    def is_open(self) -> bool:
        """Return whether other machines reach the scheduler that is started."""
        listening = self.listening()
        return not is_loopback(listening.get("host", "")) and listening.get("interface") != "lo"

    @contextmanager
    def connected(self, out: Path) -> Iterator[Client]:
        """Run the cluster while the block runs; its certificates are removed afterwards."""
        with self._security(out) as security, dask.config.set(dask_settings()):
            try:
                cluster = self.start(security)
            except (ConfigError, MachineError):
                raise
            # Each kind of cluster raises its own errors; report them all as errors of the machine.
            except Exception as error:
                reason = str(error) or type(error).__name__
                raise MachineError(f"the workers did not start: {reason}") from None
            with closing_cluster(cluster), Client(cluster) as client:
                yield client

    @contextmanager
    def _security(self, out: Path) -> Iterator[Security | None]:
        if self.tls and self.tls_files is None:
            with private_directory(out) as folder:
                yield security_of(make_certificates(folder))
        else:
            yield chosen_security(self.tls, self.tls_files, elsewhere=True)


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
    if not (isinstance(found, type) and issubclass(found, Local)):
        raise ConfigError(f"clusters: {kind} must be a subclass of Local, got {found!r}")
    known = [f.name for f in fields(found) if f.name not in Local.__dataclass_fields__]
    for text in own:
        key, equals, value = text.partition("=")
        if key not in known or not (equals and value):
            settings = f"KEY=VALUE with KEY one of {', '.join(known)}" if known else "left out"
            raise ConfigError(
                f"--with must be {settings} for --cluster {kind}, got {text!r}{found.elsewhere()}"
            )
        options[key] = value
    cluster: Local = found(kind=kind, **options)
    return cluster


def describe(cluster: Local) -> list[str]:
    """Return lines for the user that describe the cluster, with a warning about an open port."""
    tls = cluster.tls
    lines = [cluster.line(), f"connections: {'TLS' if tls else 'not encrypted'}"]
    if not tls and cluster.is_open():
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


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached only from this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def refuse_unplain(name: str, text: str) -> None:
    """Reject what cannot be a host, an address or an interface.

    Raises:
        ConfigError: If it has other characters than these have.
    """
    if not _PLAIN.fullmatch(text):
        raise ConfigError(f"{name} must be a name or an address, got {text[:40]!r}")


def memory_bytes(text: str) -> int:
    """Return a size of memory such as "2GB" in bytes.

    Raises:
        ConfigError: If the text is not a valid size.
    """
    try:
        size = int(parse_bytes(text)) if text.strip() and text.isascii() else 0
    except (ValueError, OverflowError):
        size = 0
    if not 0 < size <= MOST_MEMORY:
        raise ConfigError(f"memory must be a size such as 2GB, got {text[:40]!r}")
    return size
