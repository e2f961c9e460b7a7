"""The command `drakegrasp audit`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.options import PATH, shared


@click.command()
@click.argument("mesh_dir", type=PATH)
@shared("--units", "--manifest")
@click.option(
    "--hand",
    metavar="HAND",
    help="Hand whose opening the sizes are compared with (default: barrett).",
)
@click.option(
    "--json", "json_file", type=PATH, metavar="FILE", help="Write all findings as JSON too."
)
@click.option(
    "--sheet",
    type=PATH,
    metavar="FILE",
    help="Write a picture of every object with its status (.png).",
)
def audit(
    mesh_dir: Path,
    units: str,
    manifest: Path | None,
    hand: str | None,
    json_file: Path | None,
    sheet: Path | None,
) -> None:
    """Check which meshes are fit, repaired or refused.

    Meshes are prepared as in a build with the default configuration. A build also drops each
    object on the table, and refuses one that does not come to rest.
    Exit code 1 if every mesh is refused.
    """
    from drakegrasp.cli.tables import ROOMY, audit_line, audit_table, make_console, memory_line
    from drakegrasp.hand.description import load_hand
    from drakegrasp.hand.kinematics import opening
    from drakegrasp.hand.settings import load_config
    from drakegrasp.objects.audit import audit as audit_meshes
    from drakegrasp.runtime.files import atomic_path, write_atomic
    from drakegrasp.runtime.progress import progress_bar

    config = load_config(overrides=[f"hand={hand}"] if hand else [])
    wide = opening(load_hand(config.hand_source))
    with progress_bar("audit", "meshes") as progress:
        rows = audit_meshes(
            mesh_dir, units=units, manifest=manifest, opening=wide, progress=progress
        )
    console = make_console()
    console.print(audit_table(rows, compact=console.width < ROOMY))
    say(audit_line(rows))
    if line := memory_line(rows):
        say(line)

    if json_file is not None:
        text = json.dumps([row.to_json() for row in rows], indent=1, ensure_ascii=False)
        write_atomic(json_file, f"{text}\n".encode())
    if sheet is not None:
        from drakegrasp.pictures.object_sheet import object_sheet

        with progress_bar("draw", "objects") as progress, atomic_path(sheet) as png:
            object_sheet(rows, png, progress=progress)
    if all(row.status == "refused" for row in rows):
        sys.exit(1)
