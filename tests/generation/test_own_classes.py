"""The sampler and the filter of the how-to page: built, checked, replayed, and never imported."""

from __future__ import annotations

import pickle
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import trimesh
from helpers.builds import build
from helpers.commands import error_line, run
from helpers.datasets import make_dataset
from helpers.meshes import SMALL, write_fixed
from helpers.successes import good, judge

from drakegrasp.config import Config
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.check import check_dataset
from drakegrasp.dataset.manifest import read_manifest, write_manifest
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.filters import Removal
from drakegrasp.generation.directory import build_config
from drakegrasp.generation.replay import replay_trial
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.settings import load_config, override_config
from drakegrasp.objects.model import ObjectModel, prepare_object
from drakegrasp.objects.sources import MeshSource, find_meshes
from drakegrasp.simulation.attempt import Source
from drakegrasp.simulation.candidates import Candidates, Drawing, palm_attempts

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "own-sampler.md"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def own(folder: Path) -> Path:
    """The current folder with both files of the page."""
    texts = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.S)
    for name, text in zip(("my_sampler.py", "my_filter.py"), texts, strict=True):
        (folder / name).write_text(text)
    return folder


@pytest.fixture(scope="module")
def box(tmp_path_factory: pytest.TempPathFactory) -> ObjectModel:
    path = tmp_path_factory.mktemp("box") / "box.stl"
    trimesh.creation.box([0.04, 0.06, 0.08]).export(path)
    return prepare_object(MeshSource(name="box", class_name="box", path=path))


def sampler(text: str, hand: str = "barrett") -> Config:
    """Return the configuration of a sampler with this body of `poses`."""
    lines = ["import numpy as np", "class Mine:", "  def __init__(self, *arguments): pass"]
    Path("mine.py").write_text("\n".join([*lines, f"  def poses(self): {text}"]))
    return load_config(overrides=["candidates.method=mine.py:Mine", f"hand={hand}"])


def draw(box: ObjectModel, config: Config, count: int = 20) -> Candidates:
    X_TO = np.eye(4)
    X_TO[2, 3] = box.half_extents[2]
    return Drawing(box, X_TO, config).candidates(count)


def test_it_takes_turns_with_others_and_comes_to_workers(own: Path, box: ObjectModel) -> None:
    """A worker has the configuration alone: the file may be gone, or on another machine."""
    turns = ["candidates.method=[my_sampler.py:Ring, normals]", "filters.own=my_filter.py:Wide"]
    config = load_config(overrides=turns)
    sent = pickle.dumps(config)
    (own / "my_sampler.py").unlink()
    (own / "my_filter.py").unlink()
    received = pickle.loads(sent)
    assert received == config and received.filters.code.keys() == set(config.filters.own)
    assert draw(box, received).source.tolist() == [Source.OWN, Source.NORMALS] * 10
    build_config(received)
    assert override_config(received, ["seed=3"]).code == config.code


def test_a_file_is_the_same_wherever_it_lies(own: Path) -> None:
    setting = "candidates.method=my_sampler.py:Ring"
    config = load_config(overrides=[setting])
    (own / "folder").mkdir()
    (own / "my_sampler.py").rename(own / "folder" / "my_sampler.py")
    moved = load_config(overrides=["candidates.method=folder/my_sampler.py:Ring"])
    assert moved.simulation_hash() == config.simulation_hash()
    assert re.fullmatch(r"my_sampler\.py:Ring@[0-9a-f]{16}", config.candidates.method[0])


@pytest.mark.parametrize(
    ("hand", "shape", "stored"),
    [
        ("barrett", "(None, np.deg2rad(11.25))", (-1, np.deg2rad(11.25))),
        ("barrett", "(None, 3.1415927)", (-1, 3.141592654)),  # the limit of the hand's model
        ("franka", "(None, 0)", (-1, 0.0)),
        ("allegro_four", "('envelope', 0.0)", (1, 0.0)),
        ("allegro_four", "(np.int64(1), 0.0)", (1, 0.0)),
    ],
)
def test_a_palm_with_a_shape_of_the_hand_is_tried_once(
    box: ObjectModel, hand: str, shape: str, stored: tuple[int, float]
) -> None:
    """Beside palms without one, which are tried at each stand-off."""
    text = f"X = np.diag([1.0, -1, -1, 1]); X[2, 3] = 0.2; yield X, {shape}; yield X"
    config = sampler(text, hand)
    drawn = draw(box, config)
    assert (drawn.preshape_index[0], drawn.spread[0]) == stored
    assert (drawn.preshape_index[1], np.isnan(drawn.spread[1])) == (-1, True)
    place = {"name": "box", "seed": 0, "preshapes": len(load_hand(hand).preshapes)}
    once, *others = palm_attempts(drawn, range(2), config.candidates, **place)
    assert (once.candidate, once.spread) == (0, stored[1])
    assert once.preshape == (None if stored[0] < 0 else stored[0])
    np.testing.assert_array_equal(once.X_OG, drawn.X_OG[0])
    assert [a.standoff for a in others] == list(config.candidates.standoffs)


# What is refused


def use(text: str, box: ObjectModel) -> None:
    """Use a file as that of a sampler."""
    Path("mine.py").write_text(text)
    build_config(load_config(overrides=["candidates.method=mine.py:Mine"]))


def poses(body: str, box: ObjectModel) -> None:
    """Draw the poses of a sampler."""
    draw(box, sampler(body))


def barrett(shape: str, box: ObjectModel) -> None:
    """Draw a pose with a shape after one with a good shape."""
    draw(box, sampler(f"yield np.eye(4), (None, 0.0); yield np.eye(4), {shape}"))


def allegro(shape: str, box: ObjectModel) -> None:
    body = f"yield np.eye(4), (0, 0.0); yield np.eye(4), {shape}"
    draw(box, sampler(body, "allegro_four"))


def verdict(value: str, box: ObjectModel) -> None:
    """Let a filter return a value."""
    lines = ["import numpy as np", "class Mine:", "  def keep(self, successes):"]
    Path("mine.py").write_text("\n".join([*lines, f"    return {value}"]))
    judge(good(3), load_config(overrides=["filters.own=mine.py:Mine"]).filters)


MADE = "class Mine:\n  def __init__(self, model"


@pytest.mark.parametrize(
    ("how", "text", "message"),
    [
        (use, "class Mine(:", r"mine\.py: must be imported, got SyntaxError \(.*line 1\)"),
        (use, "Other = 3", r"mine\.py: must have a class Mine, got none"),
        (
            use,
            f"{MADE}): pass\n  def poses(self): yield",
            r"mine\.py:Mine: must take \(model, X_TO, stream, config\), got other arguments",
        ),
        (
            use,
            f"{MADE}, X_TO, stream, config): pass",
            r"mine\.py:Mine: must have a method poses\(self\), got none like it",
        ),
        (poses, "yield np.eye(3)", r"Mine: pose 0 must be a pose, 4 x 4 .* of shape \(3, 3\)"),
        (poses, "yield np.eye(4); yield np.nan * np.eye(4)", r"pose 1 must be finite"),
        (poses, "yield 1 / 0", r"mine\.py:Mine: must run, got ZeroDivisionError in line 4 \("),
        (barrett, "(None, 22.5)", r"pose 1: spread must be 0 to 3\.14 rad .*, got 22\.5$"),
        (barrett, "('pinch', 0)", r"preshape must be None .* barrett, got 'pinch'$"),
        (
            allegro,
            "('pinch', 0)",
            r"must be one of tripod, envelope, or its index, for the hand .*, got 'pinch'$",
        ),
        (allegro, "(None, 0)", r"preshape must be one of .*, got None$"),
        (verdict, "np.ones(len(successes.slip))", r"must return \(3,\) of bool, got \(3,\) of fl"),
        (verdict, "successes.magic", r"Mine: must run, got AttributeError in line 4 \(.*magic"),
    ],
)
def test_what_cannot_be_used_is_refused_in_one_line(
    how: Callable[[str, ObjectModel], None], text: str, message: str, box: ObjectModel
) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        how(text, box)
    assert "\n" not in str(caught.value)


@pytest.mark.nightly
def test_a_set_with_filters_of_its_own_is_merged_and_assembled_again(tmp_path: Path) -> None:
    """Whatever runs them takes the same option, and so do the lines that other commands print."""
    rule = "class {}:\n  def keep(self, successes): return successes.trial_id.argsort() % 2 == 0\n"
    for name in ("Even", "Half"):
        Path(f"{name.lower()}.py").write_text(rule.format(name))
    own = "filters.own=[even.py:Even, half.py:Half]"
    whole = make_dataset(tmp_path / "whole", tmp_path / "meshes")
    outs = [tmp_path / name for name in ("first", "others")]
    for out, places in zip(outs, (slice(1), slice(1, None)), strict=True):
        shutil.copytree(whole, out)
        manifest = read_manifest(out)
        write_manifest(replace(manifest, objects=manifest.objects[places]), out)
        assemble(out, overrides=[own])
    refused = run("merge", "into", *outs)
    assert refused.exit_code == 2
    again = r"even\.py:Even@\w+: must be given again, --set filters\.own=FILE\.py:NAME, because"
    assert re.search(again, error_line(refused))
    assert not Path("into").exists()

    merged = run("merge", "into", *outs, "--set", own)
    assert merged.exit_code == 0, merged.output
    assert check_dataset(Path("into")) == []
    assert len(read_manifest(Path("into")).config.filters.own) == 2


@pytest.mark.sim
@pytest.mark.slow
def test_a_dataset_of_both_is_sound_and_imports_no_code(own: Path) -> None:
    write_fixed(own / "meshes", "8_wineglass_flute")
    sources, out = find_meshes(own / "meshes"), own / "out"
    rules = [*SMALL, "candidates.max=5", "camera.size=32", "samples=99"]
    (own / "half.py").write_text(
        "class Half:\n"
        "  def keep(self, successes):\n"
        "    with open('asked', 'a') as file: file.write('.' * successes.count)\n"
        "    return successes.trial_id.argsort() % 2 == 0\n"
    )
    settings = [
        "candidates.method=my_sampler.py:Ring",
        "filters.own=[my_filter.py:Wide, half.py:Half]",
    ]
    config = load_config(overrides=[*rules, *settings])
    report = build(sources, out, config)
    removed = report.assembly.removed
    assert removed[Removal.OWN] == removed[Removal.KEPT] > 0
    assert len(Path("asked").read_text()) == report.assembly.grasps  # each is judged once
    assert check_dataset(out) == []
    with h5py.File(out / "trials.hdf5") as file:
        assert set(file["trials/source"][:]) == {Source.OWN}

    # Without the files: everything that reads goes on; what would run them asks for them.
    for name in ("my_sampler.py", "my_filter.py", "half.py"):
        (own / name).rename(own / f"{name}.txt")
    assert not read_manifest(out).config.code
    assert check_dataset(out) == []
    assert replay_trial(out, 0).same
    with pytest.raises(ConfigError, match=r"my_filter\.py:Wide@.* must be given again"):
        assemble(out, overrides=["filters.max_slip=null"])
    with pytest.raises(ConfigError, match=r"my_sampler\.py:Ring@.* must be given again"):
        build(sources, out, read_manifest(out).config)
    assert Removal.OWN not in assemble(out, overrides=["filters.own=null"]).removed

    # With another file it is another dataset.
    (own / "my_sampler.py").write_text((own / "my_sampler.py.txt").read_text() + "\n")
    other = load_config(overrides=[*rules, settings[0]])
    with pytest.raises(DataError, match=r"candidates\.method \(\['my_sampler\.py:Ring@.* there, "):
        build(sources, out, other)
