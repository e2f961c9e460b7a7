"""Which successes become samples: the limits, the reasons, and the filters themselves.

A `Filter` has the columns that it needs, and tells the rows that it rejects. A new filter is one
entry in `FILTERS`, with its reason in `Removal` and its limit in `LIMITS`; the configuration, the
writer, verdicts, `check` and the docs follow. A filter removes a grasp from the two data files, but
never from trials.hdf5. A removal has one reason: the first filter that rejects the grasp. The
filters of images and contacts are the paper's (Veres et al., "Postprocessing"); the filters of the
hold are our own.

All functions are pure functions of arrays. The module imports only NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from drakegrasp.arithmetic import Array
from drakegrasp.table import Table

Flags = npt.NDArray[np.bool_]


class Removal(IntEnum):
    """Why a success is not a sample, in the order of the filters except for the last ones."""

    KEPT = 0
    OTHER_LINKS = 1  # links that are not fingertips touch the object after the lift
    SLID = 2  # the object moved too far in the hand
    TURNED = 3  # the object turned too far in the hand
    NOT_SEEN = 4  # the object is missing in an image
    OUT_OF_VIEW = 5  # a contact point lies outside of an image
    BISECTS_TABLE = 6  # the camera is at the table's height or below
    FLAT_DEPTH = 7  # the otm depth image varies too little
    OFF_SURFACE = 8  # a contact's centre is off the surface: its patches span an edge
    NORMAL_OFF = 9  # a contact's mean normal is not that of the surface: its patches span an edge
    OUTLIER = 10  # a component of the grasp is too far from the mean of its object's grasps
    REJECTED = 11  # an inspection rejected it; the last of the filters
    # Values are stored in files: a later filter has the next number, which is not its place.
    ANOMALOUS = 12  # the anomaly score or a part of it is too high; before OUTLIER
    MISSING_FINGER = 13  # a fingertip that is not required does not touch; the first filter
    OWN = 15  # a user-defined filter does not keep it; before OUTLIER
    NEAR_CONE = 16  # a fingertip uses too much of its friction cone; before OUTLIER
    UNREACHABLE = 17  # the arm of `filters.reachable` does not reach it; before REJECTED

    @property
    def label(self) -> str:
        """The name as written in tables."""
        return self.name.lower()


@dataclass(frozen=True)
class Limit:
    """A setting of the filters: `filters.NAME` of a configuration.

    Attributes:
        default: Value if a configuration gives none.
        kind: Kind of numbers that are allowed.
        meaning: What the setting limits, with its unit.
        off: Value that switches the filter off, if there is one.
    """

    default: float | None
    kind: Literal["number", "positive", "not negative", "count"]
    meaning: str
    off: Literal["", "null", "zero"] = ""


#: The settings of the filters; those of the hold are own choices, see docs/reference/outcomes.md.
LIMITS = {
    "max_slip": Limit(
        0.010, "positive", "motion of the object in the hand in the lift [m]", "null"
    ),
    "max_turn_deg": Limit(10.0, "positive", "turn of the object in the hand in the lift", "null"),
    "other_links": Limit(0, "count", "links that touch the object after the lift", "null"),
    "min_depth_variance": Limit(
        1e-3,
        "not negative",
        "variance of an otm depth image [m^2]; flatter ones are removed",
        "zero",
    ),
    "min_camera_height": Limit(
        0.01,
        "number",
        "height of the camera above the table [m]; from below it sees the table edge-on",
    ),
    "outlier_sigma": Limit(
        4.0, "not negative", "standard deviations, per object and component of the grasp", "zero"
    ),
    "max_surface_distance": Limit(
        2e-3, "positive", "distance of a contact point from the object's surface [m]"
    ),
    # The paper removed such grasps by eye.
    "max_normal_angle_deg": Limit(
        30.0,
        "positive",
        "angle between a contact's mean normal and the object's nearest face",
        "null",
    ),
    # As thresholds, the score and its parts would also remove good grasps, so they are off.
    "max_anomaly": Limit(None, "positive", "score of dataset/quality.py", "null"),
    "max_penetration": Limit(
        None, "positive", "penetration of the object in a fingertip [m]", "null"
    ),
    "max_imbalance": Limit(
        None, "positive", "imbalance of the fingertips' forces, as a fraction of the weight", "null"
    ),
    "max_normal_sum": Limit(
        None, "positive", "sum of the contact normals, per finger: 0 balanced, 1 not", "null"
    ),
    "max_slip_use": Limit(
        None, "positive", "fraction of its friction cone that a fingertip uses", "null"
    ),
}


class Limits(Protocol):
    """Values of `LIMITS` by their names: the section `filters` of a configuration."""

    @property
    def require(self) -> str:
        """`lifted` switches the filters of the hold off."""

    def __getattr__(self, name: str) -> Any: ...


@dataclass(frozen=True, kw_only=True)
class Filter:
    """A filter.

    Attributes:
        removal: Reason of its removals.
        needs: Names of the columns that it uses; it is not applied to a table without one of them.
        refuses: Given a table of n rows and the limits, returns the rows (n,) that it rejects.
        limit: Name of the limit that can switch it off; empty if it is always on.
        of_hold: Whether it judges the hold; `require: lifted` switches such filters off.
    """

    removal: Removal
    needs: tuple[str, ...]
    refuses: Callable[[Table, Limits], Flags]
    limit: str = ""
    of_hold: bool = False

    def is_on(self, limits: Limits) -> bool:
        """Return whether the limits switch the filter on."""
        if self.of_hold and limits.require == "lifted":
            return False
        if not self.limit:
            return True
        value = getattr(limits, self.limit)
        return not (value == 0.0 if LIMITS[self.limit].off == "zero" else value is None)


def at_most(
    removal: Removal,
    column: str,
    limit: str,
    *,
    scale: float = 1.0,
    of_hold: bool = False,
    by_finger: bool = False,
) -> Filter:
    """Return the filter that a value, times `scale`, is at most a limit; it rejects NaN.

    With `by_finger`, the value is a number per finger (n, k), and that of each used finger counts.
    """

    def refuses(t: Table, limits: Limits) -> Flags:
        above: Flags = ~(scale * t[column] <= getattr(limits, limit))
        return np.any(above & ~t["unused"], axis=1) if by_finger else above

    needs = (column, "unused") if by_finger else (column,)
    return Filter(removal=removal, needs=needs, refuses=refuses, limit=limit, of_hold=of_hold)


def _not_finite(column: str) -> Filter:
    """Return the filter that each contact of a used finger has a finite point and normal."""

    def refuses(t: Table, limits: Limits) -> Flags:
        # The contact of an unused finger is NaN. The mean normal of opposed patches has length
        # zero, so the normalised one is NaN.
        unused = np.tile(np.repeat(t["unused"], 3, axis=1), 2)
        return np.asarray(~(np.isfinite(t[column]) | unused).all(axis=1))

    return Filter(removal=Removal.OFF_SURFACE, needs=(column, "unused"), refuses=refuses)


def _unless(removal: Removal, column: str) -> Filter:
    """Return the filter that a flag is set."""
    return Filter(removal=removal, needs=(column,), refuses=lambda t, limits: ~t[column])


#: All filters that judge a success on its own, in their order: the first that rejects it counts.
#: The columns are those of `dataset.successes`.
FILTERS = (
    # A grasp vector has a contact for every finger that its preshape uses.
    _unless(Removal.MISSING_FINGER, "complete"),
    at_most(Removal.OTHER_LINKS, "other_links", "other_links", of_hold=True),
    at_most(Removal.SLID, "slip", "max_slip", of_hold=True),
    at_most(Removal.TURNED, "turn", "max_turn_deg", scale=180.0 / np.pi, of_hold=True),
    _unless(Removal.NOT_SEEN, "seen"),
    _unless(Removal.OUT_OF_VIEW, "in_view"),
    Filter(
        removal=Removal.BISECTS_TABLE,
        needs=("camera_height",),
        refuses=lambda t, limits: t["camera_height"] < limits.min_camera_height,
    ),
    Filter(
        removal=Removal.FLAT_DEPTH,
        needs=("depth_variance",),
        refuses=lambda t, limits: t["depth_variance"] < limits.min_depth_variance,
        limit="min_depth_variance",
    ),
    _not_finite("grasp_T"),
    _not_finite("lifted_O"),
    at_most(Removal.OFF_SURFACE, "surface_distance", "max_surface_distance"),
    at_most(Removal.NORMAL_OFF, "normal_angle", "max_normal_angle_deg", scale=180.0 / np.pi),
    at_most(Removal.ANOMALOUS, "anomaly", "max_anomaly"),
    at_most(Removal.ANOMALOUS, "penetration", "max_penetration"),
    at_most(Removal.ANOMALOUS, "imbalance", "max_imbalance"),
    at_most(Removal.ANOMALOUS, "normal_sum", "max_normal_sum"),
    at_most(Removal.NEAR_CONE, "slip_use", "max_slip_use", by_finger=True),
)
#: The columns that the filters use.
NEEDED = tuple(dict.fromkeys(name for each in FILTERS for name in each.needs))


def first_removal(
    t: Table, limits: Limits, filters: Sequence[Filter] = FILTERS
) -> npt.NDArray[np.uint8]:
    """Return the reason of the first filter that rejects each row, `KEPT` (n,) if no filter does.

    A filter is left out if it is off or the table lacks one of its columns.
    """
    removal = np.full(t.count, Removal.KEPT, dtype=np.uint8)
    for each in filters:
        if each.is_on(limits) and t.has(*each.needs):
            removal[each.refuses(t, limits) & (removal == Removal.KEPT)] = each.removal
    return removal


def is_outlier(values: Array, sigma: float) -> Flags:
    """Return for rows (n, d) whether a component is more than sigma deviations from its mean.

    Among n values, none is more than sqrt(n - 1) deviations from the mean (Samuelson's inequality).
    So the paper's 4 sigma removes nothing from objects with fewer than 18 grasps.
    """
    deviation = values.std(axis=0)
    return np.asarray(np.any(np.abs(values - values.mean(axis=0)) > sigma * deviation, axis=1))
