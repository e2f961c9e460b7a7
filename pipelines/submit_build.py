"""Build a dataset on a cluster: this machine, SSH, SLURM, or a running Dask scheduler.

\b
    python pipelines/submit_build.py --cluster local ...
    python pipelines/submit_build.py --cluster ssh node1 node2 --cores 16 --interface eth0 ...
    python pipelines/submit_build.py --cluster slurm --workers 200 --walltime 04:00:00 ...
    python pipelines/submit_build.py --cluster scheduler tcp://10.0.0.1:8786 ...
    python pipelines/submit_build.py --cluster scheduler-file scheduler.json ...

The script first prints what will run and how long it is expected to take; --dry-run stops
there. The same command continues an interrupted build, on any cluster. See
docs/how-to/clusters.md for the details and pipelines/recipes/ for an example of each.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import click
from distributed import Client

from drakegrasp.api.building import build_on, find_sources
from drakegrasp.cli.console import OneCommand
from drakegrasp.cli.datasets import print_plan, print_report
from drakegrasp.cli.options import (
    Named,
    chosen_tls,
    described,
    parse_request,
)
from drakegrasp.cluster.connect import dashboard_line
from drakegrasp.cluster.kinds import REMOTE, Local, cluster_of, describe
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.hand.description import load_hand


@click.command(
    cls=OneCommand, help=__doc__, context_settings={"help_option_names": ["-h", "--help"]}
)
@partial(described, request=Local)
@click.argument("where", nargs=-1, metavar="[HOST...|ADDRESS|PATH]")
def main(
    where: tuple[str, ...],
    times: Path | None,
    kind: Annotated[str, Named("clusters")] = "local",
    dry_run: bool = False,
    **options: Any,
) -> None:
    """Run the script.

    Options:
        --cluster (kind): Where the work runs. Hosts follow ssh, an address follows scheduler, and a
            path follows scheduler-file.
        BUILD
        --workers N: Processes in all. [default with local: one per core]
        --cores N: Cores of each SSH host or SLURM job, a worker on each.
        --memory SIZE: Memory of each worker, e.g. 2GB.
        --walltime TIME: Time limit of each SLURM job, [D-]HH:MM:SS.
        --interface NAME: Network interface on which scheduler and workers listen.
        --host ADDRESS: Address on which the scheduler listens, instead.
        TLS, --times
        --dry-run: Only print what would run.
    """
    tls = chosen_tls(options)
    own = {name: options.pop(name) for name in (*REMOTE, "walltime")}
    request = parse_request(options)
    cluster = cluster_of(kind, where=where, **own, **tls)

    # Say what will run before anything starts.
    click.echo("\n".join(describe(cluster)))
    if request.postures is None:
        print_plan(request, cluster.count(), times)
    if dry_run:
        return

    sources = find_sources(request.objects, request.units, request.manifest)
    running = _present(cluster.connected(request.out), request.show)
    postures = None
    if request.postures is not None:
        postures = read_attempts(request.postures, load_hand(request.config.hand_source))
    report = build_on(
        running,
        sources,
        request.out,
        request.config,
        only=request.only,
        postures=postures,
        show=request.show,
    )
    print_report(report)


@contextmanager
def _present(cluster: AbstractContextManager[Client], show: bool) -> Iterator[Client]:
    """Enter a cluster, say where its dashboard is, and wait for its first worker."""
    with cluster as client:
        if show and client.dashboard_link:  # workers on this machine have none
            click.echo(dashboard_line(client), err=True)
        if not client.nthreads():
            click.echo("waiting for the first worker", err=True)
            client.wait_for_workers(1)
        yield client


if __name__ == "__main__":
    main()
