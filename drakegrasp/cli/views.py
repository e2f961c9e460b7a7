"""The commands that show a dataset in a browser or in figures, or export it to other formats."""

from __future__ import annotations

from textwrap import fill
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from drakegrasp import registry
from drakegrasp.cli.arguments import AnyPath, Count, Dataset, Folder, given
from drakegrasp.cli.console import UsageError, progress_bar, say
from drakegrasp.cli.help import new_group
from drakegrasp.errors import counted

#: Default of --port: a fixed number, so that a tunnel to another machine can stay open.
PORT = 8321


def inspect(
    out: Dataset,
    /,
    *,
    results: Annotated[AnyPath | None, Parameter(name="--predictions", metavar="RESULTS")] = None,
    port: Annotated[Count, Parameter(validator=Number(gte=0, lte=65535))] = PORT,
    no_browser: bool = False,
) -> None:
    """Render at grasps in a browser, and reject them.

    The page shows every attempt in OUT with images, contacts, forces and a 3D view, the most
    anomalous first. Rejections are written to OUT/reject.json immediately; assemble --reject reads
    that file. The page can be reached from this machine only. Ctrl-C ends the command.

    Args:
        out: Directory of the dataset.
        results: Show predictions next to their rows of the dataset: the results that verify
            --dataset FILE --out NAME wrote.
        port: Port on this machine; 0 selects any free port.
        no_browser: Only print the address.
    """
    from drakegrasp.errors import MachineError, one_line

    try:
        from drakegrasp.page.app import serve
    except ImportError as error:
        if (error.name or "").partition(".")[0] == "drakegrasp":
            raise
        raise MachineError(
            f"inspect needs its packages: pip install 'drakegrasp[inspect]' ({one_line(error)})"
        ) from None

    serve(out, results=results, port=port, browser=not no_browser, announce=say)


def figures(
    out: Dataset,
    /,
    *,
    folder: Annotated[Folder | None, Parameter(name="--out")] = None,
    quiet: bool = False,
) -> None:
    """Draw a dataset: pictures as PNG and SVG, numbers as JSON.

        sheet          colour, depth and mask of samples of all objects in turn
        outcomes       how the attempts ended: samples, removed, failed
        distributions  slip, turn, forces of the samples

    Args:
        out: Directory of the dataset.
        folder: Folder of the figures. [default: OUT/figures]
        quiet: Show no progress.
    """
    from drakegrasp.foreign_files import validate_no_link
    from drakegrasp.pictures.figures import write_figures

    if folder is None:
        folder = out / "figures"
        validate_no_link(folder)
    with progress_bar("draw", "figures", show=not quiet) as progress:
        written = write_figures(out, folder, progress=progress)
    for name, why in written.left_out.items():
        say(f"{name} is left out: {why}")
    say(f"{counted(len(written.names), 'figure')} in {written.folder}")


def _formats() -> str:
    """Return a line or more on each format."""
    names = registry.names("exporters")
    rows = (f"  {name:<15}{registry.summary('exporters', name)}" for name in names)
    return "Formats:\n" + "\n".join(fill(row, 79, subsequent_indent=" " * 17) for row in rows)


export = new_group("export", None, help_epilogue=_formats())


@export.default
def export_samples(
    out: Dataset,
    directory: Folder | None = None,
    /,
    *,
    form: Annotated[str, Parameter(name="--to", metavar="FORMAT")],
    licence: Annotated[str | None, Parameter(name=("--licence", "--license"), metavar="ID")] = None,
    quiet: bool = False,
) -> None:
    """Write the samples of a dataset in another format.

    Args:
        out: Directory of the dataset.
        directory: New or empty folder. [default: OUT/export_FORMAT]
        form: The format, see below.
        licence: Licence that the card of format hf names, e.g. cc-by-4.0.
        quiet: Show no progress.
    """
    from drakegrasp.exchange.export import export_dataset, options_of
    from drakegrasp.foreign_files import validate_no_link

    # What only some formats take.
    options = given(licence=licence)
    for name, value in options.items():
        if name not in options_of(form):
            raise UsageError(f"--{name} must be left out with --to {form}, got {value}")

    if directory is None:
        directory = out / f"export_{form}"
        validate_no_link(directory)
    counts = registry.summary("exporters", form, "COUNTS") or "sample"
    with progress_bar("export", f"{counts}s", show=not quiet) as progress:
        count = export_dataset(out, directory, form, progress=progress, **options)
    say(f"{counted(count, counts)} in {directory}")
