"""Locates the hand file of a hand. Does not import Drake."""

from __future__ import annotations

import re
from pathlib import Path

from drakegrasp import registry
from drakegrasp.config import CarriedHand, HandSource
from drakegrasp.errors import HandError

#: Folder of the package's hand files `<name>_hand.yaml`, their models and the table's model.
MODELS = Path(__file__).resolve().parent.parent / "models"


def hand_names() -> list[str]:
    """Return the names of the package's hands and of the hands that plugins register."""
    ours = (path.name.removesuffix("_hand.yaml") for path in MODELS.glob("*_hand.yaml"))
    return sorted({*ours, *registry.names("hands")})


def hand_file(source: HandSource) -> Path:
    """Return the YAML file of a registered hand, of a dataset's hand, or the given file.

    Raises:
        HandError: If there is no such file, or the path of a dataset's hand leads elsewhere.
    """
    if isinstance(source, CarriedHand):
        validate_inside(source.path, source.path.parent)
        return source.path
    path = MODELS / f"{source}_hand.yaml"
    if source in hand_names() and not path.exists():
        path = Path(registry.find("hands", str(source)))
    elif source not in hand_names():
        path = Path(source)
    if not path.is_file():
        names = ", ".join(hand_names())
        raise HandError(f"hand must be one of {names} or a YAML file, got {str(source)!r}")
    return path


def validate_inside(path: Path, folder: Path) -> None:
    """Reject a path that is not a plain file of a folder; the folder may be a stranger's.

    Raises:
        HandError: If the path is missing or no file, or if it or the folder is a link.
    """
    try:
        found, real = path.resolve(strict=True), folder.parent.resolve() / folder.name
    except (OSError, RuntimeError, ValueError):
        raise HandError(f"{path}: must be a file of the dataset's hand, got none") from None
    if not (found.is_relative_to(real) and found.is_file()):
        raise HandError(f"{path}: must be a file in {folder}, got a link or no file")


#: References in a model: meshes and models in SDFormat, meshes in URDF, then textures.
REFERENCES = re.compile(
    rb"<uri>\s*(?P<uri>.*?)\s*</uri>|<mesh\b[^>]*\bfilename\s*=\s*[\"'](?P<mesh>.*?)[\"']"
    rb"|<texture\b[^>]*\bfilename\s*=\s*[\"'](?P<texture>.*?)[\"']"
    rb"|<drake:diffuse_map>\s*(?P<map>.*?)\s*</drake:diffuse_map>"
)
