"""Locates and hashes a hand's files. Does not import Drake."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from drakegrasp.errors import HandError

#: Folder of the table and of the hands that come with the package, as `<name>_hand.yaml`.
MODELS = Path(__file__).resolve().parent.parent / "models"


def hand_names() -> list[str]:
    """Return the names of the hands that come with the package."""
    return sorted(path.name.removesuffix("_hand.yaml") for path in MODELS.glob("*_hand.yaml"))


def hand_file(name_or_yaml: str | Path) -> Path:
    """Return the YAML file of a hand that comes with the package, or the given YAML file.

    Raises:
        HandError: If there is no such file.
    """
    if name_or_yaml in hand_names():
        return MODELS / f"{name_or_yaml}_hand.yaml"
    path = Path(name_or_yaml)
    if not path.is_file():
        names = ", ".join(hand_names())
        raise HandError(f"hand must be one of {names} or a YAML file, got {str(name_or_yaml)!r}")
    return path


def hand_digest(name_or_yaml: str | Path) -> str:
    """Return a hash (16 hex digits) of a hand's YAML, its SDFormat model and the meshes in it.

    It distinguishes two hands of the same name. A missing file counts as empty; refusing it is
    left to `description.load_hand`.

    Raises:
        HandError: If there is no such hand.
    """
    path = hand_file(name_or_yaml)
    digest = hashlib.sha256(path.read_bytes())
    (model,) = re.findall(rb"^model:\s*([^\s#]+)", path.read_bytes(), flags=re.MULTILINE) or [b""]
    sdf = path.parent / model.strip(b"\"'").decode()
    text = sdf.read_bytes() if sdf.is_file() else b""
    digest.update(text)
    for uri in sorted(set(re.findall(rb"<uri>\s*(.*?)\s*</uri>", text))):
        mesh = sdf.parent / uri.decode()
        digest.update(mesh.read_bytes() if mesh.is_file() else b"")
    return digest.hexdigest()[:16]
