"""Files of a stranger are safe to open: nothing outside of them is read, written or steered."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from helpers.commands import run
from helpers.datasets import OTO, TRIALS

from drakegrasp.dataset.log import BuildLog, read_log
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError
from drakegrasp.inspection.pages import TEMPLATES
from drakegrasp.runtime.processes import host_label

#: What a terminal would obey: a title of its window, as bytes of 7 and of 8 bits.
STEERING = "\x1b]0;x\x07\x9b31m"


def refusal(*arguments: str | Path) -> str:
    """Return the only line that a command prints when it refuses."""
    result = run(*arguments)
    assert result.exit_code in (1, 2), result.output
    (line,) = result.output.splitlines()
    assert line.startswith("error: ")
    return line


@pytest.mark.parametrize("how", [os.symlink, os.link])
def test_lock_that_is_a_link_is_not_written(
    out: Path, tmp_path: Path, how: Callable[[Path, Path], None]
) -> None:
    victim = tmp_path / "profile"
    victim.write_text("mine\n")
    how(victim, out / "build.lock")
    assert "build.lock: must be a file of its own, got a link" in refusal("assemble", out)
    assert run("stats", out).exit_code == 0
    assert victim.read_text() == "mine\n"


def test_log_that_is_a_link_is_not_written(out: Path, tmp_path: Path) -> None:
    victim = tmp_path / "profile"
    (out / "log.jsonl").symlink_to(victim)
    with pytest.raises(DataError, match="must be a file of its own, got a link"):
        BuildLog(out)("mesh prepared", name="$(touch me)")
    assert not victim.exists()


@pytest.mark.parametrize("folder", ["shards", "shards/1_box_a", "objects", "builtin"])
def test_folder_that_is_a_link_is_neither_written_nor_swept(
    out: Path, tmp_path: Path, folder: str
) -> None:
    outside = tmp_path / "outside"
    if (out / folder).exists():
        (out / folder).rename(outside)
    else:
        outside.mkdir()
    mine = outside / f".mine.{host_label()}~999999999~0123456789ab.tmp"
    mine.write_text("mine\n")
    (out / folder).symlink_to(outside)
    assert f"{out / folder}: must be a folder in the dataset, got a link" in refusal(
        "assemble", out
    )
    assert run("stats", out).exit_code == 0
    assert mine.read_text() == "mine\n"


@pytest.mark.parametrize("name", ["../../outside", f"a{STEERING}", ".hidden", ""])
def test_names_in_a_manifest_are_names(out: Path, name: str) -> None:
    content = json.loads((out / "manifest.json").read_text())
    content["objects"][0]["name"] = name
    (out / "manifest.json").write_text(json.dumps(content))
    for command in ("stats", "assemble", "check"):
        assert "a name must be printable" in refusal(command, out)


def test_list_of_replaced_files_names_files_of_its_folder(out: Path, tmp_path: Path) -> None:
    (tmp_path / "profile").write_text("mine\n")
    for listed in ({"../profile": ".x.tmp"}, {TRIALS: "manifest.json"}, {TRIALS: "../profile"}):
        (out / "replacement.json").write_text(json.dumps(listed))
        assert "replacement.json: must be a list of files" in refusal("assemble", out)
    assert (out / "manifest.json").exists()
    assert (tmp_path / "profile").read_text() == "mine\n"


def _soft(file: h5py.File, place: str, secret: Path) -> None:
    file[place] = h5py.SoftLink("/other")


def _external(file: h5py.File, place: str, secret: Path) -> None:
    file[place] = h5py.ExternalLink(str(secret), "/secret")


def _raw(file: h5py.File, place: str, secret: Path) -> None:
    file.create_dataset(place, shape=(4,), dtype="u1", external=[(str(secret), 0, 4)])


def _virtual(file: h5py.File, place: str, secret: Path) -> None:
    layout = h5py.VirtualLayout(shape=(4,), dtype="u1")
    layout[:] = h5py.VirtualSource(str(secret), "secret", shape=(4,))
    file.create_virtual_dataset(place, layout)


@pytest.mark.parametrize("name", [TRIALS, OTO])
@pytest.mark.parametrize(
    ("lead", "words"),
    [(_soft, "a link"), (_external, "a link"), (_raw, "values"), (_virtual, "values")],
)
def test_values_that_lie_elsewhere_are_not_read(
    out: Path, tmp_path: Path, name: str, lead: Callable[[h5py.File, str, Path], None], words: str
) -> None:
    secret = tmp_path / "secret.h5"
    with h5py.File(secret, "w") as file:
        file["secret"] = np.arange(4, dtype="u1")
    group = "objects" if name == TRIALS else "test/object_props"
    with h5py.File(out / name, "r+") as file:
        lead(file, f"{group}/more", secret)
    line = f"{out / name}: must hold its own values, got {words}"
    assert line in refusal("stats", out)
    assert line in refusal("check", out / name)
    if name == OTO:
        with pytest.raises(DataError, match="must hold its own values"):
            GraspDataset(out / OTO)


def test_file_whose_groups_go_in_circles_is_read(out: Path) -> None:
    with h5py.File(out / TRIALS, "r+") as file:
        file["objects/again"] = file["/"]
    assert "groups must be" in run("check", out).stdout or run("check", out).exit_code == 1


@pytest.mark.parametrize("field", ["name", "class_name"])
def test_names_in_a_file_do_not_steer_the_terminal(out: Path, field: str) -> None:
    with h5py.File(out / TRIALS, "r+") as file:
        file[f"objects/{field}"][0] = STEERING
    assert "a name must be printable" in refusal("stats", out)
    for command in ("stats", "check"):
        assert not set("\x1b\x07\x9b") & set(run(command, out).output)


def test_paths_and_names_of_files_do_not_steer_the_terminal(tmp_path: Path) -> None:
    meshes = tmp_path / f"meshes{STEERING}"
    meshes.mkdir()
    trimesh.creation.box([0.1, 0.1, 0.1]).export(meshes / "1_box.stl")
    (meshes / "1_box.stl").rename(meshes / f"1_{STEERING}.stl")
    for arguments in (["stats", meshes], ["audit", meshes], ["build", "--objects", meshes]):
        said = run(*arguments, *(["--out", tmp_path / "out"] * (arguments[0] == "build"))).output
        assert "x" in said
        assert not set("\x1b\x07\x9b") & set(said)


def test_names_in_a_log_and_on_a_page_steer_nothing(tmp_path: Path) -> None:
    BuildLog(tmp_path)("mesh refused", name=f"é{STEERING}")
    text = (tmp_path / "log.jsonl").read_text(encoding="utf-8")
    assert "é" in text
    assert not set("\x1b\x07\x9b") & set(text)
    assert next(read_log(tmp_path))["name"] == f"é{STEERING}"
    page = TEMPLATES.from_string("<p>{{ name }}</p>").render(name=f"<é{STEERING}>")
    assert page == "<p>&lt;é\\x1b]0;x\\x07\\x9b31m&gt;</p>"


#: Nine lists of nine: a billion values in a few lines.
BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)


@pytest.mark.parametrize("text", [BOMB, "a: &a [*a]\n", "[" * 5000])
def test_yaml_that_grows_is_refused(tmp_path: Path, text: str) -> None:
    meshes, bomb = tmp_path / "meshes", tmp_path / "bomb.yaml"
    meshes.mkdir()
    trimesh.creation.box([0.1, 0.1, 0.1]).export(meshes / "1_box.stl")
    bomb.write_text(text)
    words = "nested too deeply" if text.startswith("[") else "aliases that stand for more than"
    build = ["build", "--out", tmp_path / "out", "--objects", meshes]
    assert words in refusal(*build, "--config", bomb)
    assert words in run("hand", "check", bomb).output
    assert words in refusal(*build, "--manifest", bomb)
    assert not (tmp_path / "out").exists()
