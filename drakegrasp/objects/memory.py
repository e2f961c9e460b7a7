"""How much memory preparing a mesh takes: faces of a file come in, a forecast goes out.

`pipelines/measurements/prepare_memory.py` measures it beside the forecast.
"""

from __future__ import annotations

import math

from drakegrasp.mesh.coarsening import MOST_FACES

#: Memory of a worker that prepares a small mesh [B], of which 240 MB are there before; and of each
#: face that is mended and that is read: largest of balls of 20,000 to 1,300,000 faces in STL, OBJ
#: and PLY, with 30 MB for what a worker has besides.
BASE, MENDED, READ = 425e6, 0.6e3, 0.14e3
#: Share of its limit at which Dask ends a worker, and steps in which a limit is told [B].
ENDED, STEP = 0.95, 50e6


def forecast_memory(faces: int) -> float:
    """Return the most memory that a worker takes to prepare a mesh [B].

    Args:
        faces: Number of triangles in the file.
    """
    return BASE + MENDED * min(faces, MOST_FACES) + READ * faces


def needed_limit(memory: float) -> float:
    """Return the limit of a worker's memory [B] with which it may take so much [B]."""
    return STEP * math.ceil(memory / ENDED / STEP)
