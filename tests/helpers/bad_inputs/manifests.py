"""Bad manifests, and bad decisions of an inspection."""

from __future__ import annotations

import json
from pathlib import Path

from helpers.bad_inputs.kinds import ANY_TEXT, Kind
from helpers.bad_inputs.trees import keys, some_values, twice, value_kind, ways

_X_TO = ("objects", 0, "resting", 0, "X_TO")


def manifest_kinds(path: Path) -> tuple[Kind, ...]:
    """Return the ways to spoil a manifest, whose hash tells any other value."""
    return (
        *ANY_TEXT,
        value_kind(_X_TO, "of 11 numbers", [0.5] * 11),
        value_kind(_X_TO, "of texts", ["x"] * 12),
        value_kind(_X_TO, "no rotation", [0.5] * 12),
        value_kind(("objects", 0, "name"), "leads outside", "../../outside"),
        value_kind(("objects", 0, "name"), "of another object", "2_box_b"),
        value_kind(("objects", 0, "colour"), "is no key", 5),
        value_kind(("config", "colour"), "is no key", 5),
        twice(("objects",)),
        twice(("seed",)),
        *some_values(json.loads(path.read_text(encoding="utf-8")), 17),
    )


#: An attempt that is rejected, and decisions of an inspection.
KEY = {"object": "1_box_a", "candidate": 0, "standoff_index": 0}
SOUND_DECISIONS = json.dumps({"version": 1, "rejected": [KEY], "kept": [KEY]}).encode()
_NO_TREE = ("null", "list", "mapping", "truth value")
_COUNT = (*_NO_TREE, "number as text", "negative", "fraction", "NaN", "huge")
_NAME = (*_NO_TREE, "empty text", "control characters", "half a surrogate", "zero")
_LIST = ("null", "mapping", "truth value", "text", "zero")
_KEYS = {
    ("version",): _COUNT,
    ("rejected",): _LIST,
    ("kept",): _LIST,
    ("rejected", 0, "object"): _NAME,
    ("rejected", 0, "candidate"): _COUNT,
    ("rejected", 0, "standoff_index"): _COUNT,
}
DECISIONS: tuple[Kind, ...] = (
    *ANY_TEXT,
    *keys(_KEYS),
    *ways(("rejected", 0), "null", "list", "truth value", "text", "zero"),
    value_kind(("version",), "of the future", 2),
    twice(("rejected",)),
)
