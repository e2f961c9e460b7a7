"""Which cases of a test every change must pass, and which are for the night."""

from __future__ import annotations

from typing import Any

import pytest


def in_second_tier(case: Any) -> Any:
    """Return a case that `make test` leaves out."""
    return pytest.param(case, marks=pytest.mark.nightly)
