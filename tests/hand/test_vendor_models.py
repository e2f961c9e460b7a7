"""Models as vendors ship them: what becomes of frames, mimics, formats and meshes."""

from __future__ import annotations

import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.tables import table
from helpers.vendors import JAWS, JAWS_MJCF, link, write_mesh, write_model

from drakegrasp.errors import HandError, MachineError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.draft.source import read_model
from drakegrasp.hand.file_format import MODELS
from drakegrasp.hand.shapes import link_shapes
from drakegrasp.hand_setup import draft_hand

JAW_BOX = '<geometry><box size="0.02 0.012 0.06"/></geometry>'
MESH = '<geometry><mesh filename="{}"/></geometry>'


def with_mesh(uri: str) -> str:
    """Return the jaws, the left one's collision shape a mesh."""
    old = f'<collision><origin xyz="0 0.006 0.03"/>{JAW_BOX}'
    assert old in JAWS
    return JAWS.replace(old, f'<collision><origin xyz="0 0.006 0.03"/>{MESH.format(uri)}')


def test_masses_of_welded_links_add_up(tmp_path: Path) -> None:
    """By Huygens and Steiner."""
    heavy = '<link name="left_end"><inertial><mass value="0.15"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>'  # noqa: E501
    model = read_model(write_model(tmp_path, JAWS.replace('<link name="left_end"/>', heavy)))
    # The heavier link names both; the frame stays that of the joint.
    inertia = model.links["left_end"].inertia
    assert inertia.get_mass() == pytest.approx(0.2)
    np.testing.assert_allclose(inertia.get_com(), [0.0, 0.0, 0.045])
    about = inertia.Shift(inertia.get_com()).CalcRotationalInertia().get_moments()
    reduced = 0.05 * 0.15 / 0.2 * 0.06**2
    np.testing.assert_allclose(about, 2e-4 + np.array([reduced, reduced, 0.0]))


def test_a_mimic_leads_to_the_joint_that_leads_it(tmp_path: Path) -> None:
    """Through all joints in between."""
    chained = JAWS.replace(
        '<mimic joint="left_slide"/>', '<mimic joint="third" multiplier="2" offset="0.01"/>'
    ).replace(
        "</robot>",
        '<link name="bar"/><joint name="third" type="prismatic"><parent link="body"/><child '
        'link="bar"/><axis xyz="0 1 0"/><limit lower="0" upper="0.05" effort="1" velocity="1"/>'
        '<mimic joint="left_slide" multiplier="-3" offset="0.1"/></joint></robot>',
    )
    chained = re.sub('("right_slide".*?)lower="0" upper="0.05"', r'\1lower="-1" upper="1"', chained)
    chained = re.sub('("third".*?)lower="0" upper="0.05"', r'\1lower="-1" upper="1"', chained)
    mimic = read_model(write_model(tmp_path, chained)).mimics["right_slide"]
    assert (mimic.leader, mimic.ratio) == ("left_slide", -6.0)
    assert mimic.offset == pytest.approx(0.21)


def test_limits_that_bar_the_way_of_a_mimic_are_refused(tmp_path: Path) -> None:
    """Vendors give a joint that turns the other way the limits of its leader."""
    with pytest.raises(HandError, match=r"follow 'left_slide', -0\.05\.\.0, got 0\.\.0\.05"):
        read_model(write_model(tmp_path, JAWS.replace('slide"/>', 'slide" multiplier="-1"/>')))
    assert read_model(write_model(tmp_path / "sound", JAWS)).notes == ()


MOTOR = '<motor joint="left_slide" forcerange="-60 60"/>'
JOINT = '<joint name="left_slide"'
LINE = 'polycoef="0 1 0 0 0"'


@pytest.mark.parametrize(
    ("changes", "effort", "ratio"),
    [
        ({}, 60.0, 1.0),
        ({MOTOR: '<position joint="left_slide" kp="9" forcerange="-7 9" gear="2"/>'}, 18.0, 1.0),
        ({MOTOR: '<position joint="left_slide" kp="9" ctrlrange="0 0.05"/>'}, 0.0, 1.0),
        ({JOINT: f'{JOINT} actuatorfrcrange="-8 8"'}, 8.0, 1.0),
        ({JOINT: f'{JOINT} actuatorfrcrange="-8 8" actuatorfrclimited="false"'}, 60.0, 1.0),
        ({LINE: 'active="false"'}, 60.0, None),
        ({JOINT: f'{JOINT} ref="0.01"', LINE: 'polycoef="0 0.5"'}, 60.0, 0.5),
        ({JOINT: f'{JOINT} pos="0.01 0.02 0.03"'}, 60.0, 1.0),
        ({LINE: 'active="false"', MOTOR: '<motor joint="left_slide" gear="3"/>'}, 0.0, None),
        ({MOTOR: f'{MOTOR}<motor joint="left_slide" gear="2" forcerange="-5 5"/>'}, 70.0, 1.0),
    ],
)
def test_mjcf_is_read_as_mujoco_compiles_it(
    tmp_path: Path, changes: dict[str, str], effort: float, ratio: float | None
) -> None:
    """Joints with their limits, couplings, efforts, masses, and where bodies are."""
    mujoco = pytest.importorskip("mujoco")
    text = re.sub(r">\s+<", "><", JAWS_MJCF)
    for old, new in changes.items():
        old, new = re.sub(r">\s+<", "><", old.strip()), new.strip()
        assert old in text
        text = text.replace(old, new)
    path = write_model(tmp_path, text, "hand.xml")
    model, peer = read_model(path), mujoco.MjModel.from_xml_path(str(path))
    assert set(model.joints) == {peer.joint(j).name for j in range(peer.njnt)}
    for name, joint in model.joints.items():
        if name not in model.mimics:
            np.testing.assert_allclose(joint.limits, peer.joint(name).range, atol=1e-12)
    assert model.joints["left_slide"].effort == pytest.approx(effort)
    assert {m.ratio for m in model.mimics.values()} == ({ratio} - {None})

    # Bodies are where MuJoCo has them at its reference, with their masses and centres.
    drawn = {peer.joint(j).name: float(peer.qpos0[j]) for j in range(peer.njnt)}
    for m in model.mimics.values():
        assert drawn[m.joint] == pytest.approx(m.ratio * drawn[m.leader] + m.offset)
    data = mujoco.MjData(peer)
    mujoco.mj_forward(peer, data)
    X_WR = np.eye(4)
    X_WR[:3, :3], X_WR[:3, 3] = data.body("body").xmat.reshape(3, 3), data.body("body").xpos
    for name, part in model.links.items():
        assert part.inertia.get_mass() == pytest.approx(float(peer.body(name).mass[0]))
        X_WL = X_WR @ model.pose(name, drawn)
        centre = X_WL[:3, :3] @ part.inertia.get_com() + X_WL[:3, 3]
        np.testing.assert_allclose(centre, data.body(name).xipos, atol=1e-9)


def test_a_body_of_two_joints_moves_as_in_mujoco(tmp_path: Path) -> None:
    """About points beside its origin, and from positions at which the model is not drawn."""
    mujoco = pytest.importorskip("mujoco")
    lean = '<joint name="lean" axis="1 0.5 0" pos="0.01 0 0.02" range="-40 40" ref="10"/>'
    text = JAWS_MJCF.replace(JOINT, f'{lean}{JOINT} pos="0 0.03 0" ref="0.02"')
    text = text.replace(
        '<body name="left_jaw">', '<body name="left_jaw" pos="0 0 0.01" euler="9 8 7">'
    )
    path = write_model(tmp_path, text, "hand.xml")
    model, peer = read_model(path), mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(peer)
    for lean_at, slide_at in ((0.0, 0.0), (0.3, 0.04), (-0.5, 0.01)):
        data.joint("lean").qpos, data.joint("left_slide").qpos = lean_at, slide_at
        mujoco.mj_kinematics(peer, data)
        X_RL = model.pose("left_jaw", {"lean": lean_at, "left_slide": slide_at})
        (shape,) = model.links["left_jaw"].collisions
        X_RS = X_RL @ shape.X_LS
        np.testing.assert_allclose(X_RS[:3, 3], data.geom_xpos[1], atol=1e-12)
        np.testing.assert_allclose(X_RS[:3, :3].ravel(), data.geom_xmat[1], atol=1e-12)


def test_what_mjcf_does_not_name_has_a_name(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    text = re.sub(r' name="(left|right)_(jaw|slide)"', "", JAWS_MJCF)
    text = re.sub("<equality>.*</equality>|<actuator>.*</actuator>", "", text)
    model = read_model(write_model(tmp_path, text, "hand.xml"))
    assert list(model.links) == ["body", "body2", "body3"]
    assert list(model.joints) == ["body-body2", "body-body3"]
    twin = text.replace("<worldbody>", '<worldbody><body name="body3"/>')
    with pytest.raises(HandError, match="names must be unique, got 'body3' twice"):
        read_model(write_model(tmp_path, twin, "hand.xml"))


PLATE = "0 0 0 .02 0 0 0 .012 0 .02 .012 0 0 0 .06 .02 0 .06 0 .012 .06 .02 .012 .06"


def mesh_tip(attributes: str) -> dict[str, str]:
    """Return changes by which the tip of the left jaw is a mesh."""
    asset = f'<asset><mesh name="tip" {attributes}/></asset><worldbody>'
    return {"<worldbody>": asset, TIP: '<geom type="mesh" mesh="tip"'}


TIP = '<geom type="box" size="0.01 0.006 0.03" pos="0 0.006 0.03"'


@pytest.mark.parametrize(
    ("changes", "low", "high"),
    [
        ({TIP: '<geom type="box" size=".01" fromto="0 0 0 0 0 .06"'}, (-10, -10, 0), (10, 10, 60)),
        ({TIP: '<geom type="capsule" size=".01" fromto="0 0 0 .06 0 0"'},
         (-10, -10, -10), (70, 10, 10)),
        ({TIP: '<geom type="cylinder" size=".01" fromto="0 0 0 0 .06 0"'},
         (-10, 0, -10), (10, 60, 10)),
        ({TIP: '<geom type="sphere" size=".01" pos="0 0 .05"'}, (-10, -10, 40), (10, 10, 60)),
        ({TIP: '<geom type="ellipsoid" size=".01 .02 .03"'}, (-10, -20, -30), (10, 20, 30)),
        (mesh_tip(f'vertex="{PLATE}"'), (0, 0, 0), (20, 12, 60)),
        (mesh_tip('file="jaw.stl" refpos="0 0 0.01"'), (-10, -6, -40), (10, 6, 20)),
        (mesh_tip('file="jaw.obj" refquat="1 1 0 0"'), (-10, -30, -6), (10, 30, 6)),
    ],
)  # fmt: skip
def test_shapes_of_mjcf_are_those_that_mujoco_compiles(
    tmp_path: Path, changes: dict[str, str], low: tuple[int, ...], high: tuple[int, ...]
) -> None:
    """Bounds in [mm]; the mass stays."""
    pytest.importorskip("mujoco")
    for suffix in ("stl", "obj"):
        write_mesh(tmp_path / f"jaw.{suffix}")
    text = JAWS_MJCF
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    link = read_model(write_model(tmp_path, text, "hand.xml")).links["left_jaw"]
    (shape,) = link.collisions
    corners = 1e3 * shape.corners()
    np.testing.assert_allclose(corners.min(axis=0), low, atol=0.3)
    np.testing.assert_allclose(corners.max(axis=0), high, atol=0.3)
    assert link.inertia.get_mass() == pytest.approx(0.05)


def test_shapes_of_mjcf_collide_as_in_mujoco(tmp_path: Path) -> None:
    """A body none of whose shapes collide has those that are drawn."""
    pytest.importorskip("mujoco")
    more = ('<geom size="0.001" contype="0" conaffinity="0"/><geom size="0.002" group="3"/>'
            '<geom size="0.003" contype="0"/>')  # fmt: skip
    text = JAWS_MJCF.replace(TIP, more + TIP)
    text = text.replace('<body name="body">', '<body name="body"><geom type="plane" size="1 1 1"/>')
    model = read_model(write_model(tmp_path, text, "hand.xml"))
    shapes = model.links["left_jaw"].collisions
    assert [round(1e3 * float(s.corners().max(axis=0)[0])) for s in shapes] == [2, 3, 10]
    assert model.notes == ("link body: a shape of type plane is not kept",)

    drawn = JAWS_MJCF.replace(TIP, TIP.replace("<geom", '<geom contype="0" conaffinity="0"'))
    model = read_model(write_model(tmp_path, drawn, "drawn.xml"))
    assert len(model.links["left_jaw"].collisions) == 1
    assert "link left_jaw: the model has no collision shapes; hulls of its pictures" in model.notes


def test_a_draft_of_mjcf_is_urdf_that_needs_no_mujoco(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    text = JAWS_MJCF
    for old, new in mesh_tip(f'vertex="{PLATE}"').items():
        text = text.replace(old, new)
    path = write_model(tmp_path, text, "hand.xml")
    file = draft_hand(path, tmp_path / "out").path
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert load_hand(file).num_fingers == 2
    assert not list(file.parent.glob("*.xml"))
    with pytest.raises(MachineError, match=r"^mujoco must be installed: pip install 'drakegrasp"):
        read_model(path)


@pytest.mark.parametrize("moments", ["1 1e-6 1e-6", "0 0 0", "-1e-5 1e-5 1e-5", "1e-5 1e-5 3e-5"])
def test_an_inertia_that_no_body_has_is_replaced_and_said(tmp_path: Path, moments: str) -> None:
    text = JAWS
    for axes, moment in zip(("xx", "yy", "zz"), moments.split(), strict=True):
        text = text.replace(f'i{axes}="1e-4"', f'i{axes}="{moment}"')
    model = read_model(write_model(tmp_path, text))
    assert len([n for n in model.notes if "the model's inertia is impossible (" in n]) == 3
    box = 0.05 / 12.0 * (0.012**2 + 0.06**2)
    inertia = model.links["left_jaw"].inertia
    central = inertia.Shift(inertia.get_com()).CalcRotationalInertia().get_moments()
    assert central[0] == pytest.approx(box, rel=0.1)
    # A rod is a body.
    rod = JAWS.replace('izz="1e-4"', 'izz="0"')
    assert read_model(write_model(tmp_path / "rod", rod)).notes == ()


def test_a_mesh_has_the_scale_that_the_model_gives(tmp_path: Path) -> None:
    write_mesh(tmp_path / "jaw.stl")
    text = with_mesh("jaw.stl").replace('jaw.stl"', 'jaw.stl" scale="2 2 1"')
    (shape,) = read_model(write_model(tmp_path, text)).links["left_jaw"].collisions
    np.testing.assert_allclose(np.ptp(shape.corners(), axis=0), [0.04, 0.024, 0.06], atol=1e-9)


def test_a_collision_mesh_is_a_hull_of_few_corners(tmp_path: Path) -> None:
    import trimesh

    ball = trimesh.creation.icosphere(4, 0.02)
    ball.export(tmp_path / "ball.stl")
    model = read_model(write_model(tmp_path, with_mesh("ball.stl")))
    (shape,) = model.links["left_jaw"].collisions
    assert shape.vertices is not None
    assert len(shape.vertices) <= 70
    np.testing.assert_allclose(np.linalg.norm(shape.vertices, axis=1), 0.02, atol=1e-6)
    assert trimesh.Trimesh(shape.vertices, shape.faces).volume > 0.9 * ball.volume


def test_a_link_without_collision_shapes_gets_those_of_its_pictures(tmp_path: Path) -> None:
    text = JAWS.replace(f'<collision><origin xyz="0 0.006 0.03"/>{JAW_BOX}</collision>', "")
    model = read_model(write_model(tmp_path, text))
    assert len(model.links["left_jaw"].collisions) == 1
    assert "link left_jaw: the model has no collision shapes; hulls of its pictures" in model.notes


def test_a_link_without_a_mass_gets_one_by_its_size(tmp_path: Path) -> None:
    text = JAWS.replace('<mass value="0.05"/>', '<mass value="0"/>', 1)
    model = read_model(write_model(tmp_path, text))
    # A box of 14 cm^3, a little thicker.
    assert model.links["left_jaw"].inertia.get_mass() == pytest.approx(0.02, rel=0.1)
    assert any(note.startswith("link left_jaw: the model gives no mass") for note in model.notes)


def test_packages_are_folders_above_or_given_ones(tmp_path: Path) -> None:
    write_mesh(tmp_path / "pkg" / "meshes" / "jaw.stl")
    text = with_mesh("package://pkg/meshes/jaw.stl")
    inside = write_model(tmp_path / "pkg" / "urdf", text)
    assert read_model(inside).links["left_jaw"].collisions[0].vertices is not None
    outside = write_model(tmp_path / "elsewhere", text)
    with pytest.raises(HandError, match=r"must lie in a known package: .* --package pkg=FOLDER"):
        read_model(outside)
    assert read_model(outside, packages={"pkg": tmp_path / "pkg"}).links["left_jaw"].collisions


# Spoilt models: each is refused in one line that names the fault


MIMIC = '<mimic joint="left_slide"/>'
EMPTY = '<model name="{}"><link name="x"/></model>'
# fmt: off
#: Of a file of its own: its text, its name, and what is said of it.
FILES = {
    "not XML": ("<robot", "hand.urdf", "must be XML, got text that is not"),
    "another language": ("<html/>", "hand.urdf", "does not contain a robot tag"),
    "xacro": (JAWS, "hand.xacro", "must be URDF, got xacro: run `xacro hand.xacro"),
    "another suffix": (JAWS, "hand.step", r"must end in \.urdf, \.sdf or \.xml"),
    "XML bomb": ('<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;">]>'
                 + JAWS.replace('name="jaws"', 'name="&b;"'), "hand.urdf", "document type"),
    "deep": ("<robot>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>", "hand.urdf", "DEPTH_EXCEEDED"),
    "no shapes": (re.sub(r"<(collision|visual)>.*?</\1>", "", JAWS), "hand.urdf",
                  "must have shapes, got links without any"),
    "joint that floats": (
        re.sub('(right_slide" type=")prismatic', r"\1planar", JAWS.replace(MIMIC, "")),
        "hand.urdf", "joint 'right_slide' must be revolute, prismatic or fixed"),
    "no joints": (f'<robot name="block">{link("body", 0.5, JAW_BOX)}</robot>', "hand.urdf",
                  r"must have two fingers or more, got one chain .* --palm LINK \(body\)"),
    "two models": (f'<sdf version="1.7">{"".join(map(EMPTY.format, "ab"))}</sdf>', "hand.sdf",
                   "can only contain one model"),
    "other files": ('<sdf version="1.7"><model name="a"><include><uri>model://b</uri></include>'
                    "</model></sdf>", "hand.sdf", "must be complete by itself, got '<include'"),
    "missing mesh of MJCF": ('<mujoco><asset><mesh file="lost.stl"/></asset></mujoco>', "hand.xml",
                             "lost.stl: must be a readable file, got: No such file"),
}
# fmt: on


TABLE = table("spoilt_models")


def changed(text: str, old: str, new: str, count: int = -1) -> str:
    assert old in text
    return text.replace(old, new, count)


SPOILT = (
    FILES
    | {name: (changed(JAWS, *row[:3]), "hand.urdf", row[3]) for name, row in TABLE["urdf"].items()}
    | {
        name: (changed(JAWS_MJCF, *row[:3]), "hand.xml", row[3])
        for name, row in TABLE["mjcf"].items()
    }
)


@pytest.mark.parametrize("fault", SPOILT)
def test_a_spoilt_model_is_refused_in_one_line(tmp_path: Path, fault: str) -> None:
    """Nothing is left behind."""
    text, name, message = SPOILT[fault]
    path = write_model(tmp_path, text, name)
    (tmp_path / "broken.glb").write_bytes(bytes(range(256)))
    (tmp_path / "empty.obj").write_text("v 0 0 0\n")
    (tmp_path / "tip.gltf").write_text("{}")
    (tmp_path / "jaw.step").write_text("ISO-10303-21;")
    out = tmp_path / "out"
    result = run("hand", "new", str(path), "--out", str(out))
    assert result.exit_code == 2, result.output
    assert len(result.output.strip().splitlines()) == 1, result.output
    assert re.search(message, result.output), result.output
    assert not out.exists()


@pytest.mark.parametrize("word", ["0,05", "0.05m", "nan", "0_1"])
@pytest.mark.parametrize(
    ("name", "text", "old", "new"),
    [
        ("hand.urdf", JAWS, 'upper="0.05"', 'upper="{}"'),
        ("hand.urdf", JAWS, 'xyz="0 1 0"', 'xyz="{} {} {}"'),
        ("hand.urdf", JAWS, 'ixx="1e-4"', 'ixx="{}"'),
        ("hand.urdf", JAWS, MIMIC, '<mimic joint="left_slide" multiplier="{}"/>'),
        ("hand.xml", JAWS_MJCF, 'range="0 0.05"', 'range="{} {}"'),
        ("hand.xml", JAWS_MJCF, 'mass="0.05"', 'mass="{}"'),
    ],
)
def test_what_is_no_number_is_refused(
    tmp_path: Path, name: str, text: str, old: str, new: str, word: str
) -> None:
    """Drake reads the start of a single number, and MuJoCo its default."""
    path = write_model(tmp_path, changed(text, old, new.replace("{}", word), 1), name)
    with pytest.raises(HandError, match=r"must be a number|Expected|bad format|which is no number"):
        read_model(path)


def test_fault_of_an_sdformat_file_is_said_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name in ("allegro_hand.sdf", "allegro_hand.yaml", "allegro_fingertip.obj"):
        shutil.copyfile(MODELS / name, tmp_path / name)
    model = tmp_path / "allegro_hand.sdf"
    model.write_text(model.read_text().replace("<pose>0 ", "<pose>", 1))
    with pytest.raises(HandError, match="Error reading element <pose>"):
        load_hand(tmp_path / "allegro_hand.yaml")
    with pytest.raises(HandError, match="Error reading element <pose>"):
        read_model(model)
    assert caplog.text == ""


def test_pipe_in_place_of_a_model_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "hand.urdf")
    with pytest.raises(HandError, match=r"hand\.urdf: must be a readable file, got: a pipe"):
        read_model(tmp_path / "hand.urdf")


@pytest.mark.parametrize(
    ("hand", "name", "spoil", "said"),
    [
        ("barrett", "barrett_palm_plate.obj", (r"(?m)^v \S+", "v 26.5"),
         r"within 3 m of it, got one that reaches 26\.5 m"),
        ("franka", "franka_hand.urdf", (r'<box size="\S+', '<box size="-0.5'),
         r"must be a file of one model, got .*width = -0\.5"),
        ("barrett", "barrett_palm_plate.obj", None, "plate.obj: must be a file, got a pipe, a s"),
    ],
)  # fmt: skip
def test_spoilt_file_of_a_hand_is_refused(
    tmp_path: Path, hand: str, name: str, spoil: tuple[str, str] | None, said: str
) -> None:
    for path in MODELS.glob(f"{hand}_*"):
        shutil.copyfile(path, tmp_path / path.name)
    text = (tmp_path / name).read_text()
    (tmp_path / name).unlink()
    if spoil is None:
        (tmp_path / name).symlink_to("/dev/zero")
    else:
        (tmp_path / name).write_text(re.sub(*spoil, text, count=1))
    with pytest.raises(HandError, match=said):
        link_shapes(load_hand(tmp_path / f"{hand}_hand.yaml").model)
