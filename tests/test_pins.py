"""What comes out of all rooms is what it was: see `helpers/pins.py`.

Exact on any machine are the draws, labels, counts and words. Simulated numbers round otherwise on
another CPU, see docs/explanation/determinism.md, so they are near.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import pins

FOLDER = Path(pins.__file__).parent


@pytest.mark.sim
def test_nothing_of_a_few_pins_has_changed(tmp_path: Path) -> None:
    found = pins.summaries(pins.few(tmp_path))
    assert pins.far(found, pins.read_values(FOLDER / "few_pins.npz")) == []


@pytest.mark.nightly
@pytest.mark.sim
@pytest.mark.timeout(1800)
def test_nothing_that_is_pinned_has_changed(tmp_path: Path) -> None:
    found = pins.summaries(pins.everything(tmp_path))
    assert pins.far(found, pins.read_values(FOLDER / "pins.npz")) == []


def test_near_numbers_are_the_same_and_exact_ones_are_not() -> None:
    expected = {"slip": np.array([0.1, np.nan]), "seed": np.array([2**63], np.uint64)}
    near = {"slip": np.array([0.1 + 1e-9, np.nan]), "seed": np.array([2**63], np.uint64)}
    assert pins.far(near | {"more": np.zeros(1)}, expected) == []
    other = {"slip": np.array([0.1, 0.0]), "seed": np.array([2**63 + 1], np.uint64)}
    assert pins.far(other, expected | {"lost": np.zeros(1)}) == [
        *("differs: seed", "differs: slip", "gone: lost")
    ]
