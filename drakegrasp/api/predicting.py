"""Grasps for the views of scenes, on Dask workers or on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from drakegrasp.cluster.executor import DaskExecutor
from drakegrasp.cluster.worker_checks import checked_workers
from drakegrasp.dataset.manifest import read_manifest
from drakegrasp.errors import ConfigError
from drakegrasp.hand.settings import override_config
from drakegrasp.reach.arm import Arm
from drakegrasp.runtime.executor import processes
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.scoring import predicting
from drakegrasp.simulation.attempts import GraspTable

if TYPE_CHECKING:
    from distributed import Client


def predict_scenes(
    scenes: str | Path,
    *,
    split: str = "test",
    simulate: int = 0,
    count: int | None = None,
    overrides: Sequence[str] = (),
    arm: Arm | None = None,
    client: Client | None = None,
    workers: int | None = None,
    show: bool = False,
) -> tuple[GraspTable, int]:
    """Return grasps for all views of a split, the best first; the work of `drakegrasp predict`.

    The result does not depend on the workers.

    Args:
        scenes: The file scenes.hdf5 or clutter.hdf5 of a dataset. In the latter, lifts are tried
            and arms are asked among the other objects, as completed from the view, and among the
            surroundings.
        split: `train`, `valid` or `test`.
        simulate: Largest number of grasps of a view that are lifted on the object as completed from
            this view, see `rank`; the lifts have the rules of the dataset.
        count: Maximum number of grasps of a view; None for all.
        overrides: Strings `"a.b=c"`, which change the configuration of the dataset.
        arm: An arm, see `load_arm`, on the table of the scenes: grasps of a view that it does not
            reach come last, with a confidence of 0; `q_arm` has its joints at the others.
        client: A Dask client whose workers share the views, e.g. from `connect`.
        workers: Number of processes of this machine, instead of a client; None for one per core.
        show: Whether to show progress on standard error.

    Returns:
        Postures in {O} with the row that each is for (`of_row`, in the order of `SceneDataset`, for
        clutter.hdf5 of `SceneRows`), its resting pose and its chance of being a sample
        (`confidence`); and the number of views that show too little of their object for any.

    Raises:
        ConfigError: If client and workers are both given, or an override is invalid.
        DataError: If the file cannot be used.
        GraspError: If no view yields a posture, or a view is invalid.
        MachineError: If a worker would give other results than this machine.
    """
    path = Path(scenes)
    if client is not None and workers is not None:
        raise ConfigError("workers must not be given with a client, got both")
    with ExitStack() as stack:
        # Who does the work.
        if client is None:
            execute = stack.enter_context(processes(workers))
        else:
            config = override_config(read_manifest(path.parent).config, overrides)
            stack.enter_context(checked_workers(client, config))
            execute = DaskExecutor(client)

        # The views, one after the other.
        report = stack.enter_context(progress_bar("predict", "views", show=show))
        return predicting.predict_scenes(
            path,
            split=split,
            simulate=simulate,
            count=count,
            overrides=overrides,
            arm=arm,
            execute=execute,
            report=report,
        )
