"""`score` writes a card of predicted grasps, with reference rows."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

import drakegrasp as dg
from drakegrasp.cli.arguments import (
    AsJson,
    DataFile,
    Existing,
    Folder,
    Positive,
    Postures,
    RowFrame,
    Settings,
    Split,
    Workers,
    given,
)
from drakegrasp.cli.console import MORE, same_command, say, say_json, wrong_input
from drakegrasp.cli.reach import ArmOptions

#: Options that change no verdict: flags, and options with a value.
IDLE = (
    ("--json", "--quiet", "--tls", "--no-tls"),
    ("--workers", "--scheduler", "--scheduler-file", "--tls-ca-file", "--tls-cert", "--tls-key"),
)


def score(
    predictions: Annotated[tuple[Existing, ...], Parameter(name="PREDICTIONS")] = (),
    /,
    *,
    dataset: DataFile,
    split: Split = "test",
    against: Annotated[tuple[Existing, ...], Parameter(metavar="FILE")] = (),
    references: Annotated[tuple[str, ...], Parameter(name="--reference", metavar="NAME")] = (),
    per_object: Positive | None = None,
    out: Folder | None = None,
    overrides: Settings = (),
    as_json: AsJson = False,
    quiet: bool = False,
    train: Annotated[DataFile | None, Parameter(group=MORE)] = None,
    frame: Annotated[RowFrame | None, Parameter(group=MORE)] = None,
    postures: Postures = Postures(),
    protocol: Annotated[str, Parameter(group=MORE, metavar="NAME|FILE.py:NAME")] = "lift",
    robot: ArmOptions = ArmOptions(),
    workers: Workers = Workers(),
) -> None:
    """Score predicted grasps against reference rows.

    Each of PREDICTIONS is a .npy or HDF5 file of (n, 6k) numbers, one grasp per row of the
    split, or (n, m, 6k), m grasps per row, in the camera's frame. It may also be a file of postures
    with the `row` of each, or a file or folder of exported samples. Several files are treated as
    several training runs of one method. Without PREDICTIONS only the reference rows are scored.

    With --out the command writes card.json, card.md, card.png and the verdicts to DIR, so that an
    interrupted score can continue.

    Args:
        predictions: Files of one method.
        dataset: The data file of the predicted rows or views: OUT/grasping_oto.hdf5, _otm,
            OUT/scenes.hdf5, or OUT/clutter.hdf5.
        split: Rows of the dataset.
        against: Predictions of another method for the same rows: the card contains the difference
            of the headlines. May be given several times, once per training run of that method.
        references: Score these reference rows only; may be given several times: own, nearest image,
            constant, random, top-down, closing. [default: all]
        per_object: Maximum number of rows of each object.
        out: Folder of the card and of the verdicts, from which the same command continues.
            [default: nothing is written]
        overrides: Change one setting, e.g. lift.hold_time=1; may be given several times.
        as_json: Print the card as JSON.
        quiet: Show neither progress nor warnings.
        train: Data file whose training rows are used for the reference rows. [default: --dataset]
        frame: Frame of all postures, which overrides their files.
        protocol: The rule of a verdict, see `drakegrasp verify`. All protocols except lift try the
            first wrist pose of a prediction in MuJoCo.
    """
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.scenes import open_rows
    from drakegrasp.exchange.attempts import holds_postures
    from drakegrasp.scoring.references import REFERENCES

    on, arm = workers.asked(), robot.asked()
    with wrong_input():
        read_manifest(dataset.parent)
        bare = not references and bool(predictions) and all(map(holds_postures, predictions))
        data = open_rows(dataset, split=split, fewer_fingers=bare)
        trained = None if train is None else open_rows(train, split="train")
    references = references or tuple(REFERENCES)
    if data.has_fewer_fingers:
        say("no reference rows: some samples leave fingers out", err=True)
        references = ()
    scored = dg.score(
        predictions,
        data,
        against=against or None,
        train=trained,
        references=references,
        per_object=per_object,
        overrides=overrides,
        read_as=given(frame=frame) | postures.asked(),
        protocol=protocol,
        arm=arm,
        out=out,
        again=same_command(*IDLE),
        **on,
        show=not quiet,
    )
    _say_card(scored.card, out, as_json=as_json, quiet=quiet)


def _say_card(card: Mapping[str, Any], out: Path | None, *, as_json: bool, quiet: bool) -> None:
    """Print the headlines of a card, or the card, and unless quiet all sets and warnings."""
    from drakegrasp.scoring.card import share_text

    if as_json:
        say_json(card, indent=1)
    else:
        for name, value in card["headline"].items():
            say(f"{name}: {share_text(value, 1, ' %')}")
        if out is not None:
            say(str(out / "card.md"))
    if not quiet:
        for name, each in card["sets"].items():
            shares = {m: share_text(of, 1, " %") for m, of in each["measures"].items()}
            clean = f", clean {shares['clean']}" if "clean" in shares else ""
            say(f"{name}: {shares['headline']}{clean}", err=True)
        for warning in card["warnings"]:
            say(f"warning: {warning}", err=True)
