"""Draw the figures of the README and the docs from a dataset of built-in objects.

The script writes trial.png (one grasp from start to lift, with the images of both cameras),
frames.png (all frames) and candidates.png (palm poses on a mug, by surface normals and by
rotations).
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

from doc_figures import frames_figure, hero_figure
from trial_pictures import frames_panels, render_trial

from drakegrasp.dataset.paths import DATA_FILES
from drakegrasp.dataset.prepared_objects import PreparedObject
from drakegrasp.generation.prepare import prepare
from drakegrasp.hand.settings import load_config
from drakegrasp.objects.sources import find_meshes
from drakegrasp.pictures.approaches import palm_poses_figure
from drakegrasp.pictures.samplers import METHODS, palm_rays
from drakegrasp.pictures.style import save_figure
from drakegrasp.shapes.catalog import export_builtin
from drakegrasp.simulation.candidates import sample_candidates

#: Object in the figure of the candidates.
MUG = "1_mug_1"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="directory of a finished dataset")
    parser.add_argument("--trial", type=int, required=True, help="a trial that became a sample")
    parser.add_argument("--images", type=Path, default=Path("docs/images"), help="where to write")
    parser.add_argument("--rays", type=int, default=220, help="palm poses drawn per method")
    arguments = parser.parse_args(argv)

    # Draw one trial and its frames.
    out, images = arguments.dataset, arguments.images
    images.mkdir(parents=True, exist_ok=True)
    pictures = render_trial(out, arguments.trial)
    oto, otm = out / DATA_FILES["oto"], out / DATA_FILES["otm"]
    hero_figure(oto, otm, arguments.trial, pictures, images / "trial.png")
    frames_figure(frames_panels(out, arguments.trial), images / "frames.png")

    # Draw candidates of a built-in mug.
    with tempfile.TemporaryDirectory() as folder:
        export_builtin(folder, [MUG])
        mug = prepare(find_meshes(Path(folder))[0], load_config(None, ["candidates.max=1"]))
    draw_candidates(mug, arguments.rays, images / "candidates.png")
    return 0


def draw_candidates(prepared: PreparedObject, rays: int, png: Path) -> None:
    """Draw palm poses of an object from both methods."""
    drawn = {}
    for method, title in METHODS.items():
        overrides = [f"candidates.method={method}", f"candidates.max={10 * rays}"]
        config = load_config(None, overrides)
        candidates = sample_candidates(prepared.model, prepared.X_TO, config)
        drawn[title] = palm_rays(candidates, max(config.candidates.standoffs), rays)
    model = prepared.model
    save_figure(palm_poses_figure(model.visual_vertices, model.visual_faces, drawn), png, dpi=130)


if __name__ == "__main__":
    raise SystemExit(main())
