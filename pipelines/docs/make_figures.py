"""Draw the figures of the README and the docs from a dataset of built-in objects.

The script writes trial.png (one grasp from start to lift, with the images of both cameras) and
frames.png (all frames).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from doc_figures import frames_figure, hero_figure
from trial_pictures import frames_panels, render_trial

from drakegrasp.dataset.paths import DATA_FILES


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("dataset", type=Path, help="directory of a finished dataset")
    parser.add_argument("--trial", type=int, required=True, help="a trial that became a sample")
    parser.add_argument("--images", type=Path, default=Path("docs/images"), help="where to write")
    arguments = parser.parse_args(argv)

    # Draw one trial and its frames.
    out, images = arguments.dataset, arguments.images
    images.mkdir(parents=True, exist_ok=True)
    pictures = render_trial(out, arguments.trial)
    oto, otm = out / DATA_FILES["oto"], out / DATA_FILES["otm"]
    hero_figure(oto, otm, arguments.trial, pictures, images / "trial.png")
    frames_figure(frames_panels(out, arguments.trial), images / "frames.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
