"""`drakegrasp score` and `drakegrasp bench-set`: a score card, and the frozen benchmark."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.help import Command
from drakegrasp.cli.options import PATH, PathType, chosen_workers, connection_options, shared

if TYPE_CHECKING:
    from drakegrasp.scoring.run import Score

EXISTING = PathType(path_type=Path, exists=True)
#: Where files are written if --out does not say.
DEFAULT_FOLDER = Path("score")


@click.command(cls=Command)
@click.argument("predictions", type=EXISTING, metavar="[PREDICTIONS]...", nargs=-1)
@click.option(
    "--dataset",
    type=PATH,
    required=True,
    metavar="FILE",
    help="The data file OUT/grasping_oto.hdf5 or _otm, or OUT/scenes.hdf5, whose rows or views the "
    "predictions are for.",
)
@click.option(
    "--split",
    type=click.Choice(["train", "valid", "test"]),
    default="test",
    show_default=True,
    help="Rows of the dataset.",
)
@click.option(
    "--against",
    type=EXISTING,
    multiple=True,
    metavar="FILE",
    help="Predictions of another method for the same rows: the card says by how much the headline "
    "is above its. May be given several times, for a method that was trained several times.",
)
@click.option(
    "--train",
    type=PATH,
    metavar="FILE",
    help="Data file whose training rows give the reference rows.  [default: --dataset]",
)
@click.option(
    "--reference",
    "references",
    multiple=True,
    metavar="NAME",
    help="Score these reference rows only; may be given several times: own, nearest image, "
    "constant, random, top-down, palm normals, surface.  [default: all]",
)
@click.option(
    "--per-object", type=click.IntRange(1), metavar="N", help="Rows of each object, at most."
)
@shared("--set")
@click.option(
    "--protocol",
    metavar="NAME|FILE.py:NAME",
    default="lift",
    show_default=True,
    help="The rule of a verdict, see `drakegrasp verify`. All but lift try the first wrist pose of "
    "a prediction in MuJoCo.",
)
@click.option(
    "--out",
    type=PATH,
    metavar="DIR",
    default=DEFAULT_FOLDER,
    show_default=True,
    help="Folder of the card and of the verdicts; the same command goes on from there.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the card as JSON.")
@connection_options
@shared("--quiet", help="Show neither progress nor the table.")
def score(
    predictions: tuple[Path, ...],
    dataset: Path,
    split: str,
    against: tuple[Path, ...],
    train: Path | None,
    references: tuple[str, ...],
    per_object: int | None,
    overrides: tuple[str, ...],
    protocol: str,
    out: Path,
    as_json: bool,
    quiet: bool,
    **options: Any,
) -> None:
    """Score predicted grasps beside reference rows, and write a card.

    Each of PREDICTIONS is a .npy, HDF5 or Parquet file: (n, 6k) numbers, one grasp per row of the
    split, or (n, m, 6k), m per row, in the camera's frame; or a file of postures with the `row`
    that each is for; or a file or a folder of samples that were exported. Several files are of one
    method that was trained several times. Without any, the reference rows are scored alone.

    DIR gets card.json, card.md, card.png, and the verdicts, so that an interrupted score goes on.
    """
    from drakegrasp.api.scoring import score as score_predictions
    from drakegrasp.cli.tables import make_console, score_table
    from drakegrasp.dataset.manifest import read_manifest
    from drakegrasp.dataset.scenes.rows import open_rows
    from drakegrasp.errors import DataError, GraspError
    from drakegrasp.exchange.attempts import holds_postures
    from drakegrasp.scoring.references import REFERENCES

    workers = chosen_workers(options)

    # A bad dataset is wrong usage, as for `verify`.
    try:
        read_manifest(dataset.parent)
        bare = not references and bool(predictions) and all(map(holds_postures, predictions))
        data = open_rows(dataset, split=split, fewer_fingers=bare)
        trained = None if train is None else open_rows(train, split="train")
    except DataError as error:
        raise GraspError(str(error)) from None
    chosen = references or tuple(REFERENCES)
    if data.has_fewer_fingers:
        say("no reference rows: some samples leave fingers out", err=True)
        chosen = ()
    again = _command(
        predictions, dataset, split, against, train, references, per_object, overrides, protocol
    )
    scored = score_predictions(
        predictions,
        data,
        against=against or None,
        train=trained,
        references=chosen,
        per_object=per_object,
        overrides=overrides,
        protocol=protocol,
        out=out,
        again=again,
        **workers,
        show=not quiet,
    )
    if as_json:
        click.echo(json.dumps(scored.card, indent=1, allow_nan=False))
    else:
        say_paths(scored, out)
    if not quiet:
        make_console(stderr=True).print(score_table(scored.card, scored.seconds))
        for warning in scored.card["warnings"]:
            say(f"warning: {warning}", err=True)


def say_paths(scored: Score, out: Path) -> None:
    """Print the headline of the predictions, and where the card is."""
    for name, value in scored.card["headline"].items():
        low, high = 100.0 * value["low"], 100.0 * value["high"]
        say(f"{name}: {100.0 * value['value']:.1f} % ({low:.1f} to {high:.1f})")
    say(str(out / "card.md"))


def _command(
    predictions: tuple[Path, ...],
    dataset: Path,
    split: str,
    against: tuple[Path, ...],
    train: Path | None,
    references: tuple[str, ...],
    per_object: int | None,
    overrides: tuple[str, ...],
    protocol: str,
) -> str:
    """Return the command that makes the card again, without what changes no verdict."""
    words = ["drakegrasp", "score", *map(str, predictions), "--dataset", str(dataset)]
    words += [] if split == "test" else ["--split", split]
    for path in against:
        words += ["--against", str(path)]
    words += [] if train is None else ["--train", str(train)]
    for name in references:
        words += ["--reference", name]
    words += [] if per_object is None else ["--per-object", str(per_object)]
    for text in overrides:
        words += ["--set", text]
    words += [] if protocol == "lift" else ["--protocol", protocol]
    return shlex.join(words)


@click.command("bench-set", cls=Command)
@click.argument("out", type=PATH, metavar="OUT")
@shared("--only", "--set")
@connection_options
@shared("--quiet")
def bench_set(
    out: Path,
    only: tuple[str, ...],
    overrides: tuple[str, ...],
    quiet: bool,
    **options: Any,
) -> None:
    """Make the frozen benchmark drakegrasp-bench-1 in OUT.

    256 built-in objects with masses and frictions of their own, all for testing. Their meshes are
    compared with the published hashes. With --only or --set it is a part of the benchmark or
    another one, and each card says so. The same command continues an interrupted build.
    """
    from drakegrasp.api.building import make_benchmark
    from drakegrasp.cli.build import print_report

    report = make_benchmark(
        out,
        only=only,
        overrides=overrides,
        **chosen_workers(options),
        show=not quiet,
    )
    print_report(report)
