"""The command `drakegrasp objects morph`."""

from __future__ import annotations

from pathlib import Path

import click

from drakegrasp.cli.errors import say
from drakegrasp.cli.options import PATH, shared
from drakegrasp.errors import counted


@click.command()
@click.argument("mesh_dir", type=PATH)
@click.option(
    "--per-mesh",
    required=True,
    type=click.IntRange(min=1),
    metavar="N",
    help="Morphs of each mesh.",
)
@shared("--seed", type=click.IntRange(min=0), default=0, help="Seed of the draws.  [default: 0]")
@shared("--out", help="Directory of the morphs; new or empty.")
@shared("--units", "--manifest")
def morph(
    mesh_dir: Path, per_mesh: int, seed: int, out: Path, units: str, manifest: Path | None
) -> None:
    """Make objects of other proportions from meshes.

    Each mesh of MESH_DIR is widened, bent in and stretched along an axis at random. The morphs
    (.obj, metres, +z up) stand on the table as the mesh does, and an objects.yaml beside them
    keeps their class. The same seed gives the same files.
    """
    from drakegrasp.objects.morph import morph_meshes
    from drakegrasp.runtime.progress import progress_bar

    with progress_bar("morph", "morphs") as progress:
        report = morph_meshes(
            mesh_dir,
            out,
            per_mesh=per_mesh,
            seed=seed,
            units=units,
            manifest=manifest,
            progress=progress,
        )
    for reason in report.refused:
        say(f"no morphs of {reason}", err=True)
    for name, count in report.crossing.items():
        faces = counted(count, "face")
        say(f"{name} passes through itself in {faces}, and so do its morphs", err=True)
    share = report.first_draws / report.morphs
    say(f"{counted(report.morphs, 'morph')} in {out}; {share:.0%} by the first draw")
