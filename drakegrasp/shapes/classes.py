"""The table of built-in classes: 64 everyday things, and the ranges of their sizes.

Each row of `CLASSES` is a function and, for each of its parameters, the range from which
`drakegrasp.shapes.catalog` draws. Nothing is drawn or built here.

Sizes are our own, chosen for a hand of the Barrett's size: it spans 0.24 m and its pads reach
about 0.11 m ahead of the palm. A class that a smaller hand needs otherwise is a row to copy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import trimesh

from drakegrasp.shapes import (
    animals,
    belongings,
    clothing,
    household,
    kitchenware,
    packaging,
    plants,
    tools,
    toys,
    vessels,
)
from drakegrasp.shapes.parameters import Range, deg, mm, pieces


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectClass:
    """A class of built-in objects.

    Attributes:
        number: Its place in the table, from 1.
        shape: Returns a mesh [m] for values of the parameters; its name is that of the class.
        parameters: Their ranges, by name.
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
        """What the shape is, in words."""
        return (self.shape.__doc__ or "").partition("\n")[0].removeprefix("Return ").rstrip(".")


# fmt: off
_ROWS: tuple[tuple[Callable[..., trimesh.Trimesh], dict[str, Range]], ...] = (
    (vessels.mug, dict(
        radius=mm(34, 42), height=mm(80, 102), handle_reach=mm(26, 34),
        handle_radius=mm(4.5, 6.5))),
    (packaging.bottle, dict(
        radius=mm(29, 40), height=mm(150, 210), neck_radius=mm(11, 16))),
    (vessels.bowl, dict(
        radius=mm(52, 70), height=mm(50, 68), foot_radius=mm(25, 34))),
    (vessels.wineglass, dict(
        foot_radius=mm(33, 38), stem_radius=mm(5.5, 7), belly_radius=mm(30, 42),
        rim_radius=mm(26, 34), height=mm(145, 180), stem_height=mm(60, 75))),
    (packaging.box, dict(
        width=mm(60, 100), depth=mm(45, 70), height=mm(60, 150))),
    (packaging.can, dict(
        radius=mm(32, 38), height=mm(75, 120))),
    (tools.hammer, dict(
        length=mm(115, 135), head_length=mm(95, 115), head_thickness=mm(42, 47))),
    (household.candlestick, dict(
        foot_radius=mm(43, 52), stem_radius=mm(10, 12.5), height=mm(120, 190))),
    (vessels.vase, dict(
        foot_radius=mm(31, 37), belly_radius=mm(42, 52), neck_radius=mm(20, 26),
        lip_radius=mm(29, 34), height=mm(130, 190))),
    (belongings.flashlight, dict(
        head_radius=mm(26, 34), body_radius=mm(15, 20), height=mm(120, 170),
        head_height=mm(28, 36))),
    (vessels.cup, dict(
        top_radius=mm(36, 43), bottom_radius=mm(26, 31), height=mm(85, 120))),
    (packaging.jar, dict(
        radius=mm(34, 43), height=mm(80, 125), lid_radius=mm(28, 34), lid_height=mm(14, 18))),
    (vessels.pitcher, dict(
        foot_radius=mm(36, 42), belly_radius=mm(44, 52), neck_radius=mm(31, 36),
        rim_radius=mm(36, 42), height=mm(120, 165), handle_reach=mm(21, 26),
        handle_radius=mm(6, 7), lip=mm(14, 18))),
    (vessels.funnel, dict(
        radius=mm(38, 46), spout_radius=mm(12, 15), cone_height=mm(58, 72), height=mm(110, 140))),
    (belongings.dumbbell, dict(
        length=mm(160, 200), head_width=mm(56, 76), head_length=mm(40, 52),
        grip_radius=mm(13.5, 16.5))),
    (packaging.spray_bottle, dict(
        width=mm(64, 84), depth=mm(46, 56), height=mm(170, 220))),
    (belongings.book, dict(
        width=mm(70, 88), length=mm(105, 130), thickness=mm(42, 56))),
    (plants.banana, dict(
        bend_radius=mm(105, 125), angle=deg(60, 72), thickness=mm(38, 43))),
    (vessels.saucepan, dict(
        radius=mm(48, 58), height=mm(55, 85), handle_length=mm(85, 100))),
    (plants.apple, dict(
        radius=mm(34, 42), height=mm(60, 70))),
    (plants.pear, dict(
        radius=mm(35, 38), neck_radius=mm(17, 20), height=mm(85, 105))),
    (clothing.hat, dict(
        brim=mm(56, 64), crown=mm(35, 42), height=mm(64, 85))),
    (kitchenware.toaster, dict(
        length=mm(115, 140), width=mm(66, 80), height=mm(80, 98))),
    (packaging.carton, dict(
        width=mm(54, 70), height=mm(85, 120), roof=mm(24, 32))),
    (household.watertap, dict(
        base=mm(36, 42), pipe=mm(8, 10), height=mm(140, 170), reach=mm(64, 80))),
    (packaging.towel_roll, dict(
        radius=mm(36, 46), height=mm(95, 125), core=mm(16, 20))),
    (kitchenware.coffeemaker, dict(
        width=mm(76, 90), depth=mm(104, 122), height=mm(130, 160))),
    (kitchenware.teapot, dict(
        radius=mm(44, 54), height=mm(80, 96), spout=mm(34, 42))),
    (tools.screwdriver, dict(
        handle=mm(88, 105), radius=mm(18, 22), shaft=mm(65, 85))),
    (household.knob, dict(
        rose=mm(32, 36), neck=mm(10, 12.5), radius=mm(26, 31), height=mm(60, 74))),
    (clothing.comb, dict(
        length=mm(115, 140), depth=mm(24, 30), spine=mm(24, 30), teeth=mm(30, 38),
        count=pieces(8, 11))),
    (clothing.shoe, dict(
        length=mm(140, 170), width=mm(58, 66), height=mm(62, 74))),
    (clothing.boot, dict(
        length=mm(115, 135), width=mm(52, 60), height=mm(115, 140))),
    (animals.bunny, dict(
        body=mm(32, 38), head=mm(22, 26), ear=mm(40, 52))),
    (animals.toy_dog, dict(
        length=mm(90, 110), height=mm(62, 74), girth=mm(20, 24))),
    (animals.snake, dict(
        coil=mm(34, 40), thickness=mm(26, 30), neck=mm(60, 76))),
    (animals.rubber_duck, dict(
        length=mm(88, 106), head=mm(23, 28))),
    (kitchenware.pepper_mill, dict(
        radius=mm(27, 32), waist=mm(15, 19), height=mm(120, 155))),
    (kitchenware.juicer, dict(
        radius=mm(48, 58), rim=mm(34, 42), cone=mm(58, 70))),
    (tools.garbage_bin, dict(
        width=mm(58, 70), height=mm(100, 125))),
    (household.lamp, dict(
        base=mm(38, 44), shade=mm(46, 54), height=mm(140, 170))),
    (household.bell, dict(
        radius=mm(38, 46), body=mm(58, 72), handle=mm(62, 78))),
    (toys.chess_pawn, dict(
        base=mm(30, 35), head=mm(19, 23), height=mm(95, 120))),
    (toys.chess_rook, dict(
        base=mm(32, 37), top=mm(25, 30), height=mm(90, 115))),
    (toys.trophy, dict(
        base=mm(58, 68), cup=mm(32, 38), height=mm(140, 170))),
    (tools.watering_can, dict(
        radius=mm(38, 45), height=mm(80, 95), spout=mm(62, 76))),
    (household.iron, dict(
        length=mm(150, 175), width=mm(76, 88), height=mm(84, 98))),
    (belongings.camera, dict(
        width=mm(104, 122), height=mm(66, 78), depth=mm(38, 46), lens=mm(25, 29))),
    (household.hourglass, dict(
        radius=mm(36, 42), waist=mm(5.5, 7.5), height=mm(110, 140))),
    (tools.padlock, dict(
        width=mm(62, 74), height=mm(54, 64), depth=mm(30, 38), shackle=mm(42, 54))),
    (tools.bucket, dict(
        top_radius=mm(44, 52), bottom_radius=mm(32, 38), height=mm(80, 100))),
    (toys.house, dict(
        width=mm(74, 90), depth=mm(62, 76), wall=mm(52, 66), roof=mm(36, 48))),
    (toys.toy_car, dict(
        length=mm(115, 135), width=mm(56, 64), wheel=mm(13, 16))),
    (toys.rocket, dict(
        radius=mm(23, 28), height=mm(135, 165), span=mm(42, 50))),
    (plants.mushroom, dict(
        cap=mm(38, 46), stalk=mm(16, 20), height=mm(75, 95))),
    (plants.pumpkin, dict(
        radius=mm(42, 50), height=mm(62, 76), ribs=pieces(9, 12))),
    (plants.cactus, dict(
        pot=mm(34, 40), radius=mm(19, 23), height=mm(130, 155))),
    (toys.dice, dict(
        size=mm(58, 72), pip=mm(5, 6))),
    (toys.bowling_pin, dict(
        radius=mm(28, 33), height=mm(140, 175))),
    (tools.mallet, dict(
        length=mm(170, 200), head_length=mm(86, 104), radius=mm(25, 30))),
    (tools.barrel, dict(
        radius=mm(30, 36), bulge=mm(6, 10), height=mm(85, 105))),
    (packaging.soap_dispenser, dict(
        width=mm(62, 74), depth=mm(44, 52), height=mm(135, 160))),
    (belongings.alarm_clock, dict(
        radius=mm(36, 43), depth=mm(36, 44))),
    (tools.traffic_cone, dict(
        base=mm(84, 100), radius=mm(30, 35), height=mm(115, 145))),
)
# fmt: on

#: Every class, by number.
CLASSES: tuple[ObjectClass, ...] = tuple(
    ObjectClass(number=number, shape=shape, parameters=parameters)
    for number, (shape, parameters) in enumerate(_ROWS, start=1)
)
