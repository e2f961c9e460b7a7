"""Recordings: an attempt as a single HTML file that any browser plays.

Input: a function that runs a simulation. Output: its result, which is equal to the last bit to that
without a recording because the same code runs, and an HTML file that needs neither other files nor
the network. An attempt that ends before it is simulated is shown at its start.
"""

from __future__ import annotations

import gc
import logging
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from matplotlib.colors import to_rgb
from pydrake.geometry import Cylinder, Meshcat, MeshcatCone, MeshcatParams, Rgba, Sphere
from pydrake.math import RigidTransform, RotationMatrix

from drakegrasp.config import Config
from drakegrasp.frames import X_WT, Array
from drakegrasp.hand.description import load_hand
from drakegrasp.objects.model import ObjectModel
from drakegrasp.objects.surroundings import Neighbourhood
from drakegrasp.pictures.style import PREDICTED, SEEN_THROUGH, STILL
from drakegrasp.runtime.environment import allow_network
from drakegrasp.runtime.files import write_atomic
from drakegrasp.simulation.attempt import Attempt
from drakegrasp.simulation.construction import MESHCAT_RATE, build_object_scene, build_scene
from drakegrasp.simulation.scene import ObjectScene, reset_attempt, reset_object
from drakegrasp.simulation.trial import TrialRecord, run_attempt

Result = TypeVar("Result")

#: Meshcat's path of the object; everything below this path moves with the object.
OBJECT_PATH = "visualizer/object/object"
#: Radius of a contact's dot, length and radius of the arrow along its normal [m].
DOT, ARROW, SHAFT = 0.004, 0.03, 0.0012
#: Caption over the picture, in the lower left corner.
CAPTION = (
    '<p style="position:fixed;left:1em;bottom:4em;z-index:9;max-width:34em;margin:0;'
    "padding:.6em .8em;font:14px/1.4 sans-serif;color:#222;background:#fffc;"
    'border-radius:4px;pointer-events:none">{}</p>'
)
#: Length and radius of an arrow's head [m].
HEAD, HEAD_RADIUS = 0.009, 0.0035
#: Direction of the camera: azimuth about the vertical from the palm's side, and elevation [rad].
AZIMUTH, ELEVATION = np.deg2rad(50.0), np.deg2rad(20.0)
#: Distance of the camera in radii of a sphere around the whole lift; the hand's addition to this
#: radius [m].
DISTANCE, HAND_RADIUS = 1.15, 0.1


def record_attempt(
    model: ObjectModel,
    X_TO: npt.ArrayLike,
    attempt: Attempt,
    config: Config,
    path: Path,
    *,
    p_OQ: Array | None = None,
    nhat_Q_O: Array | None = None,
    caption: str = "",
    around: Neighbourhood | None = None,
    still: Mapping[str, Array] | None = None,
) -> TrialRecord:
    """Return the result of `trial.run_attempt`, and write a recording of the attempt.

    Args:
        model: The object.
        X_TO: (4, 4), resting pose of the object in the table-top frame.
        attempt: The attempt.
        config: Hand, physics, lift and limits.
        path: Path of the HTML file.
        p_OQ: (k, 3), predicted contacts to draw on the object, in {O} [m].
        nhat_Q_O: (k, 3), outward unit normals of the contacts in {O}.
        caption: Text in a corner.
        around: What is around the object, see `build_scene`.
        still: What else to draw, by name: triangles (t, 3, 3) in {W} [m], of which the first are
            solid and the others can be seen through.

    Raises:
        OSError: If the file cannot be written.
    """

    def run(meshcat: Meshcat) -> TrialRecord:
        hand = load_hand(config.hand_source).at(attempt.preshape)
        scene = build_scene(model, config.physics, hand, meshcat=meshcat, around=around)
        # An attempt that fails before it is simulated is shown at its start.
        X_WO = X_WT @ np.asarray(X_TO, dtype=float)
        q = None if attempt.path is None else attempt.path[0]
        spread, closing = attempt.spread, attempt.closing
        reset_attempt(scene, X_WO, X_WO @ attempt.X_OG, spread=spread, closing=closing, q=q)
        _aim_camera(meshcat, scene, X_WO, config, side_W=X_WO[:3, :3] @ attempt.X_OG[:3, 3])
        record = run_attempt(scene, X_TO, attempt, config)
        _draw_predicted(meshcat, p_OQ, nhat_Q_O)
        _draw_still(meshcat, still or {})
        return record

    return _record_html(run, path, caption)


def record_object(
    model: ObjectModel, X_TO: npt.ArrayLike, config: Config, path: Path, *, caption: str = ""
) -> None:
    """Write a recording of an object at rest; see `record_attempt`."""

    def run(meshcat: Meshcat) -> None:
        scene = build_object_scene(model, config.physics, meshcat=meshcat)
        X_WO = X_WT @ np.asarray(X_TO, dtype=float)
        reset_object(scene, X_WO)
        scene.simulator.Initialize()
        _aim_camera(meshcat, scene, X_WO, config, side_W=np.array([1.0, 0.0, 0.0]))

    _record_html(run, path, caption)


def _aim_camera(
    meshcat: Meshcat, scene: ObjectScene, X_WO: Array, config: Config, *, side_W: Array
) -> None:
    """Render from beside the palm, whose direction is `side_W`, so far that the lift is visible."""
    way = X_WT[:3, 3] + config.lift.p_TG - X_WO[:3, 3]
    radius = np.linalg.norm(way) / 2.0 + np.linalg.norm(scene.model.half_extents) + HAND_RADIUS
    azimuth = np.arctan2(side_W[1], side_W[0]) + AZIMUTH
    towards = np.array([np.cos(azimuth), np.sin(azimuth), np.tan(ELEVATION)])
    middle = X_WO[:3, 3] + way / 2.0
    meshcat.SetCameraPose(middle + DISTANCE * radius * towards, middle)


def _draw_still(meshcat: Meshcat, still: Mapping[str, Array]) -> None:
    """Draw triangles (t, 3, 3) in {W} [m] by their names, see `record_attempt`."""
    for number, (name, triangles) in enumerate(still.items()):
        corners = np.asfortranarray(triangles.reshape(-1, 3).T)
        faces = np.asfortranarray(np.arange(corners.shape[1], dtype=np.int32).reshape(-1, 3).T)
        colour = Rgba(*STILL, SEEN_THROUGH if number else 1.0)
        meshcat.SetTriangleMesh(f"/still/{name}", corners, faces, colour)


def _record_html(run: Callable[[Meshcat], Result], path: Path, caption: str = "") -> Result:
    """Return the result of `run`, and write what it published, unless it raises an error.

    Args:
        run: Function that runs a simulation, which publishes to the given Meshcat.
        path: Path of the HTML file.
        caption: Text in a corner.

    Raises:
        OSError: If the file cannot be written.
    """
    meshcat = _make_meshcat()
    try:
        for part in ("/Grid", "/Axes"):
            meshcat.SetProperty(part, "visible", False)
        meshcat.StartRecording(frames_per_second=MESHCAT_RATE)
        result = run(meshcat)
        meshcat.StopRecording()
        meshcat.PublishRecording()
        text = meshcat.StaticHtml()
        if caption:
            text = text.replace("<body>", f"<body>{CAPTION.format(escape(caption))}", 1)
        write_atomic(path, text.encode())
    finally:
        # The diagram of `run` is in a reference cycle; collecting it closes Meshcat's port.
        del meshcat
        gc.collect()
    return result


def _make_meshcat() -> Meshcat:
    """Return a Meshcat that only this machine can reach.

    A Meshcat always starts a server, and only a Meshcat can write the HTML. Under
    `DRAKE_ALLOW_NETWORK=none`, which our workers set, its constructor raises an error; so the
    network is allowed here, but nothing leaves the machine. Drake's announcement of the address is
    suppressed, because nobody needs to open it.
    """
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        with allow_network("meshcat"):
            # Port 0 means any free port, so that several recordings can run at once.
            return Meshcat(MeshcatParams(host="localhost", port=0, show_stats_plot=False))
    finally:
        logger.setLevel(level)


def _draw_predicted(meshcat: Meshcat, p_OQ: Array | None, nhat_Q_O: Array | None) -> None:
    """Draw a dot for each contact on the object, with an arrow along its normal.

    Args:
        meshcat: Meshcat to draw in.
        p_OQ: (k, 3), contacts in {O} [m]; nothing is drawn if None.
        nhat_Q_O: (k, 3), outward unit normals of the contacts in {O}.
    """
    if p_OQ is None or nhat_Q_O is None:
        return
    colour = Rgba(*to_rgb(PREDICTED))
    # A posture has no predicted contacts.
    there = np.isfinite(p_OQ).all(axis=1)
    for i, (p, n) in enumerate(zip(p_OQ[there], nhat_Q_O[there], strict=True)):
        path = f"{OBJECT_PATH}/predicted/{i + 1}"
        meshcat.SetTransform(path, RigidTransform(RotationMatrix.MakeFromOneVector(n, 2), p))
        meshcat.SetObject(f"{path}/dot", Sphere(DOT), colour)
        meshcat.SetObject(f"{path}/shaft", Cylinder(SHAFT, ARROW - HEAD), colour)
        meshcat.SetTransform(f"{path}/shaft", RigidTransform([0.0, 0.0, (ARROW - HEAD) / 2.0]))
        # A Meshcat cone opens along its +z from its apex, which is the arrow's tip here.
        meshcat.SetObject(f"{path}/head", MeshcatCone(HEAD, HEAD_RADIUS, HEAD_RADIUS), colour)
        tip = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.0, 0.0, ARROW])
        meshcat.SetTransform(f"{path}/head", tip)
