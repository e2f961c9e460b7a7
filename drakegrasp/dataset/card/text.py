"""The data card as files: JSON for programs, Markdown for people.

In: the content of a card. Out: `DATACARD.json` and `DATACARD.md` of a dataset, and the text of the
card that goes with an export.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from drakegrasp.dataset.card.content import card_content
from drakegrasp.dataset.paths import CARD_FILES
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.runtime.files import write_atomic


def write_card(out: Path) -> None:
    """Write both files of the card, each whole or not at all.

    Args:
        out: Directory of the dataset, whose three files are there.

    Raises:
        DataError: If a file of the dataset is missing or damaged.
        OSError: If the disk is full.
    """
    for name, text in card_files(card_content(out)).items():
        write_atomic(out / name, text)


def card_files(content: dict[str, Any]) -> dict[str, bytes]:
    """Return the bytes of both files by their names.

    Args:
        content: Of the card, see `card_content`.
    """
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    return dict(zip(CARD_FILES, (text.encode(), card_text(content).encode()), strict=True))


def card_text(content: Mapping[str, Any]) -> str:
    """Return a card as Markdown.

    Args:
        content: As `card_content` gives it; that of an export also has the samples by camera, the
            camera, the columns, and those of scenes (`exchange.hub.folder`).
    """
    sections = [_what, _files, _how, _licences, _how_many, _limits]
    if content.get("fingertip_loads", {}).get("samples"):
        sections.insert(-1, _loads)
    if "p_hold" in content:
        sections.insert(-1, _bears)
    if "scenes" in content:
        sections.insert(sections.index(_limits), _scenes)
    if "columns" in content:
        sections += [_cameras, _columns]
    text = "\n\n".join(section(content) for section in sections)
    return f"# {_plain(content['title'])}\n\n{text}\n"


def _what(content: Mapping[str, Any]) -> str:
    said = (("fingers in the order of a grasp", "fingers"), ("joints in that of a `q`", "joints"))
    fingers, joints = (
        f" The {what}: {', '.join(map(_plain, content[key]))}." if content[key] else ""
        for what, key in said
    )
    conventions = "\n".join(f"* **{k}**: {text}" for k, text in content["conventions"].items())
    return f"""## What it is

Every sample is a grasp that a simulated hand (`{content["hand"]}`) closed, lifted and held, with
colour, depth and mask as a camera behind the palm sees the object before. Made by drakegrasp; its
docs explain every field.{fingers}{joints}

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
    hand = _table(("file", "its first line"), list(content["hand_licences"].items()))
    return f"""## Licence of the hand

The files of the hand `{content["hand"]}` are in `hand/`, digest `{content["hand_digest"]}`.

{hand if content["hand_licences"] else "Its licence is not stated."}

## Licence of the meshes

As it was stated in `objects.yaml`; that of the built-in objects is the package's.

{_table(("licence", "objects"), rows)}"""


def _how_many(content: Mapping[str, Any]) -> str:
    counts = content["counts"]
    names = tuple(counts["all"])
    splits = [(name, *row.values()) for name, row in counts["splits"].items()]
    classes = [(name, *row.values()) for name, row in counts["classes"].items()]
    classes.append(("**all**", len(counts["objects"]), *counts["all"].values()))
    objects = [(name, *row.values()) for name, row in counts["objects"].items()]

    # Tables that would be empty are left out.
    tables = [
        (
            f"Samples by split, which is by {content['split_by']}",
            ("split", "samples", "in effect", "objects", "classes"),
            splits,
        ),
        ("By class", ("class", "objects", *names), classes),
        ("By object", ("object", "class", *names), objects),
        ("Outcomes of the attempts", ("outcome", "attempts"), list(counts["outcomes"].items())),
        ("Held grasps that are no samples", ("filter", "grasps"), list(counts["removed"].items())),
        ("Meshes that were refused", ("mesh", "reason"), list(content["refused"].items())),
    ]
    parts = [f"### {head}\n\n{_table(heads, rows)}" for head, heads, rows in tables if rows]
    head = """## How many

*Held* are the attempts that lifted the object and kept it in the hand; *precision* grasps are those
of them that the fingertips held alone; *stable* those of these in which the object moved by less
than 5 mm and 5 degrees in the hand. These count palm poses of the first round. *Refined* are
samples whose palm pose was drawn about that of another sample; *samples* all held grasps that
passed all filters; *in effect* their number where those with almost the same palm count as one."""
    return "\n\n".join([head, *parts])


def _bears(content: Mapping[str, Any]) -> str:
    lines = "\n".join(f"* {line}." for line in content["p_hold"]["in_words"])
    return f"""## How much a grasp bears

A share of the lifts is repeated with noise on the palm's pose, friction and mass (`p_hold_samples`
of `p_hold_repeats`, law in the setting `certify`). Intervals are of 95 %; a grasp counts for the
inverse of its probability to be drawn.

{lines}"""


def _scenes(content: Mapping[str, Any]) -> str:
    rows = [(split, *counts.values()) for split, counts in content["scenes"].items()]
    heads = ("split", *next(iter(content["scenes"].values())))
    return f"""## Scenes

A scene is an object in a resting pose, anywhere on the table, with views by cameras that know no
grasp, and all hands that closed on the object in that pose. *Tested* are grasps that were lifted to
a verdict. No object is in two splits.

{_table(heads, rows)}"""


def _loads(content: Mapping[str, Any]) -> str:
    rated, above, samples, median = content["fingertip_loads"].values()
    return f"""## Forces and the hand

The maker allows {rated:.1f} N at a fingertip. In {above:,} of {samples:,} samples one presses
harder, after closing or after the lift; the median of the largest force is {median:.1f} N. The
setting `physics.finger_load` makes the motors weaker."""


def _limits(content: Mapping[str, Any]) -> str:
    lines = "\n".join(f"* {each['limit']} ({each['docs']})" for each in content["limits"])
    return f"## Known limits\n\nThe pages are those of drakegrasp's repository.\n\n{lines}"


def _cameras(content: Mapping[str, Any]) -> str:
    """Return how many samples each camera has, and how a pixel of a depth image is a point."""
    cameras, unit = content["samples_by_camera"], content["depth_unit"]
    rows = [(split, *(counts[split] for counts in cameras.values())) for split in SPLITS]
    (fx, _, cx), (_, fy, cy) = content["camera"]["K"][:2]
    near, far = content["camera"]["near"], content["camera"]["far"]
    return f"""## Samples by camera

{_table(("split", *(f"camera `{camera}`" for camera in cameras)), rows)}

## Camera

Both cameras have focal lengths {fx:.6f} and {fy:.6f} and their centre at ({cx:g}, {cy:g}) [px].
A pixel (u, v) of depth z [m], {1.0 / unit:g} units of the image to a metre, is the point
((u - {cx:g}) z / {fx:.6f}, (v - {cy:g}) z / {fy:.6f}, z) in the camera's frame. The camera sees
from {near:g} m on; where nothing is before {far:g} m, the depth is {far:g} m."""


def _columns(content: Mapping[str, Any]) -> str:
    tables = {"## Columns": content["columns"]}
    tables |= {f"## Columns of `{name}`": of for name, of in content["columns_of"].items()}
    heads = ("column", "shape", "unit", "frame", "what it is")
    return "\n\n".join(
        f"{title}\n\n{_table(heads, [(f'`{name}`', *column) for name, column in columns.items()])}"
        for title, columns in tables.items()
    )


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
