"""Predicting grasps and scoring predicted ones, on Dask workers or on this machine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, TypeAlias, Unpack

import numpy.typing as npt

from drakegrasp.api.verifying import run_verification, verify_by_protocol
from drakegrasp.dataset.manifest import installed_versions, read_manifest
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.scenes import SceneRows
from drakegrasp.errors import ConfigError, GraspError
from drakegrasp.hand.settings import override_config
from drakegrasp.protocols.postures import describe, versions
from drakegrasp.protocols.protocol import Lift, find_protocol
from drakegrasp.reach.arm import Arm
from drakegrasp.runtime.environment import require_mujoco
from drakegrasp.runtime.executor import processes
from drakegrasp.runtime.progress import progress_bar
from drakegrasp.scoring import predicting
from drakegrasp.scoring.references import REFERENCES
from drakegrasp.scoring.run import Methods, Score
from drakegrasp.scoring.run import score as score_predictions
from drakegrasp.scoring.verdict import Verdict, protocol_verdict, ranked_sets, verdict_of
from drakegrasp.simulation.attempts import GraspRows, GraspTable
from drakegrasp.verification.placing import dataset_config, overridden_keys, place_on_rows
from drakegrasp.verification.result import Verification

if TYPE_CHECKING:
    from distributed import Client

    from drakegrasp.cluster.connect import Workers

#: Folder of the convex parts of objects, for protocols of MuJoCo.
CONVEX_PARTS = "convex_parts"
#: Receives verdicts as they are computed: called with the index of a grasp and its verdict.
Deliver: TypeAlias = Callable[[int, Verdict], None]


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
            from drakegrasp.cluster.executor import DaskExecutor
            from drakegrasp.cluster.worker_checks import checked_workers

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


def score(
    predictions: npt.ArrayLike | str | Path | Sequence[str | Path],
    dataset: GraspDataset,
    *,
    rows: Sequence[int] | None = None,
    confidence: npt.ArrayLike | None = None,
    read_as: Mapping[str, str] | None = None,
    against: str | Path | Sequence[str | Path] | None = None,
    train: GraspDataset | None = None,
    references: Sequence[str] = tuple(REFERENCES),
    per_object: int | None = None,
    overrides: Sequence[str] = (),
    protocol: str = "lift",
    arm: Arm | None = None,
    out: str | Path | None = None,
    again: str = "drakegrasp.score",
    client: Client | None = None,
    show: bool = False,
    **workers: Unpack[Workers],
) -> Score:
    """Return the score of predicted grasps against reference rows; see docs/how-to/score.md.

    Args:
        predictions: Predictions in the frame of the rows' camera: (n, 6k) with one per row, or
            (n, m, 6k) with m per row; a file of them or of postures; or several files of one method
            that was trained several times. An empty list scores only the reference rows.
        dataset: The split whose rows the predictions are for.
        rows: With an array: (n,), row of each prediction; None for all rows, in order.
        confidence: With an array: (n,) or (n, m), greater is better.
        read_as: How to read all postures of files: `frame` and `link` override what the files
            state; `preshape` applies to rows that name none.
        against: File or files of another method for the same rows. The card states by how much the
            headline is above that of the other method, object by object.
        train: Training rows for the reference rows; None for the split `train` of the same file.
        references: Names of the reference rows, see `scoring.references.REFERENCES`.
        per_object: Maximum number of rows of each object; None for all.
        overrides: `"key=value"` settings. `verify.max_tries` is 1 unless they set it, because the
            headline is about the first wrist pose.
        protocol: The rule of a verdict, by name or as `FILE.py:NAME`. All protocols but "lift" try
            the first wrist pose of a prediction in MuJoCo, on this machine.
        arm: An arm, see `load_arm`: the card counts what it reaches apart; only with "lift".
        out: Folder that stores verdicts, so that the same call can continue, and the card.
        again: Text of the card on how to create the card again.
        client: A Dask client whose workers do the work, e.g. from `connect`.
        show: Whether to show progress on standard error.
        workers: The arguments of `connect`, instead of a client; one process per core if neither
            is given.

    Raises:
        GraspError: If predictions and rows do not match, there is nothing to score, a reference is
            unknown, or `train` is of another camera or hand.
        ConfigError: If there is no such protocol, or it cannot have these rows, an arm or a client.
        ConfigError, DataError, HandError, MachineError: As `run_verification`.
    """
    unknown = [name for name in references if name not in REFERENCES]
    if unknown:
        raise GraspError(f"references must be of {', '.join(REFERENCES)}, got {unknown[0]!r}")

    # The rules of the score, and the predictions.
    rules = _Rules(dataset, protocol, overrides, arm)
    for where in ("client", "scheduler", "scheduler_file") if rules.in_mujoco else ():
        if {"client": client, **workers}.get(where):
            raise ConfigError(f"{where} must be None with protocol {rules.stored}, got one")
    settings = rules.settings()
    name, ranked = ranked_sets(
        predictions, dataset, rows=rows, confidence=confidence, read_as=read_as
    )
    methods = {name: ranked}
    if against is not None:
        methods |= _method(against, dataset, read_as, beside=methods)

    # The verdicts, from this process or from workers.
    def try_all(grasps: GraspRows, chosen: Sequence[int], deliver: Deliver) -> None:
        placed = place_on_rows(
            grasps, dataset, chosen, config=rules.config, overrides=rules.overrides
        )
        if rules.in_mujoco:
            verify_by_protocol(
                placed,
                rules.config,
                protocol,
                lambda i, found, _: deliver(placed[i].index, protocol_verdict(found[0])),
                keep=Path(scratch if out is None else out) / CONVEX_PARTS,
                workers=workers.get("workers"),
                show=show,
            )
            return

        # This package's own trials.
        run_verification(
            placed,
            rules.config,
            client=client,
            on_result=lambda index, result: deliver(index, verdict_of(_asked(result, arm))),
            show=show,
            explained=False,
            **workers,
        )

    with TemporaryDirectory() as scratch:
        scored = score_predictions(
            dataset,
            methods,
            try_all,
            train=_training_rows(dataset, references) if train is None else train,
            references=references,
            per_object=per_object,
            config=rules.config,
            settings=settings,
            again=again,
            folder=None if out is None else Path(out),
        )
    if out is not None:
        scored.save(Path(out))
    return scored


def _asked(result: Verification, arm: Arm | None) -> Verification:
    return result if arm is None else result.reached_by(arm)


class _Rules:
    """All that decides a verdict apart from the row.

    Attributes:
        config: Configuration of the trials.
        overrides: The settings in it that are not of the dataset.
        protocol: The rule of a verdict.
        stored: Its name on the card.
        in_mujoco: Whether grasps are tried in MuJoCo, on this machine.
        arm: The arm that is asked, if any.
    """

    def __init__(
        self, dataset: GraspDataset, protocol: str, overrides: Sequence[str], arm: Arm | None
    ) -> None:
        self.arm, self.overrides = arm, ("verify.max_tries=1", *overrides)
        self.config = dataset_config(dataset, overrides=self.overrides)
        self.protocol, self.stored = find_protocol(protocol)
        self.in_mujoco = not isinstance(self.protocol, Lift)
        if self.in_mujoco and isinstance(dataset, SceneRows) and dataset.several:
            got = self.stored
            raise ConfigError(f"protocol must be lift for scenes of several objects, got {got}")
        if self.in_mujoco and arm is not None:
            raise ConfigError(f"arm must be None with protocol {self.stored}, got {arm.name}")

    def settings(self) -> dict[str, Any]:
        """Return them as JSON types, with the versions; CoACD cuts objects for MuJoCo.

        Raises:
            MachineError: If a package of the protocol is missing.
        """
        settings: dict[str, Any] = {
            "config": self.config.to_dict(),
            "overridden": sorted(overridden_keys(self.overrides)),
            "versions": installed_versions(self.config),
        }
        if not isinstance(self.protocol, Lift):
            require_mujoco("mujoco", "coacd")
            used = {**versions(), "coacd": metadata.version("coacd")}
            settings["protocol"] = {**describe(self.protocol, self.stored), "versions": used}
        if self.arm is not None:
            settings["arm"] = self.arm.described()
        return settings


def _method(
    files: object, dataset: GraspDataset, read_as: Mapping[str, str] | None, *, beside: Methods
) -> Methods:
    """Return the predictions of another method by its name.

    Raises:
        GraspError: If they are not files of predictions, or the card could not tell the methods
            apart.
    """
    given = [files] if isinstance(files, str | Path) else files
    if not isinstance(given, list | tuple) or not given:
        raise GraspError(f"against must be a file or a list of files, got {files!r}")
    if wrong := [each for each in given if not isinstance(each, str | Path)]:
        raise GraspError(f"against must have files of predictions, got {wrong[0]!r}")
    name, ranked = ranked_sets(given, dataset, read_as=read_as)
    if name in beside or not any(beside.values()):
        got = name if any(beside.values()) else "no predictions"
        raise GraspError(
            f"against must be beside predictions whose file has another name, got {got}"
        )
    return {name: ranked}


def _training_rows(dataset: GraspDataset, references: Sequence[str]) -> GraspDataset:
    """Return the training rows of the file of a split; only reference rows need their contacts."""
    if type(dataset) is GraspDataset:
        return GraspDataset(dataset.path, split="train", fewer_fingers=not references)
    return type(dataset)(dataset.path, split="train")
