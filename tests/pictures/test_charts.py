"""Plots and thumbnails: bars are as long as what they count, names are text, pixels are right."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from drakegrasp.pictures.charts import (
    card_picture,
    draw_distributions,
)
from drakegrasp.pictures.style import MASK, NO_DEPTH, strip_png


def test_what_is_beyond_a_histogram_is_in_its_last_bin() -> None:
    values = np.append(np.linspace(0.0, 1.0, 99), [50.0, np.nan])
    groups = {"samples": np.ones(101, bool), "stable": values < 0.5}
    figure = draw_distributions([("slip [mm]", values)], groups, title="101 samples")
    assert figure.legends[0].get_title().get_text() == "101 samples"
    samples, stable = (patch.get_data().values for patch in figure.axes[0].patches)
    assert samples.sum() == 100
    assert stable.sum() == (values < 0.5).sum()
    assert figure.axes[0].get_xlim()[1] < 2.0


def test_panels_of_a_card_state_what_they_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drakegrasp.pictures.charts.png_bytes", lambda figure, dpi: figure)
    each = {
        "measures": {
            "headline": {"value": 0.5, "low": 0.25, "high": 0.75},
            "lifted": {"value": 0.6},
        },
        "lifted_within_mm": {"0": 0.0, "20": 0.5, "40": 0.6},
        "calibration": [{"confidence": 0.1, "share": 0.2}, {"confidence": 0.9, "share": 0.7}],
    }
    card = {
        "sets": {"net": each},
        "headline": ["net"],
        "measures": ["lifted"],
        "limit_mm": 20.0,
        "rows": 8,
        "objects": 2,
        "classes": 1,
        "dataset": {"file": "data.hdf5", "split": "test", "rows_sha256": "0" * 64},
        "settings": {"versions": {"drake": "1", "drakegrasp": "2"}},
    }
    figure: Any = card_picture(card)
    headline, curves, calibration = figure.axes
    assert headline.get_xlabel() == "per cent of rows, mean over objects"
    assert curves.get_xlabel() == "d: largest distance from a requested contact [mm]"
    assert calibration.get_xlabel() == "stated confidence, five groups"
    assert [line.get_xdata().tolist() for line in headline.lines] == [[25.0, 75.0], [50.0], [60.0]]
    assert curves.lines[0].get_xydata().tolist() == [[0.0, 0.0], [20.0, 50.0], [40.0, 60.0]]
    assert calibration.lines[0].get_xydata().tolist() == [[0.1, 20.0], [0.9, 70.0]]


def panels(image: np.ndarray, mask: np.ndarray) -> list[np.ndarray]:
    """Return the three panels (S, S, 4) uint8 of a strip."""
    strip = imread(BytesIO(strip_png(image, mask, far=0.75)))
    assert strip.shape == (4, 12, 4)
    return np.split(np.rint(255.0 * strip).astype(np.uint8), 3, axis=1)


def test_strip_is_colour_depth_and_mask() -> None:
    image = np.zeros((4, 4, 4), dtype=np.float32)
    image[0, 1, 2], image[3] = 1.0, 0.75
    image[3, 1, 2], image[3, 0, 0] = 0.3, 0.5
    mask = np.zeros((4, 4), dtype=np.uint8)
    mask[1, 2] = 1
    colour, depth, seen = panels(image, mask)
    assert colour[1, 2].tolist() == [255, 0, 0, 255]
    assert (np.delete(colour.reshape(16, 4), 6, axis=0) == [0, 0, 0, 255]).all()
    # The nearest pixel is the first of the colours, the farthest with a depth the last.
    assert depth[1, 2].tolist() == [253, 231, 37, 255]
    assert depth[0, 0].tolist() == [68, 1, 84, 255]
    assert (depth[2:] == NO_DEPTH).all()
    assert seen[1, 2].tolist() == MASK[1].tolist()
    assert (seen[2:] == MASK[0]).all()
