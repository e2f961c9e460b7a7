"""Workers in SLURM jobs, with the user's jobqueue.yaml; it needs the extra `[slurm]`.

A job's script means what it says, whatever is in the names of folders: dask-jobqueue (0.9) writes
paths into it without quotes, a blank splits them, and the shell runs what is in `$(...)`.
"""

from __future__ import annotations

import math
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import dask
from dask_jobqueue import SLURMCluster
from dask_jobqueue.slurm import SLURMJob
from distributed import SpecCluster, Status
from distributed.security import Security
from tornado.ioloop import PeriodicCallback

from drakegrasp.cluster.connect import LOOPBACK, NANNY_PRELOAD, dask_settings
from drakegrasp.cluster.kinds import REMOTE, Remote, memory_bytes
from drakegrasp.errors import ConfigError, MachineError

#: Memory of a worker, if neither the user nor jobqueue.yaml gives it.
WORKER_MEMORY = "2GB"
#: Time between two looks for lost jobs [s]; a job that is missing twice in a row is lost.
REFILL_SECONDS = 20.0
#: A worker ends by itself this long before its job's walltime, give or take the second [s]; less
#: for short jobs. Then its unit is not cut off, and jobs do not all end together.
LIFETIME_MARGIN, LIFETIME_STAGGER = 300.0, 120.0
#: A number of days, hours, minutes or seconds.
_NUMBER = re.compile("[0-9]{1,6}")


class Slurm(Remote):
    """Jobs of some cores each, with a worker on each core."""

    options = (*REMOTE, "walltime")

    def __post_init__(self) -> None:
        """Refuse a malformed walltime, and jobs without a number of workers."""
        super().__post_init__()
        if self.walltime is not None:
            walltime_seconds(self.walltime)
        if self.workers is None:
            raise ConfigError("--workers must be given with --cluster slurm")
        self.listening()
        self.per_job = int(self.cores or jobqueue("cores") or 1)
        self.jobs = math.ceil(self.workers / self.per_job)
        # None: jobqueue.yaml says that of a job; the queue has a limit.
        self.memory = self.memory or (None if jobqueue("memory") else WORKER_MEMORY)
        self.walltime = self.walltime or jobqueue("walltime")

    def listens(self) -> bool:
        """Return whether jobqueue.yaml says where the scheduler listens."""
        options = jobqueue("scheduler-options") or {}
        return bool(jobqueue("interface") or {"host", "interface"} & set(options))

    def count(self) -> int:
        """Return how many workers there will be."""
        return self.per_job * self.jobs

    def line(self) -> str:
        """Return what each job asks for, in words."""
        memory = "memory as in jobqueue.yaml" if self.memory is None else f"{self.memory} each"
        walltime = f"walltime {self.walltime or 'as the queue has it'}"
        return f"{self.count()} workers in SLURM jobs of {self.per_job}, {memory}, {walltime}"

    def start(self, security: Security | None) -> SpecCluster:
        """Submit the jobs, if SLURM would run them, and others in place of those that end."""
        # Whatever is None or not named here is as the user's jobqueue.yaml says.
        memory = None if self.memory is None else f"{self.per_job * memory_bytes(self.memory)}B"
        cluster = SLURMCluster(
            job_cls=QuotedJob,
            cores=self.per_job,
            processes=self.per_job,
            memory=memory,
            walltime=self.walltime,
            interface=self.interface,
            security=security,
            worker_extra_args=[
                *(jobqueue("worker-extra-args") or ()),
                *_lifetime(self.walltime),
                f"--dashboard-address={LOOPBACK}:0",
                # The settings' preload is not read by the command that starts a worker.
                f"--preload-nanny={NANNY_PRELOAD}",
                *([f"--host={LOOPBACK}"] if "host" in self.workers_listening() else []),
            ],
            job_script_prologue=[*(jobqueue("job-script-prologue") or ()), *_exports()],
            scheduler_options={
                "dashboard_address": f"{LOOPBACK}:0",
                **(jobqueue("scheduler-options") or {}),
                **self.listening(),
            },
        )
        try:
            _refuse_bad_job(cluster.job_script())
        except MachineError:
            cluster.close()
            raise
        cluster.scale(jobs=self.jobs)

        async def refill() -> None:
            PeriodicCallback(_Refill(cluster, self.jobs), 1000.0 * REFILL_SECONDS).start()

        cluster.sync(refill)
        return cluster


def jobqueue(key: str) -> Any:
    """Return a value of the user's jobqueue.yaml, or dask-jobqueue's default."""
    return dask.config.get(f"jobqueue.slurm.{key}", None)


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


class QuotedJob(SLURMJob):
    """A `SLURMJob` with every path of ours in quotes.

    What the user's jobqueue.yaml says of options and of lines of the script is shell already.
    """

    def __init__(
        self,
        *arguments: Any,
        security: Security | None = None,
        worker_extra_args: Sequence[str] = (),
        python: str | None = None,
        local_directory: str | None = None,
        **options: Any,
    ) -> None:
        """Take the arguments of a `SLURMJob`."""
        folder = local_directory or jobqueue("local-directory")
        super().__init__(
            *arguments,
            # Given as `security`, the files of the certificates would not be quoted.
            worker_extra_args=[*worker_extra_args, *_tls_words(security)],
            python=shlex.quote(python or jobqueue("python") or sys.executable),
            local_directory=None if folder is None else shlex.quote(str(folder)),
            **options,
        )


def _tls_words(security: Security | None) -> list[str]:
    """Return the options of a worker that name its certificates, as words of a shell."""
    files = {} if security is None else security.get_tls_config_for_role("worker")
    words = (
        (f"--tls-{key.replace('_', '-')}", shlex.quote(str(value)))
        for key, value in files.items()
        if key != "ciphers"  # Dask has no option for them
    )
    return [word for pair in words for word in pair]


def _refuse_bad_job(script: str) -> None:
    """Ask SLURM whether it would run a job, before any is submitted: later nobody sees it fail.

    Raises:
        MachineError: If there is no SLURM here, or it would not run the job.
    """
    command = ["sbatch", "--test-only"]
    try:
        test = subprocess.run(command, input=script, capture_output=True, text=True)
    except FileNotFoundError:
        raise MachineError(
            "there is no sbatch on the PATH: start this on a machine that submits jobs"
        ) from None
    if test.returncode:
        raise MachineError(f"SLURM does not accept the job: {test.stderr.strip()}")


def _exports() -> list[str]:
    """Return Dask's settings as lines of a job script, which inherits nothing."""
    names = {k: "DASK_" + k.upper().replace(".", "__").replace("-", "_") for k in dask_settings()}
    return [f"export {names[k]}={shlex.quote(repr(v))}" for k, v in dask_settings().items()]


def _lifetime(walltime: str | None) -> list[str]:
    """Return the options by which a worker ends before its job's walltime."""
    if walltime is None:
        return []
    seconds = walltime_seconds(walltime)
    margin = min(LIFETIME_MARGIN, seconds / 4.0)
    stagger = min(LIFETIME_STAGGER, margin / 2.0)
    return ["--lifetime", f"{seconds - margin:.0f}s", "--lifetime-stagger", f"{stagger:.0f}s"]


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
