"""Verdicts on files: a protocol by name or of the user's own, and files that are no grasps."""

from __future__ import annotations

import hashlib
import json
import pickle
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import error_line, run
from helpers.jaws import HERE, jaws

from drakegrasp.errors import ConfigError, DataError, HandError, MachineError
from drakegrasp.exchange.dexgraspbench import write_object
from drakegrasp.protocols.postures import (
    PostureTrials,
    json_line,
    prepare_trials,
    read_grasp_file,
    verify_postures,
)
from drakegrasp.protocols.protocol import find_protocol
from drakegrasp.protocols.scene import read_object_folder

OWN = """
from dataclasses import dataclass, replace

from drakegrasp.protocols.protocol import MujocoProtocol


@dataclass(frozen=True, kw_only=True)
class Weak(MujocoProtocol):
    '''Pushes too weak to matter.'''

    name: str = "weak"
    source: str = "a test"
    acceleration: float = 0.1
    friction: tuple[float, float] = (0.1, 0.0)


class Broken(Weak):
    def run(self, scene, motion):
        return 1 / 0


class Wordless(Weak):
    def run(self, scene, motion):
        return True


class Heavy(Weak):
    density = 500.0


class Nameless(MujocoProtocol):
    acceleration = 0.1


class Stranger:
    def run(self, scene, motion):
        return None
"""

Write = Callable[..., Path]


@pytest.fixture
def assets(tmp_path: Path) -> Path:
    half = 0.02 * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    write_object(tmp_path / "assets" / "box", [half])
    return tmp_path / "assets"


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a grasp of the box, with changed keys."""

    def make(name: str = "0.npy", **changes: Any) -> Path:
        motion = jaws(0.01)
        content: Any = {
            "pregrasp_qpos": motion.pregrasp.astype(np.float32),
            "grasp_qpos": motion.grasp,
            "squeeze_qpos": motion.squeeze,
            "obj_pose": np.array(HERE),
            "obj_scale": np.float64(1.0),
            "obj_path": "box",
            **changes,
        }
        content = {key: value for key, value in content.items() if value is not None}
        path = tmp_path / "grasps" / name
        path.parent.mkdir(exist_ok=True)
        np.save(path, content)
        return path

    return make


@pytest.fixture
def own(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(OWN)
    return path


@pytest.fixture
def trials(hand: Path, assets: Path) -> PostureTrials:
    return prepare_trials("dexgraspbench", hand, assets)


def test_line_names_protocol_numbers_versions_and_digests(
    trials: PostureTrials, write: Write, hand: Path
) -> None:
    (result,) = verify_postures([write()], trials)
    line = json.loads(json_line(0, "0.npy", result, trials))
    assert line["success"] is True
    assert line["protocol"] == "dexgraspbench"
    assert "JYChen18/DexGraspBench" in line["source"]
    assert line["numbers"]["mass"] == 0.1
    assert line["simulator"] == "mujoco"
    assert set(line["versions"]) == {"drakegrasp", "mujoco"}
    assert line["digests"]["hand"] == hashlib.sha256(hand.read_bytes()).hexdigest()[:16]
    assert len(line["digests"]["object"]) == 16


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"grasp_qpos": np.full(9, np.nan)}, "grasp_qpos must be finite numbers"),
        ({"grasp_qpos": np.zeros((2, 9))}, "the postures must have equal lengths"),
        (
            {f"{name}_qpos": np.ones((2, 9)) for name in ("pregrasp", "grasp", "squeeze")},
            "grasp_qpos must be a vector, got 2 of them",
        ),
        ({"grasp_qpos": np.zeros(9)}, "grasp_qpos must have a quaternion"),
        ({"grasp_qpos": np.ones(8)}, "the postures must have equal lengths"),
        ({"grasp_qpos": np.array([1e6, 0, 0, 1, 0, 0, 0, 0, 0])}, "within 10 m of the object"),
        ({"grasp_qpos": "text"}, "grasp_qpos must be numbers"),
        ({"obj_pose": np.ones(8)}, "obj_pose must be 7 numbers"),
        ({"obj_path": "../secret"}, "obj_path must be a path within"),
        ({"obj_path": "/etc"}, "obj_path must be a path within"),
        ({"squeeze_qpos": None}, "must have squeeze_qpos, got none"),
        (
            {f"{name}_qpos": np.ones(10) for name in ("pregrasp", "grasp", "squeeze")},
            "a posture must be 9 numbers, got 10",
        ),
        ({"obj_path": None}, "must have obj_path, got pregrasp_qpos"),
    ],
)
def test_numbers_that_are_no_grasp_are_invalid_and_the_others_are_tried(
    trials: PostureTrials, write: Write, changes: dict[str, Any], why: str
) -> None:
    bad, good = verify_postures([write("0.npy", **changes), write("1.npy")], trials)
    line = json.loads(json_line(0, "0.npy", bad, trials))
    assert (line["success"], line["moved"]) == (False, None)
    assert re.match(f"invalid: .*{re.escape(why)}", line["reason"])
    assert good[0].success


def test_file_of_a_stranger_runs_no_code(tmp_path: Path) -> None:
    class Harm:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "harm",))

    content: Any = {"grasp_qpos": Harm()}
    np.save(tmp_path / "evil.npy", content)
    with pytest.raises(
        DataError, match=r"must hold .* arrays alone, got pathlib.*; nothing of it was run"
    ):
        read_grasp_file(tmp_path / "evil.npy")
    assert not (tmp_path / "harm").exists()


@pytest.mark.parametrize(
    "content",
    [b"", b"\x93NUMPY", pickle.dumps({}), b"x" * 65_000_000],
    ids=["empty", "cut", "pickle", "large"],
)
def test_file_that_is_none_of_a_grasp(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "0.npy"
    path.write_bytes(content)
    with pytest.raises(DataError, match="must be"):
        read_grasp_file(path)


def test_own_protocol_decides_and_its_digest_is_in_the_result(
    own: Path, hand: Path, assets: Path, write: Write
) -> None:
    trials = prepare_trials(f"{own}:Weak", hand, assets)
    (result,) = verify_postures([write()], trials)
    line = json.loads(json_line(0, "0.npy", result, trials))
    assert line["success"] is True
    assert line["protocol"] == f"mine.py:Weak@{hashlib.sha256(OWN.encode()).hexdigest()[:16]}"
    assert line["numbers"]["acceleration"] == 0.1

    # A worker has the text, not the file.
    own.unlink()
    (again,) = verify_postures([write()], pickle.loads(pickle.dumps(trials)))
    assert again == result


def test_example_of_the_docs_decides(
    tmp_path: Path, hand: Path, assets: Path, write: Write
) -> None:
    """DRO-Grasp's rule: 0.016 N, so hardly any grip is enough, but 0.5 N/kg move a loose box."""
    page = Path(__file__).parents[2] / "docs/how-to/protocols.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    (tmp_path / "dro.py").write_text(code)
    trials = prepare_trials(f"{tmp_path / 'dro.py'}:Dro", hand, assets)
    apart = np.array([*HERE, -0.03, -0.03])
    loose = write("1.npy", grasp_qpos=apart, squeeze_qpos=apart)
    (held, _), (lost, _) = verify_postures([write(), loose], trials)
    assert held.success
    assert lost.reason == "moved"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("{}:Broken", "mine.py:Broken: must run, got ZeroDivisionError in line"),
        ("{}:Wordless", "mine.py:Wordless.*run must return a PostureVerdict, got True"),
        ("{}:Stranger", "Stranger: must be a subclass of MujocoProtocol"),
        ("{}:Nameless", "Nameless: must have a name and a source, got none"),
        ("{}:Heavy", "weak: mass or density must be None, and only one of them, got 0.1 and 500.0"),
        ("lift", "must be one that runs in mujoco, got lift"),
    ],
)
def test_a_protocol_that_cannot_run_here_is_refused_in_one_line(
    own: Path, hand: Path, assets: Path, write: Write, name: str, why: str
) -> None:
    with pytest.raises(ConfigError, match=why) as caught:
        list(verify_postures([write()], prepare_trials(name.format(own), hand, assets)))
    assert "\n" not in str(caught.value)


def test_code_comes_from_a_file_that_is_given_and_never_by_its_stored_name() -> None:
    with pytest.raises(ConfigError, match="code of a dataset is never imported"):
        find_protocol("mine.py:Weak@0123456789abcdef", {})


def test_missing_mujoco_is_one_line(
    hand: Path, assets: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MachineError, match=r"pip install 'drakegrasp\[peer\]'") as raised:
        prepare_trials("dexgraspbench", hand, assets)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "text",
    ["", "<mujoco>", "<mujoco><asset><mesh file='no.obj'/></asset></mujoco>"],
    ids=["empty", "broken", "mesh"],
)
def test_bad_mjcf_is_one_line(tmp_path: Path, assets: Path, text: str) -> None:
    path = tmp_path / "hand.xml"
    path.write_text(text)
    with pytest.raises(HandError, match=r"hand\.xml: ") as raised:
        prepare_trials("dexgraspbench", path, assets)
    assert "\n" not in str(raised.value)


def test_bad_part_of_an_object_or_none_costs_only_its_grasps(
    trials: PostureTrials, write: Write, assets: Path
) -> None:
    flat = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 4 3\n"
    for text, why in (("v 0 0 0\n", "at least 4 vertices"), (flat, "coplanar")):
        (assets / "box/urdf/meshes/convex_piece_000.obj").write_text(text)
        rows = [write("0.npy"), write("1.npy", obj_path="gone")]
        (bad, _), (gone, _) = verify_postures(rows, trials)
        assert re.search(rf"convex_piece_000\.obj: must be a convex part, .*{why}", bad.reason)
        assert "\n" not in bad.reason
    assert "must hold the object's convex parts" in gone.reason


def test_object_without_parts_or_volume_is_refused(tmp_path: Path, assets: Path) -> None:
    with pytest.raises(DataError, match="must hold the object's convex parts"):
        read_object_folder(tmp_path / "none", 1.0)
    one, half = (read_object_folder(assets / "box", scale).volume for scale in (1.0, 0.5))
    assert half == pytest.approx(one / 8.0)
    info = assets / "box/info/simplified.json"
    said = json.loads(info.read_text())
    info.write_text(json.dumps(said | {"mass": 8.0 * said["mass"], "scale": 2.0 * said["scale"]}))
    assert read_object_folder(assets / "box", 1.0).volume == pytest.approx(one)
    info.write_text("{}")
    with pytest.raises(DataError, match="must have mass, density and scale"):
        read_object_folder(assets / "box", 1.0)
    with pytest.raises(DataError, match="scale must be a positive number, got 0"):
        read_object_folder(assets / "box", 0.0)


def test_command_prints_a_line_per_file(hand: Path, assets: Path, write: Write) -> None:
    folder = write("b.npy", obj_pose=np.array([0.0, 0.0, 1.0, *HERE[3:]])).parent
    write("a.npy")
    usual = ["verify", folder, "--protocol", "dexgraspbench", "--hand", hand, "--assets", assets]
    result = run(*usual, "--workers", 1)
    assert result.exit_code == 0, result.stderr
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert [Path(line["file"]).name for line in lines] == ["a.npy", "b.npy"]
    assert [line["success"] for line in lines] == [True, False]
    assert "1 of 2 grasps hold by dexgraspbench" in result.stderr


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--protocol", "nobody"], "protocol must be one of lift"),
        (["--protocol", "dexgraspbench"], "hand must be an MJCF"),
        (["--protocol", "dexgraspbench", "--units", "mm"], "--units must be left out with"),
        (["--protocol", "dexgraspbench", "--set", "seed=1"], "--set must be left out with"),
    ],
)
def test_options_that_contradict_each_other(write: Write, options: list[str], why: str) -> None:
    result = run("verify", write(), *options)
    assert result.exit_code == 2
    assert why in error_line(result)
