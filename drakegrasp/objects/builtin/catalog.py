"""The built-in objects: a table of everyday things, so that a dataset needs no meshes.

Each row of `BUILTIN_OBJECTS` is one object: a class, a variant and a function of `solid_shapes`,
`revolved_shapes` or `hollow_shapes` with its sizes. Nothing is built before `build()` is called.
Every class has at least two variants, so that a split by class has something on both sides.
`export_builtin` writes the meshes as Wavefront files, the same bytes every time.

Sizes are our own, chosen for a hand of the Barrett's size: it spans 0.24 m and its pads
reach about 0.11 m ahead of the palm.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import trimesh

from drakegrasp.errors import MeshError
from drakegrasp.objects.builtin import hollow_shapes, revolved_shapes, solid_shapes
from drakegrasp.objects.builtin.modelling import DECIMALS
from drakegrasp.runtime.files import write_atomic


@dataclass(frozen=True, kw_only=True)
class BuiltinObject:
    """One built-in object; `build` returns its mesh [m], standing on z = 0, z up."""

    number: int
    class_name: str
    variant: str
    build: Callable[[], trimesh.Trimesh]

    @property
    def name(self) -> str:
        """The name of the object and the stem of its file, such as "1_mug_small"."""
        return f"{self.number}_{self.class_name}_{self.variant}"


#: The classes in order: the function and, for each variant, its sizes [m] (angles [rad]).
_CLASSES: tuple[tuple[Callable[..., trimesh.Trimesh], dict[str, dict[str, Any]]], ...] = (
    (
        hollow_shapes.mug,
        {
            "small": dict(radius=0.036, height=0.085, handle_reach=0.028, handle_radius=0.005),
            "large": dict(radius=0.044, height=0.100, handle_reach=0.034, handle_radius=0.006),
        },
    ),
    (
        revolved_shapes.bottle,
        {
            "slim": dict(radius=0.030, height=0.200, neck_radius=0.012),
            "stout": dict(radius=0.040, height=0.160, neck_radius=0.016),
        },
    ),
    (
        hollow_shapes.bowl,
        {
            "small": dict(radius=0.055, height=0.055, foot_radius=0.026),
            "large": dict(radius=0.070, height=0.065, foot_radius=0.034),
        },
    ),
    (
        hollow_shapes.wineglass,
        {
            "round": dict(
                foot_radius=0.036,
                stem_radius=0.006,
                belly_radius=0.040,
                rim_radius=0.032,
                height=0.150,
                stem_height=0.070,
            ),
            "flute": dict(
                foot_radius=0.034,
                stem_radius=0.006,
                belly_radius=0.028,
                rim_radius=0.026,
                height=0.180,
                stem_height=0.065,
            ),
        },
    ),
    (
        solid_shapes.box,
        {
            "flat": dict(width=0.100, depth=0.070, height=0.060),
            "tall": dict(width=0.070, depth=0.050, height=0.150),
        },
    ),
    (
        revolved_shapes.can,
        {
            "short": dict(radius=0.037, height=0.075),
            "tall": dict(radius=0.033, height=0.120),
        },
    ),
    (
        solid_shapes.hammer,
        {
            "claw": dict(length=0.220, head_length=0.110, head_thickness=0.030, claw=True),
            "mallet": dict(length=0.200, head_length=0.090, head_thickness=0.046, claw=False),
        },
    ),
    (
        revolved_shapes.candlestick,
        {
            "short": dict(foot_radius=0.045, stem_radius=0.010, height=0.120),
            "tall": dict(foot_radius=0.050, stem_radius=0.012, height=0.190),
        },
    ),
    (
        hollow_shapes.vase,
        {
            "round": dict(
                foot_radius=0.032,
                belly_radius=0.050,
                neck_radius=0.022,
                lip_radius=0.030,
                height=0.130,
            ),
            "slender": dict(
                foot_radius=0.036,
                belly_radius=0.042,
                neck_radius=0.020,
                lip_radius=0.030,
                height=0.190,
                edge=0.007,
            ),
        },
    ),
    (
        revolved_shapes.flashlight,
        {
            "small": dict(head_radius=0.026, body_radius=0.015, height=0.120, head_height=0.028),
            "large": dict(head_radius=0.034, body_radius=0.020, height=0.170, head_height=0.036),
        },
    ),
    (
        hollow_shapes.cup,
        {
            "small": dict(top_radius=0.036, bottom_radius=0.027, height=0.085),
            "large": dict(top_radius=0.042, bottom_radius=0.030, height=0.120),
        },
    ),
    (
        revolved_shapes.jar,
        {
            "small": dict(radius=0.034, height=0.080, lid_radius=0.030, lid_height=0.014),
            "large": dict(radius=0.042, height=0.125, lid_radius=0.038, lid_height=0.018),
        },
    ),
    (
        hollow_shapes.pitcher,
        {
            "small": dict(
                foot_radius=0.036,
                belly_radius=0.044,
                neck_radius=0.032,
                rim_radius=0.036,
                height=0.120,
                handle_reach=0.022,
                handle_radius=0.006,
                lip=0.014,
            ),
            "large": dict(
                foot_radius=0.042,
                belly_radius=0.052,
                neck_radius=0.036,
                rim_radius=0.042,
                height=0.165,
                handle_reach=0.026,
                handle_radius=0.007,
                lip=0.018,
                edge=0.008,
            ),
        },
    ),
    (
        hollow_shapes.funnel,
        {
            "small": dict(radius=0.042, spout_radius=0.011, cone_height=0.050, height=0.095),
            "large": dict(radius=0.055, spout_radius=0.013, cone_height=0.070, height=0.130),
        },
    ),
    (
        solid_shapes.dumbbell,
        {
            "light": dict(length=0.160, head_width=0.056, head_length=0.040, grip_radius=0.014),
            "heavy": dict(length=0.200, head_width=0.076, head_length=0.052, grip_radius=0.016),
        },
    ),
    (
        solid_shapes.spray_bottle,
        {
            "small": dict(width=0.064, depth=0.046, height=0.170),
            "large": dict(width=0.084, depth=0.056, height=0.220, edge=0.007),
        },
    ),
    (
        solid_shapes.book,
        {
            "small": dict(width=0.090, length=0.125, thickness=0.034),
            "thick": dict(width=0.105, length=0.150, thickness=0.052),
        },
    ),
    (
        solid_shapes.banana,
        {
            "short": dict(bend_radius=0.090, angle=1.75, thickness=0.034),
            "long": dict(bend_radius=0.130, angle=1.55, thickness=0.040),
        },
    ),
    (
        hollow_shapes.saucepan,
        {
            "small": dict(radius=0.050, height=0.055, handle_length=0.090),
            "deep": dict(radius=0.058, height=0.085, handle_length=0.100),
        },
    ),
    (
        revolved_shapes.apple,
        {
            "small": dict(radius=0.034, height=0.060),
            "large": dict(radius=0.042, height=0.070),
        },
    ),
    (
        revolved_shapes.pear,
        {
            "round": dict(radius=0.037, neck_radius=0.020, height=0.085),
            "long": dict(radius=0.036, neck_radius=0.017, height=0.105),
        },
    ),
)


def _number_objects() -> tuple[BuiltinObject, ...]:
    rows = [
        (shape, variant, sizes)
        for shape, variants in _CLASSES
        for variant, sizes in variants.items()
    ]
    return tuple(
        BuiltinObject(
            number=number,
            class_name=shape.__name__,
            variant=variant,
            build=partial(shape, **sizes),
        )
        for number, (shape, variant, sizes) in enumerate(rows, start=1)
    )


#: Every built-in object, by number.
BUILTIN_OBJECTS: tuple[BuiltinObject, ...] = _number_objects()


def builtin_object(name: str) -> BuiltinObject:
    """Return the built-in object of this name.

    Raises:
        MeshError: If there is none; the message lists the known names.
    """
    for item in BUILTIN_OBJECTS:
        if item.name == name:
            return item
    names = ", ".join(item.name for item in BUILTIN_OBJECTS)
    raise MeshError(f"a built-in object must be one of {names}; got {name!r}")


def export_builtin(
    directory: str | os.PathLike[str], names: Iterable[str] | None = None
) -> list[Path]:
    """Write built-in objects as `<name>.obj` and return the paths, in the order asked for.

    A file appears whole or not at all, and holds the same bytes every time.

    Args:
        directory: Where to write; made if it is missing.
        names: Which objects; all of them by default.

    Raises:
        MeshError: If a name is unknown; nothing is written then.
    """
    # Look up all names before anything is written.
    chosen = BUILTIN_OBJECTS if names is None else [builtin_object(name) for name in names]
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)

    paths = []
    for item in chosen:
        path = folder / f"{item.name}.obj"
        write_atomic(path, _wavefront(item.build()))
        paths.append(path)
    return paths


def _wavefront(mesh: trimesh.Trimesh) -> bytes:
    """Return a mesh as Wavefront text; not trimesh's, which may change by release."""
    d = DECIMALS
    lines = [f"v {x:.{d}f} {y:.{d}f} {z:.{d}f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")
