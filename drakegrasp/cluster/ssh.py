"""Workers on hosts that are reached over SSH; the first host also runs the scheduler."""

from __future__ import annotations

import logging
import math
import shlex
import sys

from distributed import SpecCluster, SSHCluster
from distributed.security import Security

from drakegrasp.cluster.certificates import server_options
from drakegrasp.cluster.connect import BLAS_KERNEL, LOOPBACK, start_environment
from drakegrasp.cluster.kinds import Remote, refuse_unplain
from drakegrasp.errors import ConfigError

#: A scheduler on another machine ends by itself after this time without work, because its client
#: must have been killed.
IDLE_TIME = "1 hour"


class Ssh(Remote):
    """Hosts by name; a host that is named twice has twice as many workers."""

    follow = (1, math.inf, "the names of the hosts")

    def __post_init__(self) -> None:
        """Reject hosts with a user name, and numbers of workers that do not fit the hosts."""
        super().__post_init__()
        for host in self.where:
            if "@" in host:
                raise ConfigError(
                    f"a host must be a name or address, got {host!r}: the user and "
                    "the key for it go into ~/.ssh/config"
                )
            refuse_unplain("a host", host)

        # All hosts have the same number of workers.
        hosts, workers, cores = len(self.where), self.workers, self.cores
        if cores is not None and workers not in (None, hosts * cores):
            raise ConfigError(
                f"--workers must be --cores times the number of hosts, {hosts * cores}, or "
                f"not be given, got {workers}"
            )
        if cores is None:
            if workers is None:
                raise ConfigError("--workers or --cores must be given for workers over ssh")
            if workers % hosts:
                raise ConfigError(
                    f"--workers must be a multiple of the number of hosts, {hosts}, got {workers}; "
                    "a host may be named more than once"
                )
            cores = workers // hosts
        self.per_host = cores
        self.listening()

    def line(self) -> str:
        """Return a description of the workers that will be started."""
        hosts = dict.fromkeys(self.where)
        on = f"{' '.join(hosts)}, scheduler on {self.where[0]}"
        return f"{len(self.where) * self.per_host} workers over ssh on {on}"

    def start(self, security: Security | None) -> SpecCluster:
        """Start scheduler and workers.

        SSHCluster sends Dask's settings with every command that it runs on another machine.

        Raises:
            ConfigError: If a path of a certificate or a variable contains a single quotation mark,
                because Dask puts its options between such marks.
        """
        server, environment = server_options(security), start_environment()
        for text in (*server.get("security", {}).values(), *environment.values()):
            if "'" in str(text):
                raise ConfigError(
                    f"paths of certificates (in --out) and {BLAS_KERNEL} must be without ', "
                    f"got {text}"
                )

        # A worker on each core; the first host also runs the scheduler.
        worker = {
            "n_workers": self.per_host,
            "nthreads": 1,
            "memory_limit": self.memory or "auto",
            "env": environment,
            **self.workers_listening(),
            **server,
        }
        scheduler = {"port": 0, "dashboard_address": f"{LOOPBACK}:0", "idle_timeout": IDLE_TIME}
        return SSHCluster(
            [self.where[0], *self.where],
            worker_options=worker,
            scheduler_options={**scheduler, **self.listening(), **server},
            security=security,
            remote_python=shlex.quote(sys.executable),
            silence_logs=logging.ERROR,
        )
