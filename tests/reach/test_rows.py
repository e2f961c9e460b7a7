"""OUT/reach/NAME.hdf5, and arms that cannot be used."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from unittest.mock import Mock
from xml.etree import ElementTree

import h5py
import numpy as np
import pytest
from helpers.arms import write_arm
from helpers.commands import error_line, run
from starlette.testclient import TestClient

from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.paths import reach_path
from drakegrasp.dataset.reach import IDENTITY, count_reach, is_reachable
from drakegrasp.dataset.rejections import AttemptKey
from drakegrasp.dataset.schema import REACHES
from drakegrasp.dataset.trials import Trials
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.filters import Removal
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.file_format import MODELS, hand_names
from drakegrasp.page.app import Inspection, make_app
from drakegrasp.pictures.figures import NUMBERS_FILE, write_figures
from drakegrasp.reach import place, rows
from drakegrasp.reach.arm import ARMS, TABLE_SIZE, Arm, load_arm, mount_of
from drakegrasp.reach.cell import make_cell
from drakegrasp.reach.reaching import Reach
from drakegrasp.reach.rows import reach_dataset
from drakegrasp.runtime.files import seal

BASE = "-0.5,0,0,0"


@pytest.fixture(scope="module")
def arm(six: Path) -> Arm:
    return load_arm(six, (-0.5, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def asked(sound: Path, arm: Arm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with a file of the arm."""
    out = tmp_path_factory.mktemp("asked") / "out"
    shutil.copytree(sound, out)
    reach_dataset(out, arm)
    return out


@pytest.fixture
def out(asked: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(asked, tmp_path / "out"))


@pytest.fixture
def mixed(out: Path, arm: Arm, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A dataset with a file `mixed` in which the rows have each outcome in turn."""
    turns = cycle(REACHES)

    def answer(*_: object) -> Reach:
        outcome = next(turns)
        value = 0.1 if outcome == "reachable" else np.nan
        return Reach(outcome=outcome, q=np.full((3, 6), value), clearance=value)

    with monkeypatch.context() as patch:
        patch.setattr(rows, "reach_grasp", answer)
        reach_dataset(out, arm, name="mixed")
    return out


def test_a_row_per_sample(asked: Path, arm: Arm) -> None:
    trials = Trials(asked)
    samples = trials[trials["removal"] == Removal.KEPT]
    with h5py.File(reach_path(asked, "six")) as file:
        rows = {name: file["reach"][name][:] for name in file["reach"]}
        assert file.attrs["arm"] == "six"
        np.testing.assert_array_equal(file.attrs["base"], arm.base)
        assert file.attrs["mount"].shape == (12,)
    assert rows["trial_id"].tolist() == samples.trial_ids.tolist()
    assert [name.decode() for name in rows["object"]] == samples["object_name"].tolist()
    assert rows["q_grasp"].shape == (len(samples), 6)
    assert not check_dataset(asked)


def test_the_command_on_any_number_of_workers(out: Path, six: Path) -> None:
    first = reach_path(out, "six").read_bytes()
    result = run("reach", out, "--arm", six, "--base", BASE, "--name", "again", "--quiet")
    assert result.exit_code == 0, result.output
    assert "reachable: " in result.stdout
    assert reach_path(out, "again").read_bytes() == first


def test_only_the_first_outcome_is_reachable(mixed: Path) -> None:
    with h5py.File(reach_path(mixed, "mixed")) as file:
        found = {name: file["reach"][name][:] for name in ("reachable", "reach_outcome", "q_lift")}
    turns = np.arange(len(found["reachable"])) % len(REACHES)
    assert len(turns) > len(REACHES)
    assert found["reach_outcome"].tolist() == turns.tolist()
    np.testing.assert_array_equal(found["reachable"], turns == 0)
    np.testing.assert_array_equal(np.isfinite(found["q_lift"]), (turns == 0)[:, None] & [True] * 6)
    assert not check_dataset(mixed)


def test_a_grasp_has_the_answer_of_its_own_row(mixed: Path) -> None:
    samples = Trials(mixed).where(kept=True)
    columns = samples.columns(IDENTITY)
    expected = np.arange(len(samples)) % len(REACHES) == 0
    for chosen in (slice(None, None, -1), slice(3, 8, 2)):
        some = {name: column[chosen] for name, column in columns.items()}
        asked, reachable = is_reachable(mixed, "mixed", some)
        assert asked.all()
        assert reachable.tolist() == expected[chosen].tolist()
    # Of a grasp that the arm was not asked for, nothing is said.
    other = {**columns, "candidate": np.append(columns["candidate"][:-1], 10**6)}
    asked, reachable = is_reachable(mixed, "mixed", other)
    assert asked.tolist() == [True] * (len(samples) - 1) + [False]
    assert reachable.tolist() == [*expected[:-1], False]


def test_a_dataset_that_grew_gets_the_missing_rows(
    out: Path, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = reach_dataset(out, arm)
    reach_path(out, "six").unlink()
    identity = (whole[name][:4].tolist() for name in ("object", "candidate", "standoff_index"))
    rejected = [AttemptKey(*key) for key in zip(*identity, strict=True)]
    assemble(out, rejected=rejected)
    some = reach_dataset(out, arm)
    assert some.count == whole.count - 4
    assemble(out)
    spy = Mock(side_effect=rows.reach_grasp)
    monkeypatch.setattr(rows, "reach_grasp", spy)
    grown = reach_dataset(out, arm)
    assert spy.call_count == 4
    for name in whole.names:
        np.testing.assert_array_equal(grown[name], whole[name])
    # Rows of grasps that are no samples any more stay.
    assemble(out, rejected=rejected)
    assert reach_dataset(out, arm).count == whole.count


def test_stats_count_by_elevation(asked: Path) -> None:
    result = run("stats", asked)
    reachable = int(count_reach(asked)[0].reachable.sum())
    assert (
        f"six reaches {reachable} of 9 samples; by elevation of the approach 0-30° 0 of 0, "
        f"30-60° 0 of 0, 60-90° {reachable} of 9"
    ) in result.stdout
    (said,) = json.loads(run("stats", asked, "--json").stdout)["reach"]
    assert said == {"name": "six", "asked": [0, 0, 9], "reachable": [0, 0, reachable]}


def test_card_and_figures_tell_the_share_of_each_arm(mixed: Path, tmp_path: Path) -> None:
    expected = [
        {"name": "mixed", "asked": [0, 0, 9], "reachable": [0, 0, 2]},
        json.loads(run("stats", mixed, "--json").stdout)["reach"][1],
    ]
    folder = tmp_path / "figures"
    assert "reach" in write_figures(mixed, folder).names
    assert (folder / "reach.png").is_file()
    assert json.loads((folder / NUMBERS_FILE).read_text())["reach"] == expected
    pytest.importorskip("datasets")
    assert run("export", mixed, tmp_path / "hub", "--to", "hf", "--quiet").exit_code == 0
    text = (tmp_path / "hub" / "README.md").read_text()
    assert (
        "* arm mixed reaches 2 of 9 samples; by elevation of the approach 0-30° 0 of 0, "
        "30-60° 0 of 0, 60-90° 2 of 9\n* arm six reaches "
    ) in text

    # Without files of arms there is none of it, and an old picture is removed.
    shutil.rmtree(mixed / "reach")
    assert "reach" not in write_figures(mixed, folder).names
    assert not (folder / "reach.png").exists()


def test_the_filter_of_reachable_grasps(
    out: Path, arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, whole = reach_path(out, "six"), reach_dataset(out, arm)
    with h5py.File(path, "r+") as file:  # as if the arm reached all but two
        group = file["reach"]
        group["reachable"][...] = np.arange(whole.count) >= 2
        for name in ("q_approach", "q_grasp", "q_lift"):
            group[name][...] = np.where(np.arange(whole.count)[:, None] >= 2, 0.0, np.nan)
        group["clearance"][...] = np.where(np.arange(whole.count) >= 2, 0.1, np.nan)
        group["reach_outcome"][...] = np.arange(whole.count) < 2
    seal(path)
    assemble(out, overrides=["filters.reachable=six"])
    removal = Trials(out)[whole.trial_id]["removal"]
    assert removal[:2].tolist() == [Removal.UNREACHABLE] * 2
    assert not removal[2:].any()
    assert not check_dataset(out)
    # Another arm is asked for them, too, the same arm not again; a file that is missing is named.
    assert reach_dataset(out, arm, name="other").count == whole.count
    monkeypatch.setattr(rows, "reach_grasp", Mock(side_effect=AssertionError))
    assert reach_dataset(out, arm).count == whole.count
    with pytest.raises(DataError, match=r"seven.hdf5: must be the reach of an arm, got none"):
        assemble(out, overrides=["filters.reachable=seven"])


def test_the_page_names_an_arm_and_draws_it_at_grasp_and_approach(mixed: Path, arm: Arm) -> None:
    reach_path(mixed, "six").unlink()
    with h5py.File(reach_path(mixed, "mixed"), "r+") as file:
        trials = file["reach/trial_id"][:2].tolist()
        file["reach/q_approach"][0], file["reach/q_lift"][0] = 0.3, 0.5
    seal(reach_path(mixed, "mixed"))
    client = TestClient(make_app(Inspection(mixed)), base_url="http://127.0.0.1")
    for trial, shown in zip(trials, (True, False), strict=True):
        text = client.get(f"/grasp/{trial}").text
        assert ('data-layer="arm mixed"' in text) == shown
        assert ("reaches it" if shown else "does not reach it") in text
        answer = client.get(f"/arm/{trial}-mixed.json")
        assert answer.status_code == (200 if shown else 404)
        assert client.get(f"/arm/{trial}-other.json").status_code == 404
    assert "arm mixed" not in client.get(f"/grasp/{trials[0] + 1}").text
    parts = client.get(f"/arm/{trials[0]}-mixed.json").json()
    assert [part["opacity"] for part in parts] == [1.0, 0.25]
    cell = make_cell(arm, "barrett", mount_of(arm, load_hand()))
    for part, q in zip(parts, (0.1, 0.3), strict=True):  # the grasp, and the start of the approach
        corners = np.frombuffer(base64.b64decode(part["vertices"]), "<f4").reshape(-1, 3, 3)
        np.testing.assert_allclose(corners, cell.arm_triangles(np.full(6, q)), atol=1e-6)


def test_a_file_of_another_arm_is_not_replaced(out: Path, six: Path) -> None:
    before = reach_path(out, "six").read_bytes()
    with pytest.raises(DataError, match="must be of the same base, got another"):
        reach_dataset(out, load_arm(six, (-0.6, 0.0, 0.0, 0.0)))
    assert reach_path(out, "six").read_bytes() == before


FAULTS: dict[str, tuple[str, Callable[[h5py.File], object]]] = {
    "reachable must be true": ("reachable", lambda values: ~values),
    "q_lift must be finite": ("q_lift", lambda values: np.where(np.isnan(values), 0.0, np.nan)),
    "reach_outcome must be 0..4": ("reach_outcome", lambda values: values + 5),
    "candidate must be that of the trial": ("candidate", lambda values: values + 1),
    "object must be that of the trial": ("object", lambda values: values[::-1]),
    "trial_id must be one of the rows": ("trial_id", lambda values: values + 10**6),
}


@pytest.mark.parametrize("what", FAULTS)
def test_check_finds_a_fault(out: Path, what: str) -> None:
    path, (name, spoil) = reach_path(out, "six"), FAULTS[what]
    with h5py.File(path, "r+") as file:
        dataset = file[f"reach/{name}"]
        dataset[...] = spoil(dataset[:])
    seal(path)
    (found, *_) = check_dataset(out)
    assert found.file == "reach/six.hdf5"
    assert found.what.startswith(what)


def test_check_finds_a_damaged_file_and_one_of_another_state(out: Path) -> None:
    path = reach_path(out, "six")
    content = path.read_bytes()
    with h5py.File(path, "r+") as file:
        file.attrs["shards"] = "0"
    seal(path)
    (found,) = check_dataset(out)
    assert str(found) == (
        "reach/six.hdf5: attribute shards must be that of the shards that are there, got another; "
        "run `drakegrasp reach` again"
    )
    middle = len(content) // 2
    path.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    assert "the file must be as it was written" in [found.what for found in check_dataset(out)]


def test_a_build_rejects_an_arm_that_was_not_asked(small_meshes: Path, tmp_path: Path) -> None:
    new = tmp_path / "new"
    given = ("build", "--objects", small_meshes, "--out", new, "--set", "filters.reachable=six")
    assert error_line(run(*given)) == (
        "error: filters.reachable must be null until `drakegrasp reach` has asked the arm, got six"
    )
    assert not new.exists()


def test_a_map_of_places(
    out: Path, arm: Arm, six: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(place, "SPACING", 0.7)
    monkeypatch.setattr(place, "MOST", 3)
    found = place.map_reach(out, arm)
    assert found.count == 3
    assert found.p_TS.tolist() == [[x, y] for x in (-0.7, 0, 0.7) for y in (-0.7, 0, 0.7)]
    assert found.share[7] == 0.0  # 1.2 m from the base
    # To move the object is to move the base the other way.
    moved = place.map_reach(out, load_arm(six, (-0.5, -0.7, 0.0, 0.0)))
    assert moved.share[3] == found.share[4] > 0.0

    png = tmp_path / "map.png"
    given = ("reach", out, "--arm", six, "--base", BASE, "--workers", 1, "--quiet")
    assert run(*given, "--map", png).stdout == f"{png}\n"
    assert png.read_bytes().startswith(b"\x89PNG")


# Arms


BAD_FILES = {
    "joint 'elbow' must have a lower limit below its upper one, got 3.1..3.1": ("-3.1", "3.1"),
    "joint 'pan' must be revolute, continuous, prismatic, fixed, got 'floating'": (
        'name="pan" type="revolute"',
        'name="pan" type="floating"',
    ),
    "its meshes must be there, got none at 'package://else/upper.stl'": (
        "upper.stl",
        "package://else/upper.stl",
    ),
    "must be the URDF of an arm, got XML of <sdf>": ("robot", "sdf"),
    "must be the URDF of an arm, got mismatched tag": ("</robot>", "</rob>"),
    "flange must be named, as the model ends at flange, spare": (
        '<link name="flange"/>',
        '<link name="flange"/><link name="spare"/>',
    ),
}


@pytest.mark.parametrize("message", BAD_FILES)
def test_a_file_that_is_no_arm(tmp_path: Path, message: str) -> None:
    old, new = BAD_FILES[message]
    path = write_arm(tmp_path)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError) as caught:
        load_arm(path, (0.0, 0.0, 0.0, 0.0))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


BAD_OPTIONS = {
    "arm must be panda, ur5, ur10 or a .urdf file, got 'pandas'": ("--arm", "pandas"),
    "arm must be panda, ur5, ur10 or a .urdf file, got 'arm.sdf'": ("--arm", "arm.sdf"),
    "a joint must move the flange 'base', got none": ("--flange", "base"),
    "flange must be a link of six.urdf, got 'tool'": ("--flange", "tool"),
    "base must be on the table, z >= 0, or beside it, |x| or |y| >= 0.8 m, got x=0.1, y=0, "
    "z=-0.05 inside of it": ("--base", "0.1,0,-0.05,0"),
    "base must leave the arm clear of table and walls, got 'shoulder'": (
        "--base",
        "-0.81,0,-0.12,0",
    ),
    "--base must be 4 numbers with commas, got '1,2'": ("--base", "1,2"),
    "--mount must be 6 numbers with commas, got 'a'": ("--mount", "a"),
    "the name of an object must be": ("--name", "../x"),
}


@pytest.mark.parametrize("message", BAD_OPTIONS)
def test_bad_options_are_one_line(asked: Path, six: Path, message: str) -> None:
    given = ("reach", asked, "--arm", six, "--base", BASE, "--quiet", *BAD_OPTIONS[message])
    assert message in error_line(run(*given))


def test_a_mesh_is_where_its_origin_puts_it(tmp_path: Path) -> None:
    """The upper arm is a box of 80 x 80 x 480 mm, at 250 mm along z."""
    ends = {
        "0 0 0": ([-0.04, -0.04, 0.01], [0.04, 0.04, 0.49]),
        "0 1.570796 0": ([-0.24, -0.04, 0.21], [0.24, 0.04, 0.29]),
        "1.570796 0 1.570796": ([-0.24, -0.04, 0.21], [0.24, 0.04, 0.29]),
    }
    for rpy, expected in ends.items():
        placed = ('xyz="0 0 0.25"', f'xyz="0 0 0.25" rpy="{rpy}"')
        ((link, corners),) = load_arm(write_arm(tmp_path, replace=placed), (0, 0, 0, 0)).hulls
        p_LC = np.frombuffer(corners).reshape(-1, 3)
        assert link == "upper"
        np.testing.assert_allclose([p_LC.min(axis=0), p_LC.max(axis=0)], expected, atol=1e-6)


def test_what_is_beyond_the_flange_is_left_out(tmp_path: Path) -> None:
    """A camera beside the way to the flange stays, as do the links before it."""
    beside = (
        "</robot>",
        '<link name="camera"/><joint name="clip" type="fixed"><parent link="shoulder"/>'
        '<child link="camera"/></joint></robot>',
    )
    path = write_arm(tmp_path, replace=beside)
    for flange, links, joints in (
        ("flange", "base shoulder upper fore one two three flange camera", 6),
        ("two", "base shoulder upper fore one two camera", 5),
        ("shoulder", "base shoulder", 1),
    ):
        arm = load_arm(path, (0.0, 0.0, 0.0, 0.0), flange=flange)
        assert [e.get("name") for e in ElementTree.fromstring(arm.urdf).iter("link")] == (
            links.split()
        )
        assert len(arm.joints) == joints
        assert bool(arm.hulls) == ("upper" in links)


def test_a_hand_without_a_mount_is_one_line(six: Path) -> None:
    own = replace(load_hand(), name="own")
    arm, stated = (load_arm(six, (0.0, 0.0, 0.0, 0.0), mount=X) for X in (None, np.eye(4)))
    with pytest.raises(ConfigError) as caught:
        mount_of(arm, own)
    assert str(caught.value) == (
        "mount must be given for a hand other than barrett, franka, allegro, allegro_four, leap, "
        "got 'own'"
    )
    np.testing.assert_array_equal(mount_of(stated, own), np.eye(4))


def test_mounts(six: Path) -> None:
    arm = load_arm(six, (0.0, 0.0, 0.0, 0.0))
    for name in hand_names():
        X_FB = mount_of(arm, load_hand(name))
        # The open hand is beyond the flange, and its palm link near it.
        assert X_FB[2, 3] >= 0.0


def test_the_table_is_the_slab_that_is_seen() -> None:
    size = " ".join(f"{length:g}" for length in TABLE_SIZE)
    assert f'<box size="{size}"/>' in (MODELS / "table.urdf").read_text()


@pytest.mark.parametrize("name", ARMS)
def test_arms_of_the_package(name: str) -> None:
    try:
        arm = load_arm(name, (-0.5, 0.0, 0.0, 0.0))
    except ConfigError as error:
        assert "pip install 'drakegrasp[arms]'" in str(error)
        pytest.skip("example-robot-data is not installed")
    assert len(arm.joints) == (7 if name == "panda" else 6)
    assert arm.flange in ("panda_link8", "tool0")
