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
from pathlib import Path
from typing import Any

import click
from distributed import Client

from drakegrasp.api.building import build_on, find_sources
from drakegrasp.cli.console import OneCommand
from drakegrasp.cli.datasets import print_plan, print_report
from drakegrasp.cli.options import (
    BUILD,
    TLS,
    Named,
    chosen_tls,
    parse_request,
    shared,
)
from drakegrasp.cluster.connect import dashboard_line
from drakegrasp.cluster.kinds import ClusterRequest, cluster_of, describe
from drakegrasp.exchange.attempts import read_attempts
from drakegrasp.hand.description import load_hand


@click.command(
    cls=OneCommand, help=__doc__, context_settings={"help_option_names": ["-h", "--help"]}
)
@click.option(
    "--cluster",
    "kind",
    type=Named("clusters"),
    default="local",
    show_default=True,
    help="Where the work runs. Hosts follow ssh, an address follows scheduler, and a path follows "
    "scheduler-file.",
)
@click.argument("where", nargs=-1, metavar="[HOST...|ADDRESS|PATH]")
@shared(*BUILD)
@shared("--workers", text="Processes in all.  [default with local: one per core]")
@click.option(
    "--cores", type=int, metavar="N", help="Cores of each SSH host or SLURM job, a worker on each."
)
@click.option("--memory", metavar="SIZE", help="Memory of each worker, e.g. 2GB.")
@click.option("--walltime", metavar="TIME", help="Time limit of each SLURM job, [D-]HH:MM:SS.")
@click.option(
    "--interface", metavar="NAME", help="Network interface on which scheduler and workers listen."
)
@click.option("--host", metavar="ADDRESS", help="Address on which the scheduler listens, instead.")
@shared(*TLS)
@shared("--times")
@click.option("--dry-run", is_flag=True, help="Only print what would run.")
def main(
    kind: str,
    where: tuple[str, ...],
    workers: int | None,
    cores: int | None,
    memory: str | None,
    walltime: str | None,
    interface: str | None,
    host: str | None,
    times: Path | None,
    dry_run: bool,
    **options: Any,
) -> None:
    """Run the script."""
    tls = chosen_tls(options)
    request = parse_request(options)
    cluster = cluster_of(
        ClusterRequest(
            kind=kind,
            where=where,
            workers=workers,
            cores=cores,
            memory=memory,
            walltime=walltime,
            host=host,
            interface=interface,
            **tls,
        )
    )

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
