"""The built-in objects: everyday things of drawn sizes, so that a dataset needs no meshes.

`CLASSES` is the table of 64 classes: a function, and for each of its parameters the range from
which a value is drawn. Values are whole numbers of steps, so a draw is equal on every machine. An
object is a class, an index from 1 and a seed; its name is `<number>_<class>_<index>`. The same
class, index and seed produce the same object, however many other objects there are.
`export_builtin` writes the meshes as Wavefront files, with the same bytes every time.

Sizes are our own, chosen for a hand of the Barrett's size, which spans 0.24 m and whose pads reach
about 0.11 m ahead of the palm. If a smaller hand needs another size of a class, copy its row.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import trimesh

from drakegrasp.config import BuiltinConfig
from drakegrasp.errors import MeshError
from drakegrasp.objects.sources import MeshSource, find_mesh
from drakegrasp.runtime.files import write_atomic
from drakegrasp.runtime.progress import Report, silent
from drakegrasp.seeding import Stream, object_key
from drakegrasp.shapes import garden, home, kitchen, toys
from drakegrasp.shapes.solids import DECIMALS

#: Licence of the built-in objects, which are part of the package.
LICENCE = "BSD-3-Clause"

#: Steps per unit: lengths in 0.1 mm, angles in 0.1 degrees, and whole numbers.
_STEPS = {"mm": 10, "deg": 10, "-": 1}


@dataclass(frozen=True)
class Range:
    """Range from which a parameter is drawn; both ends are included.

    Attributes:
        low, high: Ends of the range, in `unit`.
        unit: "mm", "deg", or "-" for a number of pieces.
    """

    low: float
    high: float
    unit: str

    def draw(self, stream: Stream) -> float | int:
        """Return the next value of a stream: lengths in [m], angles in [rad]."""
        steps = _STEPS[self.unit]
        first, last = round(self.low * steps), round(self.high * steps)
        number = first + int(stream.integers(last - first + 1, 1)[0])
        if self.unit == "-":
            return number
        return number / 1e4 if self.unit == "mm" else number * (np.pi / 1800.0)

    def __str__(self) -> str:
        """Return the range as it is written in tables."""
        unit = "" if self.unit == "-" else f" {self.unit}"
        return f"{self.low:g} to {self.high:g}{unit}"


#: Ranges of a length [mm], of an angle [deg], and of a number of pieces.
mm, deg, pieces = (partial(Range, unit=unit) for unit in _STEPS)


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectClass:
    """A class of built-in objects.

    Attributes:
        number: Position of the class in the table, from 1.
        shape: Function from the parameters to a mesh [m]; its name is the name of the class.
        parameters: Ranges of the parameters, by name.
    """

    number: int
    shape: Callable[..., trimesh.Trimesh]
    parameters: dict[str, Range]

    @property
    def name(self) -> str:
        """The name of the class, such as "mug"."""
        return self.shape.__name__

    @property
    def meaning(self) -> str:
        """Description of the shape, in words."""
        return (self.shape.__doc__ or "").partition("\n")[0].removeprefix("Return ").rstrip(".")


# fmt: off
_ROWS: tuple[tuple[Callable[..., trimesh.Trimesh], dict[str, Range]], ...] = (
    (kitchen.mug, dict(radius=mm(34, 42), height=mm(80, 102), handle_reach=mm(26, 34),
        handle_radius=mm(4.5, 6.5))),
    (kitchen.bottle, dict(radius=mm(29, 40), height=mm(150, 210), neck_radius=mm(11, 16))),
    (kitchen.bowl, dict(radius=mm(52, 70), height=mm(50, 68), foot_radius=mm(25, 34))),
    (kitchen.wineglass, dict(foot_radius=mm(33, 38), stem_radius=mm(5.5, 7),
        belly_radius=mm(30, 42), rim_radius=mm(26, 34), height=mm(145, 180),
        stem_height=mm(60, 75))),
    (kitchen.box, dict(width=mm(60, 100), depth=mm(45, 70), height=mm(60, 150))),
    (kitchen.can, dict(radius=mm(32, 38), height=mm(75, 120))),
    (garden.hammer, dict(length=mm(115, 135), head_length=mm(95, 115), head_thickness=mm(42, 47))),
    (home.candlestick, dict(foot_radius=mm(43, 52), stem_radius=mm(10, 12.5), height=mm(120, 190))),
    (kitchen.vase, dict(foot_radius=mm(31, 37), belly_radius=mm(42, 52), neck_radius=mm(20, 26),
        lip_radius=mm(29, 34), height=mm(130, 190))),
    (home.flashlight, dict(head_radius=mm(26, 34), body_radius=mm(15, 20), height=mm(120, 170),
        head_height=mm(28, 36))),
    (kitchen.cup, dict(top_radius=mm(36, 43), bottom_radius=mm(26, 31), height=mm(85, 120))),
    (kitchen.jar, dict(radius=mm(34, 43), height=mm(80, 125), lid_radius=mm(28, 34),
        lid_height=mm(14, 18))),
    (kitchen.pitcher, dict(foot_radius=mm(36, 42), belly_radius=mm(44, 52), neck_radius=mm(31, 36),
        rim_radius=mm(36, 42), height=mm(120, 165), handle_reach=mm(21, 26), handle_radius=mm(6, 7),
        lip=mm(14, 18))),
    (kitchen.funnel, dict(radius=mm(38, 46), spout_radius=mm(12, 15), cone_height=mm(58, 72),
        height=mm(110, 140))),
    (home.dumbbell, dict(length=mm(160, 200), head_width=mm(56, 76), head_length=mm(40, 52),
        grip_radius=mm(13.5, 16.5))),
    (kitchen.spray_bottle, dict(width=mm(64, 84), depth=mm(46, 56), height=mm(170, 220))),
    (home.book, dict(width=mm(70, 88), length=mm(105, 130), thickness=mm(42, 56))),
    (garden.banana, dict(bend_radius=mm(105, 125), angle=deg(60, 72), thickness=mm(38, 43))),
    (kitchen.saucepan, dict(radius=mm(48, 58), height=mm(55, 85), handle_length=mm(85, 100))),
    (garden.apple, dict(radius=mm(34, 42), height=mm(60, 70))),
    (garden.pear, dict(radius=mm(35, 38), neck_radius=mm(17, 20), height=mm(85, 105))),
    (home.hat, dict(brim=mm(56, 64), crown=mm(35, 42), height=mm(64, 85))),
    (kitchen.toaster, dict(length=mm(115, 140), width=mm(66, 80), height=mm(80, 98))),
    (kitchen.carton, dict(width=mm(54, 70), height=mm(85, 120), roof=mm(24, 32))),
    (home.watertap, dict(base=mm(36, 42), pipe=mm(8, 10), height=mm(140, 170), reach=mm(64, 80))),
    (kitchen.towel_roll, dict(radius=mm(36, 46), height=mm(95, 125), core=mm(16, 20))),
    (kitchen.coffeemaker, dict(width=mm(76, 90), depth=mm(104, 122), height=mm(130, 160))),
    (kitchen.teapot, dict(radius=mm(44, 54), height=mm(80, 96), spout=mm(34, 42))),
    (garden.screwdriver, dict(handle=mm(88, 105), radius=mm(18, 22), shaft=mm(65, 85))),
    (home.knob, dict(rose=mm(32, 36), neck=mm(10, 12.5), radius=mm(26, 31), height=mm(60, 74))),
    (home.comb, dict(length=mm(115, 140), depth=mm(24, 30), spine=mm(24, 30), teeth=mm(30, 38),
        count=pieces(8, 11))),
    (home.shoe, dict(length=mm(140, 170), width=mm(58, 66), height=mm(62, 74))),
    (home.boot, dict(length=mm(115, 135), width=mm(52, 60), height=mm(115, 140))),
    (toys.bunny, dict(body=mm(32, 38), head=mm(22, 26), ear=mm(40, 52))),
    (toys.toy_dog, dict(length=mm(90, 110), height=mm(62, 74), girth=mm(20, 24))),
    (toys.snake, dict(coil=mm(34, 40), thickness=mm(26, 30), neck=mm(60, 76))),
    (toys.rubber_duck, dict(length=mm(88, 106), head=mm(23, 28))),
    (kitchen.pepper_mill, dict(radius=mm(27, 32), waist=mm(15, 19), height=mm(120, 155))),
    (kitchen.juicer, dict(radius=mm(48, 58), rim=mm(34, 42), cone=mm(58, 70))),
    (garden.garbage_bin, dict(width=mm(58, 70), height=mm(100, 125))),
    (home.lamp, dict(base=mm(38, 44), shade=mm(46, 54), height=mm(140, 170))),
    (home.bell, dict(radius=mm(38, 46), body=mm(58, 72), handle=mm(62, 78))),
    (toys.chess_pawn, dict(base=mm(30, 35), head=mm(19, 23), height=mm(95, 120))),
    (toys.chess_rook, dict(base=mm(32, 37), top=mm(25, 30), height=mm(90, 115))),
    (toys.trophy, dict(base=mm(58, 68), cup=mm(32, 38), height=mm(140, 170))),
    (garden.watering_can, dict(radius=mm(38, 45), height=mm(80, 95), spout=mm(62, 76))),
    (home.iron, dict(length=mm(150, 175), width=mm(76, 88), height=mm(84, 98))),
    (home.camera, dict(width=mm(104, 122), height=mm(66, 78), depth=mm(38, 46), lens=mm(25, 29))),
    (home.hourglass, dict(radius=mm(36, 42), waist=mm(5.5, 7.5), height=mm(110, 140))),
    (garden.padlock, dict(width=mm(62, 74), height=mm(54, 64), depth=mm(30, 38),
        shackle=mm(42, 54))),
    (garden.bucket, dict(top_radius=mm(44, 52), bottom_radius=mm(32, 38), height=mm(80, 100))),
    (toys.house, dict(width=mm(74, 90), depth=mm(62, 76), wall=mm(52, 66), roof=mm(36, 48))),
    (toys.toy_car, dict(length=mm(115, 135), width=mm(56, 64), wheel=mm(13, 16))),
    (toys.rocket, dict(radius=mm(23, 28), height=mm(135, 165), span=mm(42, 50))),
    (garden.mushroom, dict(cap=mm(38, 46), stalk=mm(16, 20), height=mm(75, 95))),
    (garden.pumpkin, dict(radius=mm(42, 50), height=mm(62, 76), ribs=pieces(9, 12))),
    (garden.cactus, dict(pot=mm(34, 40), radius=mm(19, 23), height=mm(130, 155))),
    (toys.dice, dict(size=mm(58, 72), pip=mm(5, 6))),
    (toys.bowling_pin, dict(radius=mm(28, 33), height=mm(140, 175))),
    (garden.mallet, dict(length=mm(170, 200), head_length=mm(86, 104), radius=mm(25, 30))),
    (garden.barrel, dict(radius=mm(30, 36), bulge=mm(6, 10), height=mm(85, 105))),
    (kitchen.soap_dispenser, dict(width=mm(62, 74), depth=mm(44, 52), height=mm(135, 160))),
    (home.alarm_clock, dict(radius=mm(36, 43), depth=mm(36, 44))),
    (garden.traffic_cone, dict(base=mm(84, 100), radius=mm(30, 35), height=mm(115, 145))),
)
# fmt: on

#: Every class, by number.
CLASSES: tuple[ObjectClass, ...] = tuple(
    ObjectClass(number=number, shape=shape, parameters=parameters)
    for number, (shape, parameters) in enumerate(_ROWS, start=1)
)


@dataclass(frozen=True, kw_only=True)
class BuiltinObject:
    """One drawn object.

    Attributes:
        object_class: Class of the object.
        index: Number of the object among the objects of the class, from 1.
        seed: Seed of the draw.
    """

    object_class: ObjectClass
    index: int
    seed: int = 0

    @property
    def name(self) -> str:
        """The name of the object and the stem of its file, such as "1_mug_2"."""
        return f"{self.object_class.number}_{self.object_class.name}_{self.index}"

    @property
    def sizes(self) -> dict[str, float | int]:
        """The drawn parameters by name: lengths in [m], angles in [rad]."""
        stream = Stream(self.seed, object_key(self.object_class.name), self.index)
        return {name: span.draw(stream) for name, span in self.object_class.parameters.items()}

    def build(self) -> trimesh.Trimesh:
        """Return the mesh [m], standing on z = 0, z up."""
        return self.object_class.shape(**self.sizes)


def draw_builtin(config: BuiltinConfig | None = None) -> list[BuiltinObject]:
    """Return the built-in objects of a configuration, class by class; the default's if None."""
    config = config or BuiltinConfig()
    return [
        BuiltinObject(object_class=object_class, index=index, seed=config.seed)
        for object_class in CLASSES
        for index in range(1, config.per_class + 1)
    ]


def builtin_object(name: str, *, seed: int = 0) -> BuiltinObject:
    """Return the built-in object with a name such as "1_mug_2".

    Raises:
        MeshError: If there is no such class; the message lists the classes.
    """
    index = name.rpartition("_")[2]
    for object_class in CLASSES:
        number = int(index) if index.isdecimal() else 0
        item = BuiltinObject(object_class=object_class, index=number, seed=seed)
        if number >= 1 and item.name == name:
            return item
    stems = ", ".join(f"{c.number}_{c.name}" for c in CLASSES)
    raise MeshError(
        f"a built-in object must be a class and a number from 1, e.g. 1_mug_2, got {name!r}; "
        f"the classes: {stems}"
    )


def export_builtin(
    directory: str | os.PathLike[str],
    names: Iterable[str] | None = None,
    *,
    config: BuiltinConfig | None = None,
    progress: Report = silent,
) -> list[Path]:
    """Write built-in objects as `<name>.obj` and return the paths, in the requested order.

    A file appears completely or not at all, and has the same bytes every time.

    Args:
        directory: Directory to write to; created if it is missing.
        names: Names of the objects; all objects of the configuration by default.
        config: Number of objects of each class, and the seed of their sizes; the defaults if None.
        progress: Called with the number of written meshes and the number of all meshes.

    Raises:
        MeshError: If a name is unknown; then nothing is written.
    """
    # Look up all names before anything is written.
    config = config or BuiltinConfig()
    if names is None:
        chosen = draw_builtin(config)
    else:
        chosen = [builtin_object(name, seed=config.seed) for name in names]
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)

    paths = []
    for item in chosen:
        path = folder / f"{item.name}.obj"
        write_atomic(path, wavefront(item.build()))
        paths.append(path)
        progress(len(paths), len(chosen))
    return paths


def builtin_sources(
    folder: str | os.PathLike[str],
    config: BuiltinConfig,
    progress: Report = silent,
    only: Collection[str] = (),
) -> list[MeshSource]:
    """Return the built-in objects as meshes in a folder, which is created, sorted by name.

    Args:
        folder: The folder.
        config: Number of objects of each class, and the seed of their sizes.
        progress: Called with the number of written meshes and the number of all meshes.
        only: Names of the objects; all objects of the configuration if empty.
    """
    names = sorted(set(only)) or None
    paths = export_builtin(folder, names, config=config, progress=progress)
    sources = [replace(find_mesh(path), licence=LICENCE) for path in paths]
    return sorted(sources, key=lambda source: source.name)


def wavefront(mesh: trimesh.Trimesh) -> bytes:
    """Return a mesh as Wavefront text; trimesh's own text may differ between its releases."""
    d = DECIMALS
    lines = [f"v {x:.{d}f} {y:.{d}f} {z:.{d}f}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.faces + 1).tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")
