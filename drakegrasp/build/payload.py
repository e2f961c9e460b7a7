"""Objects that are heavier than the hand is made for.

In: the manifest of a dataset. Out: a warning, in words.
"""

from __future__ import annotations

from drakegrasp.build.counts import NAMED
from drakegrasp.dataset.manifest import Manifest
from drakegrasp.hand.description import load_hand


def too_heavy(manifest: Manifest) -> str:
    """Return which objects are heavier than the payload of the hand file; empty if none is."""
    hand = load_hand(manifest.config.hand)
    if hand.payload is None:
        return ""
    names = [entry.name for entry in manifest.objects if entry.mass > hand.payload]
    if not names:
        return ""
    listed = ", ".join(names[:NAMED]) + ", ..." * (len(names) > NAMED)
    return (
        f"heavier than the payload of the hand {hand.name}, {hand.payload:g} kg: {len(names)} of "
        f"{len(manifest.objects)} objects ({listed}); objects.mass makes them lighter"
    )
