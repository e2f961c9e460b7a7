"""`drakegrasp verify --protocol NAME`: grasps under the rules of a protocol that runs in MuJoCo."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from drakegrasp.cli.errors import say

if TYPE_CHECKING:
    from drakegrasp.hand.description import Hand
    from drakegrasp.runtime.executor import Executor
    from drakegrasp.runtime.progress import Report
    from drakegrasp.verification.verify import PlacedGrasp

#: Options that say what the grasps are and where.
PLACES = ("grasps", "mesh", "units", "dataset", "split", "frame", "camera", "hand")


@dataclass(frozen=True, kw_only=True)
class ProtocolRequest:
    """The options of the command that count with a protocol; None for those not given."""

    grasps: Path
    protocol: str
    hand: str | None
    assets: Path | None
    mesh: Path | None
    units: str | None
    dataset: Path | None
    split: str | None
    frame: str | None
    camera: Path | None

    @property
    def is_foreign(self) -> bool:
        """Whether the grasps are files of DexGraspBench."""
        import numpy as np

        path = self.grasps
        if Path(self.hand or "").suffix == ".xml" or self.assets is not None:
            return True
        if path.is_dir():
            return any(path.rglob("*.npy"))
        try:
            return path.suffix == ".npy" and np.load(path, mmap_mode="r") is None
        except ValueError:  # an array of Python objects
            return True
        except OSError:
            return False


def is_lift(name: str, simulator: str | None) -> bool:
    """Return whether a protocol is the lift in Drake.

    Raises:
        ConfigError: If there is no such protocol.
        click.UsageError: If it does not run in the simulator.
    """
    from drakegrasp.protocols.protocol import find_protocol

    protocol, stored = find_protocol(name)
    if simulator not in (None, protocol.simulator):
        raise click.UsageError(
            f"--simulator of protocol {stored} must be {protocol.simulator}, got {simulator}"
        )
    return protocol.simulator == "drake"


def refuse_options(protocol: str, **options: Any) -> None:
    """Refuse options that the protocol answers by itself.

    Raises:
        click.UsageError: If one is given.
    """
    usual = {"method": "hand", "overrides": (), "snap_points": False, "tls": True}
    names = {"mesh": "object", "overrides": "set", "tls": "no-tls", "tls_files": "tls-ca-file"}
    for name, value in options.items():
        if value is not None and value != usual.get(name):
            option = names.get(name, name.replace("_", "-"))
            raise click.UsageError(f"--{option} must not be used with protocol {protocol}")


def verify_by_protocol(
    request: ProtocolRequest, out: Path | None, workers: int | None, *, as_json: bool, quiet: bool
) -> None:
    """Write the verdicts, and how many hold.

    Raises:
        GraspError, DataError: If grasps or objects cannot be used, or the results not be written.
        HandError, ConfigError, MachineError: As `prepare_trials`.
    """
    from drakegrasp.protocols.postures import json_line, prepare_trials, verify_postures
    from drakegrasp.runtime.executor import processes
    from drakegrasp.runtime.progress import progress_bar
    from drakegrasp.verification.result_files import refuse_unwritable, result_paths, text_lines

    if out is not None:
        refuse_unwritable(out)
    held, show = 0, not (quiet or as_json)
    with TemporaryDirectory() as folder, processes(workers) as execute:
        with progress_bar("cut", "objects", show=show) as report:
            hand, assets, files, names = _grasp_files(request, Path(folder), execute, report)
        trials = prepare_trials(request.protocol, hand, assets)

        # A line per verdict as it comes.
        with (
            nullcontext(_print_line) if out is None else text_lines(out) as write,
            progress_bar("verify", "grasps", show=show) as report,
        ):
            for index, result in enumerate(verify_postures(files, trials, execute)):
                line = json_line(index, replace(result, file=names[index]), trials)
                write(line)
                if as_json and out is not None:
                    _print_line(line)
                held += result.verdict.success
                report(index + 1, len(files), holding=held)
    if out is not None and not as_json:
        say(str(result_paths(out)[0]))
    if show:
        say(f"{held:,} of {len(files):,} grasps hold by {trials.protocol}", err=True)


def _grasp_files(
    request: ProtocolRequest, folder: Path, execute: Executor, report: Report
) -> tuple[Path, Path, list[Path | str], list[Path]]:
    """Return the MJCF of the hand, the folder of objects, and of each grasp its file and name."""
    from drakegrasp.errors import DataError, HandError
    from drakegrasp.exchange.dexgraspbench import fitted_postures, write_grasps
    from drakegrasp.runtime.environment import require_mujoco

    # Files of DexGraspBench.
    path = request.grasps
    if request.is_foreign:
        given = {n: getattr(request, n) for n in PLACES if n not in ("grasps", "hand")}
        refuse_options(f"{request.protocol} and files of DexGraspBench", **given)
        if Path(request.hand or "").suffix != ".xml":
            raise HandError(
                f"--hand must be an MJCF (.xml) with files of DexGraspBench, got {request.hand}"
            )
        files = [path] if path.is_file() else sorted(path.rglob("*.npy"))
        if not files:
            raise DataError(f"{path}: must be a .npy file or a folder of them, got none")
        return Path(request.hand or ""), request.assets or Path(), list(files), files

    # Our own grasps are written as such files.
    require_mujoco("mujoco", "coacd")
    hand, grasps = _own_grasps(request)
    postures = fitted_postures(grasps, execute)
    hand_path, found = write_grasps(postures, hand, folder, execute=execute, report=report)
    return hand_path, folder, found, [path] * len(found)


def _own_grasps(request: ProtocolRequest) -> tuple[Hand, list[PlacedGrasp]]:
    """Return the grasps of a file of postures or contacts, in its order, and their hand."""
    from drakegrasp.cli.verify.request import VerifyRequest, place_requested
    from drakegrasp.hand.description import load_hand

    options = {name: getattr(request, name) for name in PLACES}
    placed, config = place_requested(VerifyRequest(**options))
    placed.sort(key=lambda grasp: grasp.index)
    return load_hand(config.hand_source), placed


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
