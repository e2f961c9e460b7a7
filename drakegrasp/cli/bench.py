"""`drakegrasp bench`: what attempts cost on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import click

from drakegrasp.cli.console import progress_bar, say
from drakegrasp.cli.options import FILE, NEW_FILE, PATH, chosen_settings, option, shared
from drakegrasp.generation.request import BUILTIN
from drakegrasp.runtime.environment import require_mujoco


@click.command()
@shared("--objects", required=False, default=BUILTIN, show_default=True, text="The meshes.")
@shared("--per-class", "--objects-seed")
@shared("--only", text="Only objects whose names begin with NAME; may be given several times.")
@shared("--config", text="Configuration.  [default: paper]")
@shared("--set")
@shared("--candidates", default=100, show_default=True, text="Palm poses per object.")
@option(
    "--fidelity",
    "N",
    "Compare the labels of N attempts per object.",
    type=click.IntRange(min=0),
    default=0,
    show_default=True,
)
@option("--peer mujoco", None, "Run the same attempts in MuJoCo as well.", is_flag=True)
@option(
    "--cross-check",
    "OUT N",
    "Instead, try N stored lifts of the dataset OUT again in MuJoCo.",
    type=(PATH, click.IntRange(min=1)),
)
@option("--compare", "FILE", "Print the ratios to this earlier report.", type=FILE)
@option(
    "--out",
    "FILE",
    "Where the report goes, as JSON.",
    type=NEW_FILE,
    default=Path("bench.json"),
    show_default=True,
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
    from drakegrasp.shapes.catalog import builtin_sources

    if mujoco:
        require_mujoco("mujoco", "coacd")
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
    require_mujoco("mujoco", "coacd")
    from drakegrasp.bench.cross_check import cross_check
    from drakegrasp.cli import tables

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
