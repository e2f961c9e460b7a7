"""Build a dataset on a cluster: the command `drakegrasp submit`, from a checkout."""

from __future__ import annotations

from drakegrasp.cli.submit import submit as main

if __name__ == "__main__":
    main()
