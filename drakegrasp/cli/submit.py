"""The command `submit`: a build whose workers the command also starts."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from drakegrasp.cli.console import OneCommand, say
from drakegrasp.cli.datasets import print_report
from drakegrasp.cli.options import NEW_FILE, Named, chosen_tls, described, parse_request

if TYPE_CHECKING:
    from drakegrasp.cluster.kinds import Local


@click.command(cls=OneCommand, context_settings={"help_option_names": ["-h", "--help"]})
@described
def submit(
    kind: Annotated[str, Named("clusters")] = "local",
    scheduler: str | None = None,
    scheduler_file: Path | None = None,
    workers: int | None = None,
    cores: int | None = None,
    memory: str | None = None,
    walltime: str | None = None,
    interface: str | None = None,
    host: str | None = None,
    own: tuple[str, ...] = (),
    dry_run: bool = False,
    script: Annotated[Path | None, NEW_FILE] = None,
    **options: Any,
) -> None:
    """Build a dataset on a cluster; the command starts the workers.

    \b
        drakegrasp submit --cluster local OPTIONS
        drakegrasp submit --cluster slurm --workers 200 --interface ib0 OPTIONS
        drakegrasp submit --scheduler tls://10.0.0.1:8786 OPTIONS

    The command first prints which workers it will use. The same command continues an interrupted
    build, on any cluster. See docs/how-to/clusters.md for the details and pipelines/recipes/ for an
    example of each.

    Options:
        --cluster KIND (kind): Where the work runs: local, slurm, pbs, lsf, sge, htcondor, oar, or a
            kind of another package.
        --scheduler ADDRESS: In place of --cluster: use the running Dask scheduler at this address.
        --scheduler-file FILE: In place of --cluster: use the running Dask scheduler that wrote this
            file.
        BUILD
        --workers N: Total number of processes. [default with local: one per core]
        --cores N: Number of cores of each job, with a worker on each core.
        --memory SIZE: Memory of each worker, e.g. 2GB.
        --walltime TIME: Time limit of each job, as the batch scheduler writes it.
        --interface NAME: Network interface on which scheduler and workers listen.
        --host ADDRESS: In place of --interface: address on which the scheduler listens.
        --with KEY=VALUE (own): A setting that only this kind of cluster has, e.g. queue=long; may
            be given several times.
        TLS
        --dry-run: Only print which workers would run, the amount of work that is known before the
            build, and the script of a job.
        --script FILE: Only write the script of a job.
    """  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)
    from drakegrasp.api.building import build_on, find_sources, known_work
    from drakegrasp.cluster.kinds import Running, cluster_of, describe, present
    from drakegrasp.exchange.attempts import read_attempts
    from drakegrasp.hand.description import load_hand

    given: dict[str, Any] = dict(workers=workers, cores=cores, memory=memory, walltime=walltime)
    given |= dict(interface=interface, host=host)
    tls = chosen_tls(options)
    request = parse_request(options)
    if scheduler is not None or scheduler_file is not None:
        if kind != "local":
            raise click.UsageError("--scheduler must be used without --cluster")
        cluster: Local = Running(address=scheduler, file=scheduler_file, **given, **tls)
    else:
        cluster = cluster_of(kind, own, **given, **tls)

    # Print what will run before anything starts.
    say("\n".join(describe(cluster)))
    if dry_run:
        say("\n".join(known_work(request)))
    if dry_run or script is not None:
        _give_script(cluster, request.out, script)
        return

    sources = find_sources(request.objects, request.units, request.manifest)
    running = present(cluster.connected(request.out), request.show)
    postures = None
    if request.postures is not None:
        postures = read_attempts(
            request.postures, load_hand(request.config.hand_source), read_as=request.read_as
        )
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


def _give_script(cluster: Local, out: Path, file: Path | None) -> None:
    """Print or write the script of a job, and the next steps."""
    script = cluster.script(out)
    if not script:
        if file is not None:
            raise click.UsageError(f"--script must not be given with --cluster {cluster.kind}")
        return
    if file is None:
        say(f"\nscript of each job, for {cluster.submission()}:\n\n{script.rstrip()}\n")
    else:
        file.write_text(script, encoding="utf-8")
        say(f"{cluster.submission()} {shlex.quote(str(file))}")
    say(f"client: {_client_command(sys.argv[1:])}")


def _client_command(words: Sequence[str]) -> str:
    """Return the command of the process that distributes the work, from the present words."""
    kept, left = list[str](), iter(words)
    for word in left:
        if word == "--script":
            next(left, None)
        elif word != "--dry-run" and not word.startswith("--script="):
            kept.append(word)
    kept = kept[1:] if kept[:1] == ["submit"] else kept
    return shlex.join(["drakegrasp", "submit", *kept])
