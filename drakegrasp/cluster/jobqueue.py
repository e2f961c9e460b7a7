"""Workers in jobs of a batch scheduler, with the user's jobqueue.yaml; needs extra `[jobqueue]`.

Each kind of scheduler is a short class here. It names the class of dask-jobqueue that submits the
jobs, and overrides what differs from SLURM.
dask-jobqueue (0.9) quotes nothing in a script, so the shell would split a path at a blank and run a
command in `$(...)`. Each path goes into a script through `_word`; names and addresses are plain
(`kinds.refuse_unplain`), and the rest are numbers.
"""

from __future__ import annotations

import math
import re
import shlex
import shutil
import subprocess
import sys
import types
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import dask
import dask_jobqueue
from distributed import SpecCluster, Status
from distributed.security import Security
from tornado.ioloop import PeriodicCallback

from drakegrasp.cluster.certificates import security_of
from drakegrasp.cluster.connect import LOOPBACK, NANNY_PRELOAD, dask_settings, dask_variables
from drakegrasp.cluster.kinds import REMOTE, Remote, memory_bytes
from drakegrasp.errors import ConfigError, MachineError, counted

#: Memory of a worker, if neither the user nor jobqueue.yaml states it.
WORKER_MEMORY = "2GB"
#: Time between two checks for lost jobs [s]; a job that is missing twice in a row is lost.
REFILL_SECONDS = 20.0
#: Time before the walltime of its job at which a worker ends by itself, and the random variation of
#: this time [s]; they are shorter for short jobs. In this way units are not interrupted, and jobs
#: do not all end at the same time.
LIFETIME_MARGIN, LIFETIME_STAGGER = 300.0, 120.0
#: Name of the jobs, unless jobqueue.yaml states another than the default of dask-jobqueue.
NAME, _DEFAULT_NAME = "drakegrasp", "dask-worker"
#: Keys of jobqueue.yaml that a newcomer looks for among the options.
_SITE = ("queue", "account", "project", "job-extra-directives")
#: A number of days, hours, minutes or seconds.
_NUMBER = re.compile("[0-9]{1,6}")


class Jobs(Remote):
    """Jobs with several cores each, and a worker on each core.

    Attributes:
        of: Class of dask-jobqueue.
        title: Name of the scheduler.
        log: Directives that name the log file; empty if the scheduler names it after the job.
        test: Command that asks the scheduler whether it would run a script; empty if it has none.
        alone: Unit of a walltime in jobqueue.yaml that is a single number [s].
        pair: Units of the two numbers of a walltime with a single colon [s].
    """

    options = (*REMOTE, "walltime")
    of: ClassVar[type[Any]]
    title: ClassVar[str]
    log: ClassVar[tuple[str, ...]] = ()
    test: ClassVar[tuple[str, ...]] = ()
    alone: ClassVar[float] = 1.0
    pair: ClassVar[tuple[float, float]] = (60.0, 1.0)

    def __post_init__(self) -> None:
        """Reject a malformed walltime, and jobs without a number of workers."""
        super().__post_init__()
        if self.walltime is not None:
            walltime_seconds(self.walltime)
        if self.workers is None:
            raise ConfigError(f"--workers must be given with --cluster {self.kind}")
        self.listening()
        self.per_job = int(self.cores or self.setting("cores") or 1)
        self.jobs = math.ceil(self.workers / self.per_job)
        # None means that jobqueue.yaml states the memory of a job.
        self.memory = self.memory or (None if self.setting("memory") else WORKER_MEMORY)

    def setting(self, key: str) -> Any:
        """Return a value of the user's jobqueue.yaml, or dask-jobqueue's default."""
        return dask.config.get(f"jobqueue.{self.of.job_cls.config_name}.{key}", None)

    @classmethod
    def elsewhere(cls) -> str:
        """Return which keys of jobqueue.yaml state what no option states."""
        section = f"jobqueue.{cls.of.job_cls.config_name}"
        keys = ", ".join(key for key in _SITE if key in dask.config.get(section))
        return f": {section} in ~/.config/dask/jobqueue.yaml has {keys}"

    def listens(self) -> bool:
        """Return whether jobqueue.yaml states where the scheduler listens."""
        options = self.setting("scheduler-options") or {}
        return bool(self.setting("interface") or {"host", "interface"} & set(options))

    def line(self) -> str:
        """Return a description of the resources that each job requests."""
        memory = (
            "memory as in jobqueue.yaml" if self.memory is None else f"{self.memory} per worker"
        )
        walltime = f"walltime {self._walltime() or 'of the queue'}"
        jobs = f"{counted(self.jobs, f'{self.title} job')} ({self.per_job} in each)"
        workers = counted(self.per_job * self.jobs, "worker")
        return f"{workers} in {jobs}, {memory}, {walltime}"

    def _walltime(self) -> str | None:
        """Return the time limit of a job; None if it is not stated."""
        return self.walltime or self.setting("walltime")

    def seconds(self) -> float | None:
        """Return the time limit of a job [s]."""
        if self.walltime is not None:
            return walltime_seconds(self.walltime)
        told = self.setting("walltime")
        return None if told is None else walltime_seconds(str(told), self.alone, self.pair)

    def job_memory(self) -> int:
        """Return the memory of a job [bytes]."""
        if self.memory is None:
            return memory_bytes(str(self.setting("memory")))
        return self.per_job * memory_bytes(self.memory)

    def asks(self) -> dict[str, Any]:
        """Return the resources that a job requests, as options of the scheduler's class."""
        # The user's directives come later, and override ours.
        log = () if self.setting("log-directory") else self.log
        told = self.setting("job-extra-directives") or ()
        return {"walltime": self.told_walltime(), "job_extra_directives": [*log, *told]}

    def told_walltime(self) -> str | None:
        """Return the user's time limit as H:MM:SS; None if jobqueue.yaml states it."""
        return None if self.walltime is None else clock(walltime_seconds(self.walltime))

    def job(self, security: Security | None) -> dict[str, Any]:
        """Return all options of a job."""
        # Options that are None or not listed here are taken from the user's jobqueue.yaml.
        memory = None if self.memory is None else f"{self.job_memory()}B"
        return {
            "cores": self.per_job,
            "processes": self.per_job,
            "memory": memory,
            "job_name": NAME if (name := self.setting("name")) == _DEFAULT_NAME else name,
            "interface": self.interface,
            "security": security,
            "worker_extra_args": [
                *(self.setting("worker-extra-args") or ()),
                *_lifetime(self.seconds()),
                f"--dashboard-address={LOOPBACK}:0",
                # The command that starts a worker does not read the preload of the settings.
                f"--preload-nanny={NANNY_PRELOAD}",
                *([f"--host={LOOPBACK}"] if "host" in self.workers_listening() else []),
            ],
            "job_script_prologue": [*(self.setting("job-script-prologue") or ()), *_exports()],
            **self.asks(),
        }

    def script(self, out: Path) -> str:
        """Return the script of a job, with placeholders for scheduler address and certificates."""
        keys = out / ".tls-RUN"
        files = self.tls_files or (keys / "ca.pem", keys / "cert.pem", keys / "key.pem")
        options = self.job(security_of(files) if self.tls else None)
        protocol = "tls://" if self.tls else None
        job = quoted(self.of.job_cls)(
            f"{protocol or 'tcp://'}SCHEDULER:PORT", name="WORKER", protocol=protocol, **options
        )
        return str(job.job_script())

    def submission(self) -> str:
        """Return the command that submits a script."""
        return str(self.of.job_cls.submit_command)

    def start(self, security: Security | None) -> SpecCluster:
        """Submit the jobs, if the scheduler would run them, and replace lost jobs."""
        cluster = self.of(
            job_cls=quoted(self.of.job_cls),
            **self.job(security),
            scheduler_options={
                "dashboard_address": f"{LOOPBACK}:0",
                **(self.setting("scheduler-options") or {}),
                **self.listening(),
            },
        )
        try:
            self.refuse_bad_job(cluster.job_script())
        except MachineError:
            cluster.close()
            raise
        cluster.scale(jobs=self.jobs)

        async def refill() -> None:
            PeriodicCallback(_Refill(cluster, self.jobs), 1000.0 * REFILL_SECONDS).start()

        cluster.sync(refill)
        return cluster

    def refuse_bad_job(self, script: str) -> None:
        """Ask the scheduler whether it would run a job, because a later failure is not visible.

        Raises:
            MachineError: If the scheduler's commands are missing, or it would not run the job.
        """
        command = shlex.split(self.submission())[0]
        if shutil.which(command) is None:
            raise MachineError(
                f"there is no {command} on the PATH: start this on a machine that submits jobs"
            )
        if not self.test:
            return
        test = subprocess.run(self.test, input=script, capture_output=True, text=True)
        if test.returncode:
            raise MachineError(f"{self.title} does not accept the job: {test.stderr.strip()}")


class Slurm(Jobs):
    """SLURM: memory of a job by --mem."""

    of, title, test = dask_jobqueue.SLURMCluster, "SLURM", ("sbatch", "--test-only")
    log = (f"-o {NAME}-%j.log",)
    alone = 60.0

    def told_walltime(self) -> str | None:
        """Return the user's time limit, which has the form of SLURM."""
        return self.walltime


class Pbs(Jobs):
    """PBS: cores and memory of a job by one -l select."""

    of, title, log = dask_jobqueue.PBSCluster, "PBS", ("-j oe",)


class Lsf(Jobs):
    """LSF: -M limits the memory of a job, in the unit of lsf.conf; times are in minutes."""

    of, title, log = dask_jobqueue.LSFCluster, "LSF", (f"-o {NAME}-%J.log",)
    alone, pair = 60.0, (3600.0, 60.0)

    def told_walltime(self) -> str | None:
        """Return the user's time limit as H:MM, rounded up."""
        if self.walltime is None:
            return None
        minutes = math.ceil(walltime_seconds(self.walltime) / 60.0)
        return f"{minutes // 60}:{minutes % 60:02d}"


class Sge(Jobs):
    """Grid Engine: `mem_free` of a slot, unless jobqueue.yaml has a resource-spec."""

    of, title = dask_jobqueue.SGECluster, "Grid Engine"

    def __post_init__(self) -> None:
        """Reject jobs with several cores if the site's parallel environment is not stated."""
        super().__post_init__()
        directives = self.setting("job-extra-directives") or ()
        if self.per_job > 1 and not any("-pe " in directive for directive in directives):
            raise ConfigError(
                f"--cores must be 1 with --cluster {self.kind}, got {self.per_job}: for more, "
                f"job-extra-directives in jobqueue.yaml must have -pe NAME {self.per_job}"
            )

    def asks(self) -> dict[str, Any]:
        """Return the time limit and the memory of a job."""
        if self.setting("resource-spec"):
            return super().asks()
        slot = math.ceil(self.job_memory() / self.per_job / 2**20)
        return {**super().asks(), "resource_spec": f"mem_free={slot}M"}


class Htcondor(Jobs):
    """HTCondor: a job states its memory and disk in its ClassAd; only our time limit ends it."""

    of, title = dask_jobqueue.HTCondorCluster, "HTCondor"

    def asks(self) -> dict[str, Any]:
        """Return the disk and the time limit of a job."""
        disk = None if self.setting("disk") else f"{self.per_job}GB"
        file = f"{NAME}-$(ClusterId).log"
        log = {} if self.setting("log-directory") else {"output": file, "error": file}
        extra = {"batch_name": NAME, **log, **(self.setting("job-extra-directives") or {})}
        if (seconds := self.seconds()) is not None:
            extra.setdefault("allowed_job_duration", math.ceil(seconds))
        return {"disk": disk, "job_extra_directives": extra}


class Oar(Jobs):
    """OAR: cores of one node; memory if jobqueue.yaml names the property that has it."""

    of, title = dask_jobqueue.OARCluster, "OAR"
    log = (f"-O {NAME}-%jobid%.log", f"-E {NAME}-%jobid%.log")
    alone, pair = 3600.0, (3600.0, 60.0)

    def asks(self) -> dict[str, Any]:
        """Return the time limit and the property of memory."""
        name = self.setting("memory-per-core-property-name") or "not_applicable"
        return {**super().asks(), "memory_per_core_property_name": name}


def clock(seconds: float) -> str:
    """Return a time as HH:MM:SS."""
    whole = math.ceil(seconds)
    return f"{whole // 3600:02d}:{whole // 60 % 60:02d}:{whole % 60:02d}"


def walltime_seconds(
    text: str, alone: float = 60.0, pair: tuple[float, float] = (60.0, 1.0)
) -> float:
    """Return a time limit in seconds; the default units are those of SLURM.

    SLURM's forms: M, M:S, H:M:S, D-H, D-H:M, D-H:M:S.

    Args:
        text: The time.
        alone: Unit of a single number [s].
        pair: Units of two numbers without days [s].

    Raises:
        ConfigError: If the text has none of these forms.
    """
    days, dash, rest = text.partition("-") if "-" in text else ("0", "", text)
    parts = rest.split(":")
    if len(parts) > 3 or not all(_NUMBER.fullmatch(part) for part in (days, *parts)):
        raise ConfigError(f"walltime must be a time of SLURM such as 02:00:00, got {text[:40]!r}")
    numbers = [int(p) for p in parts]
    if dash or len(numbers) == 3:
        hours, minutes, seconds = [*numbers, 0, 0][:3]
        total = 86400.0 * int(days) + 3600.0 * hours + 60.0 * minutes + seconds
    elif len(numbers) == 2:
        total = pair[0] * numbers[0] + pair[1] * numbers[1]
    else:
        total = alone * numbers[0]
    if total <= 0.0:
        raise ConfigError(f"walltime must be longer than 0 s, got {text!r}")
    return total


class _Quoted:
    """A job of dask-jobqueue in which texts that are not ours are words of a shell.

    What jobqueue.yaml states is the user's shell code, e.g. `python: apptainer exec IMAGE python`.
    """

    config_name: str

    def __init__(
        self,
        *arguments: Any,
        security: Security | None = None,
        worker_extra_args: Sequence[str] = (),
        **options: Any,
    ) -> None:
        """Take the arguments of the job."""
        told = dask.config.get(f"jobqueue.{self.config_name}.python", None)
        super().__init__(  # type: ignore[call-arg]
            *arguments,
            # If the certificates were given as `security`, their paths would not be quoted.
            worker_extra_args=[*worker_extra_args, *self._tls_words(security)],
            python=told or self._word(sys.executable),
            **options,
        )

    def _tls_words(self, security: Security | None) -> Iterator[str]:
        """Yield a worker's options for its certificates."""
        files = {} if security is None else security.get_tls_config_for_role("worker")
        for key, value in files.items():
            if key != "ciphers":  # Dask has no option for them
                yield from (f"--tls-{key.replace('_', '-')}", self._word(str(value)))

    def _word(self, text: str) -> str:
        """Return a text as a word of a shell.

        Raises:
            ConfigError: If it has control characters: a line of a script may be a directive, also
                between quotation marks.
        """
        if not text.isprintable():
            raise ConfigError(f"a path in a job must be printable, got {text!r}")
        word = shlex.quote(text)
        # HTCondor replaces `$(NAME)` before the shell reads the line.
        return word.replace("$", "$(DOLLAR)") if self.config_name == "htcondor" else word


@cache
def quoted(job: type[Any]) -> type[Any]:
    """Return a class of jobs in which our paths are quoted."""
    return types.new_class(f"Quoted{job.__name__}", (_Quoted, job))


def _exports() -> list[str]:
    """Return Dask's settings as lines of a job script, because a job does not inherit settings."""
    told = dask_variables(dask_settings())
    return [f"export {name}={shlex.quote(value)}" for name, value in told.items()]


def _lifetime(seconds: float | None) -> list[str]:
    """Return the options that make a worker end before the walltime [s] of its job."""
    if seconds is None:
        return []
    margin = min(LIFETIME_MARGIN, seconds / 4.0)
    stagger = min(LIFETIME_STAGGER, margin / 2.0)
    return ["--lifetime", f"{seconds - margin:.0f}s", "--lifetime-stagger", f"{stagger:.0f}s"]


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
