"""What is found by name: ours, those of other packages, and what cannot be loaded."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from drakegrasp import registry
from drakegrasp.errors import ConfigError, MachineError
from drakegrasp.hand.description import load_hand
from drakegrasp.hand.files import MODELS, hand_names

KINDS: tuple[registry.Kind, ...] = ("clusters", "exporters", "protocols", "samplers")


@pytest.fixture
def theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another package's exporters: one that works, one with our name, and two that do not."""
    values = {
        "usd": "json:dumps",
        "glb": "json:loads",
        "gone": "no_such_library:write [hub]",
        "old": "json:no_such_function",
    }
    entries = {name: EntryPoint(name, value, "") for name, value in values.items()}
    monkeypatch.setattr(registry, "_theirs", lambda kind: entries)


@pytest.mark.parametrize("kind", KINDS)
def test_ours_are_loaded_and_named(kind: registry.Kind) -> None:
    assert registry.names(kind)
    for name in registry.names(kind):
        assert callable(registry.find(kind, name))


def test_an_installation_without_a_checkout_has_the_same_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    here = {kind: set(registry.names(kind)) for kind in KINDS}
    text = registry._PROJECT.read_text()
    (tmp_path / "pyproject.toml").write_text(text.replace('"drakegrasp"', '"another"'))
    for place in (tmp_path / "pyproject.toml", tmp_path / "none"):
        monkeypatch.setattr(registry, "_PROJECT", place)
        registry._ours.cache_clear()
        found = {kind: set(registry.names(kind)) for kind in KINDS}
        registry._ours.cache_clear()
        # An old installation of a checkout may lack a group.
        assert all(found[kind] in (here[kind], set()) for kind in KINDS)


@pytest.mark.usefixtures("theirs")
def test_names_of_others_follow_and_take_none_of_ours() -> None:
    names = registry.names("exporters")
    assert names[0] == "hf" and names[-3:] == ("usd", "gone", "old")
    assert registry.find("exporters", "usd").__name__ == "dumps"
    assert registry.find("exporters", "glb").__name__ == "write_glb"
    assert registry.summary("exporters", "glb").startswith("a 3D scene")
    assert registry.summary("exporters", "usd") == ""


@pytest.mark.usefixtures("theirs")
@pytest.mark.parametrize(
    ("name", "words", "kind"),
    [
        ("fbx", "exporters must be one of hf, original, .*, got 'fbx'", ConfigError),
        ("old", "exporters: old must be loaded from json:no_such", ConfigError),
        (
            "gone",
            r"no_such_library must be .*: pip install 'drakegrasp\[hub\]'",
            MachineError,
        ),
    ],
)
def test_what_cannot_be_used_is_one_line(name: str, words: str, kind: type[Exception]) -> None:
    with pytest.raises(kind, match=words):
        registry.find("exporters", name)


def test_hand_of_another_package_is_used_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = EntryPoint("claw", "tests_of_hands:FILE", "")
    monkeypatch.setattr(EntryPoint, "load", lambda self: str(MODELS / "franka_hand.yaml"))
    monkeypatch.setattr(registry, "_theirs", lambda kind: {"claw": entry})
    assert "claw" in hand_names()
    assert load_hand("claw").joint_names == load_hand("franka").joint_names
