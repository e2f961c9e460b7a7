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
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.errors import DrakegraspError
from drakegrasp.hand.settings import load_config
from drakegrasp.pictures.sheets import sample_sheet
from drakegrasp.pictures.style import save_figure
from drakegrasp.shapes.catalog import draw_builtin, export_builtin

#: Classes that the hand often grasps.
CLASSES = ("wineglass", "carton", "boot")
#: Objects per class: one trains and validates, the other is tested.
PER_CLASS = 2
#: Palm poses per object, normal to its surface: far fewer of the paper's poses become samples.
CANDIDATES, METHOD = 40, "normals"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("directory", type=Path, metavar="DIR", help="where to write")
    parser.add_argument(
        "--candidates",
        type=int,
        default=CANDIDATES,
        help=f"palm poses per object  [default: {CANDIDATES}]",
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
            candidates=arguments.candidates,
            per_class=arguments.per_class,
            workers=arguments.workers,
        )
    except DrakegraspError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    return 0


def run(
    directory: Path, *, candidates: int, per_class: int = PER_CLASS, workers: int | None = None
) -> None:
    """Export the objects, build their dataset, and print and draw its contents."""
    meshes, out, sheet = (
        directory / "meshes",
        directory / "dataset",
        directory / "contact_sheet.png",
    )

    # Shards of 20 candidates keep all cores busy to the end of such a small dataset.
    overrides = [f"candidates.max={candidates}", f"candidates.method={METHOD}"]
    overrides += [f"builtin.per_class={per_class}", "unit_candidates=20"]
    config = load_config(None, overrides)
    drawn = draw_builtin(config.builtin)
    export_builtin(meshes, [item.name for item in drawn if item.object_class.name in CLASSES])
    build_dataset(meshes, out, config=config, workers=workers)

    print_stats(out)
    console = make_console()
    figure, trials = sample_sheet(out / DATA_FILES["oto"])
    save_figure(figure, sheet, dpi=130)
    console.print(f"{sheet}: {len(trials)} samples drawn", soft_wrap=True, highlight=False)
    for name in (*DATA_FILES.values(), TRIALS_FILE):
        console.print(str(out / name), soft_wrap=True, highlight=False)


if __name__ == "__main__":
    raise SystemExit(main())
