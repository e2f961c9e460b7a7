"""Parameters of the built-in classes: a range comes in, a drawn value goes out.

A value is a whole number of steps of its range, e.g. of 0.1 mm, so a draw is equal on every
machine. Ranges are inert; `drakegrasp.shapes.classes` has the table of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drakegrasp.seeding import Stream

#: Steps per unit: lengths in 0.1 mm, angles in 0.1 degrees, and whole numbers.
_STEPS = {"mm": 10, "deg": 10, "-": 1}


@dataclass(frozen=True, kw_only=True)
class Range:
    """From where to where a parameter is drawn, both ends included.

    Attributes:
        low, high: In `unit`.
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


def mm(low: float, high: float) -> Range:
    """Return the range of a length, in [mm]."""
    return Range(low=low, high=high, unit="mm")


def deg(low: float, high: float) -> Range:
    """Return the range of an angle, in [deg]."""
    return Range(low=low, high=high, unit="deg")


def pieces(low: int, high: int) -> Range:
    """Return the range of a number of pieces."""
    return Range(low=low, high=high, unit="-")
