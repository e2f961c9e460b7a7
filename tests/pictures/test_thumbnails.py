"""Thumbnails: the right pixels in the right panel."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from matplotlib.image import imread

from drakegrasp.pictures.style import MASK, NO_DEPTH, strip_png


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


def test_an_image_without_depth_is_drawn() -> None:
    image = np.full((4, 4, 4), 0.75, dtype=np.float32)
    _, depth, _ = panels(image, np.zeros((4, 4), dtype=np.uint8))
    assert (depth == NO_DEPTH).all()
