"""The end of a running build: where the bar says that it is."""

from __future__ import annotations

from typing import Any

import pytest
from helpers.entries import object_entry

from drakegrasp.dataset.manifest import Manifest
from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.generation.extrapolation import Extrapolation
from drakegrasp.hand.settings import load_config

#: Palm poses of each unit and of each object, and attempts of a palm pose.
UNIT, POSES, STANDOFFS = 10, 1000, 3


class Build:
    """A build whose units end as the test says."""

    def __init__(self, *names: str, **ends: Any) -> None:
        config = load_config(**ends)
        assert len(config.candidates.standoffs) == STANDOFFS
        objects = tuple(object_entry(name, candidates=POSES) for name in names)
        self._of = Extrapolation(Manifest(config=config, objects=objects, versions={}))
        self._units = dict.fromkeys(names, 0)

    def end(self, name: str, *found: int) -> None:
        """End the next units of an object, with this many samples in each."""
        for samples in found:
            start = UNIT * self._units[name]
            self._units[name] += 1
            unit = ShardHeader(
                config_hash="c",
                mesh_sha256="m",
                object_name=name,
                start=start,
                stop=start + UNIT,
            )
            self._of.add(unit, STANDOFFS * UNIT, samples)

    @property
    def units(self) -> float | None:
        """Number of units at the end."""
        total = self._of.total()
        return None if total is None else total / (STANDOFFS * UNIT)


def test_build_without_an_end_makes_all_attempts() -> None:
    build = Build("mug", "cup")
    assert build.units == 200
    build.end("mug", 5)
    assert build.units == 200


def test_other_numbers_of_attempts_per_palm_pose_go_on() -> None:
    of = Extrapolation(
        Manifest(config=load_config(), objects=(object_entry("mug", candidates=30),), versions={})
    )
    of.add(ShardHeader(config_hash="c", mesh_sha256="m", object_name="mug", start=0, stop=10), 7, 0)
    assert of.total() == 21


@pytest.mark.parametrize("ends", [{"samples": 40}, {"samples_per_object": 20}])
def test_target_has_no_end_before_each_object_was_tried(ends: dict[str, int]) -> None:
    """The mug yields two in a unit and the cup four: ten units of one and five of the other."""
    build = Build("mug", "cup", **ends)
    assert build.units is None
    build.end("mug", 2, 2)
    assert build.units is None
    build.end("cup", 4)
    assert build.units == 15
    build.end("cup", *[4] * 4)
    build.end("mug", *[2] * 8)
    assert build.units == 15


def test_object_with_more_than_its_share_leaves_less_for_the_others() -> None:
    """Three are missing: one unit and a half of the cup, and not five of a share of ten."""
    build = Build("mug", "cup", samples=20)
    build.end("mug", 15)
    build.end("cup", 2)
    assert build.units == 2 + 1.5


def test_object_without_samples_costs_the_patience() -> None:
    """Forty palm poses of the bowl, of which ten are tried; the mug yields the whole target."""
    build = Build("mug", "bowl", samples=20, samples_patience=40)
    build.end("mug", 4)
    build.end("bowl", 0)
    assert build.units == 5 + 4
    build.end("bowl", 0, 0, 0)
    assert build.units == 5 + 4


def test_object_that_is_given_up_leaves_its_share_to_the_others() -> None:
    build = Build("mug", "bowl", samples=20, samples_patience=20)
    build.end("mug", 2)
    build.end("bowl", 2, 0, 0)
    assert build.units == 9 + 3


def test_no_object_is_tried_beyond_its_palm_poses() -> None:
    build = Build("mug", samples=10_000)
    build.end("mug", 1)
    assert build.units == 100


def test_target_that_is_met_needs_no_more() -> None:
    build = Build("mug", "cup", samples=3)
    build.end("mug", 3)
    build.end("cup", 0)
    assert build.units == 2


def test_first_of_two_ends_counts() -> None:
    """Two of each object are there before fifty in all, and two in all before fifty of each."""
    for ends in (
        {"samples": 50, "samples_per_object": 2},
        {"samples": 2, "samples_per_object": 50},
    ):
        build = Build("mug", "cup", **ends)
        build.end("mug", 1)
        build.end("cup", 1)
        assert build.units == (4 if ends["samples"] == 50 else 2)


def test_objects_that_were_not_tried_take_as_long_as_the_others() -> None:
    """Units of `max_grasps` run object by object, so most objects have no attempt for long."""
    build = Build("mug", "cup", "jug", "bowl", max_grasps=4)
    assert build.units == 400
    build.end("mug", 2)
    assert build.units == 4 * 2
    build.end("mug", 2)
    build.end("cup", 1)
    assert build.units == 2 + 4 + 2 * 3
    build.end("jug", 0)
    assert build.units == pytest.approx(2 + 4 + 100 + 106 / 3, abs=0.1)
