"""Kinds of clusters by name, as `drakegrasp submit --cluster` takes them.

Input: the options of a kind. Output: lines for the user, and a Dask client while a block runs. A
kind is a line in pyproject.toml, with a class of dask-jobqueue or a subclass of `Local`. For every
other cluster start its workers yourself, and pass a client to the call (`client=`).
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from dask.utils import parse_bytes
from distributed import Client

from drakegrasp.cluster.connect import chosen_security, connect, validate_tls
from drakegrasp.errors import ConfigError, counted
from drakegrasp.runtime.executor import count_workers

#: Options of which a kind may take some.
OPTIONS: tuple[str, ...] = ("workers", "cores", "memory", "walltime", "host", "interface")
#: Maximum memory of a worker [B], more than any machine has.
MOST_MEMORY = 10**15


@dataclass(kw_only=True)
class Local:
    """Workers on this machine, as on the command line; the base class of all kinds.

    Attributes:
        options: Names of the options that the kind takes.
        settings: Names of the settings that only this kind has.
        kind: Name of the kind in the registry.
        own: Texts of such settings by name.
        workers: Total number of processes.
        cores: Number of cores of each job, with a worker on each.
        memory: Memory of each worker, e.g. "2GB".
        walltime: Time limit of each job, as the batch scheduler writes it.
        host: Address on which the scheduler listens.
        interface: Name of the network interface on which scheduler and workers listen.
        tls: Whether connections need a certificate.
        tls_files: Files in PEM format that every machine sees: authority, certificate and
            private key. Without them, certificates are created for this run if workers are started.
    """

    options: ClassVar[tuple[str, ...]] = ("workers", "memory")
    settings: ClassVar[tuple[str, ...]] = ()
    kind: str
    own: dict[str, str] = field(default_factory=dict)
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
        for name in OPTIONS:
            if getattr(self, name) is not None and name not in self.options:
                raise ConfigError(f"--{name} must not be given with --cluster {self.kind}")
        for name in ("workers", "cores"):
            count_workers(getattr(self, name), name)
        if self.memory is not None:
            memory_bytes(self.memory)
        chosen_security(self.tls, self.tls_files, elsewhere=type(self) is not Local)

    def line(self) -> str:
        """Return a description of what will be started."""
        count = self.workers
        return f"{counted(count, 'worker')} on this machine" if count else "workers on this machine"

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
        return connect(self.workers, tls=self.tls, tls_files=self.tls_files, memory=self.memory)


@dataclass(kw_only=True)
class Running(Local):
    """The workers of a running scheduler.

    Attributes:
        address: Address of the scheduler.
        file: File that the scheduler wrote, instead of its address.
    """

    options: ClassVar[tuple[str, ...]] = ()
    kind: str = "scheduler"
    address: str | None = None
    file: Path | None = None

    def __post_init__(self) -> None:
        """Reject options that contradict each other, and an address that wants no certificate."""
        super().__post_init__()
        if self.address is not None:
            validate_tls(self.address, self.tls)

    def line(self) -> str:
        """Return a description of the workers that will be used."""
        return f"the workers of {self.address or self.file}"

    def connected(self, out: Path) -> AbstractContextManager[Client]:
        """Return a context manager that connects to the scheduler and yields a client."""
        return connect(
            scheduler=self.address, scheduler_file=self.file, tls=self.tls, tls_files=self.tls_files
        )


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
