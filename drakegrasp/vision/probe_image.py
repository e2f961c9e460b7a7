"""Tests whether this machine can render: a separate process draws a box.

A broken OpenGL kills its process, and the first thread that renders in a process owns its OpenGL.
So a child process renders, and its exit and output are the finding.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

#: Time after which the child process is considered failed [s].
IMAGE_SECONDS = 60.0
#: The box's edge, and the distance of its front from the camera [m].
BOX_EDGE, BOX_DISTANCE = 0.1, 0.25
#: Code of the child process; its last line of output is `object pixels, expected pixels`.
_CHILD = "from drakegrasp.vision.probe_image import render_box; print(*render_box())"


def probe_image() -> tuple[bool, str]:
    """Return whether a child process renders a box, and a message on its finding."""
    # The child imports from the same paths, but not from its working directory.
    paths = os.pathsep.join(str(Path(p).resolve()) for p in sys.path if p)
    try:
        child = subprocess.run(
            [sys.executable, "-P", "-c", _CHILD],
            env={**os.environ, "PYTHONPATH": paths},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=IMAGE_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return False, f"no image within {IMAGE_SECONDS:g} s"
    except OSError as error:
        return False, f"no child process: {error}"

    # A signal, an error and unexpected output are different findings.
    if child.returncode < 0:
        return False, f"the renderer crashed with {_signal_name(-child.returncode)}"
    lines = (child.stderr if child.returncode else child.stdout).strip().splitlines()
    last = lines[-1] if lines else "nothing"
    if child.returncode:
        return False, last
    match = re.fullmatch(r"(\d+) (\d+)", last)
    if match is None:
        return False, f"the renderer must print two numbers, got {last!r}"

    # An edge of the mask may be off by a pixel at either end.
    seen, expected = int(match[1]), int(match[2])
    what = f"{seen} pixels of a box that has {expected}"
    if not 0.9 * expected <= seen <= 1.1 * expected:
        return False, what if seen else f"blank image: {what}"
    return True, what


def render_box() -> tuple[int, int]:
    """Render a box from above; return how many pixels show it, and how many should show it.

    Call it in a separate process, because it may crash.
    """
    import numpy as np
    import trimesh

    from drakegrasp.config import CameraConfig, ObjectConfig
    from drakegrasp.frames import make_pose
    from drakegrasp.objects.model import make_object
    from drakegrasp.vision.camera import intrinsics
    from drakegrasp.vision.rendering import build_renderer, render

    config, box = CameraConfig(), trimesh.creation.box((BOX_EDGE,) * 3)
    name = {"name": "box", "class_name": "box", "mesh_sha256": ""}
    model = make_object(box.vertices, box.faces, ObjectConfig(), **name)

    # The box stands on the table, and the camera looks straight down on it.
    X_TO = make_pose(np.eye(3), [0.0, 0.0, BOX_EDGE / 2.0])
    X_TC = make_pose(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, BOX_EDGE + BOX_DISTANCE])
    seen = render(build_renderer(model, config), X_TO, X_TC)
    edge = intrinsics(config)[0, 0] * BOX_EDGE / BOX_DISTANCE
    return int(seen.mask.sum()), round(edge**2)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
