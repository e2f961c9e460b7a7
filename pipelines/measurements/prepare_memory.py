"""Measure how much memory the preparation of a mesh needs, by its number of faces.

\b
    python pipelines/measurements/speed.py prepare [--subdivisions N ...] [--kind KIND ...]

Each mesh is prepared in a separate process. Balls of 10 cm diameter are written as STL, OBJ and PLY
(`stl`, `obj`, `ply`), and as PLY with noise and six holes (`open`). The script prints a line of
JSON for each: the peak memory before and in total, the memory that `drakegrasp audit` forecasts,
and the seconds.
"""  # noqa: D301  (click keeps the lines of a paragraph that begins with this character)

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import click
import numpy as np
import trimesh

KINDS = ("stl", "obj", "ply", "open")
RADIUS = 0.05
#: Code that runs in the process of a mesh; memory of the imports is not counted for the mesh.
_CHILD = """
import json, re, sys, time
from pathlib import Path
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.model import forecast_memory
from drakegrasp.objects.sources import find_mesh

def peak():
    # Not ru_maxrss, which begins with the parent's.
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) / 976.6

source, config, start, before = find_mesh(sys.argv[1]), load_config(), time.monotonic(), peak()
model = prepare(source, config).model
print(json.dumps({
    "before [MB]": round(before), "peak [MB]": round(peak()),
    "forecast [MB]": round(forecast_memory(int(sys.argv[2])) / 1e6),
    "seconds": round(time.monotonic() - start, 1), "notes": model.notes,
}))
"""


def ball(subdivisions: int, kind: str) -> trimesh.Trimesh:
    """Return a ball of 20 * 4^subdivisions faces; the kind "open" has noise and holes."""
    mesh = trimesh.creation.icosphere(subdivisions, radius=RADIUS)
    if kind != "open":
        return mesh
    rng = np.random.default_rng(0)
    keep = np.ones(len(mesh.faces), dtype=bool)
    for direction in rng.standard_normal((6, 3)):
        along = mesh.triangles_center @ (direction / np.linalg.norm(direction))
        keep &= along < 0.985 * RADIUS
    rough = mesh.vertices * (1.0 + 2e-3 * rng.standard_normal((len(mesh.vertices), 1)))
    return trimesh.Trimesh(rough, mesh.faces[keep], process=False)


@click.command(help=__doc__)
@click.option("--subdivisions", multiple=True, type=int, default=(5, 6, 7, 8), show_default=True)
@click.option("--kind", "kinds", multiple=True, type=click.Choice(KINDS), default=KINDS)
def main(subdivisions: tuple[int, ...], kinds: tuple[str, ...]) -> None:
    """Run the script."""
    for number in subdivisions:
        for kind in kinds:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / f"1_ball.{'ply' if kind == 'open' else kind}"
                mesh = ball(number, kind)
                mesh.export(path)
                command = [sys.executable, "-c", _CHILD, str(path), str(len(mesh.faces))]
                child = subprocess.run(command, capture_output=True, text=True, check=True)
            line = {"kind": kind, "faces": len(mesh.faces), **json.loads(child.stdout)}
            click.echo(json.dumps(line))
