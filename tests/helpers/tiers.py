"""Which cases of a test every change must pass, and which are for the night."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest


def few(cases: Sequence[Any], count: int = 3) -> list[Any]:
    """Return cases that repeat a test, all but the first few of which are for the night."""
    return [*cases[:count], *map(in_second_tier, cases[count:])]


def in_second_tier(case: Any) -> Any:
    """Return a case, or a tuple of its arguments, that `make test` leaves out."""
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=pytest.mark.nightly)
