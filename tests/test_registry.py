"""What is found by name: ours, those of other packages, and what cannot be loaded."""

from __future__ import annotations

from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace

import pytest

from drakegrasp import registry
from drakegrasp.config import parse_config, parse_stored
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.hand.settings import load_config

KINDS: tuple[registry.Kind, ...] = ("clusters", "exporters", "importers", "protocols", "samplers")


@pytest.fixture
def theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package's exporters: one that works, one with our name, and two that do not."""
    values = {
        "usd": "json:dumps",
        "mjcf": "json:loads",
        "gone": "no_such_library:write [hub]",
        "old": "json:no_such_function",
        "sad": "json:no_such_function",
        "bad": "no_such_library:write [fast]",
    }
    entries = {name: EntryPoint(name, value, "") for name, value in values.items()}
    for name in ("sad", "bad"):
        entries[name]._for(SimpleNamespace(name="their-package"))  # type: ignore[attr-defined]
    monkeypatch.setattr(registry, "_theirs", lambda kind: entries)


@pytest.mark.parametrize("kind", KINDS)
def test_ours_are_loaded_and_named(kind: registry.Kind) -> None:
    assert registry.names(kind)
    for name in registry.names(kind):
        assert callable(registry.find(kind, name))


def test_an_installation_without_a_checkout_has_the_names_of_its_metadata(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    text = registry._PROJECT.read_text()
    (tmp_path / "pyproject.toml").write_text(text.replace('"drakegrasp"', '"another"'))
    entries = metadata.distribution("drakegrasp").entry_points
    for place in (tmp_path / "pyproject.toml", tmp_path / "none"):
        monkeypatch.setattr(registry, "_PROJECT", place)
        registry._ours.cache_clear()
        found = {kind: set(registry.names(kind)) for kind in KINDS}
        registry._ours.cache_clear()
        assert found == {kind: entries.select(group=f"drakegrasp.{kind}").names for kind in KINDS}


@pytest.mark.usefixtures("theirs")
def test_names_of_others_follow_and_take_none_of_ours() -> None:
    names = registry.names("exporters")
    assert names[0] == "hf" and names[-5:] == ("usd", "gone", "old", "sad", "bad")
    assert registry.find("exporters", "usd").__name__ == "dumps"
    assert registry.find("exporters", "mjcf").__name__ == "write_mjcf"
    assert registry.summary("exporters", "mjcf").startswith("a MuJoCo scene")
    assert registry.summary("exporters", "usd") == ""


@pytest.mark.usefixtures("theirs")
@pytest.mark.parametrize(
    ("name", "words", "kind"),
    [
        ("fbx", "exporters must be one of hf, original, .*, got 'fbx'", ConfigError),
        ("old", "exporters: old must be loaded from json:no_such", ConfigError),
        ("gone", r"no_such_library must be .*: pip install 'drakegrasp\[hub\]'", MachineError),
        ("sad", "exporters: sad of the package their-package must be loaded from", ConfigError),
        ("bad", r"no_such_library .* package their-package: .*their-package\[fast\]", MachineError),
    ],
)
def test_what_cannot_be_used_is_one_line(name: str, words: str, kind: type[Exception]) -> None:
    with pytest.raises(kind, match=words):
        registry.find("exporters", name)


def test_a_dataset_opens_where_its_sampler_and_its_rule_are_not_installed() -> None:
    tree = load_config().to_dict()
    tree["candidates"]["method"] = ["absent", "normals"]
    tree["filters"]["own"] = ["calm"]
    config = parse_stored(tree)
    assert config.candidates.method == ("absent", "normals")
    assert config.filters.own == ("calm",)
    with pytest.raises(ConfigError, match=r"candidates\.method: must be one of rotations"):
        parse_config(tree)
    with pytest.raises(ConfigError, match=r"filters\.own: must be FILE\.py:NAME, or a list"):
        load_config("paper", ["filters.own=calm"])
