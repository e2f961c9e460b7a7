"""Locates the files of a hand. Does not import Drake."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from drakegrasp import registry
from drakegrasp.config import CarriedHand, HandSource
from drakegrasp.errors import HandError

#: Folder of the table and of the hands that come with the package, as `<name>_hand.yaml`.
MODELS = Path(__file__).resolve().parent.parent / "models"


def hand_names() -> list[str]:
    """Return the names of the hands that come with the package, and of those of others."""
    ours = (path.name.removesuffix("_hand.yaml") for path in MODELS.glob("*_hand.yaml"))
    return sorted({*ours, *registry.names("hands")})


def hand_file(source: HandSource) -> Path:
    """Return the YAML file of a hand that comes with the package, or the one that is given.

    Raises:
        HandError: If there is no such file, or that of a dataset is elsewhere.
    """
    if isinstance(source, CarriedHand):
        refuse_outside(source.path, source.path.parent)
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


def refuse_outside(path: Path, folder: Path) -> None:
    """Refuse what is no plain file of a folder, which may be a stranger's.

    Raises:
        HandError: If it is missing or something else, or it or the folder is a link.
    """
    try:
        found, real = path.resolve(strict=True), folder.parent.resolve() / folder.name
    except (OSError, RuntimeError, ValueError):
        raise HandError(f"{path}: must be a file of the dataset's hand, got none") from None
    if not (found.is_relative_to(real) and found.is_file()):
        raise HandError(f"{path}: must be a file in {folder}, got a link or no file")


def chance_file(source: HandSource) -> Path:
    """Return the file of the weights by which lifts are chosen, which few hands have.

    It lies beside the hand file: `<name>_chance.yaml` of `<name>_hand.yaml`.

    Raises:
        HandError: If there is no such hand.
    """
    path = hand_file(source)
    return path.with_name(f"{path.stem.removesuffix('_hand')}_chance.yaml")


def find_packages(folder: Path, model: str, packages: Mapping[str, str]) -> dict[str, Path]:
    """Return the folder of each package whose files a hand's model may name.

    Those are the packages that the hand file names, and those in which the model lies: the folders
    above it with a `package.xml`, by the name that this file gives.

    Args:
        folder: Of the hand file.
        model: Path of the model, relative to it.
        packages: Folders by name, relative to it.

    Raises:
        HandError: If a package is not a folder.
    """
    found: dict[str, Path] = {}
    for above in (folder / model).resolve().parents:
        manifest = above / "package.xml"
        if manifest.is_file():
            found.setdefault(_package_name(manifest), above)
    for name, place in packages.items():
        if not (folder / place).is_dir():
            raise HandError(f"packages.{name}: must be a folder, got {place!r}")
        found[name] = folder / place
    return found


def _package_name(manifest: Path) -> str:
    """Return the name that a package.xml gives; its folder's name if it gives none."""
    try:
        name = ElementTree.parse(manifest).findtext("name")
    except ElementTree.ParseError:
        name = None
    return (name or manifest.parent.name).strip()
