"""Files of postures become one table, whoever wrote them; what is none is refused in a line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from helpers.hands import write_pincer
from helpers.isaac import isaac_grasp, quaternion, write_isaac
from scipy.spatial.transform import Rotation

import drakegrasp
from drakegrasp.errors import GraspError, HandError
from drakegrasp.exchange import columns as columns_of_files
from drakegrasp.exchange.attempts import read_attempts, write_attempts
from drakegrasp.frames import make_pose, rotation_about
from drakegrasp.hand.description import Hand, load_hand
from drakegrasp.hand.kinematics import joint_positions
from drakegrasp.simulation.attempts import CONDITIONS, GraspTable, quaternion_poses, ranked

HAND = load_hand("allegro")
ORDER = HAND.joint_order
POSES = np.array([make_pose(rotation_about([0.0, 0.6, 0.8], a), [a, 0.1, 0.2]) for a in (0.3, 2.0)])
GRASP = np.arange(32.0).reshape(2, 16) / 100.0
PREGRASP, SQUEEZE = GRASP - 0.05, GRASP + 0.05
OBJECTS = ["mug", "can"]


def arrays() -> dict[str, Any]:
    """Our own layout, with the joints in another order."""
    return {
        "object": np.array(OBJECTS),
        "X_FG": POSES,
        "q_grasp": GRASP[:, ::-1],
        "q_pregrasp": PREGRASP[:, ::-1],
        "q_squeeze": SQUEEZE[:, ::-1],
        "joints": np.array(ORDER[::-1]),
        "resting": np.array([0, 2]),
        "source": np.array(["net 7", ""]),
    }


def read_own(folder: Path, hand: Hand, **content: Any) -> GraspTable:
    """Return the postures of a file of arrays, p.npz."""
    np.savez(folder / "p.npz", **content)
    return read_attempts(folder / "p.npz", hand)


def test_rows_of_a_preshape_need_not_name_the_joints_that_it_keeps(tmp_path):
    """Those of fingers that it leaves out."""
    hand = load_hand("allegro_four")
    tripod = hand.at(hand.preshape_names.index("tripod"))
    joints = [f.closing_joint for f in tripod.fingers]
    rows = {"object": OBJECTS, "X_FG": [np.eye(4)] * 2, "preshape": ["tripod"] * 2}
    table = read_own(tmp_path, hand, **rows, q_grasp=[[0.1, 0.2, 0.3]] * 2, joints=joints)
    assert table.preshape == ("tripod", "tripod")
    expected = joint_positions(tripod, 0.0, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(table.q_grasp[1], [expected[name] for name in hand.joint_order])


def test_a_row_of_a_preshape_that_the_hand_lacks_spoils_no_other(tmp_path):
    hand = load_hand("allegro_four")
    known, q = hand.preshape_names[0], np.zeros((3, len(hand.joint_order)))
    rows = {"object": ["mug"] * 3, "X_FG": [np.eye(4)] * 3, "preshape": [known, "fist", ""]}
    table = read_own(tmp_path, hand, **rows, q_grasp=q)
    assert table.preshape == (known, "fist", "")
    assert [bool(reason) for reason in table.invalid] == [False, True, False]
    assert f"preshape must be one of {known}" in table.invalid[1] and "'fist'" in table.invalid[1]


def test_own_layouts_say_the_same_and_all_that_is_known_is_written(tmp_path):
    """What a reader knows of a row comes in again, and the file states its hand."""
    known = {
        "X_TO": np.tile(make_pose(np.eye(3), [0.0, 0.0, 0.1]), (2, 1, 1)),
        "scale": np.array([0.01, np.nan]),
        **{name: np.array([0.5, np.nan]) for name in CONDITIONS},
        "confidence": np.array([0.9, 0.1]),
    }
    table = read_own(tmp_path, HAND, **arrays(), **known)
    assert table.objects == tuple(OBJECTS) and table.invalid == ("", "")
    assert (table.frame, table.resting.tolist(), table.said) == ("object", [0, 2], ("net 7", ""))
    np.testing.assert_allclose(table.X_FG, POSES, atol=1e-12)
    for name, values in {"grasp": GRASP, "pregrasp": PREGRASP, "squeeze": SQUEEZE}.items():
        np.testing.assert_array_equal(getattr(table, f"q_{name}"), values)

    write_attempts(tmp_path / "p.h5", table, HAND)
    again = dict(read_attempts(tmp_path / "p.h5", HAND))
    for name, values in table:
        np.testing.assert_array_equal(again[name], values, err_msg=name)
    with h5py.File(tmp_path / "p.h5") as file:
        assert file.attrs["hand"] == HAND.name
        assert file.attrs["drakegrasp"] == drakegrasp.__version__

    with pytest.raises(GraspError, match="row 1: of no use"):
        write_attempts(tmp_path / "bad.h5", table.refuse(["", "of no use"]), HAND)
    assert not (tmp_path / "bad.h5").exists()


def test_pose_of_the_palm_link_becomes_that_of_the_palm(tmp_path):
    table = read_own(tmp_path, HAND, **arrays(), link=np.array(HAND.palm_link))
    np.testing.assert_allclose(table.X_FG, POSES @ HAND.X_BG, atol=1e-12)


def test_joints_that_the_hand_file_moves_may_be_left_out(tmp_path):
    named = ("index_mcp_joint", "middle_mcp_joint", "thumb_mcp_joint")
    rows = {"object": ["mug"], "X_FG": POSES[:1], "q_grasp": [[0.5, 0.6, 0.7]], "joints": named}
    q = dict(zip(ORDER, read_own(tmp_path, HAND, **rows).q_grasp[0], strict=True))
    assert q["index_pip_joint"] == pytest.approx(0.7)
    assert q["thumb_ip_joint"] == pytest.approx(0.175)
    assert q["thumb_opposition_joint"] == HAND.preshape["thumb_opposition_joint"]


def test_degrees_are_refused_and_one_wild_row_is_not(tmp_path):
    with pytest.raises(GraspError, match=r"grasp joints must be in radians, .* look like degrees"):
        read_own(tmp_path, HAND, **{**arrays(), "q_grasp": np.rad2deg(GRASP + 1.0)})

    wild = np.concatenate([GRASP, GRASP[:1]])
    wild[0, 0] = 50.0
    rows = {name: np.concatenate([v, v[:1]]) for name, v in arrays().items() if len(v) == 2}
    np.savez(tmp_path / "w.npz", **{**arrays(), **rows, "q_grasp": wild})
    assert read_attempts(tmp_path / "w.npz", HAND).q_grasp[0].max() == 50.0


@pytest.mark.parametrize("name", ["p.npz", "p.h5"])
def test_arrays_larger_than_any_postures_are_refused(tmp_path, name, monkeypatch):
    np.savez(tmp_path / "p.npz", **arrays())
    with h5py.File(tmp_path / "p.h5", "w") as file:
        file["X_FG"] = POSES
    monkeypatch.setattr(columns_of_files, "MOST_BYTES", 100)
    with pytest.raises(GraspError, match=r"at most 1e\+02 bytes, got|byte, more than 100"):
        read_attempts(tmp_path / name, HAND)


def test_quaternion_of_another_length_is_none_and_a_rounded_one_is():
    lengths = np.array([0.9995, 1.002, 0.0, np.nan])
    wxyz = np.outer(lengths, [1.0, 0.0, 0.0, 0.0])
    X, reasons = quaternion_poses(np.tile([1.0, 2.0, 3.0], (4, 1)), wxyz)
    np.testing.assert_allclose(X[0], make_pose(np.eye(3), [1.0, 2.0, 3.0]), atol=1e-15)
    assert np.isnan(X[1:]).all()
    assert [bool(reason) for reason in reasons] == [False, True, True, True]
    assert reasons[1].endswith("of length 1, got [1.0, 2.0, 3.0] and [1.002, 0.0, 0.0, 0.0]")


# Formats of others


def dexgraspbench(i: int = 0, **changes: Any) -> dict[str, Any]:
    """A grasp over a table, as BODex and Dexonomy write one: the object is turned and moved."""
    X_WM = make_pose(rotation_about([0.0, 0.0, 1.0], 0.5), [0.3, 0.2, 0.1])
    X_WB = X_WM @ POSES[i] @ np.linalg.inv(HAND.X_BG)
    place = [*X_WB[:3, 3], *quaternion(X_WB)]
    return {
        "obj_pose": np.array([*X_WM[:3, 3], *quaternion(X_WM)]),
        "obj_scale": 0.08,
        "obj_path": f"assets/object/{OBJECTS[i]}",
        "pregrasp_qpos": np.array([*place, *PREGRASP[i]]),
        "grasp_qpos": np.array([*place, *GRASP[i]]),
        "squeeze_qpos": np.array([*place, *SQUEEZE[i]]),
        **changes,
    }


def write_dictionary(path: Path, content: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    array = np.empty((), dtype=object)
    array[()] = content
    np.save(path, array, allow_pickle=True)
    return path


def assert_both(table: GraspTable) -> None:
    assert (table.objects, table.frame) == (tuple(OBJECTS), "mesh")
    np.testing.assert_allclose(table.X_FG, POSES, atol=1e-9)
    np.testing.assert_array_equal(table.q_grasp, GRASP)
    np.testing.assert_array_equal(table.q_pregrasp, PREGRASP)


def test_several_grasps_of_one_dictionary_are_rows(tmp_path):
    one = dexgraspbench()
    keys = ("pregrasp_qpos", "grasp_qpos", "squeeze_qpos")
    many = {**one, **{key: np.stack([one[key]] * 3) for key in keys}}
    many |= {"joint_names": list(ORDER)}
    table = read_attempts(write_dictionary(tmp_path / "0.npy", many), HAND)
    assert table.objects == ("mug",) * 3
    np.testing.assert_allclose(table.X_FG, POSES[[0, 0, 0]], atol=1e-9)


def test_isaac_grasp_is_of_the_object_that_its_file_is_named_after(tmp_path):
    for i, name in enumerate(OBJECTS):
        grasp = isaac_grasp(
            POSES[i] @ np.linalg.inv(HAND.X_BG),
            cspace_position=dict(zip(ORDER, GRASP[i].tolist(), strict=True)),
            pregrasp_cspace_position=dict(zip(ORDER, PREGRASP[i].tolist(), strict=True)),
        )
        # Names in another order of files than of objects.
        write_isaac(tmp_path / f"{i}" / f"{name}.yaml", grasp_0=grasp)
    table = read_attempts(tmp_path, HAND)
    assert_both(table)
    assert table.said[0] == "grasp_0, confidence 0.5"


def stated(path: Path, **content: Any) -> Path:
    """Write a grasp of isaac_grasp with what GraspDataGen says of object and gripper."""
    tree = yaml.safe_load(write_isaac(path, a=isaac_grasp(POSES[0])).read_text())
    path.write_text(yaml.safe_dump(tree | content))
    return path


def test_isaac_grasp_says_of_which_object_and_gripper_it_is(tmp_path):
    """The object is that of the mesh; its scale is compared with that of the object later."""
    path = tmp_path / "grasps.yaml"
    table = read_attempts(stated(path, object_file="objects/mug.1.0.obj", object_scale=0.5), HAND)
    assert (table.objects, table.scale.tolist()) == (("mug.1.0",), [0.5])
    assert read_attempts(stated(path, object_file=r"C:\meshes\can.usd"), HAND).objects == ("can",)
    table = read_attempts(stated(path, object_scale="1e-3"), HAND)
    assert (table.objects, table.scale.tolist()) == (("grasps",), [0.001])
    assert np.isnan(read_attempts(stated(path), HAND).scale).all()
    for scale in ("half", True, None, [1.0, 1.0, 2.0]):
        with pytest.raises(GraspError, match="object_scale must be a number, got"):
            read_attempts(stated(path, object_scale=scale), HAND)


@pytest.mark.parametrize(
    ("gripper", "own"),
    [
        ("bots/allegro_hand_right.usd", True),
        ("bots/franka_panda.usd", False),
        ("single_suction_cup_30mm.usd", False),
    ],
)
def test_grasps_of_another_gripper_are_refused_unless_their_frame_is_named(tmp_path, gripper, own):
    path = stated(tmp_path / "mug.yaml", gripper_file=gripper)
    if own:
        assert read_attempts(path, HAND).invalid == ("",)
        return
    with pytest.raises(
        GraspError, match=rf"of the hand allegro .*, got those of .* {Path(gripper).stem}:"
    ):
        read_attempts(path, HAND)
    assert read_attempts(path, HAND, read_as={"link": HAND.palm_link}).invalid == ("",)


def test_palm_link_named_palm_is_no_palm_frame_in_files_of_others(tmp_path):
    leap = load_hand("leap")
    assert leap.palm_link == "palm" and not np.allclose(leap.X_BG, np.eye(4))
    grasp = isaac_grasp(POSES[0], cspace_position=dict.fromkeys(leap.joint_order, 0.1))
    table = read_attempts(write_isaac(tmp_path / "mug.yaml", grasp_0=grasp), leap)
    np.testing.assert_allclose(table.X_FG[0], POSES[0] @ leap.X_BG, atol=1e-9)


# Palm poses alone


def test_a_palm_pose_in_each_preshape_has_no_joints(tmp_path):
    hand = load_hand("allegro_four")
    q = np.zeros((1, len(hand.joint_order)))
    content = {"object": ["mug"], "X_FG": POSES[:1], "preshape": ["each"]}
    table = read_own(tmp_path, hand, **content)
    assert table.invalid == ("",) and table.shapes(0, hand) == hand.preshape_names
    assert "preshape must be left out" in read_attempts(tmp_path / "p.npz", HAND).invalid[0]
    assert "preshape must be one of" in read_own(tmp_path, hand, **content, q_grasp=q).invalid[0]


def test_joints_before_a_grasp_without_joints_are_refused(tmp_path):
    reasons = read_own(tmp_path, HAND, object=OBJECTS, X_FG=POSES, q_pregrasp=PREGRASP).invalid
    assert all("q_pregrasp must be given together with q_grasp" in reason for reason in reasons)


# Rows that are no postures


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"q_grasp": [np.nan, 1.0]}, "q_grasp must be finite numbers, got others"),
        ({"X_FG": [2.0, 1.0]}, "the palm's pose must have 0 0 0 1 as its last row"),
        ({"resting": np.array([0.5, 2.0])}, "resting must be the index of a resting pose, got 0.5"),
    ],
)
def test_bad_row_of_arrays_has_its_reason_and_spoils_no_other(tmp_path, changes, reason):
    content, good = arrays(), read_own(tmp_path, HAND, **arrays())
    for name, value in changes.items():
        factor = np.reshape(value, (2, *[1] * (content[name].ndim - 1)))
        content[name] = content[name] * factor if isinstance(value, list) else value
    table = read_own(tmp_path, HAND, **content)
    assert table.invalid[0].startswith(reason)
    assert table.invalid[1] == ""
    np.testing.assert_array_equal(table.X_FG[1], good.X_FG[1])
    np.testing.assert_array_equal(table.q_grasp[1], good.q_grasp[1])


def test_file_in_a_folder_that_is_no_grasp_is_a_row_of_its_own(tmp_path):
    write_dictionary(tmp_path / "0.npy", dexgraspbench(0))
    (tmp_path / "1.npy").write_text("junk", encoding="utf-8")
    write_dictionary(tmp_path / "2.npy", dexgraspbench(1, grasp_qpos=np.zeros(23)))
    short = {key: np.zeros(10) for key in ("pregrasp_qpos", "grasp_qpos", "squeeze_qpos")}
    write_dictionary(tmp_path / "3.npy", dexgraspbench(1, **short))
    write_dictionary(tmp_path / "4.npy", dexgraspbench(1))
    table = read_attempts(tmp_path, HAND)
    assert table.row.tolist() == [0, 1, 2, 3, 4]
    assert [bool(reason) for reason in table.invalid] == [False, True, True, True, False]
    assert table.invalid[1].startswith(f"{tmp_path / '1.npy'}: must be a .npy file")
    assert "position and quaternion" in table.invalid[2]
    assert "grasp joints must be of shape (1, 16), got (1, 3)" in table.invalid[3]
    whole = table.at([0, 4])
    assert_both(whole)
    np.testing.assert_array_equal(whole.q_squeeze, SQUEEZE)
    assert whole.scale.tolist() == [0.08, 0.08]


def test_grasp_of_isaac_grasp_that_is_none_is_a_row_of_its_own(tmp_path):
    whole = isaac_grasp(np.eye(4), cspace_position=dict.fromkeys(ORDER, 0.1))
    turned = {**whole, "orientation": {"w": 0.0, "xyz": [0.0, 0.0, 0.0]}}
    path = write_isaac(
        tmp_path / "mug.yaml",
        a=5,
        b={**whole, "position": [0.0]},
        c=whole,
        d=turned,
        palm_alone=isaac_grasp(np.eye(4)),
    )
    table = read_attempts(path, HAND)
    assert [bool(reason) for reason in table.invalid] == [True, True, False, True, False]
    assert table.invalid[1].startswith("b must have position, orientation and cspace_position")
    np.testing.assert_array_equal(table.q_grasp[2], 0.1)


# Refusals


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"q_grasp": GRASP[:, :3]}, r"grasp joints must be of shape \(2, 16\), got \(2, 3\)"),
        ({"X_FG": POSES[:1]}, r"must be of shape \(2, 4, 4\)"),
        ({"frame": np.array("palm")}, "frame must be one of object, table, camera, world, mesh"),
        ({"frame": np.array("camera")}, "X_TC must be given with the frame camera"),
        ({"link": np.array("wrist")}, "link must be 'palm' for the palm frame, or 'base'"),
        ({"joints": np.array(["a"] * 16)}, "of the hand, got 'a': rename .* has index_roll_joint"),
        ({"poses": POSES}, r"some of .*X_FG.*, got 'poses' of shape \(2, 4, 4\); contact points"),
        ({"X_FG": POSES + 0.5j}, "X_FG must be poses, .*, got complex numbers"),
        ({"q_grasp": GRASP + 1j}, "grasp joints must be numbers .*, got complex numbers"),
        ({"mass": np.array([0.1, 1j])}, "mass must be 2 numbers each, got complex numbers"),
        ({"mass": np.array([0.1])}, "mass must be 2 numbers each, got other shapes"),
        ({"q_grasp": GRASP.astype(str)}, "grasp joints must be numbers .*, got text"),
        ({"quaternion": np.eye(4)[:2]}, "poses must be X_FG, or position and .*, got both"),
        ({"object": np.zeros(2)}, "object must be texts"),
        ({"frame": ["table", ""]}, "frame must be the same in all rows"),
        ({"X_FG": None}, r"X_FG \(or position and .* must"),
    ],
)
def test_arrays_that_are_no_postures_are_refused_in_a_line(tmp_path, changes, words):
    content = {k: v for k, v in {**arrays(), **changes}.items() if v is not None}
    with pytest.raises(GraspError, match=words) as caught:
        read_own(tmp_path, HAND, **content)
    assert str(caught.value).startswith(str(tmp_path / "p.npz"))
    assert "\n" not in str(caught.value)


#: What a file has that we export.
EXPORTED = {"joint_units": ["rad"] * 16}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"grasp_qpos": "a"}, "grasp_qpos must be numbers"),
        ({"joint_names": [1, 2]}, "joint_names must be a list of texts"),
        ({"obj_pose": np.zeros(3)}, "obj_pose must be rows of 7 numbers or more"),
        ({"obj_pose": np.zeros(8)}, r"obj_pose must be 7 numbers for 1 or 1, got \(1, 8\)"),
        ({"obj_pose": np.zeros((3, 7))}, r"obj_pose must be 7 numbers .*, got \(3, 7\)"),
        ({"squeeze_qpos": np.zeros((2, 23))}, "the postures must have equal lengths"),
        (EXPORTED | {"conditions": [1.0, 2.0]}, r"conditions must be 3 numbers, got \(2,\)"),
        (EXPORTED | {"start_qpos": [0.1]}, r"start_qpos must be 16 numbers, got \(1,\)"),
        (EXPORTED | {"trial_id": 1.5}, "trial_id must be a whole number, got 1.5"),
    ],
)
def test_dictionaries_that_are_no_grasps_are_refused_in_a_line(tmp_path, changes, words):
    path = write_dictionary(tmp_path / "0.npy", dexgraspbench(**changes))
    with pytest.raises(GraspError, match=words):
        read_attempts(path, HAND)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.xyz", "x,y\n1,2\n", r"must be a file of postures \(\.npz"),
        ("a.npz", "junk", "must be a readable file of arrays"),
        (
            "a.yaml",
            "{format: isaac_grasp, format_version: 1, grasps: {a: {cspace_position: 5}}}",
            "grasps must have cspace_position, joints by name, got none",
        ),
        ("a.npy", "junk", r"must be a \.npy file"),
        ("a.yaml", "format: other", "format must be isaac_grasp"),
        ("a.yaml", "format: isaac_grasp\nformat_version: 2.0", "format_version must be 1.0"),
    ],
)
def test_other_files_are_refused_in_a_line(tmp_path, name, content, words):
    (tmp_path / name).write_text(content, encoding="utf-8")
    with pytest.raises(GraspError, match=words):
        read_attempts(tmp_path / name, HAND)


def test_file_that_is_not_there_is_refused_in_a_line(tmp_path):
    path = tmp_path / "none.npz"
    with pytest.raises(GraspError, match=f"postures must be a file or a folder .*, got '{path}'"):
        read_attempts(path, HAND)


def test_rows_without_an_object_are_of_the_one_that_is_named(tmp_path):
    np.savez(tmp_path / "p.npz", X_FG=POSES)
    assert read_attempts(tmp_path / "p.npz", HAND, of="cup").objects == ("cup", "cup")


def test_without_a_dataset_rows_are_not_asked_and_confidence_is_one_per_row(tmp_path):
    """Not even how many rows there are: a table of postures can still be cut."""
    table = read_own(tmp_path, HAND, **arrays(), row=[0], confidence=[0.5, 0.7])
    assert table.of_row is None
    assert table.at([1]).confidence.tolist() == [0.7]
    with pytest.raises(GraspError, match=r"confidence must be \(2,\) finite .* grasp, got \(\)"):
        read_own(tmp_path, HAND, **arrays(), confidence=0.5)


@pytest.mark.parametrize("none", [np.nan, np.inf, -np.inf])
def test_a_confidence_that_is_not_finite_is_refused_unless_its_row_is(tmp_path, none):
    """A row that is no posture spoils no other, whatever its confidence."""
    must = r"confidence must be \(2,\) finite numbers, one per grasp, got "
    with pytest.raises(GraspError, match=f"^{tmp_path / 'p.npz'}: {must}{none}"):
        read_own(tmp_path, HAND, **arrays(), confidence=[none, 0.7])
    rows = arrays() | {"X_FG": POSES * [[[np.nan]], [[1.0]]]}
    table = read_own(tmp_path, HAND, **rows, confidence=[np.nan, 0.7])
    assert [bool(reason) for reason in table.invalid] == [True, False]
    assert ranked(table, ["mug"] * 2).rank.tolist() == [1, 0]


def test_a_confidence_of_isaac_grasp_is_a_finite_number_of_each_grasp(tmp_path):
    known, other = isaac_grasp(POSES[0]), isaac_grasp(POSES[1])
    without = {name: value for name, value in other.items() if name != "confidence"}
    for bad in (without, other | {"confidence": np.nan}, other | {"confidence": np.inf}):
        path = write_isaac(tmp_path / "mug.yaml", a=known, b=bad)
        with pytest.raises(GraspError, match=r"confidence must be .* finite numbers"):
            read_attempts(path, HAND)
    for none in ("high", True):
        path = write_isaac(tmp_path / "mug.yaml", a=known, b=other | {"confidence": none})
        table = read_attempts(path, HAND)
        assert table.invalid[0] == "" and str(none) in table.invalid[1]


# Frames of other tools

#: What the public descriptions say: the palm link's pose in the tool's frame, as position and
#: quaternion w, x, y, z. GraspGen's hand.stl is the panda_hand's collision mesh turned by +90
#: degrees about z. In GraspGenX's description of the Barrett Hand finger 3 is on +x, and its joint
#: is 59.1 mm above the origin, not 75.4 mm. The MJCF of DexGraspBench has the palm at these poses
#: in its world, which is the root of its grasps.
X_AB = {
    ("franka", "graspgen"): ([0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 1.0]),
    ("barrett", "graspgen"): ([0.0, 0.0, 0.0591 - 0.0754], [1.0, 0.0, 0.0, -1.0]),
    ("allegro", "dexgraspbench"): ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0]),
    ("allegro_four", "dexgraspbench"): ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0]),
    ("leap", "dexgraspbench"): ([0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.0]),
}


def described(name: str, tool: str) -> np.ndarray:
    p, wxyz = X_AB[name, tool]
    return make_pose(Rotation.from_quat(wxyz, scalar_first=True).as_matrix(), p)


@pytest.mark.parametrize(("name", "tool"), X_AB)
def test_a_pose_in_the_frame_of_a_tool_puts_the_palm_where_its_description_says(
    tmp_path, name, tool
):
    hand = load_hand(name)
    X_OG = make_pose(rotation_about([0.0, 0.6, 0.8], 0.7), [0.02, -0.03, 0.05])
    X_OA = X_OG @ np.linalg.inv(hand.X_BG) @ np.linalg.inv(described(name, tool))

    def off(X: np.ndarray) -> float:
        np.savez(tmp_path / "p.npz", object=["a"], X_FG=X[None], link=tool)
        found = read_attempts(tmp_path / "p.npz", hand).X_FG[0]
        turn = Rotation.from_matrix(found[:3, :3].T @ X_OG[:3, :3]).magnitude()
        return float(np.linalg.norm(found[:3, 3] - X_OG[:3, 3]) + turn)

    assert off(X_OA) == pytest.approx(0.0, abs=1e-6)
    for axis in np.eye(3):
        assert off(X_OA @ make_pose(rotation_about(axis, np.pi), np.zeros(3))) > 1.0


def test_a_hand_file_names_frames(tmp_path):
    frame = {"p_BA": [0.0, 0.0, 0.1], "rpy_deg": [0.0, 180.0, 0.0]}
    hand = load_hand(write_pincer(tmp_path, frames={"mine": frame}))
    X_AG = hand.palm_in("mine")
    expected = np.linalg.inv(make_pose(np.diag([-1.0, 1.0, -1.0]), [0.0, 0.0, 0.1])) @ hand.X_BG
    np.testing.assert_allclose(X_AG, expected, atol=1e-12)
    np.savez(tmp_path / "p.npz", object=["a"], X_FG=np.eye(4)[None], link="mine")
    np.testing.assert_allclose(read_attempts(tmp_path / "p.npz", hand).X_FG[0], X_AG, atol=1e-12)
    with pytest.raises(GraspError, match="got 'mine'"):
        read_attempts(tmp_path / "p.npz", load_hand())
    with pytest.raises(HandError, match=r"frames.palm must have another name"):
        load_hand(write_pincer(tmp_path, frames={"palm": frame}))
