"""The commands that show a dataset: in a browser, as figures."""

from __future__ import annotations

from pathlib import Path

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.options import PATH, dataset_argument, shared
from drakegrasp.errors import counted

#: Port without --port; the same every time, so that a tunnel to another machine can stay.
PORT = 8321


@click.command("inspect")
@dataset_argument()
@click.option(
    "--predictions",
    "results",
    type=PATH,
    metavar="RESULTS",
    help="Show predictions beside the rows that they are for: the results that "
    "verify --dataset FILE --out NAME wrote.",
)
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=PORT,
    show_default=True,
    metavar="N",
    help="Port on this machine; 0 takes any that is free.",
)
@click.option(
    "--static",
    "folder",
    type=PATH,
    metavar="DIR",
    help="Write the pages to DIR as files that open without a server, and end.",
)
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def inspect_(
    out: Path, results: Path | None, port: int, folder: Path | None, no_browser: bool
) -> None:
    """Look at grasps in a browser, and reject them.

    The page shows every attempt in OUT with images, contacts, forces and a 3D view, the most
    suspicious first. Rejections are written to OUT/reject.json at once; assemble --reject reads
    that file. The page can be reached from this machine only, and while a build runs, too. Ctrl-C
    ends it.
    """
    from drakegrasp.errors import DataError

    try:
        from drakegrasp.page.serve import serve
        from drakegrasp.page.site import write_site
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in ("starlette", "uvicorn", "jinja2"):
            raise
        raise DataError(
            f"inspect needs {library}, which is missing: pip install 'drakegrasp[inspect]'"
        ) from None

    if folder is None:
        serve(out, results=results, port=port, browser=not no_browser, announce=say)
        return
    from drakegrasp.runtime.progress import progress_bar

    with progress_bar("inspect", "grasps") as progress:
        site = write_site(out, folder, results=results, progress=progress)
    rest = "" if site.grasps == site.successes else f", the most suspicious of {site.successes:,}"
    say(f"{counted(site.grasps, 'grasp')} in {folder / 'index.html'}{rest}")


@click.command()
@dataset_argument()
@click.option(
    "--out", "folder", type=PATH, metavar="DIR", help="Where to write.  [default: OUT/figures]"
)
@click.option(
    "--trial", type=int, metavar="ID", help="The grasp whose phases are drawn: row of trials.hdf5."
)
@click.option(
    "--compare",
    type=PATH,
    metavar="OTHER",
    help="A dataset of the same objects by the other method of palm poses (candidates.method).",
)
@shared("--quiet")
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
    views          views of scenes with a sample of each, if there are scenes
    """  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)
    from drakegrasp.foreign_files import refuse_link
    from drakegrasp.pictures.figures.write import write_figures
    from drakegrasp.runtime.progress import progress_bar

    if folder is None:
        folder = out / "figures"
        refuse_link(folder)
    with progress_bar("draw", "figures", show=not quiet) as progress:
        written = write_figures(
            out,
            folder,
            compare=compare,
            trial_id=trial,
            progress=progress,
        )
    for name, why in written.left_out.items():
        say(f"{name} is left out: {why}")
    say(f"{counted(len(written.names), 'figure')} in {written.folder}")
