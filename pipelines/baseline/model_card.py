"""Write the model card of a checkpoint: its purpose, its training data and its scores.

  python pipelines/baseline/model_card.py postures.pt README.md --score card/card.json

The head has the form of a README on the Hugging Face Hub. All statements are read from the
checkpoint and from cards of `drakegrasp score`; without a score the card states that nothing was
scored. The headings follow Mitchell et al., Model Cards for Model Reporting (FAT* 2019).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml
from predict import load

from drakegrasp.errors import DataError, DrakegraspError
from drakegrasp.scoring.card import FORM

#: What each network predicts.
SAYS = {
    "postures": "Proposes palm poses with joints, most likely first, from the points of one object "
    "on a table that one depth camera sees.",
    "classifier": "States the chance that a posture holds an object, and that it becomes a sample, "
    "from the points that one depth camera sees.",
    "contacts": "Predicts where fingertips touch an object, with the surface's normals, from an "
    "RGB-D image whose camera stands behind the palm.",
}
LIMITS = (
    "It learned from simulated lifts of single objects on an empty table, with one hand. It knows "
    "no clutter, no arm and no real camera's faults beyond the noise that was simulated. A lifted "
    "grasp in simulation may fail on a robot: try each on your own first. It is a baseline to "
    "compare with, not a product."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("out", type=Path, help="Markdown file to write")
    parser.add_argument("--score", type=Path, action="append", default=[], metavar="CARD.JSON")
    parser.add_argument(
        "--licence", default="unknown", help="licence of the weights  [default: unknown]"
    )
    arguments = parser.parse_args(argv)
    try:
        checkpoint = load(arguments.checkpoint, *SAYS)
        scores = [read_score(path) for path in arguments.score]
    except DrakegraspError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 2
    text = card_text(arguments.checkpoint.stem, checkpoint, scores, arguments.licence)
    arguments.out.write_text(text, encoding="utf-8")
    print(arguments.out)  # noqa: T201
    return 0


def read_score(path: Path) -> dict[str, Any]:
    """Return a card of `drakegrasp score`."""
    try:
        card: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        form = card["form"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path}: must be a card of drakegrasp score, got {error!r}") from None
    if form != FORM:
        raise DataError(f"{path}: must be a card of form {FORM}, got {form!r}")
    return card


def card_text(
    name: str, checkpoint: dict[str, Any], scores: Sequence[dict[str, Any]], licence: str
) -> str:
    """Return the Markdown of a model card."""
    task, history = checkpoint["task"], checkpoint["history"]
    best, epochs = history["best"], len(history["train"])
    weights = sum(v.numel() for v in checkpoint["weights"].values())
    head = {
        "license": licence,
        "library_name": "pytorch",
        "tags": ["robotics", "grasping", "multi-finger", "drakegrasp", task],
    }
    settings = ", ".join(f"{k} {v}" for k, v in checkpoint["settings"].items() if k != "task")
    versions = ", ".join(f"{k} {v}" for k, v in checkpoint["versions"].items())
    parts = ", ".join(f"{count:,} {part}" for part, count in history["parts"].items())
    lines = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---\n",
        f"# {name}\n",
        f"{SAYS[task]}\n",
        "## Model details\n",
        f"* {weights:,} numbers; the network `{task}` of drakegrasp's `pipelines/baseline/`.",
        f"* Settings: {settings}.",
        f"* Made with {versions}.\n",
        "## Intended use, and limits\n",
        f"{LIMITS}\n",
        "## Training data\n",
        *(f"* A file with the SHA-256 `{digest}`." for digest in checkpoint["data"]),
        f"* Items: {parts}. No object is in two parts.",
        f"* Epoch {best + 1} of {epochs} is kept: loss {history['train'][best]:.3f} in training, "
        f"{history['valid'][best]:.3f} in validation.\n",
        "## Evaluation\n",
    ]
    lines += ["Nothing was scored."] if not scores else []
    for score in scores:
        lines += _evaluation(score)
    return "\n".join(lines) + "\n"


def _evaluation(score: dict[str, Any]) -> list[str]:
    """Return the lines that describe one score card."""
    dataset = score["dataset"]
    protocol = score["settings"].get("protocol", {"protocol": "lift"})["protocol"]
    return [
        f"{score['measures']['headline']}; {score['objects']} objects, {score['rows']} rows of "
        f"`{dataset['file']}` (`rows_sha256` `{dataset['rows_sha256'][:16]}`), protocol "
        f"`{protocol}`.\n",
        "| predictions | headline [%] | 95 % |",
        "| --- | --- | --- |",
        *(
            f"| {name} | {100 * value['value']:.1f} | "
            f"{100 * value['low']:.1f} to {100 * value['high']:.1f} |"
            for name, found in score["sets"].items()
            for value in (found["measures"]["headline"],)
        ),
        "",
        *(f"> {warning}\n" for warning in score["warnings"]),
    ]


if __name__ == "__main__":
    sys.exit(main())
