"""A data card as Markdown, for people. In: its content. Out: the text of `DATACARD.md`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

#: Counts of a row, in the order of the tables.
_COUNTS = (
    *("attempts", "held", "precision", "stable", "refined", "samples"),
    *("train", "valid", "test"),
)


def card_text(content: Mapping[str, Any]) -> str:
    """Return a card as Markdown.

    Args:
        content: As `card_content` gives it.
    """
    return f"# {_plain(content['title'])}\n\n" + "\n\n".join(
        [
            _what(content),
            _files(content),
            _how(content),
            _licences(content),
            _how_many(content),
            _limits(content),
        ]
    )


def _what(content: Mapping[str, Any]) -> str:
    fingers = f"The fingers in the order of a grasp: {', '.join(content['fingers'])}."
    conventions = "\n".join(f"* **{k}**: {text}" for k, text in content["conventions"].items())
    return f"""## What it is

Every sample is a grasp that a simulated hand (`{content["hand"]}`) closed, lifted and held, with
colour, depth and mask as a camera behind the palm sees the object before. Made by drakegrasp; its
docs explain every field. {fingers if content["fingers"] else ""}

{conventions}"""


def _files(content: Mapping[str, Any]) -> str:
    rows = [(f"`{name}`", what) for name, what in content["files"].items()]
    return f"""## Files

{_table(("file", "what is in it"), rows)}"""


def _how(content: Mapping[str, Any]) -> str:
    settings = _table(("setting", "value"), [(f"`{k}`", v) for k, v in content["settings"].items()])
    versions = ", ".join(f"{name} {version}" for name, version in content["versions"].items())
    seeds = ", ".join(map(str, content["seeds"]))
    return f"""## How it was made

Schema {content["schema_version"]}, seed {seeds}, configuration
`{content["config_hash"]}`.

{settings}

Versions: {versions}."""


def _licences(content: Mapping[str, Any]) -> str:
    rows = [(licence, ", ".join(names)) for licence, names in content["licences"].items()]
    return f"""## Licence of the meshes

As it was stated in `objects.yaml`; that of the built-in objects is the package's.

{_table(("licence", "objects"), rows)}"""


def _how_many(content: Mapping[str, Any]) -> str:
    counts = content["counts"]
    splits = [(name, *row.values()) for name, row in counts["splits"].items()]
    classes = [(name, row["objects"], *_numbers(row)) for name, row in counts["classes"].items()]
    classes.append(("**all**", len(counts["objects"]), *_numbers(counts["all"])))
    objects = [(name, row["class"], *_numbers(row)) for name, row in counts["objects"].items()]
    refused = [(name, reason) for name, reason in content["refused"].items()]

    # Tables that would be empty are left out.
    tables = [
        (
            f"Samples by split, which is by {content['split_by']}",
            ("split", "samples", "in effect", "objects", "classes"),
            splits,
        ),
        ("By class", ("class", "objects", *_COUNTS), classes),
        ("By object", ("object", "class", *_COUNTS), objects),
        ("Outcomes of the attempts", ("outcome", "attempts"), list(counts["outcomes"].items())),
        ("Held grasps that are no samples", ("filter", "grasps"), list(counts["removed"].items())),
        ("Meshes that were refused", ("mesh", "reason"), refused),
    ]
    parts = [f"### {head}\n\n{_table(heads, rows)}" for head, heads, rows in tables if rows]
    head = """## How many

*Held* are the attempts that lifted the object and kept it in the hand; *precision* grasps are those
of them that the fingertips held alone; *stable* those of these in which the object moved by less
than 5 mm and 5 degrees in the hand. These count palm poses of the first round. *Refined* are
samples whose palm pose was drawn about that of another sample; *samples* all held grasps that
passed all filters; *in effect* their number where those with almost the same palm count as one."""
    return "\n\n".join([head, *parts])


def _limits(content: Mapping[str, Any]) -> str:
    lines = "\n".join(f"* {each['limit']} ({each['docs']})" for each in content["limits"])
    return f"## Known limits\n\nThe pages are those of drakegrasp's repository.\n\n{lines}\n"


def _numbers(row: Mapping[str, Any]) -> list[int]:
    return [row[key] for key in _COUNTS]


def _table(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a Markdown table; numbers are on the right."""
    rows = list(rows)
    sides = ["--:" if all(type(r[k]) is int for r in rows) else "---" for k in range(len(heads))]
    lines = [heads, sides, *([_cell(value) for value in row] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(value: object) -> str:
    if value is None:
        return "null"
    return f"{value:,}" if type(value) is int else _plain(str(value))


def _plain(text: str) -> str:
    """Return a text whose signs mean nothing to Markdown tables and HTML."""
    signs = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "\\": "\\\\", "|": "\\|"}
    for sign, written in signs.items():
        text = text.replace(sign, written)
    return " ".join(text.split())
