"""`DATACARD.json` and `DATACARD.md` of a dataset, beside its files."""

from __future__ import annotations

import json
from pathlib import Path

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
    content = card_content(out)
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    for name, each in zip(CARD_FILES, (text, card_text(content)), strict=True):
        write_atomic(out / name, each.encode())
