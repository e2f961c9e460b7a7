"""The command that draws a dataset."""

from __future__ import annotations

from pathlib import Path

import click

from drakegrasp.cli.options import out_argument


@click.command()
@out_argument
@click.option(
    "--out",
    "folder",
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Where to write.  [default: OUT/figures]",
)
@click.option(
    "--trial", type=int, metavar="ID", help="The grasp whose phases are drawn: row of trials.hdf5."
)
@click.option(
    "--compare",
    type=click.Path(path_type=Path),
    metavar="OTHER",
    help="A dataset of the same objects by the other method of palm poses (candidates.method).",
)
@click.option("--quiet", is_flag=True, help="Show no progress.")
def figures(
    out: Path, folder: Path | None, trial: int | None, compare: Path | None, quiet: bool
) -> None:
    """Draw a dataset: pictures as PNG and SVG, numbers as JSON.

    \b
    palm_poses     palm poses by surface normals and by rotations, and what
                   they found
    phases         one grasp from the side: start, closed, lifted
    classes        colour, depth and mask of one grasp of each class
    outcomes       how the attempts ended
    hold           how well successes hold, and how many are samples
    objects        successes of each object
    distributions  slip, turn, forces
    approaches     from where successes came
    """  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)
    from drakegrasp.runtime.progress import progress_bar
    from drakegrasp.visualization.figures.write import write_figures

    with progress_bar("draw", "figures", show=not quiet) as progress:
        written = write_figures(
            out,
            out / "figures" if folder is None else folder,
            compare=compare,
            trial_id=trial,
            progress=progress,
        )
    for name, why in written.left_out.items():
        click.echo(f"{name} is left out: {why}")
    click.echo(f"{len(written.names)} figures in {written.folder}")
