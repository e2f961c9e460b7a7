"""Starting the workers: on this machine, over SSH, under SLURM, or on a running scheduler.

In: a `ClusterRequest`, plain data from a command line. Out: a Dask client, while a block
runs. What the workers need is set here for every kind of cluster, because those of other
machines inherit nothing: SSH hands on the settings of this process, SLURM's jobs get them
in their script, and a running scheduler's workers are set up when they are admitted (see
`workers`). Nothing listens beyond this machine unless `host` or `interface` says so.
"""

from __future__ import annotations

import ipaddress
import logging
import math
import shlex
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import dask
from dask.utils import parse_bytes
from distributed import Client, SpecCluster, SSHCluster, Status
from distributed.security import Security
from tornado.ioloop import PeriodicCallback

from drakegrasp.cluster import DASK_SETTINGS, closing_cluster, connect
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.tls import (
    make_certificates,
    private_directory,
    security_of,
    server_options,
    temporary_security,
)
from drakegrasp.workers import WORKER_ENVIRONMENT

KINDS = ("local", "ssh", "slurm", "scheduler", "scheduler-file")
#: Memory of a worker under SLURM, where neither the user nor jobqueue.yaml says it.
WORKER_MEMORY = "2GB"
#: How often lost jobs are looked for [s]; one is lost that is missing twice.
REFILL_SECONDS = 20.0
#: A worker ends by itself between these times before its job's walltime does [s], or
#: fractions of it if that is shorter: then its unit is not cut off, and jobs do not all
#: end together.
LIFETIME_MARGIN, LIFETIME_STAGGER = 300.0, 120.0
#: Address of this machine alone.
LOOPBACK = "127.0.0.1"
#: A scheduler on another machine ends by itself when it had nothing to do for this long,
#: because its client was killed.
IDLE_TIME = "1 hour"
#: Least and largest number of words after each kind, and what they are.
_PLACES: dict[str, tuple[int, float, str]] = {
    "local": (0, 0, "nothing"),
    "ssh": (1, math.inf, "the names of the hosts"),
    "slurm": (0, 0, "nothing"),
    "scheduler": (1, 1, "its address"),
    "scheduler-file": (1, 1, "its path"),
}
#: What may be asked of each kind; a running scheduler has its own workers.
_TAKES: dict[str, tuple[str, ...]] = {
    "local": ("workers", "memory", "tls"),
    "ssh": ("workers", "cores", "memory", "host", "interface", "tls"),
    "slurm": ("workers", "cores", "memory", "walltime", "host", "interface", "tls"),
    "scheduler": (),
    "scheduler-file": (),
}


@dataclass(frozen=True, kw_only=True)
class ClusterRequest:
    """What workers are wanted, as on the command line of `pipelines/submit_build.py`.

    Attributes:
        kind: One of `KINDS`.
        where: Hosts, the address of a scheduler, or its file.
        workers: Processes in all.
        cores: Of each host or job, a worker on each.
        memory: Of each worker, e.g. "2GB".
        walltime: Of each SLURM job, as SLURM writes it: [D-]HH:MM:SS.
        host: Address on which the scheduler listens.
        interface: Name of the network interface on which scheduler and workers listen.
        tls: Whether to make certificates for this run.
        tls_files: Files in PEM format: authority, certificate and private key; every machine
            must see them.
    """

    kind: str
    where: tuple[str, ...] = ()
    workers: int | None = None
    cores: int | None = None
    memory: str | None = None
    walltime: str | None = None
    host: str | None = None
    interface: str | None = None
    tls: bool = False
    tls_files: tuple[Path, Path, Path] | None = None


def worker_count(request: ClusterRequest) -> int | None:
    """Return how many workers there will be, as far as that is known before they start.

    Raises:
        ConfigError: If the request contradicts itself, or lacks something.
    """
    _refuse_contradictions(request)
    if request.kind == "ssh":
        return len(request.where) * _cores_per_host(request)
    if request.kind == "slurm":
        cores = _cores_per_job(request)
        return cores * math.ceil((request.workers or 0) / cores)
    return request.workers


def describe(request: ClusterRequest) -> list[str]:
    """Return what will be started, in lines for the user; of an open port it warns."""
    count = worker_count(request)
    lines = [
        {
            "local": "workers on this machine",
            "ssh": f"{count} workers over ssh on {' '.join(dict.fromkeys(request.where))}, "
            f"scheduler on {request.where[0] if request.where else ''}",
            "slurm": f"{count} workers in SLURM jobs{_job_size(request)}",
        }.get(request.kind, f"the workers of {' '.join(request.where)}")
    ]
    encrypted = request.tls or request.tls_files is not None
    lines.append(f"connections: {'TLS' if encrypted else 'not encrypted'}")
    if not encrypted and _listens_beyond(request):
        lines.append(
            "warning: whoever reaches the scheduler's port can run programs as you; give --tls"
        )
    return lines


@contextmanager
def start_cluster(request: ClusterRequest, out: Path) -> Iterator[Client]:
    """Start the workers, and stop them when the block ends; yield a client.

    Args:
        request: What is wanted.
        out: Directory that all machines see; certificates for this run are put there.

    Raises:
        ConfigError: If the request contradicts itself, or lacks something.
        MachineError: If a package or a program is missing, or the workers do not start.
    """
    worker_count(request)
    with _security(request, out) as security, dask.config.set(DASK_SETTINGS):
        if request.kind == "ssh":
            with _running(partial(_ssh, request, security)) as client:
                yield client
        elif request.kind == "slurm":
            with _running(partial(_slurm, request, security)) as client:
                yield client
        else:
            with _connected(request, security) as client:
                yield client


def _connected(
    request: ClusterRequest, security: Security | None
) -> AbstractContextManager[Client]:
    address = request.where[0] if request.kind == "scheduler" else None
    file = request.where[0] if request.kind == "scheduler-file" else None
    return connect(request.workers, address, file, security=security, memory=request.memory)


@contextmanager
def _running(make: Callable[[], SpecCluster]) -> Iterator[Client]:
    """Run a cluster while the block does."""
    try:
        cluster = make()
    except (ConfigError, MachineError):
        raise
    # Each kind of cluster has failures of its own, and none of them is this program's.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise MachineError(f"the workers must start, got: {reason}") from None
    with closing_cluster(cluster), Client(cluster) as client:
        yield client


def _ssh(request: ClusterRequest, security: Security | None) -> SpecCluster:
    # Settings of Dask go to the other machines with every command that SSHCluster runs there.
    listening = _listening(request)
    worker = {
        "n_workers": _cores_per_host(request),
        "nthreads": 1,
        "memory_limit": request.memory or "auto",
        "env": WORKER_ENVIRONMENT,
        **_workers_listening(listening),
        **server_options(security),
    }
    scheduler = {
        "port": 0,
        "dashboard_address": f"{LOOPBACK}:0",
        "idle_timeout": IDLE_TIME,
        **listening,
        **server_options(security),
    }
    return SSHCluster(
        [request.where[0], *request.where],
        worker_options=worker,
        scheduler_options=scheduler,
        security=security,
        silence_logs=logging.ERROR,
    )


def _slurm(request: ClusterRequest, security: Security | None) -> SpecCluster:
    cores, listening = _cores_per_job(request), _listening(request)
    jobs = math.ceil((request.workers or 0) / cores)
    default = None if _jobqueue("memory") else WORKER_MEMORY
    memory = request.memory or default
    # What is None or not named here is as jobqueue.yaml says.
    from dask_jobqueue import SLURMCluster

    cluster = SLURMCluster(
        cores=cores,
        processes=cores,
        memory=None if memory is None else f"{cores * _bytes(memory)}B",
        walltime=request.walltime,
        interface=request.interface,
        security=security,
        worker_extra_args=[
            *(_jobqueue("worker-extra-args") or ()),
            *_lifetime(request.walltime or _jobqueue("walltime")),
            f"--dashboard-address={LOOPBACK}:0",
            *([f"--host={LOOPBACK}"] if "host" in _workers_listening(listening) else []),
        ],
        job_script_prologue=[*(_jobqueue("job-script-prologue") or ()), *_exports()],
        scheduler_options={
            "dashboard_address": f"{LOOPBACK}:0",
            **(_jobqueue("scheduler-options") or {}),
            **listening,
        },
    )
    try:
        _refuse_bad_job(cluster.job_script())
    except MachineError:
        cluster.close()
        raise
    cluster.scale(jobs=jobs)
    _refill(cluster, jobs)
    return cluster


def _refuse_bad_job(script: str) -> None:
    """Have SLURM look at a job before any is submitted: those that fail later fail unseen.

    Raises:
        MachineError: If there is no SLURM here, or it would not run the job.
    """
    try:
        test = subprocess.run(
            ["sbatch", "--test-only"], input=script, capture_output=True, text=True
        )
    except FileNotFoundError:
        raise MachineError(
            "sbatch must be on the PATH, got none: start this on a machine that submits jobs"
        ) from None
    if test.returncode:
        raise MachineError(f"SLURM must accept the job, got: {test.stderr.strip()}")


class _Refill:
    """Asks for a new job in place of each that is over: at its walltime, or with its machine."""

    def __init__(self, cluster: SpecCluster, jobs: int) -> None:
        self._cluster, self._jobs = cluster, jobs
        self._seen: set[str] = set()
        self._missing: set[str] = set()

    async def __call__(self) -> None:
        """Look for jobs that had workers and have none, twice in a row."""
        cluster = self._cluster
        if cluster.status is not Status.running:
            return
        names = {str(w["name"]) for w in cluster.scheduler_info["workers"].values()}
        present = {job for job in cluster.worker_spec if _has_worker(str(job), names)}
        missing = self._seen - present
        for job in missing & self._missing:
            if job in cluster.workers:
                await cluster.workers.pop(job).close()
            self._seen.discard(job)
        self._missing = missing
        self._seen |= present
        cluster.scale(jobs=self._jobs)


def _has_worker(job: str, names: set[str]) -> bool:
    return job in names or any(name.startswith(f"{job}-") for name in names)


def _refill(cluster: SpecCluster, jobs: int) -> None:
    async def start() -> None:
        PeriodicCallback(_Refill(cluster, jobs), 1000.0 * REFILL_SECONDS).start()

    cluster.sync(start)


def _exports() -> list[str]:
    """Return the settings of Dask as lines of a job script, which inherits no others."""
    lines = []
    for key, value in DASK_SETTINGS.items():
        name = "DASK_" + key.upper().replace(".", "__").replace("-", "_")
        lines.append(f"export {name}={shlex.quote(repr(value))}")
    return lines


def _lifetime(walltime: str | None) -> list[str]:
    """Return the options that end a worker before its job's walltime."""
    if walltime is None:
        return []
    seconds = walltime_seconds(walltime)
    margin = min(LIFETIME_MARGIN, seconds / 4.0)
    stagger = min(LIFETIME_STAGGER, margin / 2.0)
    return ["--lifetime", f"{seconds - margin:.0f}s", "--lifetime-stagger", f"{stagger:.0f}s"]


def walltime_seconds(text: str) -> float:
    """Return a time limit of SLURM in seconds.

    SLURM's forms: M, M:S, H:M:S, D-H, D-H:M, D-H:M:S.

    Raises:
        ConfigError: If it is none of them.
    """
    days, dash, rest = text.partition("-") if "-" in text else ("0", "", text)
    parts = rest.split(":")
    if not (days.isdigit() and all(p.isdigit() for p in parts) and len(parts) <= 3):
        raise ConfigError(f"walltime must be a time of SLURM such as 02:00:00, got {text!r}")
    numbers = [int(p) for p in parts]
    if dash or len(numbers) == 3:
        hours, minutes, seconds = [*numbers, 0, 0][:3]
    else:
        hours, (minutes, seconds) = 0, [*numbers, 0][:2]
    total = 86400.0 * int(days) + 3600.0 * hours + 60.0 * minutes + seconds
    if total <= 0.0:
        raise ConfigError(f"walltime must be longer than nothing, got {text!r}")
    return total


@contextmanager
def _security(request: ClusterRequest, out: Path) -> Iterator[Security | None]:
    """Yield the certificates; those that are made for other machines to read are removed."""
    if request.tls_files is not None:
        yield security_of(request.tls_files)
    elif not request.tls:
        yield None
    elif request.kind == "local":
        yield temporary_security()
    else:
        with private_directory(out) as folder:
            yield security_of(make_certificates(folder))


def _listening(request: ClusterRequest) -> dict[str, str]:
    """Return where a scheduler listens, as its options; nothing if jobqueue.yaml says it.

    Raises:
        ConfigError: If the workers are on other machines and nobody said where to listen.
    """
    if request.host is not None:
        return {"host": request.host}
    if request.interface is not None:
        return {"interface": request.interface}
    if request.kind == "ssh" and all(_is_loopback(host) for host in request.where):
        return {"host": LOOPBACK}
    if request.kind == "slurm" and _jobqueue_listens():
        return {}
    raise ConfigError(
        "--interface NAME or --host ADDRESS must be given for workers on other machines, because "
        "the scheduler listens to nobody else's machine without"
    )


def _workers_listening(listening: dict[str, str]) -> dict[str, str]:
    """Return where workers listen, as their options, given where their scheduler does."""
    if "interface" in listening:
        return listening
    # Without, a worker takes an address of its machine by which others reach it.
    return listening if _is_loopback(listening.get("host", "")) else {}


def _listens_beyond(request: ClusterRequest) -> bool:
    if request.kind not in ("ssh", "slurm"):
        return False
    listening = _listening(request)
    return not ("host" in listening and _is_loopback(listening["host"])) and (
        listening.get("interface") != "lo"
    )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _jobqueue(key: str) -> Any:
    """Return a value of the user's jobqueue.yaml, or of dask-jobqueue's own.

    Raises:
        MachineError: If dask-jobqueue is not installed.
    """
    try:
        import dask_jobqueue  # noqa: F401  (it is what reads the file)
    except ImportError:
        raise MachineError(
            "--cluster slurm needs dask-jobqueue: pip install 'drakegrasp[slurm]'"
        ) from None
    return dask.config.get(f"jobqueue.slurm.{key}", None)


def _jobqueue_listens() -> bool:
    options = _jobqueue("scheduler-options") or {}
    return bool(_jobqueue("interface") or {"host", "interface"} & set(options))


def _cores_per_host(request: ClusterRequest) -> int:
    hosts = len(request.where)
    if request.cores is not None:
        if request.workers not in (None, hosts * request.cores):
            raise ConfigError(
                f"--workers must be --cores on each of {hosts} hosts, {hosts * request.cores}, or "
                f"not be given, got {request.workers}"
            )
        return request.cores
    if request.workers is None:
        raise ConfigError("--workers or --cores must be given for workers over ssh")
    if request.workers % hosts:
        raise ConfigError(
            f"--workers must be a multiple of the number of hosts, {hosts}, got {request.workers}; "
            "a host may be named more than once"
        )
    return request.workers // hosts


def _job_size(request: ClusterRequest) -> str:
    """Return what each of SLURM's jobs asks for, in words; nothing for other clusters."""
    if request.kind != "slurm":
        return ""
    memory = request.memory or (None if _jobqueue("memory") else WORKER_MEMORY)
    walltime = request.walltime or _jobqueue("walltime")
    asked = [
        f"of {_cores_per_job(request)}",
        "memory as in jobqueue.yaml" if memory is None else f"{memory} each",
        f"walltime {walltime or 'as the queue has it'}",
    ]
    return f" {', '.join(asked)}"


def _cores_per_job(request: ClusterRequest) -> int:
    return int(request.cores or _jobqueue("cores") or 1)


def _refuse_contradictions(request: ClusterRequest) -> None:
    least, most, what = _PLACES[request.kind]
    if not least <= len(request.where) <= most:
        got = " ".join(request.where) or "nothing"
        raise ConfigError(f"--cluster {request.kind} must be followed by {what}, got {got}")
    for name in ("workers", "cores", "memory", "walltime", "host", "interface", "tls"):
        value = getattr(request, name)
        if value not in (None, False) and name not in _TAKES[request.kind]:
            raise ConfigError(f"--{name} must not be given with --cluster {request.kind}")
        if name in ("workers", "cores") and value is not None and value < 1:
            raise ConfigError(f"{name} must be at least 1, got {value}")
    if request.tls and request.tls_files is not None:
        raise ConfigError("--tls makes certificates and must not be given with files of them")
    if request.memory is not None:
        _bytes(request.memory)
    if request.walltime is not None:
        walltime_seconds(request.walltime)
    if request.kind == "slurm" and request.workers is None:
        raise ConfigError("--workers must be given with --cluster slurm")
    if request.kind == "ssh":
        for host in request.where:
            if "@" in host:
                raise ConfigError(
                    f"a host must be a name or address, got {host!r}: the user and "
                    "the key for it go into ~/.ssh/config"
                )
        _cores_per_host(request)
    if request.kind in ("ssh", "slurm"):
        _listening(request)


def _bytes(text: str) -> int:
    try:
        return int(parse_bytes(text))
    except ValueError:
        raise ConfigError(f"memory must be a size such as 2GB, got {text!r}") from None
