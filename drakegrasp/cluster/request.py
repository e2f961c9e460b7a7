"""The requested cluster: options, validation, description.

In: a `ClusterRequest` and the user's jobqueue.yaml. Out: numbers and options for `launch`, and
lines for the user. Nothing is started here.
"""

from __future__ import annotations

import ipaddress
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import dask
from dask.utils import parse_bytes

from drakegrasp.cluster.certificates import chosen_security
from drakegrasp.errors import ConfigError, MachineError

#: Memory of a worker under SLURM, if neither the user nor jobqueue.yaml gives it.
WORKER_MEMORY = "2GB"
#: Address that only this machine can reach.
LOOPBACK = "127.0.0.1"
#: Options of a cluster on other machines. A cluster on this one has fewer, and a running scheduler,
#: which has its own workers, none.
_REMOTE = ("workers", "cores", "memory", "host", "interface")
#: By kind: least and largest number of words that follow it, what they are, and its options.
_KINDS: dict[str, tuple[int, float, str, tuple[str, ...]]] = {
    "local": (0, 0, "nothing", ("workers", "memory")),
    "ssh": (1, math.inf, "the names of the hosts", _REMOTE),
    "slurm": (0, 0, "nothing", (*_REMOTE, "walltime")),
    "scheduler": (1, 1, "its address", ()),
    "scheduler-file": (1, 1, "its path", ()),
}
KINDS = tuple(_KINDS)
#: More memory than a worker has [B].
MOST_MEMORY = 10**15
#: A number of days, hours, minutes or seconds.
_NUMBER = re.compile("[0-9]{1,6}")


@dataclass(frozen=True, kw_only=True)
class ClusterRequest:
    """The requested workers, as on the command line of `pipelines/submit_build.py`.

    Attributes:
        kind: One of `KINDS`.
        where: Hosts, the address of a scheduler, or its file.
        workers: Number of processes in all.
        cores: Number of cores of each host or job, with a worker on each.
        memory: Memory of each worker, e.g. "2GB".
        walltime: Time limit of each SLURM job, as SLURM writes it: [D-]HH:MM:SS.
        host: Address on which the scheduler listens.
        interface: Name of the network interface on which scheduler and workers listen.
        tls: Whether connections need a certificate.
        tls_files: Files in PEM format that every machine sees: authority, certificate and
            private key. Without them, workers that are started get some that are made for this run.
    """

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


def worker_count(request: ClusterRequest) -> int | None:
    """Return how many workers there will be; None if that is known only when they start.

    Raises:
        ConfigError: If the request contradicts itself, or lacks something.
    """
    _refuse_contradictions(request)
    if request.kind == "ssh":
        return len(request.where) * cores_per_host(request)
    if request.kind == "slurm":
        return cores_per_job(request) * job_count(request)
    return request.workers


def describe(request: ClusterRequest) -> list[str]:
    """Return what will be started, in lines for the user, with a warning of an open port."""
    count = worker_count(request)
    lines = [
        {
            "local": "workers on this machine",
            "ssh": f"{count} workers over ssh on {' '.join(dict.fromkeys(request.where))}, "
            f"scheduler on {request.where[0] if request.where else ''}",
            "slurm": f"{count} workers in SLURM jobs{_job_size(request)}",
        }.get(request.kind, f"the workers of {' '.join(request.where)}")
    ]
    lines.append(f"connections: {'TLS' if request.tls else 'not encrypted'}")
    if not request.tls and _listens_beyond(request):
        lines.append(
            "warning: anybody who reaches the scheduler's port can run programs as you; leave out "
            "--no-tls"
        )
    return lines


def walltime_seconds(text: str) -> float:
    """Return a time limit of SLURM in seconds.

    SLURM's forms: M, M:S, H:M:S, D-H, D-H:M, D-H:M:S.

    Raises:
        ConfigError: If the text is none of them.
    """
    days, dash, rest = text.partition("-") if "-" in text else ("0", "", text)
    parts = rest.split(":")
    if len(parts) > 3 or not all(_NUMBER.fullmatch(part) for part in (days, *parts)):
        raise ConfigError(f"walltime must be a time of SLURM such as 02:00:00, got {text[:40]!r}")
    numbers = [int(p) for p in parts]
    if dash or len(numbers) == 3:
        hours, minutes, seconds = [*numbers, 0, 0][:3]
    else:
        hours, (minutes, seconds) = 0, [*numbers, 0][:2]
    total = 86400.0 * int(days) + 3600.0 * hours + 60.0 * minutes + seconds
    if total <= 0.0:
        raise ConfigError(f"walltime must be longer than 0 s, got {text!r}")
    return total


def scheduler_listening(request: ClusterRequest) -> dict[str, str]:
    """Return the options that say where a scheduler listens; none if jobqueue.yaml says it.

    Raises:
        ConfigError: If the workers are on other machines and it is not said where to listen.
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
        "--interface NAME or --host ADDRESS must be given for workers on other machines: without, "
        "the scheduler listens to this machine only"
    )


def workers_listening(listening: dict[str, str]) -> dict[str, str]:
    """Return the options that say where workers listen, given those of their scheduler."""
    if "interface" in listening:
        return listening
    # Without options a worker chooses an address by which other machines reach it.
    return listening if _is_loopback(listening.get("host", "")) else {}


def _listens_beyond(request: ClusterRequest) -> bool:
    if request.kind not in ("ssh", "slurm"):
        return False
    listening = scheduler_listening(request)
    return not ("host" in listening and _is_loopback(listening["host"])) and (
        listening.get("interface") != "lo"
    )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def jobqueue(key: str) -> Any:
    """Return a value of the user's jobqueue.yaml, or dask-jobqueue's default.

    Raises:
        MachineError: If dask-jobqueue is not installed.
    """
    try:
        import dask_jobqueue  # noqa: F401  (its import reads the file)
    except ImportError:
        raise MachineError(
            "--cluster slurm needs dask-jobqueue: pip install 'drakegrasp[slurm]'"
        ) from None
    return dask.config.get(f"jobqueue.slurm.{key}", None)


def _jobqueue_listens() -> bool:
    options = jobqueue("scheduler-options") or {}
    return bool(jobqueue("interface") or {"host", "interface"} & set(options))


def cores_per_host(request: ClusterRequest) -> int:
    """Return how many workers run on each host over SSH.

    Raises:
        ConfigError: If the request does not say it, or contradicts itself.
    """
    hosts = len(request.where)
    if request.cores is not None:
        if request.workers not in (None, hosts * request.cores):
            raise ConfigError(
                f"--workers must be --cores times the number of hosts, {hosts * request.cores}, or "
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
    """Return what each SLURM job asks for, in words; nothing for other clusters."""
    if request.kind != "slurm":
        return ""
    memory, walltime = job_memory(request), job_walltime(request)
    asked = [
        f"of {cores_per_job(request)}",
        "memory as in jobqueue.yaml" if memory is None else f"{memory} each",
        f"walltime {walltime or 'as the queue has it'}",
    ]
    return f" {', '.join(asked)}"


def cores_per_job(request: ClusterRequest) -> int:
    """Return how many workers run in each SLURM job."""
    return int(request.cores or jobqueue("cores") or 1)


def job_count(request: ClusterRequest) -> int:
    """Return how many SLURM jobs have the workers of a request."""
    return math.ceil((request.workers or 0) / cores_per_job(request))


def job_memory(request: ClusterRequest) -> str | None:
    """Return the memory of each worker in a SLURM job; None if jobqueue.yaml says that of a job."""
    return request.memory or (None if jobqueue("memory") else WORKER_MEMORY)


def job_walltime(request: ClusterRequest) -> str | None:
    """Return the time limit of each SLURM job; None if there is none."""
    return request.walltime or jobqueue("walltime")


def _refuse_contradictions(request: ClusterRequest) -> None:
    # Each kind of cluster has its own words and options.
    least, most, what, options = _KINDS[request.kind]
    if not least <= len(request.where) <= most:
        got = " ".join(request.where) or "nothing"
        raise ConfigError(f"--cluster {request.kind} must be followed by {what}, got {got}")
    for name in (*_REMOTE, "walltime"):
        value = getattr(request, name)
        if value is not None and name not in options:
            raise ConfigError(f"--{name} must not be given with --cluster {request.kind}")
        if name in ("workers", "cores") and value is not None and value < 1:
            raise ConfigError(f"{name} must be at least 1, got {value}")
    chosen_security(request.tls, request.tls_files, elsewhere=request.kind != "local")

    # Sizes and times must be readable.
    if request.memory is not None:
        memory_bytes(request.memory)
    if request.walltime is not None:
        walltime_seconds(request.walltime)

    # What a cluster on other machines cannot do without.
    if request.kind == "slurm" and request.workers is None:
        raise ConfigError("--workers must be given with --cluster slurm")
    if request.kind == "ssh":
        for host in request.where:
            if "@" in host:
                raise ConfigError(
                    f"a host must be a name or address, got {host!r}: the user and "
                    "the key for it go into ~/.ssh/config"
                )
        cores_per_host(request)
    if request.kind in ("ssh", "slurm"):
        scheduler_listening(request)


def memory_bytes(text: str) -> int:
    """Return a size of memory such as "2GB" in bytes.

    Raises:
        ConfigError: If the text is no such size.
    """
    try:
        size = int(parse_bytes(text)) if text.strip() and text.isascii() else 0
    except (ValueError, OverflowError):
        size = 0
    if not 0 < size <= MOST_MEMORY:
        raise ConfigError(f"memory must be a size such as 2GB, got {text[:40]!r}")
    return size
