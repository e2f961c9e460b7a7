"""Loads a configuration and fills its open values from the hand's file. Does not import Drake.

Input: a preset or a YAML file, and overrides. Output: a complete `Config`, whose stand-offs and
spreads are numbers.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from drakegrasp.config import (
    DEFAULT_HAND,
    Config,
    HandSource,
    apply_override,
    is_own_class,
    parse_config,
    read_settings,
)
from drakegrasp.errors import ConfigError
from drakegrasp.hand.file_format import hand_names
from drakegrasp.hand.folder import hand_folder
from drakegrasp.registry import read_class

#: Keys of `candidates` that are taken from the hand's file if they are missing or null.
HAND_KEYS = ("standoffs", "spreads_deg")
#: Sections and keys that may name user-defined classes.
CLASS_KEYS = (("candidates", "method"), ("filters", "own"))


def load_config(
    source: str | Path | None = None,
    overrides: Sequence[str] = (),
    **values: Any,
) -> Config:
    """Return the configuration of a preset or YAML file, with overrides applied.

    Missing stand-offs and spreads are taken from the hand's file. User-defined classes, given as
    `file.py:Name`, are imported, which runs the file.

    Args:
        source: Name of a preset, or path of a YAML file; None for the defaults.
        overrides: Strings `"a.b=c"`, with c read as YAML; later ones win.
        values: Top-level fields, e.g. `seed=1`; they win over the overrides.

    Raises:
        ConfigError: If a key is unknown, a value has the wrong type or is impossible, or a
            user-defined class cannot be imported. The message is one line with the key's path, what
            the value must be, and what it was.
        HandError: If the hand's file is needed and cannot be read.
    """
    tree = {} if source is None else read_settings(source)
    own = copy.deepcopy(tree)
    for text in overrides:
        apply_override(tree, text)
    tree.update({key: value for key, value in values.items() if value is not None})
    try:
        return _completed(_with_absolute_hand(tree))
    except ConfigError:
        # If the file alone is invalid, name it in the error.
        if source is not None:
            try:
                _completed(own)
            except ConfigError as error:
                raise ConfigError(f"{source}: {error}") from None
        raise


def override_config(config: Config, overrides: Sequence[str], **values: Any) -> Config:
    """Return a configuration with overrides applied, see `load_config`.

    Another hand brings its own stand-offs and spreads, unless they are overridden. The hand of a
    dataset is the hand that the dataset contains, unless another hand is named.

    Raises:
        ConfigError, HandError: See `load_config`.
    """
    tree, known = config.to_dict(), config.to_dict()
    for text in overrides:
        apply_override(tree, text)
    tree.update({key: value for key, value in values.items() if value is not None})
    if tree["hand"] != config.hand:
        tree = _with_absolute_hand(tree)

    candidates = tree["candidates"]
    if tree["hand"] != config.hand and isinstance(candidates, dict):
        same = [key for key in HAND_KEYS if candidates.get(key) == known["candidates"][key]]
        tree["candidates"] = {**candidates, **dict.fromkeys(same)}
    named = {key for key, value in values.items() if value is not None}
    named |= {text.partition("=")[0].strip() for text in overrides}
    if "hand" in named:
        return _completed(tree, config.code)
    changed = _completed(tree, config.code, config.hand_source)
    return changed.with_hand(config.hand, config.hand_source)


def _with_absolute_hand(tree: dict[str, Any]) -> dict[str, Any]:
    """Return a tree of values in which the path of a hand file is absolute.

    A stored path must name the same file in every working directory.
    """
    hand = tree.get("hand")
    if isinstance(hand, str) and hand and hand not in hand_names() and Path(hand).is_file():
        return {**tree, "hand": str(Path(hand).absolute())}
    return tree


def _read_classes(tree: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Replace each `path/file.py:Name` in a tree by name and digest; also return the files' texts.

    Raises:
        ConfigError: If a class cannot be imported; the message names its key.
    """
    code: dict[str, str] = {}

    def read(key: str, value: object) -> object:
        if not isinstance(value, str) or ".py:" not in value or is_own_class(value):
            return value
        try:
            name, text = read_class(value)
        except ConfigError as error:
            raise ConfigError(f"{key}: {error}") from None
        code[name] = text
        return name

    for section, key in CLASS_KEYS:
        values = tree.get(section)
        if isinstance(values, dict) and key in values:
            given, place = values[key], f"{section}.{key}"
            several = isinstance(given, list | tuple)
            found = [read(place, v) for v in given] if several else read(place, given)
            tree = {**tree, section: {**values, key: found}}
    return tree, code


def _completed(
    tree: dict[str, Any],
    known: Mapping[str, str] | None = None,
    source: HandSource | None = None,
) -> Config:
    """Return the configuration of a tree of values; missing values of the hand are filled in.

    Args:
        tree: The values.
        known: Texts of the files of classes that the tree names with their digests.
        source: The hand, if the tree's name does not find it.
    """
    tree, code = _read_classes(tree)
    hand, candidates = tree.get("hand", DEFAULT_HAND), tree.get("candidates", {})
    if not isinstance(candidates, dict):
        return parse_config(tree)  # which rejects it
    missing = [key for key in HAND_KEYS if candidates.get(key) is None]
    if missing:
        # `parse_config` rejects a hand that is not a string.
        source = source or (hand if isinstance(hand, str) else DEFAULT_HAND)
        described = hand_folder(source).described
        filled = {key: getattr(described, key) for key in missing}
        tree = {**tree, "candidates": {**candidates, **filled}}
    return parse_config(tree).with_code({**(known or {}), **code})
