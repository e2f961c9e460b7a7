"""Whole outputs of commands, compared with stored texts; see `helpers/golden.py`."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh
from cyclopts.annotations import get_hint_name
from helpers.commands import arguments_of, run
from helpers.datasets import SLIPPED, end_lift
from helpers.golden import Golden

from drakegrasp.cli.main import COMMANDS, app
from drakegrasp.dataset.rejections import AttemptKey, Decisions, write_decisions


def options_of(name: str) -> list[str]:
    """Return a line for each argument of a command, or of the commands of a group."""
    below = app[name]
    commands = [[name, each] for each in below if not each.startswith("-")] or [[name]]
    lines = []
    for command in commands:
        for option in arguments_of(*command):
            choices, default = option.get_choices() or (), option.field_info.default
            words = [*command, "/".join(option.names), get_hint_name(option.hint), *choices]
            told = isinstance(default, bool | int | float | str)
            words += [str(default)] * told + ["required"] * option.required
            lines.append(" ".join(words))
    return lines


def test_options(golden: Golden) -> None:
    golden("commands/options", "\n".join(line for name in COMMANDS for line in options_of(name)))


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("stats", ["stats", "OUT"]),
        ("stats_json", ["stats", "OUT", "--json"]),
        ("check", ["check", "OUT"]),
        (
            "assemble",
            ["assemble", "OUT", "--set", "split.test_fraction=0.4", "--reject", "REJECT"],
        ),
        ("audit", ["audit", "MESHES"]),
        ("hands", ["hand", "list"]),
        ("objects", ["objects", "list"]),
    ],
)
def test_output(out: Path, tmp_path: Path, golden: Golden, name: str, arguments: list[str]) -> None:
    if name == "stats":
        end_lift(out, SLIPPED, 0.02)
    meshes, reject = tmp_path / "meshes", tmp_path / "reject.json"
    meshes.mkdir()
    trimesh.creation.box([50.0, 70.0, 150.0]).subdivide().export(meshes / "1_tall.obj")
    trimesh.creation.box([0.05, 0.07, 0.15]).subdivide().export(meshes / "2_box.obj")
    (meshes / "3_none.obj").write_text("v 0 0 0\n")
    bad = frozenset(AttemptKey("1_box_a", candidate, 0) for candidate in (0, 1))
    write_decisions(reject, Decisions(rejected=bad))
    paths = {"OUT": out, "MESHES": meshes, "REJECT": reject}
    result = run(*(paths.get(argument, argument) for argument in arguments))
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    text = "\n".join([f"exit {result.exit_code}", result.stdout, *errors])
    for word, path in paths.items():
        text = text.replace(str(path), word)
    golden(f"commands/{name}", "\n".join(line.rstrip() for line in text.splitlines()))
