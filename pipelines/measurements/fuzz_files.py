"""Damage the files of a dataset at random; every reader must return equal values or one error line.

\b
    python pipelines/measurements/fuzz_files.py OUT --count 3000 --seed 0 > fuzz.jsonl

Each case damages one file of a copy of OUT: a bit is flipped, the end is cut off, all columns are
made longer, two columns are swapped, JSON gets a different value or structure, or a different kind
of file (a pipe, a device, a folder, a file of 1 TB) replaces the file. Then the loaders, `stats`
and `check` read the copy, each in its own process with 2 GB of memory and 20 s of CPU time; with
`--all` every command that reads a dataset reads it. The output of a command and the files that it
writes are compared with those of the sound dataset. The script prints a line of JSON for each
finding: a traceback, a hang, excessive memory, a signal, or other values without a message. The
same seed damages the same bytes of the same dataset. The exit code is 1 if there is a finding.
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
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NoReturn

import click
import h5py
import numpy as np

from drakegrasp.cli.main import main as command
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import DrakegraspError
from drakegrasp.page.app import Inspection
from drakegrasp.page.attempts import Attempts
from drakegrasp.page.gallery import PAGE
from drakegrasp.runtime.progress import progress_bar

#: Memory that a process may use in addition to this one's [byte], its CPU time [s], and the
#: wall-clock time that it may take on a busy machine [s].
MEMORY, CPU_SECONDS, SECONDS = 2**31, 20, 600.0
#: Files of a dataset that hold columns.
COLUMNS = ("trials.hdf5", "grasping_oto.hdf5", "grasping_otm.hdf5")
#: Files that a dataset has several of and that commands read one by one.
PARTS = ("shards/*/*.h5", "objects/*.plan.h5")
#: Numbers of rows that columns are made to claim.
CLAIMS = (400_000_000, 2**50)
#: Characters that only a line of a progress bar has: the bar, or the rotating sign.
BAR = re.compile("[━\u2800-\u28ff]")
#: Maximum number of lines of an error, and the exit code of a traceback.
LINES, UNEXPECTED = 1, 99


# --- Methods that damage a file ---


def flip(path: Path, draw: random.Random) -> str:
    """Flip one bit of a file, half of the time in a byte that is not zero."""
    content = bytearray(path.read_bytes())
    place = draw.randrange(len(content))
    if draw.random() < 0.5:
        while not content[place]:
            place = draw.randrange(len(content))
    bit = draw.randrange(8)
    content[place] ^= 1 << bit
    path.write_bytes(content)
    return f"bit {bit} of byte {place} flipped"


def truncate(path: Path, draw: random.Random) -> str:
    """Cut off the end of a file."""
    size = draw.randrange(path.stat().st_size)
    os.truncate(path, size)
    return f"cut to {size} byte"


def stretch(path: Path, draw: random.Random) -> str:
    """Make all columns of a group claim more rows than they have."""
    rows = draw.choice(CLAIMS)
    with h5py.File(path, "r+") as file:
        group = file[draw.choice([name for name in file if len(file[name])])]

        def visit(_: str, item: h5py.Dataset | h5py.Group) -> None:
            if isinstance(item, h5py.Dataset) and item.chunks:
                item.resize(rows, axis=0)

        group.visititems(visit)
        return f"columns of {group.name} resized to {rows} rows"


def swap(path: Path, draw: random.Random) -> str:
    """Swap two columns of a file."""
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visititems(
            lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None
        )
        one, other = draw.sample(names, 2)
        file.move(one, "kept")
        file.move(other, one)
        file.move("kept", other)
    return f"{one} and {other} swapped"


def restructure(path: Path, draw: random.Random) -> str:
    """Change one value of a JSON file to another value."""
    tree = json.loads(path.read_text(encoding="utf-8"))
    said = change_tree(tree, draw)
    path.write_text(json.dumps(tree), encoding="utf-8")
    return said


def change_tree(tree: Any, draw: random.Random) -> str:
    """Change one value of parsed JSON to another value."""
    values: list[Any] = [None, [], {}, "", -1, 1e300, True, "\x1b[31m", "../../x", [[]] * 3]
    value = draw.choice([*values, 2**70, "x" * 100_000])
    steps: list[Any] = []
    node = tree
    while isinstance(node, dict | list) and node:
        keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node)))
        steps.append(draw.choice(keys))
        child = node[steps[-1]]
        if draw.random() < 0.3 or not isinstance(child, dict | list) or not child:
            node[steps[-1]] = value
            break
        node = child
    return f"{'.'.join(map(str, steps))} set to {str(value)[:40]!r}"


def nest(path: Path, draw: random.Random) -> str:
    """Fill a JSON file with brackets."""
    depth = draw.choice([1_000, 100_000])
    path.write_text("[" * depth, encoding="utf-8")
    return f"{depth} brackets"


def other_kind(path: Path, draw: random.Random) -> str:
    """Replace a file by another kind of file."""
    return put(path, draw.choice(list(KINDS)))


def put(path: Path, kind: str) -> str:
    """Create a kind of file at a path, in place of the file there if there is one."""
    path.unlink(missing_ok=True)
    KINDS[kind](path)
    return f"replaced by {kind}"


def _listen(path: Path) -> None:
    """Create a socket by a relative path, because names of sockets must be short."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.bind(os.path.relpath(path))


def _sparse(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


#: Kinds of files that may replace a file, and the functions that create them.
KINDS: dict[str, Callable[[Path], Any]] = {
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a socket": _listen,
    "a link to /dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a link to nothing": lambda path: path.symlink_to(path.with_name("nothing")),
    "a file of 1 TB": _sparse,
    "an empty file": Path.touch,
}
SPOIL_HDF5 = (flip, flip, flip, flip, truncate, stretch, swap, other_kind)
SPOIL_JSON = (flip, truncate, restructure, restructure, nest, other_kind)
SPOIL_OTHERS = (flip, truncate, other_kind)


def ways(path: Path) -> tuple[Callable[[Path, random.Random], str], ...]:
    """Return the methods that can damage a file; the frequent ones are repeated."""
    if path.suffix == ".json":
        return SPOIL_JSON
    return SPOIL_HDF5 if path.name in COLUMNS else SPOIL_OTHERS


# --- Readers ---


def load(out: Path) -> None:
    """Print a hash of everything that the loaders return."""
    digest = hashlib.sha256()
    for camera in COLUMNS[1:]:
        for split in SPLITS:
            for sample in GraspDataset(out / camera, split=split):
                for value in (sample.image, sample.mask, sample.grasp, *sample.props.values()):
                    digest.update(np.asarray(value).tobytes())
    trials = Trials(out)
    for name in ("outcome", "X_TO", "closed_q", "closed_p_OQ", "slip", "object_name"):
        with contextlib.suppress(KeyError):
            digest.update(np.asarray(trials[name]).astype(str).tobytes())
    sys.stdout.write(digest.hexdigest() + "\n")


def look(out: Path) -> None:
    """Make the first gallery of `inspect`, and the pages of its attempts."""
    inspection = Inspection(out)
    table, query = inspection.table(Attempts), Attempts.query()
    chosen = table.select(query)
    table.gallery_page(query, chosen, [Attempts])
    for i in chosen[:PAGE].tolist():
        table.row_page(i, query, chosen, [Attempts], inspection.hand)


def commands(everything: bool, assembled: bool) -> dict[str, Callable[[Path], object]]:
    """Return the readers of a dataset by name; `assemble`, which also writes, comes last.

    Args:
        everything: Whether to include each command that reads a dataset.
        assembled: Whether to include `assemble`.
    """

    def say(*line: str) -> Callable[[Path], object]:
        def run(out: Path) -> object:
            words = [word.replace("OUT", str(out)) for word in line]
            return command.main(words, prog_name="drakegrasp", standalone_mode=True)

        return run

    readers = {
        "load": load,
        "stats": say("stats", "OUT"),
        "check": say("check", "OUT", "--workers", "1"),
    }
    if everything:
        readers |= {
            "replay": say("replay", "OUT", "--trial", "0"),
            "figures": say("figures", "OUT", "--out", "OUT/pictures"),
            "inspect": look,
            "export": say("export", "OUT", "OUT/exported", "--to", "glb"),
            "verify": say(
                *("verify", "OUT/grasping_oto.hdf5", "--dataset", "OUT/grasping_oto.hdf5"),
                *("--split", "test", "--workers", "1", "--out", "OUT/verified"),
            ),
        }
    return readers | ({"assemble": assemble} if assembled else {})


def _child(run: Callable[[Path], object], out: Path, folder: Path) -> None:
    """Run a reader with its output in files and its memory limited, and end the process."""
    faulthandler.disable()
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout = io.TextIOWrapper(io.FileIO(1, "w"))
    sys.stderr = io.TextIOWrapper(io.FileIO(2, "w"))
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    most = pages * resource.getpagesize() + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS + 1))
    code = 0
    try:
        run(out)
    except DrakegraspError as error:
        sys.stderr.write(f"error: {error}\n")
        code = 1
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        traceback.print_exc()
        code = UNEXPECTED
    (folder / "modules").write_text("\n".join(sys.modules), encoding="utf-8")
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


@dataclass(frozen=True, kw_only=True)
class Said:
    """Result of a reader: its exit code, None if it did not end, and what it printed and wrote.

    `written` contains a hash of each file of the dataset's folder that is new or was replaced, and
    `pages` the text of the web pages among them.
    """

    code: int | None
    out: str = ""
    err: str = ""
    modules: str = ""
    pages: str = ""
    written: dict[Path, str] = field(default_factory=dict)

    @property
    def lines(self) -> set[str]:
        """The lines that the reader printed or wrote on pages."""
        return set((self.out + self.err + self.pages).splitlines())

    def says_as(self, sound: Said) -> bool:
        """Return whether the output is the same, and the files of `sound` were written equally."""
        same = all(self.written.get(name) == digest for name, digest in sound.written.items())
        return self.out == sound.out and same


def read(run: Callable[[Path], object], out: Path) -> Said:
    """Let a reader read a dataset in a separate process."""
    with tempfile.TemporaryDirectory() as name:
        folder, before = Path(name), dict(times(out))
        process = multiprocessing.get_context("fork").Process(
            target=_child, args=(run, out, folder)
        )
        process.start()
        process.join(SECONDS)
        if process.is_alive():
            process.kill()
            process.join()
            return Said(code=None)
        texts = {
            path.name: path.read_text(encoding="utf-8", errors="replace")
            for path in folder.iterdir()
        }
        new = [path for path, changed in times(out) if before.get(path) != changed]
        pages = "\n".join(path.read_text() for path in new if path.suffix == ".html")
        digests = {
            path.relative_to(out): hashlib.sha256(path.read_bytes()).hexdigest() for path in new
        }
        return Said(code=process.exitcode, pages=pages, written=digests, **texts)


def times(out: Path) -> Iterator[tuple[Path, int]]:
    """Yield the regular files of a folder with the time of their last change [ns]."""
    for path in sorted(out.rglob("*")):
        if path.is_file() and not path.is_symlink():
            yield path, path.stat().st_mtime_ns


def preload(read_soundly: Iterable[Said]) -> None:
    """Import once the modules that readers of sound files imported, for forks of this process.

    Raises:
        RuntimeError: If a sound file could not be read.
    """
    for said in read_soundly:
        if said.code != 0:
            raise RuntimeError(
                f"a sound file must be read, got {said.code}: {said.err or said.out}"
            )
        for module in sorted(set(said.modules.splitlines()) - set(sys.modules)):
            with contextlib.suppress(Exception):
                importlib.import_module(module)


def judge(said: Said, sound: Said | None = None, name: Path = Path()) -> str | None:
    """Return what is wrong with a reader's result for a damaged file; None if nothing is.

    Args:
        said: Result for the damaged file.
        sound: Result for the sound file, if the reader must produce the same or name the file.
        name: Path of the damaged file in the dataset's folder.
    """
    lines = [line for line in said.err.strip().splitlines() if not BAR.search(line)]
    if said.code is None:
        return f"no end within {SECONDS:g} s"
    if said.code == -signal.SIGXCPU:
        return f"more than {CPU_SECONDS} s of CPU time"
    if said.code < 0:
        return f"signal {-said.code}"
    if "Traceback" in said.err or said.code == UNEXPECTED:
        return f"a traceback: {lines[-1][:200] if lines else ''}"
    if any(text in said.out + said.err for text in ("Unable to allocate", "MemoryError")):
        return f"memory: {(lines or [said.out])[-1][:200]}"
    if "No module named" in said.out + said.err:
        return f"a module that is not there: {(lines or [said.out])[-1][:200]}"
    if said.code == 0:
        if sound is None or said.says_as(sound):
            return None
        # A reader may name the files of a hand, or of an object, together.
        words = (name.name, f"{name.parts[0]}: ", f"{name.parts[0]} of {name.parent.name}")
        named = any(word in line for word in words for line in said.lines - sound.lines)
        return None if named else "other values without a word"
    if len(lines) > LINES:
        return f"{len(lines)} lines: {said.err[:200]!r}"
    return None if said.out.strip() or lines else "an exit code without a word"


# --- Cases ---


def files(out: Path) -> list[Path]:
    """Return the paths of files that are damaged, in the dataset; those with data several times."""
    found = sorted(path.relative_to(out) for path in out.rglob("*") if path.is_file())
    main = [path for path in found if path.name in COLUMNS or path.name == "manifest.json"]
    others = [path for path in found if path not in main and path.suffix != ".jsonl"]
    return main * 4 + others


def every_kind(out: Path) -> list[tuple[Path, str]]:
    """Return each file that commands read separately, with each kind that may replace it."""
    parts = [next(iter(sorted(out.glob(name)))).relative_to(out) for name in PARTS]
    named = map(Path, ("manifest.json", *COLUMNS[:2], "reject.json"))
    return [(name, kind) for name in (*named, *parts) for kind in KINDS]


def assemble(out: Path) -> None:
    """Assemble the dataset, with its rejections if it has any."""
    rejected = (
        ["--reject", str(out / "reject.json")] if os.path.lexists(out / "reject.json") else []
    )
    command.main(["assemble", str(out), "--workers", "1", *rejected], prog_name="drakegrasp")


def anew(out: Path, copy: Path) -> None:
    """Replace a folder by a new copy of a dataset."""
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(out, copy)


def read_soundly(
    out: Path, copy: Path, readers: dict[str, Callable[[Path], object]]
) -> dict[str, Said]:
    """Return the results of readers for a sound dataset, and import the modules that they import.

    Files that differ between two readings, such as files with times, are left out of `written`.

    Raises:
        RuntimeError: If a sound file could not be read, or two readings printed different values.
    """
    sound: dict[str, Said] = {}
    for _ in range(2):
        anew(out, copy)
        for name, run in readers.items():
            said = read(run, copy)
            preload([said])
            first = sound.get(name, said)
            if first.out != said.out:
                raise RuntimeError(f"{name} must say the same twice, got {first.out} {said.out}")
            both = dict(first.written.items() & said.written.items())
            sound[name] = replace(said, written=both)
    return sound


def fuzz(
    out: Path,
    count: int,
    seed: int,
    everything: bool = False,
    first: int = 0,
    kinds: bool = False,
) -> Iterator[dict[str, Any] | None]:
    """Yield for each case and reader the finding, or None.

    Args:
        out: A sound dataset; it is only read.
        count: Number of cases.
        seed: Seed of all random draws.
        everything: Whether every command reads, or only the loaders, `stats` and `check`.
        first: Number of the first case.
        kinds: Whether to use the cases of `every_kind`; `count` is then their number.
    """
    readers = commands(everything, everything or kinds)
    table = every_kind(out) if kinds else []
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "OUT"
        sound = read_soundly(out, copy, readers)
        for number in range(first, first + count):
            draw = random.Random(f"{seed}/{number}")
            anew(out, copy)
            if kinds:
                name, kind = table[number]
                how = put(copy / name, kind)
            else:
                name = draw.choice(files(copy))
                how = draw.choice(ways(copy / name))(copy / name, draw)
            for reader, run in readers.items():
                began = time.monotonic()
                finding = {
                    "case": number,
                    "file": str(name),
                    "how": how,
                    "reader": reader,
                    "wrong": judge(read(run, copy), sound[reader], name),
                    "seconds": round(time.monotonic() - began, 1),
                }
                yield finding if finding["wrong"] else None


def say_findings(cases: Iterator[dict[str, Any] | None], count: int) -> NoReturn:
    """Print findings and their number, and end with code 1 if there are any."""
    findings = 0
    with progress_bar("fuzz", "reads") as progress:
        for number, finding in enumerate(cases, 1):
            progress(number, count)
            if finding:
                findings += 1
                click.echo(json.dumps(finding))
    click.echo(json.dumps({"reads": count, "findings": findings}))
    sys.exit(bool(findings))


@click.command(help=__doc__)
@click.argument("out", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--count", default=300, show_default=True, help="Number of cases.")
@click.option("--first", default=0, show_default=True, help="Number of the first case.")
@click.option("--seed", default=0, show_default=True, help="Seed of all random draws.")
@click.option("--all", "everything", is_flag=True, help="Read with every command.")
@click.option("--kinds", is_flag=True, help="Try all kinds of files instead, also on `assemble`.")
def main(out: Path, count: int, first: int, seed: int, everything: bool, kinds: bool) -> None:
    """Run the script."""
    if kinds:
        first, count = 0, len(every_kind(out))
    cases = fuzz(out, count, seed, everything, first, kinds)
    say_findings(cases, count * len(commands(everything, everything or kinds)))


if __name__ == "__main__":
    main()
