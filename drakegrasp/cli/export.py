"""`drakegrasp export`: a dataset in the format of another tool."""

from __future__ import annotations

from pathlib import Path

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.options import PATH, dataset_argument, shared
from drakegrasp.errors import counted

#: The formats as the help lists them; loading them would take longer than printing the help.
FORMATS = ("hf", "original", "dexgraspbench", "isaac_grasp", "glb", "mjcf")


@click.command()
@dataset_argument()
@click.argument("directory", type=PATH, required=False)
@click.option("--to", "form", type=click.Choice(FORMATS), required=True, help="The format.")
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

    \b
    hf             Parquet, a dataset card and Croissant metadata, as the Hugging
                   Face Hub has them; needs pip install 'drakegrasp[hub]'
    original       HDF5 as of the paper's released code: depth first, 27 numbers
                   a grasp, axes of its cameras
    dexgraspbench  hand, objects and grasps as that benchmark's code evaluates
                   them; needs pip install 'drakegrasp[peer]'
    isaac_grasp    a YAML file per object: poses of the palm link, joints by name
    glb            a 3D scene per grasp: the object in the closed hand
    mjcf           the same for MuJoCo, with the table; needs drakegrasp[peer]
    """  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)
    from drakegrasp.exchange.export import export_dataset
    from drakegrasp.exchange.publication import Publication, not_said, read_publication
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
        count = export_dataset(out, directory, form, publication=publication, progress=progress)  # type: ignore[arg-type]
    say(f"{counted(count, 'sample')} in {directory}")
    if form == "hf" and (missing := not_said(publication)):
        say(f"before it is published, --about should say: {', '.join(missing)}")
