"""Create the certificates of a Dask cluster: an authority, a certificate and its key.

    python pipelines/make_certificates.py FOLDER

FOLDER must not exist yet; the script writes ca.pem, cert.pem and key.pem to it. Scheduler, workers
and client use the same three files, and reject everybody who does not have them. Only you may enter
FOLDER: whoever can read the key can run programs as you on the cluster. See
docs/how-to/clusters.md.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from drakegrasp.cli.arguments import Folder
from drakegrasp.cli.console import new_group, run_command, say
from drakegrasp.cluster.connect import make_certificates
from drakegrasp.errors import MachineError

app = new_group("make_certificates", __doc__)


@app.default
def make(folder: Folder, /) -> None:
    """Create the certificates.

    Args:
        folder: The new folder.
    """
    try:
        folder.mkdir(mode=0o700, parents=True)
    except OSError as error:
        raise MachineError(f"{folder}: must be a folder that can be made: {error}") from None
    for path in make_certificates(folder):
        say(str(path))


def main(words: Sequence[str] | None = None) -> None:
    """Run the script."""
    run_command(app, sys.argv[1:] if words is None else words)


if __name__ == "__main__":
    main()
