"""Build a small dataset of six built-in objects in less than a minute and show its contents.

The script writes DIR/meshes (the objects), DIR/dataset (the dataset) and DIR/contact_sheet.png. The
same command continues an interrupted build.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import numpy as np

from drakegrasp.api.building import build_dataset
from drakegrasp.cli.tables import make_console, print_stats
from drakegrasp.dataset.paths import DATA_FILES, TRIALS_FILE
from drakegrasp.dataset.reader import GraspDataset
from drakegrasp.dataset.schema import SPLITS
from drakegrasp.errors import DataError, DrakegraspError
from drakegrasp.hand.settings import load_config
from drakegrasp.pictures.sheets import ACROSS, draw_sheet
from drakegrasp.pictures.style import read_far, save_figure
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
    count = contact_sheet(out / DATA_FILES["oto"], sheet)
    console.print(f"{sheet}: {count} samples drawn", soft_wrap=True, highlight=False)
    for name in (*DATA_FILES.values(), TRIALS_FILE):
        console.print(str(out / name), soft_wrap=True, highlight=False)


def contact_sheet(path: Path, png: Path, *, rows: int = 8, split: str | None = None) -> int:
    """Draw samples of a data file: each sample's colour, depth and mask, with its contacts.

    The sheet shows as many different objects as possible. The same file yields the same sheet.

    Args:
        path: `grasping_oto.hdf5` or `grasping_otm.hdf5`.
        png: The file to write.
        rows: Maximum number of lines of samples.
        split: The split to draw from; all of them if None.

    Returns:
        The number of samples drawn.

    Raises:
        DataError: If the file is not a data file or holds no sample.
    """
    # All samples of the file.
    splits = SPLITS if split is None else (split,)
    parts = [GraspDataset(path, split=each, fewer_fingers=True) for each in splits]
    places = [(part, row) for part in parts for row in range(len(part))]
    if not places:
        raise DataError(f"{path}: must hold at least one sample to draw, got none")

    # Choose some of them, and draw them.
    names = [str(name) for part in parts for name in part.column("object_props/object_name")]
    chosen = spread_over_objects(names, rows * ACROSS)
    samples = [places[i][0][places[i][1]] for i in chosen]
    figure = draw_sheet(samples, parts[0].K, far=read_far(path))
    save_figure(figure, png, dpi=130)
    return len(samples)


def spread_over_objects(names: Sequence[str], count: int) -> list[int]:
    """Return the indices of at most `count` samples, spread over as many objects as possible.

    Objects are ordered by their numbers. If there are more objects than places, evenly spaced
    objects are taken. The first samples of each object are taken.

    Args:
        names: Name of the object of each sample.
        count: Maximum number of samples to choose.
    """
    # Turn t holds the t-th sample of every object that has at least t samples.
    order = sorted(range(len(names)), key=lambda i: (_natural(names[i]), i))
    turns: list[list[int]] = []
    for _, group in groupby(order, key=lambda i: names[i]):
        for turn, i in enumerate(group):
            if turn == len(turns):
                turns.append([])
            turns[turn].append(i)

    # Fill the places turn by turn.
    chosen: list[int] = []
    for turn_indices in turns:
        room = min(count - len(chosen), len(turn_indices))
        picks = np.linspace(0, len(turn_indices) - 1, room).round().astype(int)
        chosen += [turn_indices[k] for k in picks]

    # Samples of an object are side by side.
    place = {i: k for k, i in enumerate(order)}
    return sorted(chosen, key=place.__getitem__)


def _natural(name: str) -> tuple[int, str]:
    """Return the sorting key of a name: its leading number, then the rest."""
    number, _, rest = name.partition("_")
    return (int(number), rest) if number.isdecimal() else (10**9, name)


if __name__ == "__main__":
    raise SystemExit(main())
