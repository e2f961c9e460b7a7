"""`drakegrasp bench`: the cost of attempts on this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import click

from drakegrasp.cli.console import progress_bar, say
from drakegrasp.cli.options import FILE, NEW_FILE, chosen_settings, described
from drakegrasp.generation.request import BUILTIN
from drakegrasp.runtime.environment import require_mujoco


@click.command()
@described
def bench(
    config: str | None = None,
    mujoco: bool = False,
    compare: Annotated[Path | None, FILE] = None,
    out: Annotated[Path, NEW_FILE] = Path("bench.json"),
    objects: str = BUILTIN,
    only: tuple[str, ...] = (),
    draw: Annotated[int | None, click.IntRange(min=1)] = None,
    candidates: int = 100,
    *,
    units: str,
    manifest: Path | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Measure how fast this machine simulates attempts.

    The command runs in one process and writes a report as JSON.

    With --peer (pip install 'drakegrasp[peer]'), it simulates all attempts in MuJoCo as well.

    Options:
        --objects MESH_DIR|builtin: The meshes.
        --per-class, --objects-seed
        --only NAME: Only objects whose names begin with NAME; may be given several times.
        --draw N: Only N of the objects, drawn by the seed of the configuration.
        --config YAML|PRESET: Configuration. [default: paper]
        --set
        --candidates N: Palm poses per object.
        --peer (mujoco): Run the same attempts in MuJoCo as well.
        --compare FILE: Print the ratios to this earlier report.
        --out FILE: File of the report, as JSON.
        --units, --manifest, --quiet
    """
    import json
    import tempfile

    from drakegrasp.bench import measure as measuring
    from drakegrasp.cli import tables
    from drakegrasp.hand.settings import load_config
    from drakegrasp.objects.sources import find_meshes
    from drakegrasp.seeding import Stream, object_key
    from drakegrasp.shapes.catalog import builtin_sources

    # Unusable options are rejected before the measurement, which takes a while.
    if not os.access(out if out.exists() else out.absolute().parent, os.W_OK):
        raise click.UsageError(f"--out must be a file that can be written, got {out}")
    if mujoco:
        require_mujoco("mujoco", "coacd")
    # The time of OpenGL's threads would be counted for this core.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    options |= {"objects": objects, "candidates": candidates}
    rules = load_config(config, chosen_settings(options))
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
        if draw is not None:
            order = Stream(rules.seed, object_key("bench")).permutation(len(sources))
            sources = [sources[i] for i in sorted(order[:draw])]
        with progress_bar("bench", "attempts", show=not quiet) as progress:
            measured = measuring.measure(sources, rules, mujoco=mujoco, progress=progress)
            report = measuring.summarize(list(measured), rules)

    tables.print_table(tables.bench_table(report))
    for line in tables.bench_lines(report):
        say(line)
    if earlier is not None:
        report["ratio"] = measuring.compare(report, earlier)
        for key, ratio in report["ratio"].items():
            times = "none to compare with" if ratio is None else f"{ratio:.2f} times that"
            say(f"{key.replace('_', ' ')}: {times} of {compare}")
    out.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    say(str(out))


def _read_report(path: Path) -> dict[str, Any]:
    """Return an earlier report.

    Raises:
        click.UsageError: If the file is not a report.
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
