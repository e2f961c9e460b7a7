"""`drakegrasp bench`: what attempts cost on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.options import FILE, NEW_FILE, PATH, chosen_settings, shared
from drakegrasp.generation.request import BUILTIN


@click.command()
@shared("--objects", required=False, default=BUILTIN, show_default=True, help="The meshes.")
@shared("--per-class", "--objects-seed")
@shared("--only", help="Only objects whose names begin with NAME; may be given several times.")
@shared("--config", help="Configuration.  [default: paper]")
@shared("--set")
@shared("--candidates", default=100, show_default=True, help="Palm poses per object.")
@click.option(
    "--fidelity",
    type=click.IntRange(min=0),
    default=0,
    metavar="N",
    help="Compare the labels of N attempts per object.",
    show_default=True,
)
@click.option("--peer", "mujoco", is_flag=True, help="Run the same attempts in MuJoCo as well.")
@click.option(
    "--cross-check",
    type=(PATH, click.IntRange(min=1)),
    metavar="OUT N",
    help="Instead, try N stored lifts of the dataset OUT again in MuJoCo.",
)
@click.option(
    "--compare", type=FILE, metavar="FILE", help="Print the ratios to this earlier report."
)
@click.option(
    "--out",
    type=NEW_FILE,
    default=Path("bench.json"),
    show_default=True,
    metavar="FILE",
    help="Where the report goes, as JSON.",
)
@shared("--units", "--manifest", "--quiet")
@click.pass_context
def bench(
    context: click.Context,
    /,
    cross_check: tuple[Path, int] | None,
    out: Path,
    quiet: bool,
    **options: Any,
) -> None:
    """Measure how fast this machine simulates attempts.

    The command runs in one process and writes a report as JSON.

    With --fidelity, it simulates N random attempts of each object again without the screen, at
    half the time step, with four times the faces, with Drake's other solvers and with the other
    drives of the fingers. With --peer (pip install 'drakegrasp[peer]'), it simulates all attempts
    in MuJoCo as well.

    With --cross-check OUT N, it measures no speed: it tries N lifts of the dataset OUT, held and
    lost, again in MuJoCo and says how many of them hold there.
    """
    import json

    # What cannot be used is refused before the measurement, which takes a while.
    if not os.access(out if out.exists() else out.absolute().parent, os.W_OK):
        raise click.UsageError(f"--out must be a file that can be written, got {out}")
    if cross_check is None:
        report = _measure(**options, quiet=quiet)
    else:
        _refuse_other_options(context)
        report = _cross_check(*cross_check, quiet)
    out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    say(str(out))


def _measure(
    *,
    only: tuple[str, ...],
    config: str | None,
    fidelity: int,
    mujoco: bool,
    compare: Path | None,
    units: str,
    manifest: Path | None,
    quiet: bool,
    **options: Any,
) -> dict[str, Any]:
    """Measure what attempts cost, print it and return the report."""
    import tempfile

    from drakegrasp.bench import measure as measuring
    from drakegrasp.cli import tables
    from drakegrasp.hand.settings import load_config
    from drakegrasp.objects.sources import find_meshes
    from drakegrasp.runtime.progress import progress_bar
    from drakegrasp.shapes.catalog import builtin_sources

    if mujoco:
        _require_mujoco("--peer")
    # The time of OpenGL's threads would count as this core's.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    rules, objects = load_config(config, chosen_settings(options)), options["objects"]
    earlier = None if compare is None else _read_report(compare)

    with tempfile.TemporaryDirectory() as folder:
        if objects == BUILTIN:
            with progress_bar("objects", "meshes", show=not quiet) as progress:
                every = builtin_sources(folder, rules.builtin, progress)
        else:
            every = find_meshes(objects, units=units, manifest=manifest)
        sources = [s for s in every if not only or s.name.startswith(only)]
        if not sources:
            raise click.UsageError(f"--only must name objects of {objects}, got {', '.join(only)}")
        with progress_bar("bench", "attempts", show=not quiet) as progress:
            measured = measuring.measure(
                sources, rules, sample=fidelity, mujoco=mujoco, progress=progress
            )
            report = measuring.summarize(list(measured), rules)

    tables.print_table(tables.bench_table(report))
    for line in tables.bench_lines(report):
        say(line)
    if fidelity:
        tables.print_table(tables.fidelity_table(report["all"]["fidelity"]))
        say(tables.drive_line(report["all"]["drive"]))
    if earlier is not None:
        report["ratio"] = measuring.compare(report, earlier)
        for key, ratio in report["ratio"].items():
            times = "none to compare with" if ratio is None else f"{ratio:.2f} times that"
            say(f"{key.replace('_', ' ')}: {times} of {compare}")
    return report


def _cross_check(dataset: Path, count: int, quiet: bool) -> dict[str, Any]:
    """Try lifts of a dataset again in MuJoCo, print the agreement and return the report."""
    _require_mujoco("--cross-check")
    from drakegrasp.bench.cross_check import cross_check
    from drakegrasp.cli import tables
    from drakegrasp.runtime.progress import progress_bar

    with progress_bar("cross-check", "lifts", show=not quiet) as progress:
        report = cross_check(dataset, count, progress=progress)
    tables.print_table(tables.cross_check_table(report["groups"]))
    for line in tables.cross_check_lines(report):
        say(line)
    return report


def _refuse_other_options(context: click.Context) -> None:
    """Refuse options that do nothing with --cross-check.

    Raises:
        click.UsageError: If there is one.
    """
    for parameter in context.command.params:
        source = context.get_parameter_source(str(parameter.name))
        given = source is click.core.ParameterSource.COMMANDLINE
        if given and parameter.name not in ("cross_check", "out", "quiet"):
            raise click.UsageError(
                f"--cross-check must be used with --out and --quiet alone, got {parameter.opts[0]}"
            )


def _require_mujoco(option: str) -> None:
    """Refuse an option where the libraries of the extra `[peer]` are missing.

    Raises:
        click.UsageError: If one is missing.
    """
    from importlib.util import find_spec

    for module in ("mujoco", "coacd"):
        if find_spec(module) is None:
            raise click.UsageError(f"{option} needs {module}: pip install 'drakegrasp[peer]'")


def _read_report(path: Path) -> dict[str, Any]:
    """Return an earlier report.

    Raises:
        click.UsageError: If the file is none.
    """
    from drakegrasp.foreign_files import read_json

    try:
        report: dict[str, Any] = read_json(path)
        _ = report["all"]["resolved_per_core_second"] + report["all"]["grasps_per_core_hour"]
    except (ValueError, KeyError, TypeError):
        raise click.UsageError(
            f"--compare must be a report of `drakegrasp bench`, got {path}"
        ) from None
    return report
