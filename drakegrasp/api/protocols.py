"""Trying grasps by a protocol that runs in MuJoCo, in processes of this machine."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

from drakegrasp.config import Config
from drakegrasp.exchange.dexgraspbench import fitted_postures, write_grasps
from drakegrasp.hand.description import load_hand
from drakegrasp.protocols.postures import (
    PostureResult,
    PostureTrials,
    prepare_trials,
    verify_postures,
)
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.executor import Executor, processes
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.verification.placing import PlacedGrasp

#: Receives verdicts as they are computed: called with the place of a grasp in the sequence, its
#: verdict, and what the trials share.
OnVerdict: TypeAlias = Callable[[int, PostureResult, PostureTrials], None]


def verify_by_protocol(
    grasps: Sequence[PlacedGrasp],
    config: Config,
    protocol: str,
    on_result: OnVerdict,
    *,
    keep: Path | None = None,
    workers: int | None = None,
    show: bool = True,
) -> None:
    """Try the first wrist pose of grasps of one hand, in their order.

    Args:
        grasps: See `verification.placing`.
        config: Their configuration, with the hand.
        protocol: Name of a protocol that runs in MuJoCo, or `FILE.py:NAME`.
        on_result: Receives the verdicts.
        keep: Folder of the convex parts of objects, for the next call; None: they are not kept.
        workers: Number of processes; one per core if None.
        show: Whether to show progress on standard error.

    Raises:
        ConfigError: If there is no such protocol, or it does not run in MuJoCo.
        MachineError: If a package is missing.
    """
    require_mujoco("mujoco", "coacd")
    hand = load_hand(config.hand_source)
    with TemporaryDirectory() as scratch, processes(workers) as execute:
        with progress_bar("cut", "objects", show=show) as report:
            postures, folder = fitted_postures(grasps, execute), Path(scratch)
            path, files = write_grasps(
                postures, hand, folder, execute=execute, keep=keep, report=report
            )
        _verify(files, prepare_trials(protocol, path, folder), on_result, execute, show)


def verify_files_by_protocol(
    files: Sequence[Path],
    protocol: str,
    on_result: OnVerdict,
    *,
    hand: Path,
    objects: Path,
    workers: int | None = None,
    show: bool = True,
) -> None:
    """Try the grasps of files of DexGraspBench, in their order; see `verify_by_protocol`.

    Args:
        files: The files.
        protocol: See `verify_by_protocol`, like `on_result`, `workers` and `show`.
        on_result: See `verify_by_protocol`.
        hand: MJCF of the hand, whose world is the hand's root.
        objects: Folder to which the object paths in the files are relative.
        workers: See `verify_by_protocol`.
        show: See `verify_by_protocol`.

    Raises:
        ConfigError, MachineError: As `verify_by_protocol`.
        HandError: If the MJCF cannot be used.
    """
    trials = prepare_trials(protocol, hand, objects)
    with processes(workers) as execute:
        _verify(files, trials, on_result, execute, show)


def _verify(
    files: Sequence[Path | str],
    trials: PostureTrials,
    on_result: OnVerdict,
    execute: Executor,
    show: bool,
) -> None:
    holding = 0
    with progress_bar("verify", "grasps", show=show) as report:
        for index, result in enumerate(verify_postures(files, trials, execute)):
            on_result(index, result, trials)
            holding += result[0].success
            report(index + 1, len(files), holding=holding)
