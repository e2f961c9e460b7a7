"""What random draws depend on, so that the same command draws the same numbers."""

from __future__ import annotations

import hashlib


def object_key(name: str) -> int:
    """Return the integer by which an object enters the random streams.

    It depends on the name alone, so adding a mesh to a directory changes no other object.
    """
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:4], "big")
