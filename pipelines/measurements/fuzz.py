"""Damage files at random; every reader must return equal values, or one line that refuses them.

\b
    python pipelines/measurements/fuzz.py OUT --count 3000 > fuzz.jsonl
    python pipelines/measurements/fuzz.py meshes --count 200 > meshes.jsonl
    python pipelines/measurements/fuzz.py hands --count 100 > hands.jsonl

Each case damages one file: a bit is flipped, the end is cut off, all columns are made longer, two
columns are swapped, JSON gets another value, a text another number, or another kind of file takes
its place. The files are those of a copy of the dataset OUT, which the loaders, `stats` and `check`
read; a small solid in a format of meshes, which `audit` reads; or those of a hand of the package,
which is loaded and checked without trial grasps. Each reader runs in its own process with 2 GB of
memory and 20 s of CPU time. The script prints a line of JSON for each finding: a traceback, a hang,
excessive memory, a signal, or other values without a message. The same seed damages the same bytes.
The exit code is 1 if there is a finding.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import importlib
import io
import json
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import h5py
import numpy as np
import trimesh

from drakegrasp.cli.main import main as command
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DrakegraspError
from drakegrasp.hand.checks import check_geometry, check_limits
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.shapes import link_shapes

#: Memory that a process may use in addition to this one's [byte], its CPU time [s], and the
#: wall-clock time that it may take on a busy machine [s].
MEMORY, CPU_SECONDS, SECONDS = 2**31, 20, 600.0
#: Files of a dataset that hold columns, and numbers of rows that columns are made to claim.
COLUMNS, CLAIMS = ("trials.hdf5", "grasping_oto.hdf5", "grasping_otm.hdf5"), (400_000_000, 2**50)
#: Numbers and words that replace others in a text, and values that replace others in JSON.
ODD = ("nan", "inf", "-1", "0", "1e999", "1e-320", "99999999999999", "x", "", "-0.5")
VALUES: tuple[Any, ...] = (None, [], {}, "", -1, 1e300, True, "\x1b[31m", "../../x", 2**70)
#: Formats of meshes, and the hands of the package.
FORMATS, HANDS = ("obj", "stl", "ply", "glb"), ("allegro", "barrett", "franka", "leap")
#: Characters that only a line of a progress bar has, and the exit code of a traceback.
BAR, UNEXPECTED = re.compile("[━\u2800-\u28ff]"), 99

Draw = random.Random


# --- Ways to damage a file ---


def flip(path: Path, draw: Draw) -> str:
    """Flip one bit of a file, half of the time in a byte that is not zero."""
    content = bytearray(path.read_bytes())
    filled = [place for place, byte in enumerate(content) if byte]
    place = draw.choice(filled) if draw.random() < 0.5 else draw.randrange(len(content))
    bit = draw.randrange(8)
    content[place] ^= 1 << bit
    path.write_bytes(content)
    return f"bit {bit} of byte {place} flipped"


def truncate(path: Path, draw: Draw) -> str:
    """Cut off the end of a file."""
    size = draw.randrange(path.stat().st_size)
    os.truncate(path, size)
    return f"cut to {size} byte"


def stretch(path: Path, draw: Draw) -> str:
    """Make all columns of a file claim more rows than they have."""
    rows = draw.choice(CLAIMS)
    with h5py.File(path, "r+") as file:
        for column in columns(file):
            if column.chunks:
                column.resize(rows, axis=0)
    return f"columns resized to {rows} rows"


def swap(path: Path, draw: Draw) -> str:
    """Swap two columns of a file."""
    with h5py.File(path, "r+") as file:
        one, other = draw.sample([column.name for column in columns(file)], 2)
        for old, new in ((one, "kept"), (other, one), ("kept", other)):
            file.move(old, new)
    return f"{one} and {other} swapped"


def columns(file: h5py.File) -> list[h5py.Dataset]:
    """Return the columns of a file."""
    found: list[h5py.Dataset] = []
    file.visititems(lambda _, item: found.append(item) if isinstance(item, h5py.Dataset) else None)
    return found


def change_value(path: Path, draw: Draw) -> str:
    """Change one value of a JSON file to another value."""
    tree = node = json.loads(path.read_text(encoding="utf-8"))
    steps, value = [], draw.choice(VALUES)
    while True:
        steps.append(draw.choice(list(node) if isinstance(node, dict) else range(len(node))))
        child = node[steps[-1]]
        if draw.random() < 0.3 or not isinstance(child, dict | list) or not child:
            break
        node = child
    node[steps[-1]] = value
    path.write_text(json.dumps(tree), encoding="utf-8")
    return f"{'.'.join(map(str, steps))} set to {value!r}"


def change_number(path: Path, draw: Draw) -> str:
    """Replace a number of a text by an odd value."""
    content = path.read_bytes()
    found = list(re.finditer(rb"(?<![\w.])-?\d+(\.\d+)?(e-?\d+)?(?![\w.])", content))
    if not found:
        return flip(path, draw)
    place, value = draw.choice(found), draw.choice(ODD)
    path.write_bytes(content[: place.start()] + value.encode() + content[place.end() :])
    return f"{place[0]!r} at {place.start()} set to {value!r}"


def other_kind(path: Path, draw: Draw) -> str:
    """Replace a file by another kind of file."""
    kind = draw.choice(list(KINDS))
    path.unlink()
    KINDS[kind](path)
    return f"replaced by {kind}"


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


KINDS: dict[str, Callable[[Path], object]] = {
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a file of 1 TB": _sparse,
    "an empty file": Path.touch,
}


def ways(path: Path) -> tuple[Callable[[Path, Draw], str], ...]:
    """Return the ways to damage a file; the frequent ones are repeated."""
    if path.name in COLUMNS:
        return flip, flip, flip, truncate, stretch, swap, other_kind
    if path.suffix == ".json":
        return flip, truncate, change_value, change_value, other_kind
    if path.suffix in (".obj", ".yaml", ".sdf", ".urdf"):
        return flip, truncate, change_number, change_number, change_number, other_kind
    return flip, flip, truncate, other_kind


# --- What is damaged, and who reads it ---

Reader = Callable[[Path], object]


def load(out: Path) -> None:
    """Print a hash of everything that the loaders return."""
    digest = hashlib.sha256()
    for camera in COLUMNS[1:]:
        for split in SPLITS:
            for sample in GraspDataset(out / camera, split=split):
                for value in (sample.image, sample.mask, sample.grasp, *sample.props.values()):
                    digest.update(np.asarray(value).tobytes())
    trials = Trials(out)
    for name in ("outcome", "X_TO", "object_name"):
        digest.update(np.asarray(trials[name]).astype(str).tobytes())
    sys.stdout.write(digest.hexdigest() + "\n")


def say(*words: str) -> Reader:
    """Return a reader that runs a command of drakegrasp on the folder."""
    name, *options = words

    def read(folder: Path) -> None:
        command([name, str(folder), *options])

    return read


def check_hand(folder: Path) -> None:
    """Load and check a hand without trial grasps."""
    hand = load_hand(folder / "hand.yaml")
    link_shapes(hand.model)
    limits = check_limits(hand)
    for finding in (limits, *(check_geometry(hand) if limits.ok else ())):
        sys.stdout.write(f"{finding.name}: {finding.text}\n")


READERS: dict[str, dict[str, Reader]] = {
    "meshes": {"audit": say("audit")},
    "hands": {"check": check_hand},
    "dataset": {"load": load, "stats": say("stats"), "check": say("check", "--workers", "1")},
}


def make_mesh(folder: Path, draw: Draw) -> Path:
    """Write a solid, one in two with geometric faults, and return its file."""
    mesh = draw.choice(
        [trimesh.creation.box([0.06, 0.05, 0.1]), trimesh.creation.icosphere(2, 0.04)]
    )
    faces, some = mesh.faces.copy(), draw.sample(range(len(mesh.faces)), 3)
    fault = draw.choice(["none", "none", "none", "missing", "doubled", "turned", "huge"])
    if fault == "missing":
        faces = np.delete(faces, some, axis=0)
    elif fault == "doubled":
        faces = np.vstack([faces, faces[some]])
    elif fault == "turned":
        faces[some] = faces[some, ::-1]
    elif fault == "huge":
        mesh.apply_scale(1e30)
    path = folder / f"1_solid.{draw.choice(FORMATS)}"
    trimesh.Trimesh(mesh.vertices, faces, process=False).export(path)
    return path


def make_hand(folder: Path, draw: Draw) -> Path:
    """Copy a hand of the package, and return one of its files, half of the time the hand file."""
    name = draw.choice(HANDS)
    for path in MODELS.glob(f"{name}_*"):
        if path.suffix in (".sdf", ".urdf", ".obj"):
            shutil.copyfile(path, folder / path.name)
    shutil.copyfile(MODELS / f"{name}_hand.yaml", folder / "hand.yaml")
    return draw.choice([*sorted(folder.iterdir()), folder / "hand.yaml", folder / "hand.yaml"])


def make_dataset(out: Path, folder: Path, draw: Draw) -> Path:
    """Copy a dataset, and return one of its files, often one with data."""
    shutil.copytree(out, folder, dirs_exist_ok=True)
    found = sorted(p for p in folder.rglob("*") if p.is_file() and p.suffix != ".jsonl")
    main = [path for path in found if path.name in (*COLUMNS, "manifest.json")]
    return draw.choice(main * 4 + found)


# --- Readers in processes of their own ---


@dataclass(frozen=True, kw_only=True)
class Said:
    """Result of a reader: its exit code, None if it did not end, and what it printed.

    `modules` are the names of all modules that it had imported at its end.
    """

    code: int | None
    out: str = ""
    err: str = ""
    modules: str = ""


def _child(run: Reader, folder: Path, said: Path) -> None:
    """Run a reader with its output in files and its memory limited, and end the process."""
    faulthandler.disable()
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(said / name, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout, sys.stderr = (io.TextIOWrapper(io.FileIO(number, "w")) for number in (1, 2))
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 1))
    code = 0
    try:
        run(folder)
    except DrakegraspError as error:
        sys.stderr.write(f"error: {error}\n")
        code = 1
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = UNEXPECTED
    (said / "modules").write_text("\n".join(sys.modules), encoding="utf-8")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def read(run: Reader, folder: Path) -> Said:
    """Let a reader read a folder in a process of its own."""
    with tempfile.TemporaryDirectory() as name:
        context = multiprocessing.get_context("fork")
        process = context.Process(target=_child, args=(run, folder, Path(name)))
        process.start()
        process.join(SECONDS)
        if process.is_alive():
            process.kill()
            process.join()
            return Said(code=None)
        texts = {path.name: path.read_text(errors="replace") for path in Path(name).iterdir()}
        return Said(code=process.exitcode, **texts)


def read_soundly(what: str | Path) -> dict[str, Said]:
    """Return what the readers of sound files say, and import once what they import.

    Raises:
        RuntimeError: If a sound file was not read.
    """
    found = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_sound(what, folder, Draw(0))
        for reader, run in READERS[kind_of(what)].items():
            said = found[reader] = read(run, folder)
            if said.code != 0:
                raise RuntimeError(f"sound files must be read, got {said.code}: {said.err}")
            for module in sorted(set(said.modules.splitlines()) - set(sys.modules)):
                with contextlib.suppress(Exception):
                    importlib.import_module(module)
    return found


def judge(said: Said, sound: Said | None = None) -> str | None:
    """Return what is wrong with a reader's result for a damaged file; None if nothing is.

    Args:
        said: Result for the damaged file.
        sound: Result for the sound files, if the reader must say the same or refuse the file.
    """
    lines = [line for line in said.err.strip().splitlines() if not BAR.search(line)]
    last = (lines or [said.out])[-1][:200]
    if said.code is None:
        return f"no end within {SECONDS:g} s"
    if said.code == -signal.SIGXCPU:
        return f"more than {CPU_SECONDS} s of CPU time"
    if said.code < 0:
        return f"signal {-said.code}"
    if "Traceback" in said.err or said.code == UNEXPECTED:
        return f"a traceback: {last}"
    if any(text in said.out + said.err for text in ("Unable to allocate", "MemoryError")):
        return f"memory: {last}"
    if said.code == 0:
        same = sound is None or said.out == sound.out or lines
        return None if same else "other values without a word"
    if len(lines) > 1:
        return f"{len(lines)} lines: {said.err[:200]!r}"
    return None if said.out.strip() or lines else "an exit code without a word"


def fuzz(what: str | Path, count: int, seed: int, first: int = 0) -> Iterator[dict[str, Any]]:
    """Yield the findings of cases.

    Args:
        what: "meshes", "hands", or the directory of a sound dataset, which is only read.
        count: Number of cases.
        seed: Seed of all random draws.
        first: Number of the first case.
    """
    sound = read_soundly(what)
    # Of meshes and hands each case has another one, so there is nothing to compare with.
    sound = sound if isinstance(what, Path) else {}
    for number in range(first, first + count):
        draw = Draw(f"{seed}/{number}")
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            path = make_sound(what, folder, draw)
            how = draw.choice(ways(path))(path, draw)
            for reader, run in READERS[kind_of(what)].items():
                wrong = judge(read(run, folder), sound.get(reader))
                if wrong:
                    damaged = {"case": number, "file": str(path.relative_to(folder)), "how": how}
                    yield {**damaged, "reader": reader, "wrong": wrong}


def kind_of(what: str | Path) -> str:
    """Return the key of the readers of what is damaged."""
    return "dataset" if isinstance(what, Path) else what


def make_sound(what: str | Path, folder: Path, draw: Draw) -> Path:
    """Write sound files to a folder, and return the one to damage."""
    if isinstance(what, Path):
        return make_dataset(what, folder, draw)
    return {"meshes": make_mesh, "hands": make_hand}[what](folder, draw)


@click.command(help=__doc__)
@click.argument("what")
@click.option("--count", default=300, show_default=True, help="Number of cases.")
@click.option("--first", default=0, show_default=True, help="Number of the first case.")
@click.option("--seed", default=0, show_default=True, help="Seed of all random draws.")
def main(what: str, count: int, first: int, seed: int) -> None:
    """Run the script."""
    findings = 0
    for finding in fuzz(what if what in READERS else Path(what), count, seed, first):
        findings += 1
        click.echo(json.dumps(finding))
    click.echo(json.dumps({"cases": count, "findings": findings}))
    sys.exit(bool(findings))


if __name__ == "__main__":
    main()
