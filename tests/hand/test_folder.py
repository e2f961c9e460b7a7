"""A hand in another folder is the same hand."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.hands import PINCER_SDF, write_pincer, write_tongs
from helpers.meshes import box, write

from drakegrasp.config import CarriedHand, Config
from drakegrasp.errors import DiskFullError, HandError
from drakegrasp.hand import folder as carrying
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.folder import carry_hand, hand_digest, hand_folder
from drakegrasp.hand.settings import load_config
from drakegrasp.hand.shapes import link_shapes

#: A mesh of the gripper's palm, and where its model finds it.
MESH = "<mesh><uri>{}</uri><drake:declare_convex/></mesh>"


def with_mesh(uri: str) -> str:
    """Return the gripper's model with a mesh for a palm."""
    mesh = MESH.format(uri)
    return PINCER_SDF.replace("<box><size>0.04 0.12 0.02</size></box>", mesh).replace(
        '<sdf version="1.9">', '<sdf version="1.9" xmlns:drake="drake.mit.edu">'
    )


def write_layout(root: Path, mesh: str = "palm.obj") -> Path:
    """Write the gripper, with a mesh of its palm in a place below it."""
    folder = root / Path(mesh).parent
    folder.mkdir(parents=True, exist_ok=True)
    write(root / mesh, box((0.04, 0.12, 0.02)))
    path = write_pincer(root)
    (root / "pincer.sdf").write_text(with_mesh(mesh))
    return path


def carried_source(out: Path, config: Config) -> CarriedHand:
    """Carry a hand, and return it."""
    source = carry_hand(out, config).hand_source
    assert isinstance(source, CarriedHand)
    return source


@pytest.mark.parametrize("mesh", ["palm.obj", "./meshes/../meshes/palm.obj"])
def test_the_copy_loads_by_itself_as_the_same_hand(mesh: str, tmp_path: Path) -> None:
    path = write_layout(tmp_path / "there", mesh)
    known, digest = load_hand(path), hand_digest(path)
    shapes = link_shapes(known.model)
    copy = carried_source(tmp_path / "out", load_config(hand=str(path)))
    assert copy.digest == digest == hand_digest(copy)

    shutil.rmtree(tmp_path / "there")
    hand = load_hand(copy)
    for name in ("joint_gain", "joint_offset", "joint_limits", "X_BG", "closing_speed"):
        assert np.array_equal(getattr(hand, name), getattr(known, name))
    for name in ("name", "fingers", "joint_names"):
        assert getattr(hand, name) == getattr(known, name)
    np.testing.assert_equal(link_shapes(hand.model), shapes)
    # And it can be carried on.
    config = load_config().with_hand("hand/pincer_hand.yaml", copy)
    again = carried_source(tmp_path / "next", config)
    assert hand_digest(again) == digest


@pytest.mark.parametrize(
    ("model", "mesh"),
    [
        ("../pincer.sdf", "palm.obj"),
        ("{}/pincer.sdf", "palm.obj"),
        ("pincer.sdf", "../palm.obj"),
        ("pincer.sdf", "file://{}/palm.obj"),
        ("pincer.sdf", "package://kit/palm.obj"),
    ],
)
def test_a_hand_of_several_folders_is_refused(model: str, mesh: str, tmp_path: Path) -> None:
    path = write_pincer(tmp_path)
    (tmp_path / "pincer.sdf").write_text(with_mesh(mesh.format(tmp_path)))
    change(path, MODEL, f"model: {model.format(tmp_path)}")
    with pytest.raises(HandError, match=r"must name files in it only, got .*: copy the files into"):
        load_hand(path)


def test_materials_textures_and_licences_come_along(tmp_path: Path) -> None:
    path = write_layout(tmp_path / "there", "meshes/palm.obj")
    mesh = path.parent / "meshes" / "palm.obj"
    mesh.write_text(f"mtllib palm.mtl\n{mesh.read_text()}")
    mesh.with_name("palm.mtl").write_text("newmtl a\nmap_Kd -s 1 1 1 skin.png\n")
    mesh.with_name("skin.png").write_bytes(b"a picture")
    (path.parent / "pincer_LICENSE.txt").write_text("\nMIT License\n")
    folder = carried_source(tmp_path / "out", load_config(hand=str(path))).path.parent
    copied = folder / "meshes" / "palm.obj"
    assert copied.read_bytes() == mesh.read_bytes()
    assert (copied.parent / "skin.png").read_bytes() == b"a picture"
    assert (folder / "LICENSE.txt").read_text() == "\nMIT License\n"


def change(path: Path, before: str, after: str) -> None:
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


def link_out(path: Path, target: Path) -> None:
    path.unlink()
    path.symlink_to(target)


#: What becomes of a carried hand's files, or what is replaced in one of them by what, where `{}` is
#: the dataset's folder.
MODEL = "model: pincer.sdf"
FAULTS = {
    "another model": ("pincer.sdf", "0.04 0.02", "0.05 0.02"),
    "an absolute model": ("pincer_hand.yaml", MODEL, "model: {}/secret.sdf"),
    "a model above": ("pincer_hand.yaml", MODEL, "model: ../secret.sdf"),
    "a mesh above": ("pincer.sdf", "palm.obj", "../palm.obj"),
    "an absolute mesh": ("pincer.sdf", "palm.obj", "file://{}/palm.obj"),
    "a large hand file": ("pincer_hand.yaml", MODEL, MODEL + " " * 300_000),
    "a package": ("pincer.sdf", "palm.obj", "package://a/b.obj"),
    "a material above": ("palm.obj", "v ", "mtllib ../a.mtl\nv "),
    "a linked mesh": lambda folder, out: link_out(folder / "palm.obj", out / "palm.obj"),
    "a linked hand file": lambda folder, out: link_out(
        folder / "pincer_hand.yaml", out / "secret.yaml"
    ),
    "a directory": lambda folder, out: (
        (folder / "palm.obj").unlink(), (folder / "palm.obj").mkdir()
    ),
    "a linked folder": lambda folder, out: (
        folder.rename(out / "elsewhere"), folder.symlink_to(out / "elsewhere")
    ),
    "a pipe": lambda folder, out: ((folder / "palm.obj").unlink(), os.mkfifo(folder / "palm.obj")),
    "no model": lambda folder, out: (folder / "pincer.sdf").unlink(),
    "no hand file": lambda folder, out: (folder / "pincer_hand.yaml").unlink(),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_a_stranger_s_hand_stays_in_its_folder(
    fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_layout(tmp_path / "there")
    copy = carried_source(tmp_path / "out", load_config(hand=str(path)))
    for name in ("secret.sdf", "palm.obj", "secret.yaml"):
        (tmp_path / "out" / name).write_text("nothing")
    load_hand(copy)
    folder, out, spoil = copy.path.parent, tmp_path / "out", FAULTS[fault]
    if callable(spoil):
        spoil(folder, out)
    else:
        change(folder / spoil[0], spoil[1], spoil[2].format(out))
    read, reader = list[Path](), Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: read.append(path) or reader(path))
    with pytest.raises(HandError) as caught:
        load_hand(copy)
    assert "\n" not in str(caught.value)
    # The digest of a stranger's hand is the stranger's, too: what is elsewhere is never read.
    assert all(path.parent == copy.path.parent for path in read)
    inside = fault in ("another model", "no model")
    assert ("got other files" in str(caught.value)) == inside


def test_a_hand_that_is_too_large_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_layout(tmp_path)
    monkeypatch.setattr("drakegrasp.hand.folder.LARGEST", 1500)
    with pytest.raises(HandError, match="must be at most 1000 and 0 MB in all, its YAML 256 kB"):
        hand_folder(path)


def test_a_copy_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is full half-way; then there is room. A build that was killed then goes on."""
    config, out, full = load_config(hand=str(write_tongs(tmp_path))), tmp_path / "out", [True]

    def sync(path: Path) -> None:
        if full and path.name.endswith(".urdf"):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(carrying, "sync", sync)
    with pytest.raises(DiskFullError):
        carry_hand(out, config)
    assert not list(out.iterdir())
    full.clear()
    carry_hand(out, config)
    copy = carried_source(out, config)
    assert sorted(p.name for p in copy.path.parent.iterdir()) == ["tongs.urdf", "tongs_hand.yaml"]
    assert [p.name for p in out.iterdir()] == ["hand"]


def test_an_include_in_a_model_comes_along(tmp_path: Path) -> None:
    """And its text counts."""
    path = write_pincer(tmp_path)
    palm = '<link name="palm">'
    change(tmp_path / "pincer.sdf", palm, f"{palm}<!-- <uri>part.sdf</uri> -->")
    before = hand_digest(path)
    (tmp_path / "part.sdf").write_text("<sdf/>")
    folder = hand_folder(path)
    assert folder.content("part.sdf") == b"<sdf/>" and folder.digest != before
