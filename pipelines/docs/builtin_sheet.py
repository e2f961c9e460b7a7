"""Draw the contact sheet of the built-in objects: one object of every class, with its name."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from drakegrasp.config import CameraConfig
from drakegrasp.frames import Array, make_pose
from drakegrasp.objects.model import ObjectModel
from drakegrasp.pictures.style import INK, add_axes, hide_ticks, save_figure
from drakegrasp.shapes.catalog import CLASSES, BuiltinObject
from drakegrasp.vision.rendering import build_renderer, render

#: Objects per line of the sheet, and the edge length of each picture [inch].
ACROSS, EDGE = 8, 1.3
#: Pixels per inch, and the factor by which pictures are rendered larger than they are shown.
DPI, OVERSAMPLING = 150, 2
#: Direction to the camera: azimuth from +x and elevation [rad]; its narrow field of view [deg].
AZIMUTH, ELEVATION, FOV_Y_DEG = np.deg2rad(-58.0), np.deg2rad(27.0), 20.0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("classes", nargs="*", metavar="CLASS", help="[default: all]")
    parser.add_argument("--index", type=int, default=1, help="which object of each class")
    parser.add_argument("--objects-seed", type=int, default=0, help="seed of their sizes")
    parser.add_argument("--out", type=Path, default=Path("docs/images/builtin.png"))
    arguments = parser.parse_args(argv)
    unknown = set(arguments.classes) - {item.name for item in CLASSES}
    if unknown:
        parser.error(f"CLASS must be a built-in class, got {', '.join(sorted(unknown))}")

    chosen = [item for item in CLASSES if not arguments.classes or item.name in arguments.classes]
    objects = [
        BuiltinObject(object_class=item, index=arguments.index, seed=arguments.objects_seed)
        for item in chosen
    ]
    save_figure(draw_sheet(objects), arguments.out, dpi=DPI)
    return 0


def draw_sheet(objects: Sequence[BuiltinObject]) -> Figure:
    """Return the contact sheet of some objects, in lines of `ACROSS`."""
    # The page.
    caption, margin = 0.2, 0.06
    across = min(ACROSS, len(objects))
    lines = -(-len(objects) // across)
    size = (across * EDGE + 2 * margin, lines * (EDGE + caption) + 2 * margin)
    figure = Figure(figsize=size, facecolor="white")

    # A picture of each object, above its class.
    for k, item in enumerate(objects):
        line, column = divmod(k, across)
        left, top = margin + column * EDGE, margin + line * (EDGE + caption)
        axes = add_axes(figure, left + 0.03, top, EDGE - 0.06, EDGE - 0.06)
        axes.imshow(picture(item))
        hide_ticks(axes)
        name = item.object_class.name.replace("_", " ")
        axes.text(
            0.5, -0.04, f"{item.object_class.number} {name}", transform=axes.transAxes,
            fontsize=7.5, color=INK, ha="center", va="top",
        )  # fmt: skip
    return figure


def picture(item: BuiltinObject) -> npt.NDArray[np.float32]:
    """Return the picture (n, n, 3) of an object as it rests on the table, with values in 0..1."""
    # Only the surface is drawn, so the other values of the model are arbitrary.
    mesh = item.build()
    vertices, faces = mesh.vertices - mesh.bounds.mean(axis=0), mesh.faces.astype(np.int32)
    model = ObjectModel(
        name=item.name,
        class_name=item.object_class.name,
        mesh_sha256="",
        visual_vertices=vertices,
        visual_faces=faces,
        collision_vertices=vertices,
        collision_faces=faces,
        mass=1.0,
        p_OOcm=np.zeros(3),
        p_OM=np.zeros(3),
        I_OOcm_O=np.eye(3),
        collision_error=0.0,
    )

    # Render the view larger than it is shown, and average it.
    size = round(EDGE * DPI) * OVERSAMPLING
    config = CameraConfig(size=size, fov_y_deg=FOV_Y_DEG, near=0.05, far=5.0)
    X_TO = make_pose(np.eye(3), [0.0, 0.0, model.half_extents[2]])
    view = render(build_renderer(model, config), X_TO, camera_pose(model))
    shown = np.moveaxis(view.image[:3], 0, 2)
    blocks = shown.reshape(size // OVERSAMPLING, OVERSAMPLING, -1, OVERSAMPLING, 3)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def camera_pose(model: ObjectModel) -> Array:
    """Return X_TC (4, 4) of a camera whose picture is filled by the object at rest."""
    sideways = np.array([-np.sin(AZIMUTH), np.cos(AZIMUTH), 0.0])
    back = np.array(
        [
            np.cos(ELEVATION) * np.cos(AZIMUTH),
            np.cos(ELEVATION) * np.sin(AZIMUTH),
            np.sin(ELEVATION),
        ]
    )
    R_TC = np.column_stack([sideways, np.cross(-back, sideways), -back])

    # The centre of the object as the camera sees it, and half of its larger side.
    seen = model.visual_vertices @ R_TC
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle = R_TC @ ((low + high) / 2.0) + [0.0, 0.0, model.half_extents[2]]
    half = 0.5 * float((high - low)[:2].max())
    distance = 1.12 * half / np.tan(np.deg2rad(FOV_Y_DEG) / 2.0) + 0.5 * float((high - low)[2])
    return make_pose(R_TC, middle + distance * back)


if __name__ == "__main__":
    sys.exit(main())
