"""Which workers may do the work: checked when they are there, and when they join later.

In: a Dask client. A worker with several threads, or with another Drake, drakegrasp or hand,
would give other results than this machine; one that was started by hand lacks settings.
Those that are there are refused by name; one that joins later is closed before its first
task, with a line on standard error, and the build goes on without it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from distributed import Client, Scheduler, Worker, WorkerPlugin

from drakegrasp.config import Config
from drakegrasp.dataset.manifest import REQUIRED_VERSIONS, installed_versions
from drakegrasp.errors import MachineError

#: Environment of the workers. Software OpenGL would start threads of its own beside the
#: one process per core, and nothing that a worker does may need the network.
WORKER_ENVIRONMENT = {
    "LP_NUM_THREADS": "0",
    "DRAKE_ALLOW_NETWORK": "none",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
#: Tasks that the scheduler gives a worker, per thread: one that waits would share the blame
#: when the one that runs kills the worker.
SATURATION = 1.0
_TOPIC = "drakegrasp-refused"


class Admission(WorkerPlugin):  # type: ignore[misc]
    """Sets up a worker, or closes it before its first task if it is not fit for the work."""

    name = "drakegrasp-admission"

    def __init__(self, config: Config) -> None:
        self._config, self._wanted = config, installed_versions(config)

    def setup(self, worker: Worker) -> None:
        """Check and set up the worker; Dask calls this before it gives it any task."""
        os.environ.update(WORKER_ENVIRONMENT)  # for a worker that was started by hand
        fault = unfitness(worker.state.nthreads, installed_versions(self._config), self._wanted)
        if fault is not None:
            worker.log_event(_TOPIC, f"worker {worker.address}: {fault}")
            # Its nanny goes too: a new process would not be fitter.
            worker.loop.add_callback(worker.close, nanny=True, reason="drakegrasp-unfit")


@contextmanager
def admitted_workers(client: Client, config: Config) -> Iterator[None]:
    """Refuse workers that are not fit for the work; check those that join while the block runs.

    Raises:
        MachineError: If a worker that is there has several threads, or other versions of what
            decides.
    """
    wanted = installed_versions(config)
    found = client.run(installed_versions, config)
    for address, threads in client.nthreads().items():
        fault = unfitness(threads, found.get(address, wanted), wanted)
        if fault is not None:
            raise MachineError(f"worker {address}: {fault}")
    client.run_on_scheduler(_saturate)
    client.subscribe_topic(_TOPIC, _say)
    client.register_plugin(Admission(config))
    try:
        yield
    finally:
        # A scheduler of the user's lives on, and its later workers are no business of ours.
        with suppress(Exception):
            client.unsubscribe_topic(_TOPIC)
            client.unregister_worker_plugin(Admission.name)


def unfitness(threads: int, theirs: dict[str, str], ours: dict[str, str]) -> str | None:
    """Return why a worker with these threads and versions must not work, or None."""
    if threads != 1:
        return (
            "must have one thread (dask worker --nthreads 1), because the first that renders "
            f"owns the images, got {threads}"
        )
    for name in REQUIRED_VERSIONS:
        if theirs[name] != ours[name]:
            return f"must have {name} {ours[name]} like the client, got {theirs[name]}"
    return None


def _saturate(dask_scheduler: Scheduler) -> None:
    """Set what a scheduler that was started by hand did not read from this program's settings."""
    dask_scheduler.WORKER_SATURATION = SATURATION


def _say(event: tuple[float, Any]) -> None:
    sys.stderr.write(f"not used: {event[1]}\n")
