"""Build a small dataset of six built-in objects in less than a minute and show its contents.

The script writes DIR/meshes (the objects), DIR/dataset (the dataset) and DIR/contact_sheet.png. The
same command continues an interrupted build.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from drakegrasp.api.building import build_dataset
from drakegrasp.cli.tables import make_console, print_stats
from drakegrasp.config import BuiltinConfig
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.errors import DrakegraspError
from drakegrasp.hand.settings import load_config
from drakegrasp.pictures.figures import sample_sheet
from drakegrasp.pictures.style import save_figure
from drakegrasp.shapes.catalog import draw_builtin, export_builtin

#: Classes of the objects, and objects per class.
CLASSES, PER_CLASS = ("wineglass", "carton", "boot"), 2
#: Samples of all objects together.
SAMPLES = 60


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("directory", type=Path, metavar="DIR", help="where to write")
    parser.add_argument(
        "--samples",
        type=int,
        default=SAMPLES,
        help=f"samples of all objects together  [default: {SAMPLES}]",
    )
    parser.add_argument(
        "--per-class",
        type=int,
        default=PER_CLASS,
        help=f"objects per class  [default: {PER_CLASS}]",
    )
    parser.add_argument("--workers", type=int, help="processes  [default: one per core]")
    arguments = parser.parse_args(argv)
    try:
        run(
            arguments.directory,
            samples=arguments.samples,
            per_class=arguments.per_class,
            workers=arguments.workers,
        )
    except DrakegraspError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    return 0


def run(
    directory: Path, *, samples: int, per_class: int = PER_CLASS, workers: int | None = None
) -> None:
    """Export the objects, build their dataset, and print and draw its contents."""
    meshes, out, sheet = (
        directory / "meshes",
        directory / "dataset",
        directory / "contact_sheet.png",
    )

    drawn = draw_builtin(BuiltinConfig(per_class=per_class))
    export_builtin(meshes, [item.name for item in drawn if item.object_class.name in CLASSES])
    build_dataset(meshes, out, config=load_config("fast", samples=samples), workers=workers)

    print_stats(out)
    console = make_console()
    figure, trials = sample_sheet(out / DATA_FILES["oto"])
    save_figure(figure, sheet, dpi=130)
    console.print(f"{sheet}: {len(trials)} samples drawn", soft_wrap=True, highlight=False)
    for name in (*DATA_FILES.values(), TRIALS_FILE):
        console.print(str(out / name), soft_wrap=True, highlight=False)


if __name__ == "__main__":
    raise SystemExit(main())
