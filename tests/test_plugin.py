"""The plugin of the docs: installed from its folder, found by name, and each part of it used."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import error_line, run
from helpers.datasets import make_dataset
from helpers.jaws import HAND, box_folder, jaws
from helpers.objects import box_model
from helpers.successes import good, judge

from drakegrasp import registry
from drakegrasp.cluster.kinds import cluster_of
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.errors import ConfigError, GraspError
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.exchange.export import export_dataset, read_closed_grasps
from drakegrasp.filters import Removal
from drakegrasp.frames import invert_pose, make_pose
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config
from drakegrasp.protocols.protocol import DexGraspBench, find_protocol
from drakegrasp.protocols.scene import ProtocolScene
from drakegrasp.simulation.attempt import Source
from drakegrasp.simulation.candidates import Drawing

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "examples" / "plugin"
PACKAGE = "drakegrasp-example-plugin"


@pytest.fixture(scope="module", autouse=True)
def plugin(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder in which pip installed it, on the path of this process."""
    folder = tmp_path_factory.mktemp("plugin")
    source, site = folder / "source", folder / "site"
    # In the checkout itself setuptools would leave a folder `build`.
    shutil.copytree(FOLDER, source, ignore=shutil.ignore_patterns("__pycache__"))
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation")
    command = [*pip, "--no-index", "--target", str(site), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(site)
        registry._theirs.cache_clear()
        yield site
    sys.modules.pop("example_plugin", None)
    registry._theirs.cache_clear()


def test_sampler_draws_palms_that_look_down(tmp_path: Path) -> None:
    bar = box_model(tmp_path, np.array([0.10, 0.02, 0.03]))
    X_TO = make_pose(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), [0.0, 0.0, 0.01])
    config = load_config("paper", ["candidates.method=down", "seed=3"])
    drawn, again = (Drawing(bar, X_TO, config).candidates(8) for _ in range(2))
    np.testing.assert_allclose((X_TO @ drawn.X_OG)[:, 2, 2], -1.0, atol=1e-12)
    np.testing.assert_array_equal(drawn.X_OG, again.X_OG)
    assert len(np.unique(drawn.X_OG[:, 0, 0])) > 1
    assert (drawn.source == Source.OWN).all()


def test_rule_removes_what_turned_in_the_hand() -> None:
    turn = np.deg2rad([1.0, 5.0, np.nan])
    filters = load_config("paper", ["filters.own=calm"]).filters
    removal = judge(good(3).with_columns(turn=turn), filters)
    assert removal.tolist() == [Removal.KEPT, Removal.OWN, Removal.TURNED]
    with pytest.raises(ConfigError, match=r"calm: needs must be some of .*, got turn"):
        judge(good(3).only("trial_id", "slip"), filters)


def test_protocol_has_numbers_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "hand.xml").write_text(HAND)
    box = box_folder(tmp_path / "box", 0.04, 0.04, 0.04)
    protocol, stored = find_protocol("slippery")
    assert stored == "slippery"
    for rules, held in ((DexGraspBench(), True), (protocol, False)):
        scene = ProtocolScene(rules, tmp_path / "hand.xml", box)
        assert rules.run(scene, jaws(0.01)).success == held


def test_what_is_exported_is_imported(tmp_path: Path) -> None:
    out = make_dataset(tmp_path / "out", tmp_path / "meshes")
    count = export_dataset(out, tmp_path / "palms", "palms")
    grasps = list(read_closed_grasps(out))
    assert count == len(grasps) > 1
    (path,) = (tmp_path / "palms").iterdir()
    for source in (path, path.parent):
        found = read_attempts(source, load_hand("barrett"))
        assert found.objects == tuple(grasp.object_name for grasp in grasps)
        X_OG = [invert_pose(grasp.X_TO) @ grasp.X_TG for grasp in grasps]
        np.testing.assert_allclose(found.X_FG, X_OG, atol=1e-12)
        np.testing.assert_array_equal(found.q_grasp, [grasp.q for grasp in grasps])
        assert not any(found.invalid)
        # A format that states no frame is read for the rows of a split, too.
        data = GraspDataset(out / "grasping_oto.hdf5", split="train")
        assert len(data) < count
        rows = read_attempts(source, load_hand("barrett"), of=data).of_row
        assert set(rows.tolist()) == set(range(len(data)))
    path.write_text("no JSON")
    with pytest.raises(GraspError, match=r"samples\.palms: must be readable by the importer"):
        read_attempts(path, load_hand("barrett"))


def test_hand_is_used_by_its_name() -> None:
    assert load_hand("jaw").joint_names == ("left_slide", "right_slide")
    assert load_config("paper", ["hand=jaw"]).candidates.standoffs == (0.01, 0.02)


def test_cluster_is_found_and_says_what_it_does_not_take() -> None:
    with pytest.raises(ConfigError, match="--workers must not be given with --cluster half"):
        cluster_of("half", workers=3)


@pytest.mark.nightly
@pytest.mark.cluster
def test_cluster_starts_its_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    with cluster_of("half").connected(tmp_path) as client:
        client.wait_for_workers(1)
        assert len(client.nthreads()) == 1


@pytest.mark.parametrize(
    ("name", "broken", "told"),
    [
        ("write_palms", lambda *_: 1 / 0, "got ZeroDivisionError (division by zero)"),
        ("write_palms", lambda *_: None, "and return their number, got TypeError (int() "),
        ("write_palms", lambda *_: sys.exit("no licence"), "got SystemExit (no licence)"),
        ("write_palms", lambda out: 1, "got TypeError ("),
        ("write_palms", 7, "must write the samples and return their number, got TypeError"),
        ("read_palms", lambda *_: 1 / 0, "got ZeroDivisionError (division by zero)"),
        ("read_palms", lambda *_: sys.exit("no licence"), "got SystemExit (no licence)"),
        ("read_palms", lambda *_: 7, "got TypeError ("),
        ("read_palms", lambda *_: {}, "got KeyError ('objects')"),
        ("read_palms", 7, "got TypeError ("),
    ],
)
def test_a_broken_function_of_a_plugin_is_one_line_with_its_name(
    name: str,
    broken: object,
    told: str,
    sound: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(f"example_plugin.{name}", broken)
    (tmp_path / "grasps.palms").write_text("{}")
    if name == "write_palms":
        result = run("export", sound, tmp_path / "to", "--to", "palms")
    else:
        postures = ("--postures", tmp_path / "grasps.palms", "--out", tmp_path / "to")
        result = run("build", "--objects", "builtin", *postures)
    assert result.exit_code in (1, 2)
    line = error_line(result)
    assert f"palms of the package {PACKAGE}" in line
    assert told in line
    assert [path.name for path in tmp_path.iterdir()] == ["grasps.palms"]


@pytest.fixture
def broken(plugin: Path) -> Iterator[Path]:
    """The folder of the package, which cannot be imported."""
    module = plugin / "example_plugin" / "__init__.py"
    text = module.read_text()
    module.write_text("raise SystemExit('no licence')")
    yield plugin
    module.write_text(text)


def test_help_is_there_with_a_plugin_that_is_broken(
    broken: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In a process of its own: the help of a command is made once.
    command = [sys.executable, "-m", "drakegrasp", "export", "--help"]
    monkeypatch.setenv("PYTHONPATH", str(broken), prepend=os.pathsep)
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert "\n  palms" in done.stdout


@pytest.mark.usefixtures("broken")
def test_a_broken_plugin_is_one_line_with_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "example_plugin", raising=False)
    told = f"samplers: down of the package {PACKAGE} must be loaded from example_plugin:Down"
    with pytest.raises(ConfigError, match=rf"^{told}.*no licence") as error:
        registry.find("samplers", "down")
    assert "\n" not in str(error.value)
