"""The text of a drafted hand file, with a comment on each line that was guessed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import yaml

#: Column of the comments.
COLUMN = 56


def hand_text(tree: Mapping[str, Any], reasons: Mapping[str, str], head: list[str]) -> str:
    """Return the YAML of a hand file.

    Args:
        tree: Its keys.
        reasons: Comments, by the paths of keys.
        head: Lines at its top.
    """
    lines = [f"# {line}" for line in head]
    for key, value in tree.items():
        if isinstance(value, dict):
            lines += ["", *_line(0, f"{key}:", reasons.get(key))]
            for name, item in value.items():
                lines += _line(2, f"{_flow(name)}: {_flow(item)}", reasons.get(f"{key}.{name}"))
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            lines += ["", *_line(0, f"{key}:", reasons.get(key))]
            for i, entry in enumerate(value):
                for n, (name, item) in enumerate(entry.items()):
                    start = "- " if n == 0 else "  "
                    why = reasons.get(f"{key}.{i}.{name}")
                    lines += _entry(f"{start}{name}:", item, why)
        else:
            # What comes after a block stands apart from it.
            lines += [""] if lines[-1].startswith(" ") else []
            lines += _line(0, f"{key}: {_flow(value)}", reasons.get(key))
    return "\n".join(lines) + "\n"


def _entry(start: str, item: Any, why: str | None) -> list[str]:
    """Return the lines of a key of a list's entry; a list of mappings takes one each."""
    if isinstance(item, list) and item and isinstance(item[0], dict):
        return [*_line(2, start, why), *(f"      - {_flow(part)}" for part in item)]
    return _line(2, f"{start} {_flow(item)}", why)


def _line(indent: int, text: str, why: str | None) -> list[str]:
    text = " " * indent + text
    return [text if why is None else f"{text:<{COLUMN}} # {why}"]


def _flow(value: Any) -> str:
    text = yaml.safe_dump(value, default_flow_style=True, width=10_000, sort_keys=False)
    return text.removesuffix("\n").removesuffix("\n...").strip()
