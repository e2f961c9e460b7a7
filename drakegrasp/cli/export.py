"""`drakegrasp export`: a dataset in the format of another tool."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill

import click

from drakegrasp import registry
from drakegrasp.cli.errors import say
from drakegrasp.cli.help import Command
from drakegrasp.cli.options import PATH, Named, dataset_argument, shared
from drakegrasp.errors import counted


class _Export(Command):
    """The command, whose help lists the exporters."""

    def format_help_text(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the text, and a paragraph of the formats; called by click."""
        super().format_help_text(ctx, formatter)
        formatter.write_paragraph()
        for name in registry.names("exporters"):
            row = f"  {name:<15}{registry.summary('exporters', name)}"
            formatter.write(f"{fill(row, 79, subsequent_indent=' ' * 17)}\n")


@click.command(cls=_Export)
@dataset_argument()
@click.argument("directory", type=PATH, required=False)
@click.option("--to", "form", type=Named("exporters"), required=True, help="The format.")
@click.option(
    "--licence",
    "--license",
    metavar="ID",
    help="Licence that the card of format hf names, e.g. cc-by-4.0.",
)
@click.option(
    "--about",
    type=PATH,
    metavar="YAML",
    help="For format hf: name, version, url, creators, published, licence, citation.",
)
@shared("--quiet")
def export(
    out: Path,
    directory: Path | None,
    form: str,
    licence: str | None,
    about: Path | None,
    quiet: bool,
) -> None:
    """Write the samples of a dataset in another format.

    DIRECTORY must be new or empty.  [default: OUT/export_FORMAT]
    """
    from drakegrasp.exchange.croissant import Publication, not_said, read_publication
    from drakegrasp.exchange.export import export_dataset
    from drakegrasp.foreign_files import refuse_link
    from drakegrasp.runtime.progress import progress_bar

    # What is said of the publishers; the option is stronger than the file.
    if form != "hf" and about:
        raise click.UsageError(f"--about is for --to hf, got --to {form}")
    publication = Publication() if about is None else read_publication(about)
    if licence:
        publication = publication.model_copy(update={"licence": licence})

    if directory is None:
        directory = out / f"export_{form}"
        refuse_link(directory)
    with progress_bar("export", "sample", show=not quiet) as progress:
        count = export_dataset(out, directory, form, publication=publication, progress=progress)
    say(f"{counted(count, 'sample')} in {directory}")
    if form == "hf" and (missing := not_said(publication)):
        say(f"before it is published, --about should say: {', '.join(missing)}")
