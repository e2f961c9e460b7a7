"""Preparing one mesh as a task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest
import trimesh

from drakegrasp.dataset.manifest import ObjectEntry, RefusedMesh
from drakegrasp.generation.prepare import PREPARE_SECONDS, DrawTask, PrepareTask, prepare_one
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes, source_sha256
from drakegrasp.runtime.journal import Journal, Verdict

pytestmark = pytest.mark.sim


@pytest.fixture
def task(tmp_path: Path) -> PrepareTask:
    """A task for a box, in a new directory."""
    (tmp_path / "meshes").mkdir()
    box = trimesh.creation.box([0.05, 0.06, 0.07]).subdivide().subdivide()
    box.export(tmp_path / "meshes" / "1_box.stl")
    (source,) = find_meshes(tmp_path / "meshes")
    config = load_config(overrides=["candidates.max=5"])
    return PrepareTask(source=source, out=tmp_path / "out", config=config, restartable=False)


def test_worker_reads_the_mesh_file_once_and_parses_that_of_a_prepared_object_not_at_all(
    task: PrepareTask, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads, read_bytes = [], Path.read_bytes

    def count(path: Path) -> bytes:
        reads.append(path)
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", count)
    _, entry = prepare_one(task)
    assert isinstance(entry, ObjectEntry)
    assert reads.count(task.source.path) == 1
    monkeypatch.setattr("drakegrasp.generation.prepare.prepare", None)
    assert prepare_one(task) == ("1_box", entry)
    assert reads.count(task.source.path) == 2


def test_mesh_that_is_no_solid_is_refused_with_its_reason(task: PrepareTask) -> None:
    """The entry has the file's name already, so the reason begins behind it."""
    path = task.source.path
    path.write_bytes(b"solid nothing\nendsolid nothing\n")
    name, entry = prepare_one(task)
    assert isinstance(entry, RefusedMesh)
    assert (name, entry.name) == ("1_box", "1_box")
    assert entry.mesh_sha256 == source_sha256(task.source)
    assert entry.reason and not entry.reason.startswith(path.name)
    assert not Path(task.out).exists()


def test_files_of_the_object_travel_to_who_draws_more_palms(task: PrepareTask) -> None:
    prepare_one(task)
    more = DrawTask(out=task.out, name="1_box", config=task.config, count=9)
    assert set(more.reads()) >= {"objects/1_box.npz", "objects/1_box.plan.h5"}


@pytest.mark.parametrize(
    ("verdict", "reason", "again"),
    [
        (Verdict.HUNG, "preparing it passed its time limit", False),
        (Verdict.VANISHED, "preparing it was at work whenever its process vanished", True),
    ],
)
def test_mesh_that_killed_its_process_is_refused(
    task: PrepareTask, monkeypatch: pytest.MonkeyPatch, verdict: Verdict, reason: str, again: bool
) -> None:
    """The next build may have more memory, but no more time."""
    monkeypatch.setattr(Journal, "verdict", lambda *_: verdict)
    _, entry = prepare_one(replace(task, restartable=True))
    assert isinstance(entry, RefusedMesh)
    assert entry.reason.startswith(reason) and entry.again is again


def test_preparing_has_a_limit(task: PrepareTask, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a limit does: test_journal.py."""
    step = Mock(wraps=Journal.step)
    monkeypatch.setattr(Journal, "step", lambda *given: step(*given))
    prepare_one(replace(task, restartable=True))
    assert [call.args[1:] for call in step.call_args_list] == [("prepare", PREPARE_SECONDS)]
