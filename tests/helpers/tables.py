"""Cases of tests that are data: what is given, and what is to be said of it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

FOLDER = Path(__file__).parents[1] / "tables"


def table(name: str) -> Any:
    """Return the content of `tests/tables/NAME.yaml`."""
    return yaml.safe_load((FOLDER / f"{name}.yaml").read_text(encoding="utf-8"))
