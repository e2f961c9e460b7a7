"""Filters on made-up successes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.successes import good, judge

from drakegrasp.config import FilterConfig
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.dataset.successes import read_summary
from drakegrasp.filters import NEEDED, Removal


def test_first_reason_counts() -> None:
    bad = good(3).with_columns(seen=np.zeros(3, bool), depth_variance=np.zeros(3))
    assert np.all(judge(bad, FilterConfig(), rejected=[0, 3, 6]) == Removal.NOT_SEEN)
    worse = bad.with_columns(slip=np.ones(3), turn=np.ones(3), normal_angle=np.ones(3))
    assert np.all(judge(worse, FilterConfig()) == Removal.SLID)
    worst = worse.with_columns(other_links=np.ones(3, np.uint8))
    assert np.all(judge(worst, FilterConfig()) == Removal.OTHER_LINKS)
    nothing = worst.with_columns(complete=np.zeros(3, bool), grasp_T=np.full((3, 18), np.nan))
    assert np.all(judge(nothing, FilterConfig()) == Removal.MISSING_FINGER)


@pytest.mark.parametrize(
    ("settings", "field", "kept", "removed", "reason"),
    [
        ({}, "complete", True, False, Removal.MISSING_FINGER),
        ({}, "seen", True, False, Removal.NOT_SEEN),
        ({}, "in_view", True, False, Removal.OUT_OF_VIEW),
        ({}, "camera_height", 0.011, 0.009, Removal.BISECTS_TABLE),
        ({}, "camera_height", 0.011, -0.2, Removal.BISECTS_TABLE),
        ({"min_camera_height": 0.2}, "camera_height", 0.2, 0.199, Removal.BISECTS_TABLE),
        ({}, "depth_variance", 1.01e-3, 0.99e-3, Removal.FLAT_DEPTH),
        ({"min_depth_variance": 0.005}, "depth_variance", 0.005, 0.0049, Removal.FLAT_DEPTH),
        ({}, "surface_distance", 1.9e-3, 2.1e-3, Removal.OFF_SURFACE),
        ({"max_surface_distance": 5e-3}, "surface_distance", 5e-3, 5.1e-3, Removal.OFF_SURFACE),
        ({"max_surface_distance": 5e-4}, "surface_distance", 4e-4, 6e-4, Removal.OFF_SURFACE),
        ({}, "normal_angle", np.deg2rad(29.0), np.deg2rad(31.0), Removal.NORMAL_OFF),
        ({"max_normal_angle_deg": 50.0}, "normal_angle", 0.87, 0.88, Removal.NORMAL_OFF),
        ({}, "other_links", 0, 1, Removal.OTHER_LINKS),
        ({"other_links": 3}, "other_links", 3, 4, Removal.OTHER_LINKS),
        ({}, "slip", 0.0099, 0.0101, Removal.SLID),
        ({}, "slip", 0.0, np.nan, Removal.SLID),
        ({"max_slip": 0.02}, "slip", 0.02, 0.0201, Removal.SLID),
        ({}, "turn", np.deg2rad(9.9), np.deg2rad(10.1), Removal.TURNED),
        ({"max_turn_deg": 50.0}, "turn", 0.87, 0.88, Removal.TURNED),
        ({}, "anomaly", 0.1, 0.3, Removal.KEPT),
        ({"max_anomaly": 0.25}, "anomaly", 0.25, 0.3, Removal.ANOMALOUS),
        ({"max_anomaly": 0.2}, "anomaly", 0.1, np.nan, Removal.ANOMALOUS),
        ({"max_penetration": 0.2}, "penetration", 0.1, 0.3, Removal.ANOMALOUS),
        ({"max_imbalance": 0.2}, "imbalance", 0.1, 0.3, Removal.ANOMALOUS),
        ({"max_normal_sum": 0.2}, "normal_sum", 0.1, 0.3, Removal.ANOMALOUS),
        # Null switches a limit off.
        ({"other_links": None}, "other_links", 0, 5, Removal.KEPT),
        ({"max_slip": None}, "slip", 0.0, 0.5, Removal.KEPT),
        ({"max_turn_deg": None}, "turn", 0.0, 3.0, Removal.KEPT),
        ({"max_normal_angle_deg": None}, "normal_angle", 0.0, 3.0, Removal.KEPT),
        # A lift asks nothing of the hold, and the same of the contacts.
        ({"require": "lifted"}, "other_links", 0, 4, Removal.KEPT),
        ({"require": "lifted"}, "slip", 0.0, 1.0, Removal.KEPT),
        ({"require": "lifted"}, "turn", 0.0, 3.0, Removal.KEPT),
        ({"require": "lifted"}, "normal_angle", 0.0, 1.0, Removal.NORMAL_OFF),
    ],
)
def test_each_limit_is_the_configured_one(
    settings: dict[str, Any], field: str, kept: float, removed: float, reason: Removal
) -> None:
    """Values of which the usual limit would judge at least one otherwise, if another is set.

    A value at the limit is kept.
    """
    values = np.array([kept, removed, kept], dtype=good(3)[field].dtype)
    found = judge(good(3).with_columns(**{field: values}), FilterConfig(**settings))
    assert found.tolist() == [Removal.KEPT, reason, Removal.KEPT]


@pytest.mark.parametrize(("sigma", "outlier"), [(0.0, False), (4.35, True), (4.37, False)])
def test_outliers_are_beyond_the_configured_number_of_deviations(
    sigma: float, outlier: bool
) -> None:
    """One of twenty is sqrt(19), some 4.36 deviations from the mean."""
    grasps = np.zeros((20, 18))
    grasps[7, 3] = 1.0
    removal = judge(good(20).with_columns(grasp_T=grasps), FilterConfig(outlier_sigma=sigma))
    assert np.flatnonzero(removal == Removal.OUTLIER).tolist() == ([7] if outlier else [])


def test_outliers_are_judged_among_the_grasps_that_are_left() -> None:
    """Far ones that another filter removes do not widen the deviation."""
    grasps, slip = np.zeros((40, 18)), np.zeros(40)
    grasps[7, 3] = 1.0
    grasps[20:, 3], slip[20:] = np.linspace(-50.0, 50.0, 20), 1.0
    removal = judge(good(40).with_columns(grasp_T=grasps, slip=slip), FilterConfig())
    assert removal[7] == Removal.OUTLIER
    assert np.all(removal[20:] == Removal.SLID)
    assert np.count_nonzero(removal == Removal.KEPT) == 19


def test_numbers_of_removals_are_those_in_files() -> None:
    """Files of earlier builds have them: a new one comes at the end."""
    names = "kept other_links slid turned not_seen out_of_view bisects_table flat_depth "
    names += "off_surface normal_off outlier rejected anomalous missing_finger - own near_cone "
    names += "unreachable"
    known = [(value, name) for value, name in enumerate(names.split()) if name != "-"]
    assert [(r.value, r.label) for r in Removal] == known


@pytest.mark.parametrize("name", ["grasp_T", "lifted_O"])
def test_normal_of_opposed_patches_is_off_the_surface(name: str) -> None:
    """Its length is zero, so that it has no direction: neither grasp of a sample may have one."""
    grasps = good(3).grasp_T.copy()
    grasps[1, 12] = np.nan
    removal = judge(good(3).with_columns(**{name: grasps}), FilterConfig())
    assert removal.tolist() == [Removal.KEPT, Removal.OFF_SURFACE, Removal.KEPT]


def test_outlier_is_judged_by_its_own_objects_population() -> None:
    """A value that is common for one object is far out for the other."""
    successes = good(200)
    grasps = successes.grasp_T.copy()
    objects = np.repeat([0, 1], 100).astype(np.int32)
    grasps[100:] += 50.0
    grasps[5, 17] = 50.0
    removal = judge(successes.with_columns(object=objects, grasp_T=grasps), FilterConfig())
    assert np.flatnonzero(removal == Removal.OUTLIER).tolist() == [5]


def test_no_finger_that_is_used_may_come_near_its_cone() -> None:
    use = np.array([[0.2, 0.9, 0.3], [0.2, 0.7, 0.3], [np.nan, 0.2, 0.2], [np.nan, 0.2, 0.2]])
    unused = np.zeros((4, 3), dtype=bool)
    unused[3, 0] = True
    successes = good(4).with_columns(slip_use=use, unused=unused)
    assert np.all(judge(successes, FilterConfig()) == Removal.KEPT)
    removal = judge(successes, FilterConfig(max_slip_use=0.8))
    assert removal.tolist() == [Removal.NEAR_CONE, Removal.KEPT, Removal.NEAR_CONE, Removal.KEPT]


def test_successes_have_every_column_that_a_filter_needs(sound: Path) -> None:
    """A filter without its column would be left out without a word."""
    manifest = read_manifest(sound)
    summary = read_summary(sound, next(manifest.headers()), manifest.config)
    assert {*NEEDED} <= {*summary.successes.names}
