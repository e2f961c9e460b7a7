"""The commands that simulate; `submit` also starts the workers of a build."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import drakegrasp as dg
from drakegrasp.cli.arguments import (
    AnyPath,
    Count,
    Dataset,
    Folder,
    NewFile,
    Positive,
    Settings,
    Tls,
    What,
    Workers,
)
from drakegrasp.cli.console import UsageError, same_command, say
from drakegrasp.errors import counted

if TYPE_CHECKING:
    from drakegrasp.cluster.kinds import Local
    from drakegrasp.generation.pipeline import BuildReport


def build(
    *,
    what: What,
    dry_run: bool = False,
    workers: Workers = Workers(),
) -> None:
    """Build a dataset from a directory of meshes.

    The command simulates grasps of every object and writes trials.hdf5, grasping_oto.hdf5 and
    grasping_otm.hdf5 to DIR.

    Args:
        dry_run: Only print the amount of work that is known before the build.
    """
    asked, on = what.asked(), workers.asked()
    if dry_run:
        from drakegrasp.api.building import known_work

        say("\n".join(known_work(**asked)))
        return
    print_report(dg.build_dataset(**asked, **on, out=what.out, show=not what.quiet))


def submit(
    *,
    kind: Annotated[str, Parameter(name="--cluster", metavar="KIND")] = "local",
    scheduler: Annotated[str | None, Parameter(metavar="ADDRESS")] = None,
    scheduler_file: Annotated[AnyPath | None, Parameter(metavar="FILE")] = None,
    workers: Count | None = None,
    cores: Count | None = None,
    memory: Annotated[str | None, Parameter(metavar="SIZE")] = None,
    walltime: Annotated[str | None, Parameter(metavar="TIME")] = None,
    interface: Annotated[str | None, Parameter(metavar="NAME")] = None,
    host: Annotated[str | None, Parameter(metavar="ADDRESS")] = None,
    own: Annotated[tuple[str, ...], Parameter(name="--with", metavar="KEY=VALUE")] = (),
    what: What,
    dry_run: bool = False,
    script: NewFile | None = None,
    tls: Tls = Tls(),
) -> None:
    """Build a dataset on a cluster; the command starts the workers.

        drakegrasp submit --cluster local OPTIONS
        drakegrasp submit --cluster slurm --workers 200 --interface ib0 OPTIONS
        drakegrasp submit --scheduler tls://10.0.0.1:8786 OPTIONS

    The command first prints which workers it will use. The same command continues an interrupted
    build, on any cluster. See docs/how-to/clusters.md for the details and pipelines/recipes/ for an
    example of each.

    Args:
        kind: Where the work runs: local, slurm, pbs, lsf, sge, htcondor, oar, or a kind of another
            package.
        scheduler: In place of --cluster: use the running Dask scheduler at this address.
        scheduler_file: In place of --cluster: use the running Dask scheduler that wrote this file.
        workers: Total number of processes. [default with local: one per core]
        cores: Number of cores of each job, with a worker on each core.
        memory: Memory of each worker, e.g. 2GB.
        walltime: Time limit of each job, as the batch scheduler writes it.
        interface: Network interface on which scheduler and workers listen.
        host: In place of --interface: address on which the scheduler listens.
        own: A setting that only this kind of cluster has, e.g. queue=long; may be given several
            times.
        dry_run: Only print which workers would run, the amount of work that is known before the
            build, and the script of a job.
        script: Only write the script of a job.
    """
    from drakegrasp.api.building import known_work
    from drakegrasp.cluster.kinds import Running, cluster_of, describe, present

    options: dict[str, Any] = dict(workers=workers, cores=cores, memory=memory, walltime=walltime)
    options |= dict(interface=interface, host=host)
    asked, certificates = what.asked(), tls.asked()
    if scheduler is not None or scheduler_file is not None:
        if kind != "local":
            raise UsageError("--scheduler must be used without --cluster")
        running = Running(address=scheduler, file=scheduler_file, **options, **certificates)
        cluster: Local = running
    else:
        cluster = cluster_of(kind, own, **options, **certificates)

    # Print what will run before anything starts.
    out, show = what.out.absolute(), not what.quiet
    say("\n".join(describe(cluster)))
    if dry_run:
        say("\n".join(known_work(**asked)))
    if dry_run or script is not None:
        _give_script(cluster, out, script)
        return
    joint = present(cluster.connected(out))
    print_report(dg.build_dataset(**asked, out=out, cluster=joint, show=show))


def _give_script(cluster: Local, out: Path, file: Path | None) -> None:
    """Print or write the script of a job, and the next steps."""
    script = cluster.script(out)
    if not script:
        if file is not None:
            raise UsageError(f"--script must not be given with --cluster {cluster.kind}")
        return
    if file is None:
        say(f"\nscript of each job, for {cluster.submission()}:\n\n{script.rstrip()}\n")
    else:
        file.write_text(script, encoding="utf-8")
        say(f"{cluster.submission()} {shlex.quote(str(file))}")
    say(f"client: {same_command(('--dry-run',), ('--script',))}")


def clutter(
    out: Dataset,
    /,
    *,
    scenes: Positive = 50,
    objects: Annotated[str, Parameter(metavar="N|N..M")] = "2..6",
    surroundings: Annotated[tuple[str, ...], Parameter(metavar="NAME|YAML|MODEL")] = (),
    tries: Count = 10,
    quiet: bool = False,
    workers: Workers = Workers(),
) -> None:
    """Put objects of a dataset together, and try grasps among them.

    The command writes OUT/clutter.hdf5: scenes of several objects at rest, their views with a mask
    of each object, and all samples of the objects in them. Geometry decides which grasps are free,
    and some of these are tried in simulation among movable neighbours. The same command continues;
    more scenes keep those that are there.

    Args:
        out: Directory of the dataset.
        scenes: Number of scenes.
        objects: Number of objects of a scene, or its range.
        surroundings: table, bin, shelf, a YAML file of boxes, or a model of Drake (.sdf, .urdf,
            .dmd.yaml); given several times, scenes take them in turn. [default: table]
        tries: Number of free grasps of each scene that are tried.
        quiet: Show no progress.
    """
    from drakegrasp.dataset.paths import CLUTTER_FILE

    low, _, high = objects.partition("..")
    if not low.isdecimal() or not (high or low).isdecimal():
        raise UsageError(f"--objects must be a number or a range such as 2..6, got {objects!r}")
    made = dg.build_clutter(
        out,
        scenes=scenes,
        objects=(int(low), int(high or low)),
        surroundings=surroundings or "table",
        tries=tries,
        **workers.asked(),
        show=not quiet,
    )
    for split, row in made.items():
        say(f"{split}: {counted(row['scenes'], 'scene')}, {counted(row['grasps'], 'grasp')}")
    say(str(out / CLUTTER_FILE))


def bench_set(
    out: Folder,
    /,
    *,
    only: Annotated[tuple[str, ...], Parameter(metavar="NAME")] = (),
    overrides: Settings = (),
    clutter: bool = False,
    quiet: bool = False,
    workers: Workers = Workers(),
) -> None:
    """Build the frozen benchmark drakegrasp-bench-1 in OUT.

    The benchmark has 256 built-in objects, each with its own mass and friction, all for testing.
    Their meshes are compared with the published hashes. It takes about an hour on one core. With
    --only or --set the result is a part or a variant of the benchmark, and each card reports this.
    The same command continues an interrupted build.

    Args:
        out: Directory of the benchmark.
        only: Build this object only; may be given several times.
        overrides: Change one setting, e.g. lift.hold_time=1; may be given several times.
        clutter: Build drakegrasp-clutter-1 instead: 60 scenes of several objects.
        quiet: Show no progress.
    """
    on = workers.asked()
    if clutter:
        if only or overrides:
            raise UsageError("--clutter must be given without --only and --set")
        found, same = dg.make_clutter_benchmark(out, **on, show=not quiet)
        say(f"{counted(found.scenes, 'scene')}, {counted(found.grasps, 'grasp')}")
        say("as published" if same else "not as published: another CPU, or other versions")
        return
    print_report(dg.make_benchmark(out, only=only, overrides=overrides, **on, show=not quiet))


def print_report(report: BuildReport) -> None:
    """Print the results of a build, and the paths of its files.

    Raises:
        SystemExit: With code 1 if the machine has probably spoiled labels, which a line on standard
            error has reported.
    """
    from drakegrasp.cli import tables

    tables.print_stats(report.out)
    if report.simulated:
        reused = f" ({report.reused} had been done before)" if report.reused else ""
        say(f"{counted(report.simulated, 'work unit')} simulated{reused}")
    else:
        again = "; the files were written again" * report.assembled
        units = counted(report.reused, "work unit")
        say(f"all {units} had been done before: nothing was simulated{again}")
    for message, count in report.errors.items():
        say(f"solver error in {counted(count, 'attempt')}: {message}")
    for notice in report.notices:
        say(notice)
    for entry in report.refused:
        say(f"refused: {entry.name}: {entry.reason}")
    for name in ("grasping_oto.hdf5", "grasping_otm.hdf5", "trials.hdf5"):
        say(str(report.out / name))
    if report.unexplained:
        sys.exit(1)
