"""What a build says in its log.

In: what happens. Out: lines of `log.jsonl`, see `drakegrasp.dataset.log`.
"""

from __future__ import annotations

import socket
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from drakegrasp.config import SplitConfig
from drakegrasp.dataset.assembly.split import may_train, split_rule
from drakegrasp.dataset.log import BuildLog
from drakegrasp.dataset.manifest import Manifest, ObjectEntry, RefusedMesh
from drakegrasp.errors import listed, printable
from drakegrasp.generation.work_unit import UnitSummary
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.sources import MeshSource
from drakegrasp.runtime.executor import WorkerPool


class BuildEvents:
    """Writes the events of one build to its log."""

    def __init__(self, out: Path, pool: WorkerPool | None, *, show: bool) -> None:
        """Open the log.

        Args:
            out: Directory of the dataset.
            pool: The workers; None if this process does the work.
            show: Whether to tell the user on standard error what cannot wait for the end: a
                warning, or that the build waits for workers.
        """
        self._pool, self._show = pool, show
        self._log = BuildLog(out)

    def started(self, manifest: Manifest, notices: Sequence[str]) -> None:
        """Log who builds what, and listen to the workers."""
        self._log(
            "started",
            command=sys.argv,
            host=socket.gethostname(),
            config_hash=manifest.config.simulation_hash(),
            seed=manifest.config.seed,
            versions=manifest.versions,
        )
        for notice in notices:
            self._log("notice", text=notice)
        if self._pool is not None:
            self._pool.on_change = self.workers_changed
            self._pool.on_none = self.no_worker

    def warn(self, text: str) -> None:
        """Log what the user should know before the simulation begins, and say it."""
        self._log("notice", text=text)
        if self._show:
            sys.stderr.write(f"{printable(text)}\n")

    def workers_changed(self, joined: set[str], left: set[str]) -> None:
        """Log the addresses of workers that joined and of those that left."""
        assert self._pool is not None
        for event, addresses in (("worker joined", joined), ("worker lost", left)):
            for address in sorted(addresses):
                self._log(event, address=address, workers=self._pool.size)

    def no_worker(self) -> None:
        """Log that there has been no worker for long."""
        self._log("no worker")
        if self._show:
            sys.stderr.write("there is no worker: waiting for one\n")

    def mesh_done(self, entry: ObjectEntry | RefusedMesh) -> None:
        """Log a mesh that was prepared or refused, by its entry in the manifest."""
        if isinstance(entry, RefusedMesh):
            self._log("mesh refused", name=entry.name, reason=entry.reason)
        else:
            self._log(
                "mesh prepared",
                name=entry.name,
                candidates=entry.candidates,
                notes=list(entry.notes),
            )

    def unit_done(self, summary: UnitSummary) -> None:
        """Log what a work unit returned."""
        header = summary.header
        self._log(
            "unit done",
            object=header.object_name,
            start=header.start,
            stop=header.stop,
            outcomes={outcome.label: count for outcome, count in summary.outcomes.items()},
            seconds={stage: round(seconds, 4) for stage, seconds in summary.seconds.items()},
            errors=summary.errors,
        )

    def damaged_shard(self, reason: str) -> None:
        """Log why a shard is run again."""
        self._log("damaged shard", reason=reason)

    def finished(self, *, simulated: int, reused: int, seconds: float) -> None:
        """Log the end of the build: numbers of work units, and its duration [s]."""
        self._log("finished", simulated=simulated, reused=reused, seconds=round(seconds, 3))

    def stopped(self, error: BaseException) -> None:
        """Log what stopped the build."""
        self._log("stopped", reason=f"{type(error).__name__}: {error}")


def nothing_trains(sources: Sequence[MeshSource], split: SplitConfig) -> str:
    """Return why no sample of these meshes can be in the split `train`; empty if one can.

    A configuration that names no class to train on, as a benchmark's, means it.
    """
    if split.train_classes == ():
        return ""
    classes = [source.class_name for source in sources]
    if split_rule(split, classes, [source.group or source.name for source in sources]) == "object":
        return ""
    counts = Counter(classes)
    if any(may_train(name, count, split) for name, count in counts.items()):
        return ""
    if split.train_classes is not None:
        why = "split.train_classes names none of the classes"
    else:
        why = "every class has one object, which is tested"
    return (
        f"nothing will train: {why}. Split by object (--set split.by=object), give classes more "
        "objects (--per-class for built-in ones; objects.yaml says which meshes are of one class), "
        f"or name the classes to train on, e.g. --set split.train_classes=[{min(counts)}]"
    )


def too_heavy(manifest: Manifest) -> str:
    """Return which objects are heavier than the payload of the hand file; empty if none is."""
    hand = load_hand(manifest.config.hand_source)
    if hand.payload is None:
        return ""
    names = [entry.name for entry in manifest.objects if entry.mass > hand.payload]
    if not names:
        return ""
    return (
        f"heavier than the payload of the hand {hand.name}, {hand.payload:g} kg: {len(names)} of "
        f"{len(manifest.objects)} objects ({listed(names)}); objects.mass makes them lighter"
    )
