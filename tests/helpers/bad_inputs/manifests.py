"""Bad manifests, decisions of an inspection, lists of rejected trials, and logs."""

from __future__ import annotations

from helpers.bad_inputs.json_kinds import table, twice, value_kind
from helpers.bad_inputs.kinds import ANY_TEXT, Kind, whole_file

_OBJECT = {
    "name": "name",
    "class": "name",
    "mesh_sha256": "hash",
    "scale": "positive",
    "up": "axis",
    "mass": "positive",
    "density": "positive",
    "collision_error": "not negative",
    "resting": "list",
    "candidates": "count",
    "notes": "list of texts",
}
MANIFEST: tuple[Kind, ...] = (
    *ANY_TEXT,
    *table(
        {
            ("schema_version",): "count",
            ("config_hash",): "hash",
            ("seed",): "count",
            ("config",): "mapping",
            ("versions",): "mapping",
            ("versions", "drake"): "text",
            ("fingers",): "mapping",
            ("objects",): "list",
            ("objects", 0): "mapping",
            ("refused",): "list",
            **{("objects", 0, key): of for key, of in _OBJECT.items()},
            ("objects", 0, "resting", 0): "mapping",
            ("objects", 0, "resting", 0, "X_TO"): "pose",
            ("objects", 0, "resting", 0, "rolled"): "truth",
            ("refused", 0): "mapping",
            ("refused", 0, "name"): "name",
            ("refused", 0, "mesh_sha256"): "hash",
            ("refused", 0, "reason"): "text",
            ("rejected",): "list",
            ("rejected", 0): "mapping",
            ("rejected", 0, "object"): "name",
            ("rejected", 0, "candidate"): "count",
            ("rejected", 0, "standoff_index"): "count",
            ("config", "physics"): "mapping",
            ("config", "seed"): "count",
            ("config", "physics", "time_step"): "positive",
        },
        optional=(
            ("fingers",),
            ("rejected",),
            ("rejected", 0),
            ("refused", 0),
            ("objects", 0),
            ("versions", "drake"),
            ("config", "physics"),
            ("config", "seed"),
            ("config", "physics", "time_step"),
        ),
    ),
    *(value_kind(("objects", 0, "friction"), f"is {v}", v) for v in ("-1", "0", "NaN", '"x"')),
    value_kind(("split_by",), "is no rule", '"size"'),
    value_kind(("split_by",), "is not that of its config", '"class"'),
    value_kind(("objects", 0, "split"), "is none", '"dev"'),
    value_kind(("objects", 0, "group"), "leads outside", '"../../outside"'),
    value_kind(("objects", 0, "licence"), "is a number", "5"),
    value_kind(("objects", 0, "licence"), "steers", '"a\\u001bb"'),
    value_kind(("objects", 0, "colour"), "is no key", "5"),
    value_kind(("objects", 0, "resting", 0, "X_TO"), "of 11 numbers", str([0.5] * 11)),
    value_kind(("objects", 0, "resting", 0, "X_TO"), "of texts", str(["x"] * 12).replace("'", '"')),
    value_kind(("objects", 0, "resting", 0, "X_TO"), "no rotation", str([0.5] * 12)),
    value_kind(("objects", 0, "resting", 0, "probability"), "above one", "1.5"),
    value_kind(("objects", 0, "tried"), "is negative", "-1"),
    value_kind(("objects", 0, "name"), "leads outside", '"../../outside"'),
    value_kind(("objects", 0, "name"), "of another object", '"2_box_b"'),
    value_kind(("config", "candidates", "max"), "less than candidates", "3"),
    value_kind(("fingers", "thumb"), "is a number", "5"),
    value_kind(("schema_version",), "of the future", "999"),
    value_kind(("seed",), "of another configuration", "12"),
    value_kind(("config_hash",), "of another configuration", '"0123456789abcdef"'),
    value_kind(("config", "colour"), "is no key", "5"),
    value_kind(("rejected", 0, "colour"), "is no key", "5"),
    twice(("objects",)),
    twice(("seed",)),
)

DECISIONS: tuple[Kind, ...] = (
    *ANY_TEXT,
    *table(
        {
            ("version",): "count",
            ("rejected",): "list",
            ("kept",): "list",
            ("rejected", 0): "mapping",
            ("rejected", 0, "object"): "name",
            ("rejected", 0, "candidate"): "count",
            ("rejected", 0, "standoff_index"): "count",
            ("kept", 0): "mapping",
            ("kept", 0, "candidate"): "count",
        },
        optional=(("rejected", 0), ("kept", 0)),
    ),
    value_kind(("version",), "of the future", "2"),
    twice(("rejected",)),
)


#: A text of trial ids; 0 is a success, 1 is none.
REJECTED_IDS: tuple[Kind, ...] = tuple(
    whole_file(f"the line {text[:20]!r}", b"3\n" + text + b"\n")
    for text in (
        *(b"-1", b"1", b"1.5", b"nan", b"x", b"0 3", b"0,3", b"99999999", b"9" * 5000),
        *(b"\xff\xfe", b"\x00", "²".encode(), "٣".encode()),
    )
)
