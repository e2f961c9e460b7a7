"""Files of a stranger are safe to open: nothing outside of them is read, written or steered."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from helpers.commands import run
from helpers.datasets import OTO, TRIALS, edit_manifest

from drakegrasp import foreign_files
from drakegrasp.api.building import build_dataset
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import DataError
from drakegrasp.foreign_files import validate_regular
from drakegrasp.page.gallery import TEMPLATES
from drakegrasp.runtime.environment import host_label

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
    told = refusal("assemble", out)
    assert "must be a file of its own, got a link" in told or "symbolic links" in told
    assert run("stats", out).exit_code == 0
    assert victim.read_text() == "mine\n"


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


@pytest.mark.parametrize(
    ("folder", "command"),
    [("figures", ["figures"]), ("export_meshes", ["export", "--to", "meshes"])],
)
def test_folder_of_pictures_that_is_a_link_is_not_written_to(
    out: Path, tmp_path: Path, folder: str, command: list[str]
) -> None:
    (out / folder).symlink_to(tmp_path, target_is_directory=True)
    before = sorted(tmp_path.iterdir())
    said = f"{folder}: must be a folder of the dataset to write to, got a link"
    assert said in refusal(*command, out)
    assert sorted(tmp_path.iterdir()) == before


#: Other kinds of files: what makes one, and what is said of it.
KINDS = {
    "pipe": (os.mkfifo, "a pipe"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "a device"),
    "huge": (lambda path: (path.touch(), os.truncate(path, 2**40)), "a file of 1,099,511,627,776"),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["manifest.json", OTO, TRIALS])
def test_other_kind_of_file_is_neither_waited_for_nor_read(out: Path, kind: str, name: str) -> None:
    make, said = KINDS[kind]
    (out / name).unlink()
    make(out / name)
    assert f"{name}: " in refusal("stats", out) and said in refusal("stats", out)


@pytest.mark.parametrize("rows", [400_000_000, 2**50])
def test_columns_that_claim_more_rows_than_the_file_can_hold_are_refused(
    out: Path, rows: int
) -> None:
    with h5py.File(out / TRIALS, "r+") as file:
        for column in file["trials"].values():
            column.resize(rows, axis=0)
    assert "more rows than a file of" in refusal("stats", out)


def test_damaged_image_names_the_file(out: Path) -> None:
    with h5py.File(out / OTO, "r") as file:
        split = max(("train", "valid", "test"), key=lambda name: len(file[name]["images"]))
        place = file[split]["images"].id.get_chunk_info(0).byte_offset
    content = bytearray((out / OTO).read_bytes())
    # Several bytes, as a single bit of deflated data may be one that nothing reads.
    content[place + 200 : place + 208] = bytes(b ^ 0xFF for b in content[place + 200 : place + 208])
    (out / OTO).write_bytes(content)
    data = GraspDataset(out / OTO, split=split)
    with pytest.raises(DataError, match=f"{OTO}: must be undamaged, got: "):
        data[0]


def test_script_that_a_worker_imports_again_starts_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(multiprocessing.current_process(), "_inheriting", True, raising=False)
    with pytest.raises(SystemExit):
        build_dataset("builtin", tmp_path / "OUT")
    assert not (tmp_path / "OUT").exists()


@pytest.mark.parametrize("name", ["../../outside", f"a{STEERING}", ".hidden", ""])
def test_names_in_a_manifest_are_names(out: Path, name: str) -> None:
    edit_manifest(out, lambda tree: tree["objects"][0].update(name=name))
    for command in ("stats", "assemble", "check"):
        assert "a name must be printable" in refusal(command, out)


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
    assert f"got {words}" in run("check", out).stdout
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


def test_names_on_a_page_steer_nothing() -> None:
    page = TEMPLATES.from_string("<p>{{ name }}</p>").render(name=f"<é{STEERING}>")
    assert page == "<p>&lt;é\\x1b]0;x\\x07\\x9b31m&gt;</p>"


# Sparse files


def test_share_of_a_file_that_is_on_the_disk_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of a large one must be: 300 kB of 1 MB are too few, 900 kB are enough."""
    monkeypatch.setattr(foreign_files, "SOLID", 0.5)
    path = tmp_path / "file"
    path.write_bytes(b"x" * 300_000)
    os.truncate(path, 1_000_000)
    validate_regular(path)
    monkeypatch.setattr(foreign_files, "LARGE", 2**10)
    with pytest.raises(OSError, match=r"1,000,000 byte, of which only 3\d\d,\d{3} are on"):
        validate_regular(path)
    path.write_bytes(b"x" * 900_000)
    os.truncate(path, 1_000_000)
    validate_regular(path)
    with pytest.raises(OSError, match="1,000,000 byte, more than 1,024"):
        validate_regular(path, 2**10)
