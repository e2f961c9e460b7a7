"""A target of samples: its rounds, its shares, and what a larger one adds."""

from __future__ import annotations

from itertools import pairwise

import pytest

from drakegrasp.dataset.shards import ShardHeader
from drakegrasp.errors import ConfigError
from drakegrasp.generation.counts import Target, refuse_two_ends
from drakegrasp.hand.settings import load_config


def units(name: str, count: int) -> list[ShardHeader]:
    return [
        ShardHeader(config_hash="c", mesh_sha256="m", object_name=name, start=i, stop=i + 1)
        for i in range(count)
    ]


#: Samples of the units of each object: one gives many, one few, one none and one has few units.
YIELDS = {
    "rich": [4] * 50,
    "poor": [0, 1] * 25,
    "barren": [0] * 50,
    "short": [1, 2],
}


def make_target(samples: int | None, per_object: int | None = None, patience: int = 1000) -> Target:
    by_object = {name: units(name, len(found)) for name, found in YIELDS.items()}
    config = load_config(samples=samples, samples_per_object=per_object, samples_patience=patience)
    return Target(config=config, units=by_object)


def run(target: Target, workers: int = 1) -> tuple[dict[str, int], dict[str, int]]:
    """Run a target as a build does; return how many units and samples belong to it."""
    while target.plan()[2]:
        in_flight: list[ShardHeader] = []
        for header in target.next_units():
            in_flight.append(header)
            if len(in_flight) >= workers:
                # The last that began ends first.
                done = in_flight.pop()
                target.found[done] = YIELDS[done.object_name][done.start]
        for header in in_flight:
            target.found[header] = YIELDS[header.object_name][header.start]
    taken, counts, _ = target.plan()
    return taken, counts


def test_target_is_met_by_the_round_that_reaches_it() -> None:
    assert run(make_target(4)) == run(make_target(5))
    taken, counts = run(make_target(5))
    assert (set(taken.values()), sum(counts.values())) == ({1}, 5)
    assert sum(run(make_target(6))[1].values()) >= 6


def test_objects_share_a_target_in_turns() -> None:
    taken, counts = run(make_target(40))
    # Who has a share waits while the others catch up, and takes over what they cannot give.
    assert counts == {"rich": 20, "poor": 17, "barren": 0, "short": 3}
    assert (taken["rich"], taken["poor"], taken["short"]) == (5, 34, 2)


def test_object_that_is_tried_in_vain_is_given_up() -> None:
    taken, counts = run(make_target(40, patience=3))
    assert (taken["barren"], counts["barren"]) == (3, 0)
    # One sample in two units is enough to go on.
    assert counts["poor"] > 10


def test_what_is_out_of_reach_ends_with_the_units() -> None:
    taken, counts = run(make_target(10_000))
    assert taken == {name: len(found) for name, found in YIELDS.items()}
    assert counts == {name: sum(found) for name, found in YIELDS.items()}


def test_each_object_has_its_own_target() -> None:
    taken, counts = run(make_target(None, per_object=6))
    assert (counts["rich"], counts["poor"], counts["short"]) == (8, 6, 3)
    assert taken["barren"] == 50


@pytest.mark.parametrize("workers", [1, 2, 7])
def test_units_of_a_target_do_not_depend_on_the_workers(workers: int) -> None:
    assert run(make_target(40), workers) == run(make_target(40), 1)


def test_workers_have_work_while_a_round_ends() -> None:
    target = make_target(40)
    coming = target.next_units()
    first = [next(coming) for _ in YIELDS]
    assert {header.start for header in first} == {0}
    target.found[first[0]] = 4
    ahead = next(coming)
    assert (ahead.object_name, ahead.start) == ("rich", 1)
    # But by one round only.
    target.found[ahead] = 4
    assert next(coming, None) is None


def test_a_smaller_target_is_part_of_a_larger_one() -> None:
    reached = [run(make_target(samples))[0] for samples in range(1, 120, 7)]
    for fewer, more in pairwise(reached):
        assert all(fewer[name] <= more[name] for name in YIELDS)


def test_target_that_is_met_lacks_nothing() -> None:
    target = make_target(40)
    run(target)
    assert target.shortfall() == []


def test_shortfall_names_what_was_tried_to_its_end() -> None:
    """The short object has two units; the barren one is given up after ten of its fifty."""
    target = make_target(None, per_object=5, patience=10)
    run(target)
    assert target.shortfall() == [
        "too few samples, given up after 10 palm poses without a sample: barren (0)",
        "too few samples, all palm poses were tried, --candidates allows more: short (3)",
    ]


def test_shortfall_tells_how_many_there_are_of_a_total() -> None:
    target = make_target(1000)
    run(target)
    assert target.shortfall()[0] == "228 of 1,000 samples were found"


def test_grasps_and_samples_are_not_both_an_end() -> None:
    refuse_two_ends(load_config(max_grasps=3))
    with pytest.raises(ConfigError, match="max_grasps must be null with samples"):
        refuse_two_ends(load_config(max_grasps=3, samples_per_object=2))
