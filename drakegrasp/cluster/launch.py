"""Starting the workers: on this machine, over SSH, under SLURM, or on a running scheduler.

In: a `ClusterRequest`, plain data from a command line. Out: a Dask client, while a block
runs. Workers on other machines inherit nothing, so their settings are sent here for every kind of
cluster: SSH sends those of this process, SLURM's jobs get them in their script, and the workers of
a running scheduler are set up when they are admitted (see `admission`). Nothing listens beyond
this machine unless `host` or `interface` says so.
"""

from __future__ import annotations

import logging
import shlex
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import dask
from distributed import Client, SpecCluster, SSHCluster, Status
from distributed.security import Security
from tornado.ioloop import PeriodicCallback

from drakegrasp.cluster.admission import start_environment
from drakegrasp.cluster.certificates import (
    chosen_security,
    make_certificates,
    private_directory,
    security_of,
    server_options,
)
from drakegrasp.cluster.connect import NANNY_PRELOAD, closing_cluster, connect, dask_settings
from drakegrasp.cluster.request import (
    LOOPBACK,
    ClusterRequest,
    cores_per_host,
    cores_per_job,
    job_count,
    job_memory,
    job_walltime,
    jobqueue,
    memory_bytes,
    scheduler_listening,
    walltime_seconds,
    worker_count,
    workers_listening,
)
from drakegrasp.errors import ConfigError, MachineError

#: Time between two looks for lost jobs [s]; a job that is missing twice in a row is lost.
REFILL_SECONDS = 20.0
#: A worker ends by itself this long before its job's walltime, give or take the second [s]; less
#: for short jobs. Then its unit is not cut off, and jobs do not all end together.
LIFETIME_MARGIN, LIFETIME_STAGGER = 300.0, 120.0
#: A scheduler on another machine ends by itself after this time without work: its client was
#: killed.
IDLE_TIME = "1 hour"


@contextmanager
def start_cluster(request: ClusterRequest, out: Path) -> Iterator[Client]:
    """Start the workers, and stop them when the block ends; yield a client.

    Args:
        request: The workers to start.
        out: Directory that all machines see; certificates for this run are written there.

    Raises:
        ConfigError: If the request contradicts itself, or lacks something.
        MachineError: If a package or a program is missing, or the workers do not start.
    """
    worker_count(request)
    makers = {"ssh": _ssh, "slurm": _slurm}
    with _security(request, out) as security, dask.config.set(dask_settings()):
        if request.kind in makers:
            running = _running(makers[request.kind], request, security)
        else:
            address = request.where[0] if request.kind == "scheduler" else None
            file = request.where[0] if request.kind == "scheduler-file" else None
            running = connect(
                request.workers,
                address,
                file,
                security=security,
                tls=request.tls,
                memory=request.memory,
            )
        with running as client:
            yield client


@contextmanager
def _running(
    make: Callable[[ClusterRequest, Security | None], SpecCluster],
    request: ClusterRequest,
    security: Security | None,
) -> Iterator[Client]:
    """Run a cluster on other machines while the block runs."""
    try:
        cluster = make(request, security)
    except (ConfigError, MachineError):
        raise
    # Each kind of cluster fails in its own ways; to the user they are all the machine's.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise MachineError(f"the workers did not start: {reason}") from None
    with closing_cluster(cluster), Client(cluster) as client:
        yield client


def _ssh(request: ClusterRequest, security: Security | None) -> SpecCluster:
    # SSHCluster sends Dask's settings with every command that it runs on another machine.
    listening = scheduler_listening(request)
    _refuse_quotes(security)
    worker = {
        "n_workers": cores_per_host(request),
        "nthreads": 1,
        "memory_limit": request.memory or "auto",
        "env": start_environment(),
        **workers_listening(listening),
        **server_options(security),
    }

    # The first host also runs the scheduler.
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


def _refuse_quotes(security: Security | None) -> None:
    """Refuse paths of certificates that Dask cannot send to another machine's shell.

    Raises:
        ConfigError: If one has a quotation mark: Dask puts its commands between two of them.
    """
    for path in server_options(security).get("security", {}).values():
        if "'" in str(path):
            raise ConfigError(f"certificates (in --out) must have paths without ', got {path}")


def _slurm(request: ClusterRequest, security: Security | None) -> SpecCluster:
    from dask_jobqueue import SLURMCluster

    from drakegrasp.cluster.slurm_job import QuotedJob

    # Whatever is None or not named here is as the user's jobqueue.yaml says.
    cores, listening = cores_per_job(request), scheduler_listening(request)
    jobs, memory = job_count(request), job_memory(request)
    cluster = SLURMCluster(
        job_cls=QuotedJob,
        cores=cores,
        processes=cores,
        memory=None if memory is None else f"{cores * memory_bytes(memory)}B",
        walltime=request.walltime,
        interface=request.interface,
        security=security,
        worker_extra_args=[
            *(jobqueue("worker-extra-args") or ()),
            *_lifetime(job_walltime(request)),
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

    # Submit jobs only if SLURM would run them.
    try:
        _refuse_bad_job(cluster.job_script())
    except MachineError:
        cluster.close()
        raise
    cluster.scale(jobs=jobs)
    _refill(cluster, jobs)
    return cluster


def _refuse_bad_job(script: str) -> None:
    """Ask SLURM whether it would run a job, before any is submitted: later nobody sees it fail.

    Raises:
        MachineError: If there is no SLURM here, or it would not run the job.
    """
    try:
        test = subprocess.run(
            ["sbatch", "--test-only"], input=script, capture_output=True, text=True
        )
    except FileNotFoundError:
        raise MachineError(
            "there is no sbatch on the PATH: start this on a machine that submits jobs"
        ) from None
    if test.returncode:
        raise MachineError(f"SLURM does not accept the job: {test.stderr.strip()}")


class _Refill:
    """Submits a new job in place of each that ended: at its walltime, or with its machine.

    `SLURMCluster.adapt(minimum_jobs=n, maximum_jobs=n)` does not: it compares n with the jobs that
    were asked for, and a job of several workers stays among these when it has ended (dask-jobqueue
    0.9, distributed 2026.8).
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

        # A job is there if it has a worker; one that still queues never was.
        names = {str(w["name"]) for w in cluster.scheduler_info["workers"].values()}
        present = {job for job in cluster.worker_spec if _has_worker(str(job), names)}
        missing = self._seen - present

        # Forget the lost jobs: to reach the number of jobs again, Dask submits new ones.
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
    """Return Dask's settings as lines of a job script, which inherits nothing."""
    lines = []
    for key, value in dask_settings().items():
        name = "DASK_" + key.upper().replace(".", "__").replace("-", "_")
        lines.append(f"export {name}={shlex.quote(repr(value))}")
    return lines


def _lifetime(walltime: str | None) -> list[str]:
    """Return the options by which a worker ends before its job's walltime."""
    if walltime is None:
        return []
    seconds = walltime_seconds(walltime)
    margin = min(LIFETIME_MARGIN, seconds / 4.0)
    stagger = min(LIFETIME_STAGGER, margin / 2.0)
    return ["--lifetime", f"{seconds - margin:.0f}s", "--lifetime-stagger", f"{stagger:.0f}s"]


@contextmanager
def _security(request: ClusterRequest, out: Path) -> Iterator[Security | None]:
    """Yield the certificates; those that are made for this run are removed."""
    given = chosen_security(request.tls, request.tls_files, elsewhere=request.kind != "local")
    if request.kind in ("ssh", "slurm") and request.tls and given is None:
        with private_directory(out) as folder:
            yield security_of(make_certificates(folder))
    else:
        yield given  # workers on this machine have certificates of their own
