"""Which workers may do the work: checked at the start of a build, and when a worker joins later.

In: a Dask client. Out: workers that give the results of this machine. A worker that cannot render a
test image is closed. One with several threads, or with another version of Drake, drakegrasp or the
hand, is refused: at the start with an
error, later by closing it before its first task. All workers get the same BLAS kernel; one whose
kernel cannot be set still works, with a line on standard error.
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from distributed import Client, Nanny, NannyPlugin, Scheduler, Worker, WorkerPlugin

from drakegrasp.build.prepare import PREPARE_SECONDS
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import REQUIRED_VERSIONS, installed_versions
from drakegrasp.errors import MachineError, printable
from drakegrasp.runtime import kernels
from drakegrasp.runtime.blas import running_kernel
from drakegrasp.runtime.journal import wall_limit
from drakegrasp.runtime.kernels import KERNELS, agreed_kernel, common_kernel, supported_kernel
from drakegrasp.vision.probe_image import probe_image

#: Tasks that the scheduler gives to a worker, per thread: a task that waits behind another would
#: be blamed, too, when that one kills the worker.
SATURATION = 1.0
#: Time without a sign of life after which the scheduler gives a worker up [s]: longer than the
#: limits of every step (see `runtime.journal`). A step that holds the interpreter gives none, and
#: its journal tells more than the scheduler knows. A lost connection is noticed at once.
SILENCE_SECONDS = 2.0 * wall_limit(PREPARE_SECONDS)
#: Topic of the messages from workers that join later.
_TOPIC = "drakegrasp-admission"
_MAY_DIFFER = "last bits of simulated values may differ"


def worker_environment() -> dict[str, str]:
    """Return the environment variables that every worker gets, on this machine and on others.

    Software OpenGL and BLAS would start threads beside the one process per core, and nothing that
    a worker does needs the network. The BLAS kernel is not among them: another machine's CPU may
    not support this machine's (see `KernelSetting`), and workers here inherit it.
    """
    return {
        "LP_NUM_THREADS": "0",
        "DRAKE_ALLOW_NETWORK": "none",
        "OMP_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }


class KernelSetting(NannyPlugin):
    """Makes the workers of a nanny run a BLAS kernel.

    Dask sets this up in every nanny: in one that joins later before it starts its worker, in one
    that runs already it restarts the worker if that has another kernel.
    """

    name = "drakegrasp-kernel"

    def __init__(self, kernel: str) -> None:
        self._kernel = kernel
        #: What the nanny's two environments said before; nothing where they were left alone.
        self._before: list[str | None] = []

    def setup(self, nanny: Nanny) -> None:
        """Set the kernel in a nanny; a CPU that does not support it gets its own fastest."""
        if self._kernel not in KERNELS:
            return  # OpenBLAS chose it by itself; the worker tells if it has another
        kernel = common_kernel([self._kernel, supported_kernel()])
        if kernel in (None, _kernel_of(nanny)):
            return
        # The worker is a new process that loads NumPy before it sees `env`.
        environments = (nanny.env, nanny.pre_spawn_env)
        self._before = [environment.get(kernels.VARIABLE) for environment in environments]
        for environment in environments:
            environment[kernels.VARIABLE] = kernel
        self.restart = True  # Dask reads this after the setup

    def teardown(self, nanny: Nanny) -> None:
        """Take the kernel back; a nanny that was started by hand outlives the build."""
        for environment, value in zip((nanny.env, nanny.pre_spawn_env), self._before, strict=False):
            environment.pop(kernels.VARIABLE, None)
            if value is not None:
                environment[kernels.VARIABLE] = value


def _kernel_of(nanny: Nanny) -> str:
    """Return the BLAS kernel with which a nanny starts its worker."""
    for environment in (nanny.env, nanny.pre_spawn_env, os.environ):
        if kernels.VARIABLE in environment:
            return str(environment[kernels.VARIABLE])
    return running_kernel()


class Admission(WorkerPlugin):  # type: ignore[misc]
    """Sets up a worker, or closes it before its first task if it is not fit for the work."""

    name = "drakegrasp-admission"

    def __init__(self, config: Config, kernel: str | None, hosts: frozenset[str]) -> None:
        """Know what is fit.

        Args:
            config: Of the build.
            kernel: The BLAS kernel of the workers; None if they have none in common.
            hosts: Names of the machines that are known to render.
        """
        self._config, self._kernel, self._hosts = config, kernel, hosts
        self._versions = installed_versions(config)

    def setup(self, worker: Worker) -> None:
        """Check and set up the worker; Dask calls this before it gives it any task."""
        os.environ.update(worker_environment())  # for a worker that was started by hand
        fault = unfitness(worker.state.nthreads, installed_versions(self._config), self._versions)
        if fault is None and _host() not in self._hosts:
            fault = _image_fault()
        if fault is not None:
            worker.log_event(_TOPIC, f"not used: worker {worker.address}: {fault}")
            # Its nanny is closed, too: a new process would not be fitter.
            worker.loop.add_callback(worker.close, nanny=True, reason="drakegrasp-unfit")
        elif self._kernel not in (None, running_kernel()):
            worker.log_event(
                _TOPIC,
                f"warning: worker {worker.address} runs BLAS kernel {running_kernel()}, not "
                f"{self._kernel} like the others: {_MAY_DIFFER}",
            )


@contextmanager
def admitted_workers(client: Client, config: Config) -> Iterator[str | None]:
    """Refuse workers that are not fit for the work; check those that join while the block runs.

    Yields the BLAS kernel that the workers run; None if they have none in common.

    Args:
        client: Of the cluster.
        config: Its hand is among the versions that must agree.

    Raises:
        MachineError: If a worker that is there has several threads, or another version of
            drakegrasp, Drake or the hand, or none of them can render.
    """
    # Refuse what the user must change.
    versions = installed_versions(config)
    theirs = client.run(installed_versions, config)
    for address, threads in client.nthreads().items():
        fault = unfitness(threads, theirs.get(address, versions), versions)
        if fault is not None:
            raise MachineError(f"worker {address}: {fault}")

    # Do without machines that cannot render, if there are others.
    hosts = _rendering_hosts(client)

    # Set what this program can change: for the workers that are there and for later ones.
    client.run_on_scheduler(_saturate)
    client.subscribe_topic(_TOPIC, _print_message)
    try:
        kernel = _set_kernel(client)
        client.register_plugin(Admission(config, kernel, hosts))
        yield kernel
    finally:
        # A scheduler of the user's lives on; its later workers are not ours to check.
        with suppress(Exception):
            client.unsubscribe_topic(_TOPIC)
            client.unregister_worker_plugin(KernelSetting.name, nanny=True)
        with suppress(Exception):
            client.unregister_worker_plugin(Admission.name)


def unfitness(threads: int, theirs: Mapping[str, str], ours: Mapping[str, str]) -> str | None:
    """Return why a worker with these threads and versions must not work, or None if it may."""
    if threads != 1:
        return (
            "must have one thread (dask worker --nthreads 1), because OpenGL renders in one "
            f"thread of a process only, got {threads}"
        )
    for name in REQUIRED_VERSIONS:
        if theirs[name] != ours[name]:
            return f"must have {name} {ours[name]} like the client, got {theirs[name]}"
    return None


def _rendering_hosts(client: Client) -> frozenset[str]:
    """Return the names of the workers' machines that can render; close the others' workers.

    One worker of each machine finds it out.

    Raises:
        MachineError: If there are workers, and none can render.
    """
    addresses: dict[str, list[str]] = {}
    for address, host in client.run(_host).items():
        addresses.setdefault(host, []).append(address)
    if not addresses:
        return frozenset()  # those that join are asked then
    found = client.run(_image_fault, workers=[workers[0] for workers in addresses.values()])
    faults = {host: found.get(workers[0]) for host, workers in addresses.items()}

    # A machine without OpenGL may be one of hundreds.
    bad = [host for host, fault in faults.items() if fault is not None]
    if bad and len(bad) == len(faults):
        raise MachineError(f"worker {addresses[bad[0]][0]}: {faults[bad[0]]}")
    for host in bad:
        sys.stderr.write(f"not used: workers on {host}: {printable(str(faults[host]))}\n")
        client.retire_workers(addresses[host], close_workers=True)
    return frozenset(host for host in faults if host not in bad)


def _host() -> str:
    """Return the name of the machine that calls."""
    return socket.gethostname()


def _image_fault() -> str | None:
    """Return why this machine's workers cannot render, or None if they can."""
    ok, what = probe_image()
    return None if ok else f"must render a test image, got {what}; see `drakegrasp doctor` there"


def _set_kernel(client: Client) -> str | None:
    """Give all workers the BLAS kernel on which they agree; return it.

    Workers without a nanny keep theirs: `Admission` says so. Without a worker yet, it is the
    client's.
    """
    supported = client.run(supported_kernel)
    kernel = agreed_kernel(
        running_kernel(), client.run(running_kernel).values(), supported.values()
    )
    if kernel is not None:
        client.register_plugin(KernelSetting(kernel))
        return kernel

    # Nothing is known of other CPUs: machines of one kind run one kernel all the same.
    running = sorted(set(client.run(running_kernel).values()))
    if len(running) == 1:
        return running[0]
    sys.stderr.write(f"warning: workers run BLAS kernels {', '.join(running)}: {_MAY_DIFFER}\n")
    return None


def _saturate(dask_scheduler: Scheduler) -> None:
    """Set what a scheduler that was started by hand has not read from this program's settings."""
    dask_scheduler.WORKER_SATURATION = SATURATION
    if dask_scheduler.worker_ttl:
        dask_scheduler.worker_ttl = max(dask_scheduler.worker_ttl, SILENCE_SECONDS)


def _print_message(event: tuple[float, Any]) -> None:
    sys.stderr.write(f"{event[1]}\n")
