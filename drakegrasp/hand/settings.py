"""Loads a configuration: what it leaves open, the hand's file says. Does not import Drake.

In: a preset or a YAML file, and what overrides it. Out: a complete `Config`, whose stand-offs and
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
from drakegrasp.hand.file_format import read_hand_file
from drakegrasp.hand.files import hand_file, hand_names
from drakegrasp.registry import read_class

#: Keys of `candidates` that are the hand's own where they are not given, or null.
HAND_KEYS = ("standoffs", "spreads_deg")
#: Sections and keys that may name classes of the user's own.
CLASS_KEYS = (("candidates", "method"), ("filters", "own"))


def load_config(
    source: str | Path | None = None,
    overrides: Sequence[str] = (),
    **values: Any,
) -> Config:
    """Return the configuration of a preset or YAML file, with overrides applied.

    Stand-offs and spreads that nobody gives are those of the hand's file. Classes of the user's
    own, `file.py:Name`, are imported: that runs the file.

    Args:
        source: A preset's name, or a path to a YAML file; None: the defaults.
        overrides: `"a.b=c"` strings, c read as YAML; later ones win.
        values: Top-level fields, e.g. `seed=1`; they win over the overrides.

    Raises:
        ConfigError: If a key is unknown, or a value is of the wrong type or impossible;
            one line with the key's path, what it must be, and what it was. Also if a class of the
            user's own cannot be imported.
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
    dataset is the one that the dataset carries, unless another is named.

    Raises:
        ConfigError, HandError: See `load_config`.
    """
    # All keys: what `to_dict` leaves out would become the default.
    tree, known = config.model_dump(mode="json"), config.to_dict()
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
    """Return a tree of values whose hand, if it is a file, is an absolute path.

    What is stored must name the same file in whatever directory it is read.
    """
    hand = tree.get("hand")
    if isinstance(hand, str) and hand and hand not in hand_names() and Path(hand).is_file():
        return {**tree, "hand": str(Path(hand).absolute())}
    return tree


def _read_classes(tree: dict[str, Any]) -> tuple[dict[str, Any], dict[str, str]]:
    """Replace each `path/file.py:Name` of a tree by name and digest; return the files' texts too.

    Raises:
        ConfigError: If one cannot be imported, with its key.
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
    """Return the configuration of a tree of values, where those of the hand may be missing.

    Args:
        tree: The values.
        known: Text of the files of classes that the tree names with their digests.
        source: The hand, if it is not found by the name that the tree has.
    """
    tree, code = _read_classes(tree)
    hand, candidates = tree.get("hand", DEFAULT_HAND), tree.get("candidates", {})
    if not isinstance(candidates, dict):
        return parse_config(tree)  # which refuses it
    missing = [key for key in HAND_KEYS if candidates.get(key) is None]
    if missing:
        # A hand that is no text is refused by `parse_config` as well.
        source = source or (hand if isinstance(hand, str) else DEFAULT_HAND)
        described = read_hand_file(hand_file(source))
        filled = {key: getattr(described, key) for key in missing}
        tree = {**tree, "candidates": {**candidates, **filled}}
    return parse_config(tree).with_code({**(known or {}), **code})
