"""The commands that show a dataset in a browser or in figures, or export it to other formats."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import Annotated

import click

from drakegrasp import registry
from drakegrasp.cli.console import Command, progress_bar, say
from drakegrasp.cli.options import PATH, Named, dataset_argument, described
from drakegrasp.errors import counted

#: Default of --port: a fixed number, so that a tunnel to another machine can stay open.
PORT = 8321


@click.command("inspect")
@described
@dataset_argument()
def inspect_(
    out: Path,
    results: Path | None = None,
    port: Annotated[int, click.IntRange(0, 65535)] = PORT,
    no_browser: bool = False,
) -> None:
    """Look at grasps in a browser, and reject them.

    The page shows every attempt in OUT with images, contacts, forces and a 3D view, the most
    suspicious first. Rejections are written to OUT/reject.json immediately; assemble --reject reads
    that file. The page can be reached from this machine only. Ctrl-C ends the command.

    Options:
        --predictions RESULTS (results): Show predictions next to their rows of the dataset: the
            results that verify --dataset FILE --out NAME wrote.
        --port N: Port on this machine; 0 selects any free port.
        --no-browser: Only print the address.
    """
    from drakegrasp.errors import MachineError, one_line

    try:
        from drakegrasp.page.serve import serve
    except ImportError as error:
        if (error.name or "").partition(".")[0] == "drakegrasp":
            raise
        raise MachineError(
            f"inspect needs its packages: pip install 'drakegrasp[inspect]' ({one_line(error)})"
        ) from None

    serve(out, results=results, port=port, browser=not no_browser, announce=say)


@click.command()
@described
@dataset_argument()
def figures(
    out: Path,
    quiet: bool,
    folder: Path | None = None,
) -> None:
    """Draw a dataset: pictures as PNG and SVG, numbers as JSON.

    \b
    sheet          colour, depth and mask of samples of all objects in turn
    outcomes       how the attempts ended: samples, removed, failed
    hold           samples: how well they hold, how many are distinct
    objects        samples of each object, and how many are distinct
    distributions  slip, turn, forces of the samples
    approaches     from where the palms of the samples came
    views          views of scenes with a sample of each, if there are scenes

    Options:
        --out DIR (folder): Folder of the figures. [default: OUT/figures]
        --quiet
    """  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)
    from drakegrasp.foreign_files import refuse_link
    from drakegrasp.pictures.figures import write_figures

    if folder is None:
        folder = out / "figures"
        refuse_link(folder)
    with progress_bar("draw", "figures", show=not quiet) as progress:
        written = write_figures(out, folder, progress=progress)
    for name, why in written.left_out.items():
        say(f"{name} is left out: {why}")
    say(f"{counted(len(written.names), 'figure')} in {written.folder}")


class _Export(Command):
    """The command `export`, whose help lists the exporters."""

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the text, and a paragraph with the formats; called by click."""
        super().format_help_text(ctx, formatter)
        formatter.write_paragraph()
        for name in registry.names("exporters"):
            row = f"  {name:<15}{registry.summary('exporters', name)}"
            formatter.write(f"{fill(row, 79, subsequent_indent=' ' * 17)}\n")


@click.command(cls=_Export)
@described
@dataset_argument()
@click.argument("directory", type=PATH, required=False)
def export(
    out: Path,
    directory: Path | None,
    quiet: bool,
    *,
    form: Annotated[str, Named("exporters")],
    licence: str | None = None,
    attempts: Annotated[str | None, click.Choice(["samples", "failed", "all"])] = None,
    fps: Annotated[int | None, click.IntRange(1, 120)] = None,
) -> None:
    """Write the samples of a dataset in another format.

    DIRECTORY must be new or empty.  [default: OUT/export_FORMAT]

    Options:
        --to (form): The format.
        --licence --license ID: Licence that the card of format hf names, e.g. cc-by-4.0.
        --attempts WHICH: Attempts of format lerobot: samples; failed: the hand closed, but does
            not hold the object; all: samples, failed and held attempts.  [default: samples]
        --fps N: Frames per second of format lerobot.  [default: 10]
        --quiet
    """
    from drakegrasp.exchange.export import export_dataset, options_of
    from drakegrasp.foreign_files import refuse_link

    # What only some formats take.
    known = options_of(form)
    given = {"licence": licence, "attempts": attempts, "fps": fps}
    options = {name: value for name, value in given.items() if value}
    for name, value in options.items():
        if name not in known:
            raise click.UsageError(f"--{name} must be left out with --to {form}, got {value}")

    if directory is None:
        directory = out / f"export_{form}"
        refuse_link(directory)
    counts = registry.summary("exporters", form, "COUNTS") or "sample"
    with progress_bar("export", f"{counts}s", show=not quiet) as progress:
        count = export_dataset(out, directory, form, progress=progress, **options)
    say(f"{counted(count, counts)} in {directory}")
