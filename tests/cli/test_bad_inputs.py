"""Every kind of bad input gets one line and exit code 1 or 2, from every command that reads it.

A kind spoils one thing of one file. A table lists the kinds of a file; a test walks a table
through a command that reads the file, and names all kinds that had another answer.
"""

from __future__ import annotations

import io
import json
import shutil
import signal
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import uvicorn
import yaml
from helpers.bad_inputs import array_kinds, hdf5_kinds, manifests, text_kinds, trees
from helpers.bad_inputs.kinds import Kind
from helpers.commands import Result
from helpers.commands import run as run_command
from helpers.datasets import OTO, REPEATED, TRIALS, make_dataset

from drakegrasp.dataset.manifest import DIGEST, manifest_digest
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.settings import load_config
from drakegrasp.page.attempts import AttemptGallery

MANIFEST, REJECT = "manifest.json", "reject.json"
SHARD = "shards/1_box_a/0000000-0000002.h5"
MODEL, PLAN = "objects/1_box_a.npz", "objects/1_box_a.plan.h5"
#: What the dataset of the tests was made with.
SETTINGS = (
    *("camera.size=32", "unit_candidates=2", "filters.min_depth_variance=0"),
    "split.valid_fraction=0.34",
)
#: Commands by their names in the table.
COMMANDS = {
    "stats": "stats {out}",
    "assemble": "assemble {out}",
    "check": "check {out} --workers 1",
    "replay": "replay {out} --trial 0",
    "figures": "figures {out} --out {to}/figures --quiet",
    "inspect": "inspect {out} --port 0 --no-browser",
    "export original": "export {out} {to}/original --to original --quiet",
    "export hf": "export {out} {to}/hf --to hf --quiet",
    "export dexgraspbench": "export {out} {to}/dex --to dexgraspbench --quiet",
    "export isaac_grasp": "export {out} {to}/isaac_grasp --to isaac_grasp --quiet",
    "verify": f"verify {{out}}/{OTO} --out {{to}}/verdicts.h5 --workers 1 --quiet",
    "build": "build --objects {meshes} --out {out} --quiet --workers 1 --set "
    + " --set ".join(SETTINGS),
}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound dataset with meshes, a hand file, decisions and predictions."""
    base = tmp_path_factory.mktemp("sound")
    out = make_dataset(base / "out", base / "meshes", overrides=REPEATED)
    manifest = json.loads((out / MANIFEST).read_text())
    manifest["refused"] = [{"name": "4_cup", "mesh_sha256": "0" * 64, "reason": "open"}]
    manifest["fingers"] = {"finger_1": True, "finger_2": True, "finger_3": True}
    manifest["rejected"] = [manifests.KEY]
    (base / MANIFEST).write_text(json.dumps({**manifest, DIGEST: manifest_digest(manifest)}))
    (base / REJECT).write_bytes(manifests.SOUND_DECISIONS)
    return base


@pytest.fixture(autouse=True)
def no_server(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let `inspect` make the pages of all attempts, and end, in place of serving them."""

    def make_pages(server: uvicorn.Server, sockets: object) -> None:
        inspection = server.config.app.state.inspection  # type: ignore[union-attr]
        table, query = inspection.table(AttemptGallery), AttemptGallery.query({"outcome": "any"})
        chosen = table.select(query)
        table.gallery_page(query, chosen, [AttemptGallery])
        for i in chosen.tolist():
            table.row_page(i, query, chosen, [AttemptGallery], inspection.hand)

    monkeypatch.setattr(uvicorn.Server, "run", make_pages)


#: A bad input is refused within this computing time, and by the clock of a busy machine [s].
PATIENCE, LONG_PATIENCE = 5.0, 60.0


class TookTooLongError(BaseException):
    """A command did not end."""


def _give_up(number: int, frame: object) -> None:
    raise TookTooLongError


def run(command: Sequence[str], **places: object) -> Result:
    words = [word.format(**places) for word in command]
    before = {s: signal.signal(s, _give_up) for s in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, PATIENCE)
    signal.setitimer(signal.ITIMER_REAL, LONG_PATIENCE)
    try:
        return run_command(*words)
    except TookTooLongError as error:
        return Result(exit_code=99, stdout="", stderr="", exception=error)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in before.items():
            signal.signal(number, handler)


def wrong_answer(result: Result, names: Sequence[str]) -> str | None:
    """Return what is wrong with the answer to a bad input, or None.

    Args:
        result: Of the command.
        names: What the line must name one of.
    """
    if result.exception is not None:
        frames = traceback.extract_tb(result.exception.__traceback__)
        own = [f for f in frames if "/drakegrasp/" in f.filename and "/tests/" not in f.filename]
        at = f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""
        text = " ".join(str(result.exception).split())[:100]
        return f"TRACEBACK {type(result.exception).__name__} at {at} ({text})"
    if result.exit_code not in (1, 2):
        return f"exit code {result.exit_code}"
    lines = [line for line in result.stderr.splitlines() if "━" not in line]
    errors = [line for line in lines if line.startswith("error: ")]
    # `check` lists what it finds.
    found = [line for line in result.stdout.splitlines() if ": " in line]
    if not errors and not lines and any(name in line for name in names for line in found):
        return None
    if len(errors) != 1 or len(lines) != 1:
        return f"{len(lines)} lines on standard error: {lines[:3]}; {result.stdout[-200:]!r}"
    if not any(name in errors[0] for name in names):
        return f"no name in: {errors[0][:150]}"
    if not errors[0].isprintable():
        return f"control characters in: {errors[0][:150]!r}"
    return None


def state(folder: Path) -> dict[str, tuple[int, ...]]:
    """Return what changes when something below a folder is written or replaced."""
    found = {}
    for path in folder.rglob("*"):
        status = path.lstat()
        times = () if path.is_dir() else (status.st_mtime_ns, status.st_size, status.st_ino)
        found[str(path.relative_to(folder))] = (status.st_mode, *times)
    return found


def walk(
    tmp_path: Path,
    make: Callable[[Path], Path],
    kinds: Sequence[Kind],
    command: str,
    names: Sequence[str],
    *,
    may_pass: bool = False,
    **places: Path,
) -> None:
    """Give each kind of a file to a command; fail with all answers that are wrong.

    Args:
        tmp_path: For a folder of each kind, `{out}`, and for what the command writes, `{to}`.
        make: Makes what is sound in a folder; returns the file to spoil, `{file}`.
        kinds: Ways to spoil it.
        command: Its words.
        names: What an error must name one of.
        may_pass: Whether a kind may be as good as the sound file.
        **places: Other words in braces.
    """
    wrong, folder, to = dict[str, str](), tmp_path / "place", tmp_path / "to"
    for kind in kinds:
        to.mkdir()
        file = make(folder)
        kind.spoil(file)
        before = state(folder)
        result = run(command.split(), **{"out": folder, "to": to, "file": file, **places})
        if not (may_pass and result.exit_code == 0):
            answer = wrong_answer(result, names)
            after = state(folder)
            if answer is None and after != before:
                changed = {n for n in after.keys() | before.keys() if after.get(n) != before.get(n)}
                answer = f"changed {sorted(changed)}"
            if answer is None and any(to.iterdir()):
                answer = f"left {[path.name for path in to.iterdir()]}"
            wrong |= {} if answer is None else {kind.name: answer}
        shutil.rmtree(to)
        shutil.rmtree(folder)
    report(command, kinds, wrong)


def report(title: str, kinds: Sequence[object], wrong: dict[str, str]) -> None:
    lines = [f"{name!r}: {answer}" for name, answer in wrong.items()]
    assert not wrong, f"{title}: {len(wrong)} of {len(kinds)} kinds:\n" + "\n".join(lines)


#: By file: how it can be spoiled, which may follow from a sound one, and who reads it.
FILES: dict[str, tuple[Any, tuple[str, ...]]] = {
    MANIFEST: (
        manifests.manifest_kinds,
        (
            *("replay", "stats", "assemble", "check", "figures", "export isaac_grasp"),
            *("export dexgraspbench", "verify", "build"),
        ),
    ),
    TRIALS: (
        hdf5_kinds.trials_kinds,
        (
            *("stats", "check", "replay", "figures", "inspect", "export isaac_grasp"),
            "export dexgraspbench",
        ),
    ),
    OTO: (
        hdf5_kinds.data_kinds,
        (
            *("stats", "check", "inspect", "export isaac_grasp", "export dexgraspbench"),
            *("export original", "export hf", "verify"),
        ),
    ),
    SHARD: (hdf5_kinds.SEALED, ("assemble", "check")),
    PLAN: (hdf5_kinds.SEALED, ("replay", "check")),
    MODEL: (array_kinds.MODEL, ("replay", "assemble", "check")),
    REJECT: (manifests.DECISIONS, ("inspect",)),
}


def kinds_of(base: Path, file: str) -> Sequence[Kind]:
    """Return how a file can be spoiled."""
    kinds = FILES[file][0]
    sound = base if file == MANIFEST else base / "out"
    return kinds(sound / file) if callable(kinds) else kinds


def walk_dataset(
    base: Path, tmp_path: Path, file: str, kinds: Sequence[Kind], command: str
) -> None:
    """Give each kind of a file of the dataset to a command."""

    def make(folder: Path) -> Path:
        shutil.copytree(base / "out", folder)
        if file in (MANIFEST, REJECT):
            shutil.copy(base / file, folder / file)
        return folder / file

    names = (Path(file).name, Path(file).stem.partition(".")[0])
    walk(tmp_path, make, kinds, COMMANDS[command], names, meshes=base / "meshes")


every_command = pytest.mark.parametrize(
    ("file", "command"), [(file, c) for file, (_, commands) in FILES.items() for c in commands]
)


@every_command
def test_files(base: Path, tmp_path: Path, file: str, command: str) -> None:
    """A tenth of the kinds with the first command, a quick one, and a few with each other one.

    All of them read a file by the same function, whose kinds go by the fields of the schema.
    """
    k = FILES[file][1].index(command)
    # The whole dataset is checked for each.
    share = 160 if command == "check" else 80 if k else 10
    walk_dataset(base, tmp_path, file, kinds_of(base, file)[k % share :: share], command)


@pytest.mark.nightly
@every_command
def test_every_kind_with_every_command(base: Path, tmp_path: Path, file: str, command: str) -> None:
    walk_dataset(base, tmp_path, file, kinds_of(base, file), command)


def _npy() -> bytes:
    content = io.BytesIO()
    np.save(content, array_kinds.GRASP)
    return content.getvalue()


def _hdf5() -> bytes:
    content = io.BytesIO()
    with h5py.File(content, "w") as file:
        file.update(array_kinds.ROWS)
    return content.getvalue()


OBJECTS_YAML = (
    b"units: m\nlicence: x\nobjects:\n"
    b"  1_box_a: {friction: 0.5, mass: 1.0, scale: 1.0, up: +z, class: box, group: a}\n"
)
DRY = "build --objects {meshes} --out {to}/out --dry-run"
VERIFY = "verify {file} --out {to}/verdicts.h5 --workers 1 --quiet"
#: By what a file alone is of: its suffix, its sound content, how it can be spoiled, the command
#: that reads it, and which share of the ways to spoil a value of YAML is tried, if any.
ALONE: dict[str, tuple[Any, ...]] = {
    "grasps": (".npy", _npy(), array_kinds.PREDICTIONS_NPY, f"{VERIFY} --object {{mesh}}", 0),
    "grasps of rows": (
        *(".h5", _hdf5(), array_kinds.PREDICTIONS_HDF5, f"{VERIFY} --dataset {{data}}"),
        0,
    ),
    "decisions": (
        *(".json", manifests.SOUND_DECISIONS, manifests.DECISIONS),
        *("assemble {sound} --reject {file}", 0),
    ),
    "hand": (
        *(".yaml", (MODELS / "barrett_hand.yaml").read_bytes(), text_kinds.ANY_YAML),
        *("build --objects {meshes} --out {to}/out --set hand={file} --workers 1 --quiet", 53),
    ),
    "configuration": (
        *(".yaml", yaml.safe_dump(load_config("fast").to_dict()).encode(), text_kinds.ANY_YAML),
        *(f"{DRY} --config {{file}}", 53),
    ),
    "objects": (".yaml", OBJECTS_YAML, text_kinds.ANY_YAML, f"{DRY} --manifest {{file}}", 5),
    # The same function reads the file for it.
    "objects of an audit": (
        *(".yaml", OBJECTS_YAML, text_kinds.ANY_YAML[::4]),
        *("audit {meshes} --json {to}/a.json --manifest {file}", 17),
    ),
}


@pytest.mark.parametrize("name", ALONE)
def test_files_alone(base: Path, tmp_path: Path, name: str) -> None:
    """Some values are as good as those before.

    Which are bad: test_config.py, test_sources.py, tests/hand.
    """
    suffix, content, kinds, command, each = ALONE[name]
    sound = Path(shutil.copytree(base / "out", tmp_path / "sound"))
    places = {"meshes": base / "meshes", "mesh": base / "meshes" / "1_box_a.stl"}
    places |= {"sound": sound, "data": sound / OTO}
    before = state(sound)

    def make(folder: Path) -> Path:
        folder.mkdir()
        (folder / f"spoiled{suffix}").write_bytes(content)
        return folder / f"spoiled{suffix}"

    names = ("spoiled", "rows", "contact points")
    walk(tmp_path, make, kinds, command, names, **places)
    if each:
        spoiled = [*trees.some_values(yaml.safe_load(content), each)]
        names = ("spoiled", "1_box_a")
        walk(tmp_path, make, spoiled, command, names, may_pass=True, **places)
    assert state(sound) == before


#: How the lines about some options call them.
NAMES_OF_OPTIONS = ("candidates.max", "hand", "config", "builtin.", "seed: ", "workers")
#: By command: its options, and its words but for the option.
OPTIONS_OF = {
    "build": (text_kinds.OPTIONS, "build --objects {meshes} --out {to}/out --quiet"),
    "submit": (
        text_kinds.CLUSTER_OPTIONS,
        "submit --objects {meshes} --out {to}/out --cluster slurm --host 10.0.0.1 --dry-run "
        "--workers 2",
    ),
    "inspect": ({"--port": text_kinds.PORTS}, "inspect {out}"),
}


@pytest.mark.parametrize(
    ("command", "option"),
    [(command, option) for command, (found, _) in OPTIONS_OF.items() for option in found],
)
def test_options(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, option: str
) -> None:
    """Of an option that is given twice, the last value counts."""
    monkeypatch.chdir(tmp_path)
    values, words = OPTIONS_OF[command][0][option], OPTIONS_OF[command][1]
    objects = "builtin" if option in ("--per-class", "--objects-seed") else base / "meshes"
    if command == "build" and option != "--workers" and not option.startswith("--scheduler"):
        words += " --dry-run"
    wrong = {}
    for value in values:
        given = words.format(meshes=objects, to=tmp_path, out=base / "out").split()
        result = run([w.replace("{", "{{").replace("}", "}}") for w in (*given, option, value)])
        names = (option, option[2:], value.partition("=")[0], repr(value)[1:-1], *NAMES_OF_OPTIONS)
        answer = wrong_answer(result, names)
        if answer is None and any(tmp_path.iterdir()):
            answer = f"left {[path.name for path in tmp_path.iterdir()]}"
        if answer is not None:
            wrong[value] = answer
    report(f"{command} {option}", values, wrong)
