"""Starting the workers: on this machine, over SSH, under SLURM, or on a running scheduler.

In: a `ClusterRequest`, plain data from a command line. Out: a Dask client, while a block
runs. What the workers need is set here for every kind of cluster, because those of other
machines inherit nothing: SSH hands on the settings of this process, SLURM's jobs get them
in their script, and a running scheduler's workers are set up when they are admitted (see
`admission`). Nothing listens beyond this machine unless `host` or `interface` says so.
"""

from __future__ import annotations

import logging
import math
import shlex
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path

import dask
from distributed import Client, SpecCluster, SSHCluster, Status
from distributed.security import Security
from tornado.ioloop import PeriodicCallback

from drakegrasp.cluster.admission import WORKER_ENVIRONMENT
from drakegrasp.cluster.certificates import (
    make_certificates,
    private_directory,
    security_of,
    server_options,
    temporary_security,
)
from drakegrasp.cluster.connect import DASK_SETTINGS, NANNY_PRELOAD, closing_cluster, connect
from drakegrasp.cluster.request import (
    LOOPBACK,
    WORKER_MEMORY,
    ClusterRequest,
    cores_per_host,
    cores_per_job,
    jobqueue,
    memory_bytes,
    scheduler_listening,
    walltime_seconds,
    worker_count,
    workers_listening,
)
from drakegrasp.errors import ConfigError, MachineError

#: How often lost jobs are looked for [s]; one is lost that is missing twice.
REFILL_SECONDS = 20.0
#: A worker ends by itself between these times before its job's walltime does [s], or
#: fractions of it if that is shorter: then its unit is not cut off, and jobs do not all
#: end together.
LIFETIME_MARGIN, LIFETIME_STAGGER = 300.0, 120.0
#: A scheduler on another machine ends by itself when it had nothing to do for this long,
#: because its client was killed.
IDLE_TIME = "1 hour"


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
    listening = scheduler_listening(request)
    worker = {
        "n_workers": cores_per_host(request),
        "nthreads": 1,
        "memory_limit": request.memory or "auto",
        "env": WORKER_ENVIRONMENT,
        **workers_listening(listening),
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
    cores, listening = cores_per_job(request), scheduler_listening(request)
    jobs = math.ceil((request.workers or 0) / cores)
    default = None if jobqueue("memory") else WORKER_MEMORY
    memory = request.memory or default
    # What is None or not named here is as jobqueue.yaml says.
    from dask_jobqueue import SLURMCluster

    cluster = SLURMCluster(
        cores=cores,
        processes=cores,
        memory=None if memory is None else f"{cores * memory_bytes(memory)}B",
        walltime=request.walltime,
        interface=request.interface,
        security=security,
        worker_extra_args=[
            *(jobqueue("worker-extra-args") or ()),
            *_lifetime(request.walltime or jobqueue("walltime")),
            f"--dashboard-address={LOOPBACK}:0",
            # The settings' preload is not read by the command that starts a worker.
            f"--preload-nanny={NANNY_PRELOAD}",
            *([f"--host={LOOPBACK}"] if "host" in workers_listening(listening) else []),
        ],
        job_script_prologue=[*(jobqueue("job-script-prologue") or ()), *_exports()],
        scheduler_options={
            "dashboard_address": f"{LOOPBACK}:0",
            **(jobqueue("scheduler-options") or {}),
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
