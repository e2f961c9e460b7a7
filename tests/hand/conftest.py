"""The hand that comes with the package."""

from __future__ import annotations

import pytest

from drakegrasp.hand.description import Hand, load_hand


@pytest.fixture(scope="module")
def hand() -> Hand:
    return load_hand()
