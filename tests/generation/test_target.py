"""A target of samples: even shares, exhausted objects, and what a larger one adds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pytest

from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.generation.target import Target
from drakegrasp.hand.settings import load_config

#: Palm poses in a unit, and in all; palm poses without a hit after which an object is given up.
UNIT, PALMS, PATIENCE = 4, 400, 60
#: The palm poses of the hits of each object: many, one in ten, none, and few before it ends.
HITS: dict[str, Sequence[int]] = {
    "rich": range(PALMS),
    "poor": range(5, PALMS, 10),
    "barren": range(0),
    "short": (1, 2, 7),
}
#: Others: two that are given up before their last hits, one of them at a hit, and one with three
#: hits at a palm pose.
ODD: dict[str, Sequence[int]] = {
    "late": (3, 4, 70, 71, 72),
    "later": (0, 61, 100),
    "triple": sorted(3 * [*range(2, PALMS, 5)]),
}
EVERY = {**HITS, **ODD}
#: The number of palm poses of each object; the samplers of one have no more.
DRAWN = {**dict.fromkeys(EVERY, PALMS), "short": 10}


def units(name: str, palms: int) -> list[ShardHeader]:
    return [
        ShardHeader(
            config_hash="c",
            mesh_sha256="m",
            object_name=name,
            start=start,
            stop=min(start + UNIT, palms),
        )
        for start in range(0, palms, UNIT)
    ]


def make_target(floors: Mapping[str, int] | None = None, **ends: int) -> Target:
    config = load_config(**{"samples_patience": PATIENCE, **ends})
    target = Target(config, floors or dict.fromkeys(HITS, 0))
    for name in floors or HITS:
        target.set_units(name, units(name, DRAWN[name]), endless=False)
    # What the dataset has is counted first.
    for name, palms in (floors or {}).items():
        for unit in units(name, -(-palms // UNIT) * UNIT):
            end(target, unit)
    return target


def end(target: Target, unit: ShardHeader) -> None:
    target.add(unit, [h for h in EVERY[unit.object_name] if unit.start <= h < unit.stop])


def run(target: Target, workers: int = 1) -> dict[str, int]:
    """Run a target as a build does; return the palm poses that the dataset takes."""
    while None in (taken := target.taken()).values():
        running: list[ShardHeader] = []
        for unit in target.next_units():
            running.append(unit)
            if len(running) >= workers:
                end(target, running.pop())  # the last that began ends first
        for unit in running:
            end(target, unit)
    return {name: palms for name, palms in taken.items() if palms is not None}


def samples(taken: Mapping[str, int]) -> dict[str, int]:
    return {name: sum(hit < palms for hit in EVERY[name]) for name, palms in taken.items()}


@pytest.mark.parametrize("wanted", [1, 2, 3, 7, 40])
def test_number_that_was_asked_for_is_the_number(wanted: int) -> None:
    found = samples(run(make_target(samples=wanted)))
    assert sum(found.values()) == wanted
    # Three objects can contribute, one of them three at most.
    assert found["barren"] == 0
    assert found["rich"] - found["poor"] in (0, 1)
    assert found["short"] == 3 or abs(found["short"] - found["poor"]) <= 1


def test_object_that_has_its_samples_gets_no_more_units() -> None:
    target, begun = make_target(samples_per_object=2 * UNIT), list[str]()
    while None in target.taken().values():
        for unit in target.next_units():
            begun.append(unit.object_name)
            end(target, unit)
    assert begun.count("rich") == 2
    assert begun.count("barren") == PATIENCE // UNIT


@pytest.mark.parametrize("ends", [{"samples_per_object": 4}, {"samples": 40}])
@pytest.mark.parametrize("workers", [3, 30])
def test_result_does_not_depend_on_units_that_were_run_in_vain(
    ends: dict[str, int], workers: int
) -> None:
    """Hits after an object was given up count as little as if nobody had found them."""
    floors = dict.fromkeys(EVERY, 0)
    alone = run(make_target(floors, **ends))
    assert run(make_target(floors, **ends), workers) == alone
    assert (alone["late"], alone["later"]) == (65, 61)
    # A killed build had many workers, and the one that continues finds their units.
    again = make_target(floors, **ends)
    for name in EVERY:
        for unit in units(name, DRAWN[name])[::-1][::2]:
            end(again, unit)
    assert run(again) == alone


def test_each_object_has_the_number_of_each() -> None:
    target = make_target(samples_per_object=5)
    taken = run(target)
    assert samples(taken) == {"rich": 5, "poor": 5, "barren": 0, "short": 3}
    assert taken["barren"] == PATIENCE
    assert run(make_target(taken, samples_per_object=5)) == taken
    given_up, spent = target.warnings()
    assert "given up after 60 palm poses" in given_up
    assert "barren (0)" in given_up
    assert "all palm poses were tried" in spent
    assert "short (3)" in spent


@pytest.mark.parametrize("workers", [1, 3])
def test_unit_that_grows_is_run_again(workers: int) -> None:
    """A dataset of 10 palm poses ends within a unit of four: its last two are of no use."""
    target = Target(load_config(samples=4, samples_patience=PATIENCE), {"poor": 10})
    target.set_units("poor", units("poor", 8), endless=True)
    for unit in units("poor", 10):
        end(target, unit)
    assert target.taken() == {"poor": None}
    assert target.dry() == ["poor"]
    target.set_units("poor", units("poor", 20), endless=True)
    assert next((unit.start, unit.stop) for unit in target.next_units()) == (8, 12)
    end(target, units("poor", 20)[2])
    target.set_units("poor", units("poor", PALMS), endless=False)
    assert run(target, workers) == {"poor": 36}


def test_nothing_is_drawn_before_all_that_the_dataset_has_is_known() -> None:
    """While the samples of one object are not known, another one seems to need more."""
    target = Target(load_config(samples=12, samples_patience=PATIENCE), {"rich": 12, "poor": 0})
    for name in ("rich", "poor"):
        target.set_units(name, units(name, 12), endless=True)
    for unit in units("poor", 12):
        end(target, unit)
    assert target.dry() == []
    assert {unit.object_name for unit in target.next_units()} == {"rich"}
    for unit in units("rich", 12):
        end(target, unit)
    assert target.taken() == {"rich": 12, "poor": 0}


@pytest.mark.parametrize("wanted", [5, 8, 12])
def test_palm_poses_with_several_hits_are_counted_whole(wanted: int) -> None:
    """Each of eight objects has three hits at a palm pose, so each would exceed its share."""
    names = [f"triple {i}" for i in range(8)]
    target = Target(load_config(samples=wanted), dict.fromkeys(names, 0))
    for name in names:
        target.set_units(name, units(name, PALMS), endless=False)
    while None in target.taken().values():
        for unit in target.next_units():
            target.add(unit, [h for h in EVERY["triple"] if unit.start <= h < unit.stop])
    found = [sum(hit < palms for hit in EVERY["triple"]) for palms in target.taken().values()]
    assert wanted <= sum(found) <= wanted + 2
    assert max(found) <= 3


def test_target_that_cannot_be_met_is_told() -> None:
    target = make_target(samples=1000)
    run(target)
    assert target.warnings()[0] == "443 of 1,000 samples were found"


def test_samples_that_the_filter_of_outliers_removes_are_made_up_for() -> None:
    target = make_target(samples=12)
    run(target)
    assert target.lose({"rich": 2})
    found = samples(run(target))
    assert sum(found.values()) == 14
    assert not target.lose({"rich": 1})
