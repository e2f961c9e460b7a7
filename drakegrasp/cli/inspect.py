"""The command that shows a dataset in a browser."""

from __future__ import annotations

from pathlib import Path

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.options import out_argument

#: Port without --port; the same every time, so that a tunnel to another machine can stay.
PORT = 8321


@click.command("inspect")
@out_argument
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
    type=click.Path(path_type=Path),
    metavar="DIR",
    help="Write the pages to DIR as files that open without a server, and end.",
)
@click.option("--no-browser", is_flag=True, help="Only print the address.")
def inspect_(out: Path, port: int, folder: Path | None, no_browser: bool) -> None:
    """Look at grasps in a browser, and reject them.

    The page shows every attempt in OUT with images, contacts, forces and a 3D view, the most
    suspicious first. Rejections are written to OUT/reject.json at once; assemble --reject reads
    that file. The page can be reached from this machine only, and while a build runs, too. Ctrl-C
    ends it.
    """
    from drakegrasp.errors import DataError

    try:
        from drakegrasp.inspection.serve import serve
        from drakegrasp.inspection.static_site import write_site
    except ModuleNotFoundError as error:
        library = (error.name or "").partition(".")[0]
        if library not in ("starlette", "uvicorn", "jinja2"):
            raise
        raise DataError(
            f"inspect needs {library}, which is missing: pip install 'drakegrasp[inspect]'"
        ) from None

    if folder is None:
        serve(out, port=port, browser=not no_browser, announce=say)
        return
    from drakegrasp.runtime.progress import progress_bar

    with progress_bar("inspect", "grasps") as progress:
        count = write_site(out, folder, progress=progress)
    say(f"{count:,} grasps in {folder / 'index.html'}")
