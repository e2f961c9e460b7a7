"""A death has a name: what ends a process is found, and nothing innocent is."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from helpers import faults
from helpers.tiers import few, in_second_tier

from drakegrasp.errors import MachineError
from drakegrasp.runtime.journal import (
    GIVE_UP_DEATHS,
    HUNG_DEATHS,
    NATIVE_DEATHS,
    NO_JOURNAL,
    PREPARE_DEATHS,
    SILENT_DEATHS,
    Journal,
    Verdict,
    _History,
    open_journal,
    wall_limit,
)

UNIT = {"name": "mug", "start": 0, "stop": 10}
#: A unit of ten steps, as its own process; every argument is a fault, KIND:STEP.
RUN = """
import runpy, sys, time
from pathlib import Path
import drakegrasp.runtime.journal as j
from drakegrasp.runtime.journal import open_journal
happen = runpy.run_path(HELPER)["happen"]

faults = dict(reversed(argument.split(":")) for argument in sys.argv[2:])
with open_journal(Path(sys.argv[1]), {"name": "mug", "start": 0, "stop": 10}) as journal:
    steps = [f"try {i}" for i in range(10)]
    for step in sorted(steps, key=lambda step: step not in journal.unresolved):
        verdict = journal.verdict(step)
        if verdict is not None:
            print(step, verdict.name, flush=True)
            continue
        with journal.step(step, 0.2):
            print(step, "runs", flush=True)
            if step in faults:
                happen(faults[step])
""".replace("HELPER", repr(faults.__file__))


def with_wall_factor(factor: float) -> str:
    """Return the unit with another limit of the wall clock."""
    return RUN.replace("faults =", f"j.WALL_FACTOR = {factor}\nfaults =")


def run(journal: Path, *faults: str, unit: str = RUN) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", unit, journal, *faults], capture_output=True, text=True, timeout=60
    )


def deaths_until_done(journal: Path, *faults: str) -> tuple[int, list[str]]:
    """Run a unit until it comes to its end; return how often it died, and its last lines."""
    impatient = with_wall_factor(4.0)  # a step that hangs takes 0.8 s
    for deaths in range(30):
        result = run(journal, *faults, unit=impatient)
        if result.returncode == 0:
            return deaths, result.stdout.splitlines()
    raise AssertionError("the unit must come to its end")


#: Ways to die: how often a step may, and what is said of it then.
FATES = {
    "crash": (NATIVE_DEATHS, Verdict.CRASHED),
    "abort": (NATIVE_DEATHS, Verdict.CRASHED),
    "memory": (SILENT_DEATHS, Verdict.VANISHED),
    "hang": (HUNG_DEATHS, Verdict.HUNG),
    "freeze": (HUNG_DEATHS, Verdict.HUNG),
}


@pytest.mark.parametrize("kinds", [("crash", "hang"), in_second_tier((tuple(FATES),))])
def test_failing_steps_are_found_one_by_one_and_the_others_run(
    tmp_path: Path, kinds: tuple[str, ...]
) -> None:
    """Also the first step and the last one."""
    steps = dict(zip(kinds, (0, 9, 2, 5, 6), strict=False))
    faults = [f"{kind}:try {i}" for kind, i in steps.items()]
    found, lines = deaths_until_done(tmp_path / "journal", *faults)
    assert found == sum(FATES[kind][0] for kind in kinds)
    failing = {line for line in lines if not line.endswith("runs")}
    assert failing == {f"try {steps[kind]} {FATES[kind][1].name}" for kind in kinds}
    assert sorted(line.split()[1] for line in lines) == [str(i) for i in range(10)]
    assert list(tmp_path.iterdir()) == []


def test_suspect_runs_first_and_is_cleared_by_passing(tmp_path: Path) -> None:
    journal = tmp_path / "journal"
    run(journal, "crash:try 4")
    result = run(journal, "crash:try 7")
    assert result.stdout.splitlines()[0] == "try 4 runs"
    # One more crash there is again the first of its kind.
    run(journal, "crash:try 4")
    assert "try 4 runs" in run(journal).stdout


def test_limit_is_of_computing_time(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    command = [sys.executable, "-c", with_wall_factor(1e4), path, "spin:try 4"]
    for _ in range(HUNG_DEATHS):
        result = subprocess.run(command, capture_output=True, timeout=240)
        assert result.returncode == -signal.SIGPROF
    assert "try 4 HUNG" in run(path).stdout


@pytest.mark.parametrize("seconds", few([0.6, 3.0], 1))
def test_suspended_process_is_not_convicted(tmp_path: Path, seconds: float) -> None:
    """Neither a stop beyond the limit of computing time, nor one beyond that of the wall clock."""
    path = tmp_path / "journal"
    # The step waits for a line, so that the process is surely stopped within it.
    wait = RUN.replace("happen(faults[step])", "sys.stdin.readline()")
    process = subprocess.Popen(
        [sys.executable, "-c", wait, path, "wait:try 4"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    assert any("try 4" in line for line in process.stdout), "the process must get there"
    process.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    process.send_signal(signal.SIGCONT)
    process.communicate("\n")

    # Beyond the limit of the wall clock it may end first; it is convicted of nothing.
    assert process.returncode == 0 or seconds > wall_limit(0.2)
    assert deaths_until_done(path)[0] == 0


@pytest.mark.parametrize(
    "content", ["", "no journal", '{"unit": 3}\n', '{"deaths": {}}\nhello', "\x00" * 600]
)
def test_what_is_no_journal_is_ignored(tmp_path: Path, content: str) -> None:
    (tmp_path / "journal").write_text(content)
    with open_journal(tmp_path / "journal", UNIT) as journal:
        assert journal.unresolved == []


def test_journal_of_another_unit_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    for _ in range(NATIVE_DEATHS):
        run(path, "crash:try 4")
    with open_journal(path, {**UNIT, "name": "cup"}) as journal:
        assert journal.verdict("try 4") is None
        assert journal.unresolved == []


def test_unit_that_another_process_is_at_is_not_a_dead_one(tmp_path: Path) -> None:
    with open_journal(tmp_path / "journal", UNIT) as first:
        assert first is not NO_JOURNAL
        with open_journal(tmp_path / "journal", UNIT) as second:
            assert second is NO_JOURNAL
        assert (tmp_path / "journal").exists()


def test_process_that_nobody_restarts_keeps_no_journal(tmp_path: Path) -> None:
    with open_journal(tmp_path / "journal", UNIT, restartable=False) as journal:
        assert journal is NO_JOURNAL
        assert not list(tmp_path.iterdir())


def test_kill_leaves_a_journal_without_a_mark(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    process = subprocess.Popen(
        [sys.executable, "-c", RUN.replace("0.2", "60"), path, "hang:try 4"], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert any(b"try 4" in line for line in process.stdout), "the process must get there"
    process.kill()
    process.communicate()
    with open_journal(path, UNIT) as journal:
        assert journal.unresolved == ["try 4"]


def test_unit_that_dies_for_nothing_is_given_up() -> None:
    """Before its first step no step is at fault, whatever the process died of."""
    history = _History()
    for number in range(GIVE_UP_DEATHS):
        Journal(None, 0, history).validate_no_loop("mug")
        history.add("start", 0, b"Fatal Python error" * (number % 2))
    with pytest.raises(MachineError, match=r"^mug: the worker died 20 times in a row; is there en"):
        Journal(None, 0, history).validate_no_loop("mug")


@pytest.mark.parametrize(
    ("step", "marks", "verdict", "deaths"),
    [
        ("try 4", b"Timeout (0:00:01)!", Verdict.HUNG, 2),
        ("try 4", b"Fatal Python error", Verdict.CRASHED, 2),
        # As when there is not the memory to prepare a mesh, or to build its scene.
        ("prepare", b"", Verdict.VANISHED, PREPARE_DEATHS),
        ("build", b"", Verdict.VANISHED, SILENT_DEATHS),
    ],
)
def test_each_way_to_die_has_its_number_of_deaths(
    step: str, marks: bytes, verdict: Verdict, deaths: int
) -> None:
    history = _History()
    for _ in range(deaths):
        assert history.verdict(step) is None
        history.add(step, 0, marks)
    assert history.verdict(step) is verdict
