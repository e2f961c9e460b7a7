"""The prediction of a build: arithmetic, and what it needs to be told."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from helpers.commands import error_line, run
from helpers.scripts import load_script
from hypothesis import given
from hypothesis import strategies as st

from drakegrasp.config import Config
from drakegrasp.dataset.lock import BuildLog
from drakegrasp.dataset.statistics import count_funnel
from drakegrasp.errors import ConfigError, DataError
from drakegrasp.filters import Removal
from drakegrasp.generation.estimate import (
    CERTIFY_SECONDS,
    MEASURED,
    START_SECONDS,
    logged_times,
    measured_times,
    plan_build,
    plan_lines,
    read_times,
)
from drakegrasp.hand.settings import load_config, override_config

EVEN = replace(
    MEASURED, prepare=2.0, scene=0.0, attempt=0.1, look=0.0, survey=0.0, pack=0.0, put=0.0
)
SMALL = load_config(overrides=["candidates.max=100", "unit_candidates=50"])


def test_one_worker_does_one_thing_after_another() -> None:
    plan = plan_build(3, SMALL, 1, EVEN)
    assert (plan.attempts, plan.units) == (900, 6)
    assert plan.stages["prepare"] == pytest.approx(6.0)
    assert plan.stages["simulate"] == pytest.approx(90.0)
    assert plan.seconds == pytest.approx(START_SECONDS + 96.0, abs=0.1)
    assert plan.core_hours == pytest.approx(plan.hours)


def test_workers_wait_where_work_does_not_divide() -> None:
    """Six units of 15 s on four workers take two rounds; three objects on four take one."""
    plan = plan_build(3, SMALL, 4, EVEN)
    assert plan.stages["prepare"] == pytest.approx(2.0, abs=0.1)
    assert plan.stages["simulate"] == pytest.approx(30.0, abs=0.1)
    assert plan.core_hours == pytest.approx(4 * plan.hours)


def test_workers_share_assembling_but_for_what_one_process_does() -> None:
    """Ten million attempts in 200 tasks: what two workers pack, a fourth process could not put."""
    config = load_config(overrides=["candidates.max=10000", "candidates.standoffs=[0.1]"])
    times = replace(EVEN, survey=1e-5, pack=2e-5, put=1e-6)
    seconds = [plan_build(1000, config, n, times).stages["assemble"] for n in (1, 2, 1000)]
    assert seconds == pytest.approx([300.0, 150.0, 3.0 + 10.0], rel=0.01)


def test_assembling_is_a_small_share_of_a_large_cluster() -> None:
    plan = plan_build(1000, load_config(), 1000, MEASURED)
    assert plan.attempts == 30_000_000
    assert plan.stages["assemble"] < 0.12 * plan.seconds


def test_certificates_cost_their_trials() -> None:
    """Two successes, each tried twice more with noise and five times for its friction."""
    times = replace(EVEN, successes=2.0 / 300.0)
    certified = override_config(SMALL, ["certify.repeats=2"])
    seconds = [plan_build(1, c, 1, times).stages["simulate"] for c in (SMALL, certified)]
    assert seconds[1] - seconds[0] == pytest.approx(2 * (2 + 5) * CERTIFY_SECONDS)


def test_a_preset_has_the_times_that_were_measured_with_it() -> None:
    assert "preset fast" in measured_times(load_config("fast")).source
    assert "preset paper" in measured_times(load_config("paper")).source


def test_a_plan_is_of_the_objects_that_are_named(tmp_path: Path) -> None:
    words = ("build", "--objects", "builtin", "--out", tmp_path / "out", "--plan", "--only")
    result = run(*words, "1_mug_1", "--only", "1_mug_1")
    assert result.stdout.startswith("from the beginning: 1 object, "), result.output
    result = run(*words, "1_jug_1")
    assert (result.exit_code, result.stdout) == (2, "")
    assert error_line(result).endswith("got '1_jug_1'")


@pytest.mark.parametrize(("workers", "scenes"), [(1, 2), (2, 2), (4, 1)])
def test_every_worker_builds_the_scenes_of_its_units(workers: int, scenes: int) -> None:
    """Two objects of two units each: two workers share the units of both, four those of one."""
    plan = plan_build(2, SMALL, workers, replace(EVEN, scene=7.0))
    units = -(-4 // workers)
    assert plan.stages["simulate"] == pytest.approx(15.0 * units + 7.0 * scenes)


@given(objects=st.integers(1, 40), workers=st.integers(1, 200), candidates=st.integers(1, 500))
def test_plan_keeps_the_bounds_of_any_schedule(objects: int, workers: int, candidates: int) -> None:
    """No faster than the work shared evenly, no slower than that and one longest unit."""
    config = load_config(overrides=[f"candidates.max={candidates}"])
    plan = plan_build(objects, config, workers, EVEN)
    longest = 0.1 * 3 * max(map(len, config.unit_ranges(candidates)))
    work = 0.1 * plan.attempts
    assert work / workers <= plan.stages["simulate"] + 1e-6
    assert plan.stages["simulate"] <= work / workers + longest + 0.003 * plan.units


def test_a_million_attempts_on_a_thousand_workers() -> None:
    plan = plan_build(34, load_config(), 1000, MEASURED)
    assert plan.attempts == 1_020_000
    assert plan.hours < 1.0
    assert 5.0 < plan.core_hours < 1000.0


@pytest.mark.parametrize(("objects", "workers"), [(0, 1), (1, 0)])
def test_nothing_to_do_and_nobody_to_do_it_are_refused(objects: int, workers: int) -> None:
    with pytest.raises(ConfigError, match="must be at least 1, got 0"):
        plan_build(objects, SMALL, workers, EVEN)


def test_plan_of_the_command_line_builds_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    arguments = ["build", "--objects", "builtin", "--out", str(out), "--plan", "--workers", "8"]
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    assert "3,840,000 attempts in 3,584 work units" in result.stdout
    assert "on 8 workers" in result.stdout
    assert "core-hours" in result.stdout
    assert "GB on disk" in result.stdout
    assert not out.exists()


def test_times_are_read_as_written(tmp_path: Path) -> None:
    path = tmp_path / "times.json"
    path.write_text(json.dumps(asdict(EVEN)))
    assert read_times(path) == EVEN
    path.write_text('{"prepare": 1}')
    with pytest.raises(DataError, match="must be the output of"):
        read_times(path)


def _log_unit(log: BuildLog, name: str, seconds: float, successes: int) -> None:
    outcomes = {"dropped": 10 - successes, "success": successes}
    spent = {"build": 0.5, "try": seconds, "look": 0.1 * successes, "write": 1.0}
    log("unit done", object=name, outcomes=outcomes, seconds=spent)


def test_plan_goes_by_the_log_of_the_build(tmp_path: Path) -> None:
    """Attempts of 0.2 s on average over two objects."""
    assert logged_times(tmp_path, SMALL) is None
    log = BuildLog(tmp_path)
    log("started", config_hash="another")
    _log_unit(log, "mug", 70.0, 5)
    log("started", config_hash=SMALL.simulation_hash())
    assert logged_times(tmp_path, SMALL) is None
    _log_unit(log, "mug", 1.0, 0)
    _log_unit(log, "cup", 3.0, 2)
    log("unit done", object="cup", outcomes={"dropped": 10}, seconds={})
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"event": "unit do')
    times = logged_times(tmp_path, SMALL)
    assert times is not None
    assert times.attempt == pytest.approx(0.2 + 0.1)
    assert times.look == pytest.approx(0.1)
    assert times.successes == pytest.approx(0.1)
    assert times.prepare == MEASURED.prepare
    assert times.source == f"20 attempts of 2 objects in {tmp_path / 'log.jsonl'}"


def test_lines_name_the_source() -> None:
    assert plan_lines(plan_build(1, SMALL, 1, EVEN))[-1] == f"times and sizes: {EVEN.source}"


@pytest.mark.sim
@pytest.mark.slow
def test_storage_adds_up_to_the_directory(small_dataset: Path, small_config: Config) -> None:
    """The sizes by row, put together again, are the size of the dataset."""
    sizes = load_script("measurements/measure_stages").measure_storage(small_dataset)
    assert all(size > 0.0 for size in sizes.values())
    funnel = count_funnel(small_dataset)
    held, kept = funnel.removals.sum(), funnel.removals[:, Removal.KEPT].sum()
    shares = {"successes": held / funnel.outcomes.sum(), "samples": kept / held}
    plan = plan_build(3, small_config, 1, replace(MEASURED, **shares, **sizes))
    whole = sum(p.stat().st_size for p in small_dataset.rglob("*") if p.is_file())
    assert plan.bytes == pytest.approx(whole, rel=0.1)


@pytest.mark.parametrize(
    ("size", "words"),
    [(1.5e12, "1.5 TB"), (2e9, "2.0 GB"), (999e6, "999.0 MB"), (1e6, "1.0 MB"), (12e3, "12 kB")],
)
def test_sizes_are_in_the_largest_unit_that_they_fill(size: float, words: str) -> None:
    plan = replace(plan_build(1, SMALL, 1, EVEN), bytes=size)
    assert f", {words} on disk" in plan_lines(plan)[-2]
