"""Create the certificates of a Dask cluster: an authority, a certificate and its key.

\b
    python pipelines/make_certificates.py FOLDER

FOLDER must not exist yet; the script writes ca.pem, cert.pem and key.pem to it. Scheduler, workers
and client use the same three files, and reject everybody who does not have them. Only you may enter
FOLDER: whoever can read the key can run programs as you on the cluster. See
docs/how-to/clusters.md.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

from pathlib import Path

import click

from drakegrasp.cli.console import OneCommand
from drakegrasp.cli.options import PATH
from drakegrasp.cluster.certificates import make_certificates
from drakegrasp.errors import MachineError


@click.command(cls=OneCommand, help=__doc__)
@click.argument("folder", type=PATH)
def main(folder: Path) -> None:
    """Run the script."""
    try:
        folder.mkdir(mode=0o700, parents=True)
    except OSError as error:
        raise MachineError(f"{folder}: must be a folder that can be made: {error}") from None
    for path in make_certificates(folder):
        click.echo(path)


if __name__ == "__main__":
    main()
