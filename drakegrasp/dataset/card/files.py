"""`DATACARD.json` and `DATACARD.md` of a dataset, beside its files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from drakegrasp.dataset.card.content import card_content
from drakegrasp.dataset.card.text import card_text
from drakegrasp.dataset.paths import CARD_FILES
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
