"""A sample's images as one small picture: colour, depth and mask side by side.

In: the arrays of a sample. Out: the bytes of a PNG, of the images' own resolution.
"""

from __future__ import annotations

import io

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.image import imsave

#: Colours of depths, as in `style`; of pixels without depth; of the mask's background and object.
#: What is nothing is transparent, and the object neither dark nor light: it is seen on any page.
DEPTHS = "viridis_r"
NO_DEPTH = np.array([0, 0, 0, 0], dtype=np.uint8)
MASK = np.array([[0, 0, 0, 0], [0x7D, 0x88, 0x96, 0xFF]], dtype=np.uint8)
#: Least range of the depth colours [m].
MIN_RANGE = 0.05


def strip_png(image: npt.NDArray[np.float32], mask: npt.NDArray[np.uint8], *, far: float) -> bytes:
    """Return colour, depth and mask side by side as a PNG, (S, 3 S) pixels.

    The colours of depth run from the nearest pixel of the image to the farthest before `far`.

    Args:
        image: (4, S, S): R, G, B in 0..1 and depth [m].
        mask: (S, S), 1 where the object is seen.
        far: Far plane [m]; pixels beyond it have no depth.
    """
    # Depths as indices into the colours.
    depth = np.asarray(image[3], dtype=float)
    seen = depth < far
    near, end = (depth[seen].min(), depth[seen].max()) if seen.any() else (0.0, far)
    share = (depth - near) / max(end - near, MIN_RANGE)
    table = np.rint(255.0 * mpl.colormaps[DEPTHS](np.arange(256))).astype(np.uint8)
    depths = np.where(
        seen[..., None], table[np.rint(255.0 * share.clip(0, 1)).astype(int)], NO_DEPTH
    )

    colours = np.rint(255.0 * np.moveaxis(image[:3], 0, 2).clip(0.0, 1.0)).astype(np.uint8)
    colours = np.dstack([colours, np.full(colours.shape[:2], 255, dtype=np.uint8)])
    strip = np.concatenate([colours, depths, MASK[(mask > 0).astype(int)]], axis=1)
    return colour_png(strip)


def colour_png(colours: npt.NDArray[np.uint8]) -> bytes:
    """Return colours (h, w, 3), with opacity (h, w, 4), as a PNG."""
    buffer = io.BytesIO()
    imsave(buffer, colours, format="png")
    return buffer.getvalue()
