"""The command line: the table of all commands.

Results go to standard output, progress and errors to standard error. Exit codes: 0 done, 1 the work
failed, 2 wrong usage. A command is imported when it is used, and imports heavy libraries only when
it runs, so that `--help` answers immediately.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence

from drakegrasp.cli.console import OPTIONS, new_group, run_command

#: The commands in the order of the help: functions or groups, and the first lines of their help.
COMMANDS = {
    "doctor": ("doctor:doctor", "Check that this machine can run drakegrasp."),
    "objects": ("models:objects", "List or export the built-in objects."),
    "audit": ("models:audit", "Check which meshes are fit, repaired or refused."),
    "hand": ("models:hand", "List the hands, draft a hand file, or check a hand."),
    "build": ("build:build", "Build a dataset from a directory of meshes."),
    "submit": ("build:submit", "Build a dataset on a cluster; the command starts the workers."),
    "assemble": ("datasets:assemble", "Filter and split again, without simulating."),
    "merge": ("datasets:merge", "Merge several datasets that were built separately."),
    "scenes": ("datasets:scenes", "Render views of training scenes, independent of grasps."),
    "clutter": (
        "build:clutter",
        "Put objects of a dataset together, and try grasps among them.",
    ),
    "reach": ("reach:reach", "Ask whether an arm gets its hand to the samples."),
    "check": ("datasets:check", "Check every invariant of a dataset."),
    "stats": ("datasets:stats", "Count outcomes, how well grasps hold, and samples."),
    "inspect": ("datasets:inspect", "Look at grasps in a browser, and reject them."),
    "figures": ("datasets:figures", "Draw a dataset: pictures as PNG and SVG, numbers as JSON."),
    "replay": ("datasets:replay", "Run a trial again and compare every value."),
    "predict": ("predictions:predict", "Write grasps for what a camera saw, best first."),
    "verify": ("verify:verify", "Try predicted grasps in the simulator."),
    "score": ("predictions:score", "Score predicted grasps against reference rows."),
    "bench-set": ("build:bench_set", "Build the frozen benchmark drakegrasp-bench-1 in OUT."),
    "export": ("datasets:export", "Write the samples of a dataset in another format."),
}
#: Usage of functions whose optional or repeated arguments cyclopts does not name.
USAGES = {
    "merge": "[OPTIONS] INTO OUTS...",
    "score": "--dataset FILE [OPTIONS] [PREDICTIONS]...",
}
#: Commands that the same words continue after Ctrl-C.
RESUMABLE = ("build", "submit", "clutter", "bench-set")


def _version() -> str:
    from drakegrasp import __version__

    return f"drakegrasp, version {__version__}"


app = new_group(
    "drakegrasp",
    "Simulate multi-finger grasps of object meshes and write datasets of them.",
    {name: summary for name, (_, summary) in COMMANDS.items()},
    version=_version,
)
for _number, (_name, (_place, _)) in enumerate(COMMANDS.items()):
    _own = {"usage": f"drakegrasp {_name} {USAGES[_name]}"} if _name in USAGES else {}
    app.command(f"drakegrasp.cli.{_place}", name=_name, sort_key=_number, **_own)
for _flag in ("--help", "--version"):
    app[_flag].group = (OPTIONS,)


def main(words: Sequence[str] | None = None) -> None:
    """Run a command in this process.

    Args:
        words: The command line without the name of the program; None for that of this process.

    Raises:
        SystemExit: If the command fails.
    """
    words = sys.argv[1:] if words is None else words
    run_command(app, words, resumable=words[:1] in [[name] for name in RESUMABLE])


def run() -> None:
    """Run the program."""
    # What is printed to a closed stream is lost, and a file that is opened may get its number.
    if sys.stdout is None:
        sys.exit("error: standard output must be open, got a closed one")
    # Drake cannot be imported under another locale, nor files with any name be opened.
    if (encoding := sys.getfilesystemencoding()) != "utf-8":
        sys.exit(f"error: the locale must be UTF-8, got {encoding}; set PYTHONUTF8=1")
    # A terminal with another encoding shows ? for characters that it does not have.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    main()
