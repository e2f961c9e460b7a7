"""Build a dataset on a cluster: the command `drakegrasp submit`, from a checkout."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from drakegrasp.cli.main import main as run


def main(words: Sequence[str] | None = None) -> None:
    """Run the script."""
    sys.argv[1:] = ["submit", *(sys.argv[1:] if words is None else words)]
    run()


if __name__ == "__main__":
    main()
