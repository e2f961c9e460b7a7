"""Which workers may do the work: checked at the start of a build, and when a worker joins later.

In: a Dask client. Out: workers that give the results of this machine, and whether they see the
files of the dataset. A worker that cannot render a test image is closed. One with several threads,
or with another version of Drake, drakegrasp or the hand, is refused: at the start with an error,
later by closing it before its first task. Where one of them does not see the files, or none is
there yet, the files of all travel over the network, see `drakegrasp.cluster.wire`.
"""

from __future__ import annotations

import os
import secrets
import socket
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed import Client, Scheduler, Worker, WorkerPlugin

from drakegrasp.cluster.connect import SATURATION, SILENCE_SECONDS, WORKER_ENVIRONMENT
from drakegrasp.config import Config
from drakegrasp.dataset.manifest import REQUIRED_VERSIONS, installed_versions, package_versions
from drakegrasp.errors import HandError, MachineError, counted, printable
from drakegrasp.runtime.files import probe_folder, temporary_name
from drakegrasp.vision.probe_image import probe_image

#: Topic of the messages from workers that join later.
_TOPIC = "drakegrasp-admission"


@dataclass(frozen=True, kw_only=True)
class Shared:
    """What a worker must see to work in a dataset's directory itself.

    Attributes:
        probe: File that the client wrote there.
        text: What is in it.
        files: Others that must be there, as a mesh.
    """

    probe: Path
    text: str
    files: Sequence[Path]

    def is_seen(self) -> bool:
        """Return whether this process sees the files, and can write in the directory."""
        try:
            probe_folder(self.probe.parent)
            same = self.probe.read_text(encoding="utf-8") == self.text
        except OSError:
            return False
        return same and all(path.is_file() for path in self.files)


class Admission(WorkerPlugin):  # type: ignore[misc]
    """Sets up a worker, or closes it before its first task if it is not fit for the work."""

    name = "drakegrasp-admission"

    def __init__(
        self, config: Config, hosts: frozenset[str], shared: Shared | None, *, travels: bool
    ) -> None:
        """Know what is fit.

        Args:
            config: Of the build.
            hosts: Names of the machines that are known to render.
            shared: What it must see, if anything.
            travels: Whether it gets the hand's files from the client.
        """
        self._config, self._hosts, self._shared = config, hosts, shared
        self._travels, self._versions = travels, installed_versions(config)

    def setup(self, worker: Worker) -> None:
        """Check and set up the worker; Dask calls this before it gives it any task."""
        os.environ.update(WORKER_ENVIRONMENT)  # for a worker that was started by hand
        fault = None
        if self._shared is not None and not self._shared.is_seen():
            fault = f"must see {self._shared.probe.parent} like those at the start"
        if fault is None:
            theirs = {**self._versions, **_own_versions(self._config, travels=self._travels)}
            fault = unfitness(worker.state.nthreads, theirs, self._versions)
        if fault is None and _host() not in self._hosts:
            fault = _image_fault()
        if fault is not None:
            worker.log_event(_TOPIC, f"not used: worker {worker.address}: {fault}")
            # Its nanny is closed as well: a new process would not be fitter.
            worker.loop.add_callback(worker.close, nanny=True, reason="drakegrasp-unfit")


@contextmanager
def admitted_workers(
    client: Client, config: Config, out: Path | None = None, meshes: Sequence[Path] = ()
) -> Iterator[bool]:
    """Refuse workers that are not fit for the work; check those that join while the block runs.

    Yields whether the files of the dataset must travel, because a worker does not see them.

    Args:
        client: Of the cluster.
        config: Its hand is among the versions that must agree.
        out: Directory of the dataset; None for work that needs none.
        meshes: Files elsewhere that workers read.

    Raises:
        MachineError: If a worker that is there has several threads, or another version of
            drakegrasp, Drake or the hand, or none of them can render.
    """
    with _shared(out, meshes) as shared:
        travels = shared is not None and _must_travel(client, shared)

        # Refuse what the user must change. A hand that travels is the client's.
        versions = installed_versions(config)
        theirs = client.run(_own_versions, config, travels=travels)
        for address, threads in client.nthreads().items():
            fault = unfitness(threads, {**versions, **theirs.get(address, {})}, versions)
            if fault is not None:
                raise MachineError(f"worker {address}: {fault}")

        # Do without machines that cannot render, if there are others.
        hosts = _rendering_hosts(client)

        # Set what this program can change: for the workers that are there and for later ones.
        client.run_on_scheduler(_saturate)
        client.subscribe_topic(_TOPIC, _print_message)
        try:
            later = Admission(config, hosts, None if travels else shared, travels=travels)
            client.register_plugin(later)
            yield travels
        finally:
            # A scheduler of the user's lives on; its later workers are not ours to check.
            with suppress(Exception):
                client.unsubscribe_topic(_TOPIC)
            with suppress(Exception):
                client.unregister_worker_plugin(Admission.name)


@contextmanager
def _shared(out: Path | None, meshes: Sequence[Path]) -> Iterator[Shared | None]:
    """Yield what workers must see, with a file of random text in a dataset's directory."""
    if out is None:
        yield None
        return
    # One of each folder stands for the others.
    files = {path.parent: path for path in meshes}
    probe, text = temporary_name(out / "probe"), secrets.token_hex(16)
    try:
        probe.write_text(text, encoding="utf-8")
        yield Shared(probe=probe, text=text, files=tuple(files.values()))
    finally:
        probe.unlink(missing_ok=True)


def _must_travel(client: Client, shared: Shared) -> bool:
    """Return whether files must travel to the workers; if so, say why."""
    seen = list(client.run(shared.is_seen).values())
    if seen and all(seen):
        return False
    what = "there is no worker yet"
    if seen:
        blind = seen.count(False)
        see = f"do{'es' * (blind == 1)} not see {shared.probe.parent} and the meshes"
        what = f"{blind} of {counted(len(seen), 'worker')} {see}"
    sys.stderr.write(f"{what}: files travel over the network\n")
    return True


def _own_versions(config: Config, *, travels: bool) -> dict[str, str]:
    """Return the versions of this process; without that of the hand if its files travel."""
    if travels:
        return package_versions()
    try:
        return installed_versions(config)
    except HandError as error:
        return {**package_versions(), "hand": f"none ({error})"}


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


def _saturate(dask_scheduler: Scheduler) -> None:
    """Set what a scheduler that was started by hand has not read from this program's settings."""
    dask_scheduler.WORKER_SATURATION = SATURATION
    if dask_scheduler.worker_ttl:
        dask_scheduler.worker_ttl = max(dask_scheduler.worker_ttl, SILENCE_SECONDS)


def _print_message(event: tuple[float, Any]) -> None:
    sys.stderr.write(f"{event[1]}\n")
