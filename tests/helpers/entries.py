"""Objects of a manifest that no mesh was prepared for."""

from __future__ import annotations

from typing import Any

from drakegrasp.dataset.manifest import ObjectEntry


def object_entry(name: str, **changes: Any) -> ObjectEntry:
    """Return an object of 1 kg with one palm pose, or with other values."""
    values: dict[str, Any] = dict(
        name=name,
        class_name="thing",
        mesh_sha256="0",
        scale=1.0,
        up="+z",
        mass=1.0,
        density=1000.0,
        friction=None,
        collision_error=0.0,
        resting=(),
        candidates=1,
        notes=(),
    )
    return ObjectEntry(**{**values, **changes})
