"""Kinds of clusters by name, as `drakegrasp submit --cluster` takes them.

Input: the name of a kind and its options. Output: lines for the user, and a Dask client while a
block runs. A kind is a line in pyproject.toml, with a class of dask-jobqueue (extra `[jobqueue]`)
or a subclass of `Local`. For every other cluster start its workers yourself, and pass a client to
the call (`client=`).

The options of a class of dask-jobqueue are the settings of its kind; jobqueue.yaml of the user
states everything else. What is added here: connections need a certificate, a worker is a process of
one thread with Dask's settings of this program, and a lost job is replaced.

dask-jobqueue (0.9) quotes nothing in a script, so the shell would split a path at a blank and run a
command in `$(...)`. Here every text of the command line is a word of the shell.
"""

from __future__ import annotations

import inspect
import json
import math
import shlex
import sys
import types
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import dask
from dask.utils import parse_bytes
from distributed import Client, SpecCluster, Status
from distributed.security import Security
from tornado.ioloop import PeriodicCallback

from drakegrasp import registry
from drakegrasp.cluster.connect import (
    LOOPBACK,
    chosen_security,
    closing_cluster,
    connect,
    dask_settings,
    made_or_given,
    security_of,
    validate_tls,
)
from drakegrasp.errors import ConfigError, MachineError, counted, one_line
from drakegrasp.runtime.executor import count_workers

#: Options of which a kind may take some.
OPTIONS: tuple[str, ...] = ("workers", "cores", "memory", "walltime", "host", "interface")
#: Maximum memory of a worker [B], more than any machine has.
MOST_MEMORY = 10**15
#: Memory of a worker, if neither the user nor jobqueue.yaml states it.
WORKER_MEMORY = "2GB"
#: Time between two checks for lost jobs [s]; a job that is missing twice in a row is lost.
REFILL_SECONDS = 20.0
#: Arguments of every job of dask-jobqueue; the others are the scheduler's own.
_COMMON = ("self", "scheduler", "name", "config_name")


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
        found = type(found.__name__, (Jobs,), {"of": found})
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
def present(cluster: AbstractContextManager[Client]) -> Iterator[Client]:
    """Enter a cluster, and wait for its first worker."""
    with cluster as client:
        if not client.nthreads():
            sys.stderr.write("waiting for the first worker\n")
            client.wait_for_workers(1)
        yield client


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


# Jobs of a batch scheduler


class Jobs(Local):
    """Jobs with several cores each, and a worker on each core; the base of all batch schedulers.

    Attributes:
        of: Class of dask-jobqueue.
    """

    options = OPTIONS
    of: ClassVar[type[Any]]

    def __init_subclass__(cls) -> None:
        """Take the scheduler's own options as settings of the kind."""
        parameters = inspect.signature(cls.of.job_cls.__init__).parameters.values()
        own = [p.name for p in parameters if p.kind is p.POSITIONAL_OR_KEYWORD]
        cls.settings = tuple(name for name in own if name not in (*_COMMON, *OPTIONS))
        cls.options = tuple(name for name in OPTIONS if name != "walltime" or name in own)

    def __post_init__(self) -> None:
        """Reject jobs without a number of workers."""
        super().__post_init__()
        if self.workers is None:
            raise ConfigError(f"--workers must be given with --cluster {self.kind}")
        self.per_job = int(self.cores or self._site("cores") or 1)
        self.jobs = math.ceil(self.workers / self.per_job)

    def _site(self, key: str) -> Any:
        """Return a value of the user's jobqueue.yaml, or dask-jobqueue's default."""
        return dask.config.get(f"jobqueue.{self.of.job_cls.config_name}.{key}", None)

    def line(self) -> str:
        """Return a description of the resources that each job requests."""
        jobs = f"{counted(self.jobs, f'{self.kind} job')} ({self.per_job} in each)"
        memory = self.memory or ("as in jobqueue.yaml" if self._site("memory") else WORKER_MEMORY)
        walltime = self.walltime or self._site("walltime") or "of the queue"
        workers = counted(self.per_job * self.jobs, "worker")
        return f"{workers} in {jobs}, memory {memory}, walltime {walltime}"

    def _job(self, security: Security | None) -> dict[str, Any]:
        """Return the arguments of a job; jobqueue.yaml states those that are None."""
        memory = self.memory or (None if self._site("memory") else WORKER_MEMORY)
        total = None if memory is None else f"{self.per_job * memory_bytes(memory)}B"
        prologue, arguments = self._site("job-script-prologue"), self._site("worker-extra-args")
        return {
            "cores": self.per_job,
            "processes": self.per_job,
            "memory": total,
            "interface": self.interface,
            "security": security,
            # Every user of the worker's machine could read an open port.
            "worker_extra_args": [*(arguments or ()), f"--dashboard-address={LOOPBACK}:0"],
            "job_script_prologue": [*(prologue or ()), *_exports()],
            **({} if self.walltime is None else {"walltime": self.walltime}),
            **{key: _value(text) for key, text in self.own.items()},
        }

    def script(self, out: Path) -> str:
        """Return the script of a job, with placeholders for scheduler address and certificates.

        Raises:
            ConfigError: If dask-jobqueue misses an option.
        """
        keys = out / ".tls-RUN"
        files = self.tls_files or (keys / "ca.pem", keys / "cert.pem", keys / "key.pem")
        security, protocol = (security_of(files), "tls://") if self.tls else (None, "tcp://")
        try:
            job = quoted(self.of.job_cls)(
                f"{protocol}SCHEDULER:PORT", "WORKER", protocol=protocol, **self._job(security)
            )
        except (TypeError, ValueError) as error:
            raise ConfigError(f"--cluster {self.kind}: {one_line(error)}") from None
        return str(job.job_script())

    def submission(self) -> str:
        """Return the command that submits a script."""
        return str(self.of.job_cls.submit_command)

    @contextmanager
    def connected(self, out: Path) -> Iterator[Client]:
        """Submit the jobs, and yield a client; the jobs end with the block."""
        with (
            made_or_given(self.tls, self.tls_files, out) as security,
            dask.config.set(dask_settings()),
        ):
            try:
                cluster = self._start(security)
            except ConfigError:
                raise
            # Each class raises its own errors; report them all as errors of the machine.
            except Exception as error:
                # What the scheduler's command said is at the end.
                reason = " ".join(str(error).rpartition("stderr:")[2].split())
                raise MachineError(
                    f"the workers did not start: {reason or type(error).__name__}"
                ) from None
            with closing_cluster(cluster), Client(cluster) as client:
                yield client

    def _start(self, security: Security | None) -> SpecCluster:
        """Submit the jobs, and replace lost jobs from then on."""
        listening = {} if self.host is None else {"host": self.host}
        cluster = self.of(
            job_cls=quoted(self.of.job_cls),
            scheduler_options={
                "dashboard_address": f"{LOOPBACK}:0",
                **(self._site("scheduler-options") or {}),
                **listening,
            },
            **self._job(security),
        )

        async def submit() -> None:
            # Not `scale`, which submits later and logs the error of the scheduler's command.
            for _ in range(self.jobs):
                cluster.worker_spec.update(cluster.new_worker_spec())
            await cluster
            PeriodicCallback(_Refill(cluster, self.jobs), 1000.0 * REFILL_SECONDS).start()

        try:
            cluster.sync(submit)
        except BaseException:
            for job in cluster.workers.values():
                job.status = Status.failed  # or Dask would not close the cluster
            cluster.close()
            raise
        return cluster


def _value(text: str) -> Any:
    """Return a setting as dask-jobqueue takes it: a number or a boolean, or a text."""
    try:
        value = json.loads(text)
    except ValueError:
        return text
    return value if isinstance(value, bool | int) else text


def _exports() -> list[str]:
    """Return Dask's settings as lines of a job script, because a job does not inherit settings."""
    lines = []
    for key, value in dask_settings().items():
        name = key.upper().replace(".", "__").replace("-", "_")
        lines.append(f"export DASK_{name}={shlex.quote(json.dumps(value))}")
    return lines


class _Quoted:
    """A job of dask-jobqueue in which texts that are not ours are words of a shell.

    What jobqueue.yaml states is the user's shell code, e.g. `python: apptainer exec IMAGE python`.
    """

    config_name: str

    def __init__(
        self, scheduler: str, name: str, *, security: Security | None = None, **options: Any
    ) -> None:
        """Take the arguments of the job."""
        if dask.config.get(f"jobqueue.{self.config_name}.python", None) is None:
            options["python"] = sys.executable
        # If the certificates were given as `security`, their paths would not be quoted.
        files = {} if security is None else security.get_tls_config_for_role("worker")
        for key, path in files.items():
            if key != "ciphers":  # Dask has no option for them
                words = [f"--tls-{key.replace('_', '-')}", self._word(str(path))]
                options["worker_extra_args"] = [*options["worker_extra_args"], *words]
        texts = {key: self._word(v) for key, v in options.items() if isinstance(v, str)}
        super().__init__(scheduler, name, **{**options, **texts})  # type: ignore[call-arg]

    def _word(self, text: str) -> str:
        """Return a text as a word of a shell.

        Raises:
            ConfigError: If it has control characters: a line of a script may be a directive, also
                between quotation marks.
        """
        if not text.isprintable():
            raise ConfigError(f"a text in a job must be printable, got {text!r}")
        word = shlex.quote(text)
        # HTCondor replaces `$(NAME)` before the shell reads the line.
        return word.replace("$", "$(DOLLAR)") if self.config_name == "htcondor" else word


@cache
def quoted(job: type[Any]) -> type[Any]:
    """Return a class of jobs in which texts of the command line are quoted."""
    return types.new_class(f"Quoted{job.__name__}", (_Quoted, job))


class _Refill:
    """Replaces each job that ended at its walltime or because its machine failed.

    `adapt(minimum_jobs=n, maximum_jobs=n)` of dask-jobqueue does not do this. It compares n with
    the number of requested jobs, which still includes a job with several workers after its end
    (0.9, distributed 2026.8).
    """

    def __init__(self, cluster: SpecCluster, jobs: int) -> None:
        self._cluster, self._jobs = cluster, jobs
        self._seen: set[str] = set()
        self._missing: set[str] = set()

    async def __call__(self) -> None:
        """Replace jobs that had workers and have none, twice in a row."""
        cluster = self._cluster
        if cluster.status is not Status.running:
            return

        # A job is present if it has a worker. A job that is still queued is not yet present, and
        # not missing.
        names = {str(w["name"]) for w in cluster.scheduler_info["workers"].values()}
        present = {job for job in cluster.worker_spec if _has_worker(str(job), names)}
        missing = self._seen - present

        # Forget the lost jobs, so that Dask submits new ones to reach the number of jobs.
        for job in missing & self._missing:
            if job in cluster.workers:
                await cluster.workers.pop(job).close()
            self._seen.discard(job)
        self._missing = missing
        self._seen |= present
        cluster.scale(jobs=self._jobs)


def _has_worker(job: str, names: set[str]) -> bool:
    return job in names or any(name.startswith(f"{job}-") for name in names)
