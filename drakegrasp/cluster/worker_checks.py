"""Checks the workers at the start of a build, and each worker that joins later.

Input: a Dask client. Output: workers that produce the same results as this machine, and whether
they see the files of the dataset. A worker that cannot render a test image is closed. A worker with
several threads, or with another version of Drake, drakegrasp or the hand, is rejected. At the start
this is an error; a worker that joins later is closed before its first task. If a worker does not
see the files, or no worker has joined yet, the files are sent to all workers over the network, see
`drakegrasp.cluster.wire`.
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
    """Files that a worker must see to work directly in a dataset's directory.

    Attributes:
        probe: File that the client wrote there.
        text: Content of the probe.
        files: Other files that must exist, such as meshes.
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
    """Sets up a worker, or closes it before its first task if it is not suitable."""

    name = "drakegrasp-admission"

    def __init__(
        self, config: Config, hosts: frozenset[str], shared: Shared | None, *, travels: bool
    ) -> None:
        """Store the requirements.

        Args:
            config: Configuration of the build.
            hosts: Names of the machines that are known to render.
            shared: Files that a worker must see; None if it need not see any.
            travels: Whether the worker gets the hand's files from the client.
        """
        self._config, self._hosts, self._shared = config, hosts, shared
        self._travels, self._versions = travels, installed_versions(config)

    def setup(self, worker: Worker) -> None:
        """Check and set up the worker; Dask calls this before the worker's first task."""
        os.environ.update(WORKER_ENVIRONMENT)  # for a worker that was started by hand
        fault = None
        if self._shared is not None and not self._shared.is_seen():
            fault = f"must see {self._shared.probe.parent} like those at the start"
        if fault is None:
            fault = unfitness(
                self._config, self._versions, travels=self._travels, dask_worker=worker
            )
        if fault is None and _host() not in self._hosts:
            fault = _image_fault()
        if fault is not None:
            worker.log_event(_TOPIC, f"not used: worker {worker.address}: {fault}")
            # Its nanny is closed as well, because a new process would have the same fault.
            worker.loop.add_callback(worker.close, nanny=True, reason="drakegrasp-unfit")


@contextmanager
def checked_workers(
    client: Client, config: Config, out: Path | None = None, meshes: Sequence[Path] = ()
) -> Iterator[bool]:
    """Reject unsuitable workers, and check workers that join while the block runs.

    Yields whether the files of the dataset must be sent, because a worker does not see them.

    Args:
        client: Client of the cluster.
        config: Configuration, whose hand is among the versions that must agree.
        out: Directory of the dataset; None for work without a dataset.
        meshes: Files in other directories that workers read.

    Raises:
        MachineError: If a present worker has several threads, or another version of drakegrasp,
            Drake or the hand, or if no worker can render.
    """
    with _shared(out, meshes) as shared:
        travels = shared is not None and _must_travel(client, shared)

        # Reject workers that the user must change. A hand that is sent has the client's version.
        versions = installed_versions(config)
        faults = client.run(unfitness, config, versions, travels=travels)
        for address, fault in faults.items():
            if fault is not None:
                raise MachineError(f"worker {address}: {fault}")

        # Do not use machines that cannot render, if there are others.
        hosts = _rendering_hosts(client)

        # Change settings that this program can change, for present and for later workers.
        client.run_on_scheduler(_saturate)
        client.subscribe_topic(_TOPIC, _print_message)
        try:
            later = Admission(config, hosts, None if travels else shared, travels=travels)
            client.register_plugin(later)
            yield travels
        finally:
            # A user's scheduler continues to run, and its later workers must not be checked by us.
            with suppress(Exception):
                client.unsubscribe_topic(_TOPIC)
            with suppress(Exception):
                client.unregister_worker_plugin(Admission.name)


@contextmanager
def _shared(out: Path | None, meshes: Sequence[Path]) -> Iterator[Shared | None]:
    """Yield the files that workers must see, with a new probe file in the dataset's directory."""
    if out is None:
        yield None
        return
    # Check one file per folder.
    files = {path.parent: path for path in meshes}
    probe, text = temporary_name(out / "probe"), secrets.token_hex(16)
    try:
        probe.write_text(text, encoding="utf-8")
        yield Shared(probe=probe, text=text, files=tuple(files.values()))
    finally:
        probe.unlink(missing_ok=True)


def _must_travel(client: Client, shared: Shared) -> bool:
    """Return whether files must be sent to the workers; if so, print why."""
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


def unfitness(
    config: Config, ours: Mapping[str, str], *, travels: bool, dask_worker: Worker
) -> str | None:
    """Return why a worker must not work, or None if it may; called in the worker.

    Args:
        config: Configuration, whose hand is among the versions unless its files are sent.
        ours: Versions of the client.
        travels: Whether the worker gets the hand's files from the client.
        dask_worker: The worker.
    """
    threads = dask_worker.state.nthreads
    if threads != 1:
        return (
            "must have one thread (dask worker --nthreads 1), because OpenGL renders in one "
            f"thread of a process only, got {threads}"
        )
    try:
        theirs = {**ours, **(package_versions() if travels else installed_versions(config))}
    except HandError as error:
        theirs = {**package_versions(), "hand": f"none ({error})"}
    for name in REQUIRED_VERSIONS:
        if theirs[name] != ours[name]:
            return f"must have {name} {ours[name]} like the client, got {theirs[name]}"
    return None


def _rendering_hosts(client: Client) -> frozenset[str]:
    """Return the names of the machines that can render; close the workers of other machines.

    One worker of each machine renders a test image.

    Raises:
        MachineError: If there are workers, but no machine can render.
    """
    addresses: dict[str, list[str]] = {}
    for address, host in client.run(_host).items():
        addresses.setdefault(host, []).append(address)
    if not addresses:
        return frozenset()  # workers that join are checked then
    found = client.run(_image_fault, workers=[workers[0] for workers in addresses.values()])
    faults = {host: found.get(workers[0]) for host, workers in addresses.items()}

    # One machine without OpenGL, among hundreds, must not stop the build.
    bad = [host for host, fault in faults.items() if fault is not None]
    if bad and len(bad) == len(faults):
        raise MachineError(f"worker {addresses[bad[0]][0]}: {faults[bad[0]]}")
    for host in bad:
        sys.stderr.write(f"not used: workers on {host}: {printable(str(faults[host]))}\n")
        client.retire_workers(addresses[host], close_workers=True)
    return frozenset(host for host in faults if host not in bad)


def _host() -> str:
    """Return the name of this machine."""
    return socket.gethostname()


def _image_fault() -> str | None:
    """Return why the workers of this machine cannot render, or None if they can."""
    ok, what = probe_image()
    return None if ok else f"must render a test image, got {what}; see `drakegrasp doctor` there"


def _saturate(dask_scheduler: Scheduler) -> None:
    """Apply our settings to a scheduler, which does not have them if a user started it."""
    dask_scheduler.WORKER_SATURATION = SATURATION
    if dask_scheduler.worker_ttl:
        dask_scheduler.worker_ttl = max(dask_scheduler.worker_ttl, SILENCE_SECONDS)


def _print_message(event: tuple[float, Any]) -> None:
    sys.stderr.write(f"{event[1]}\n")
