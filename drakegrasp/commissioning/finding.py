"""What a check of a hand found."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One check of a hand.

    Attributes:
        name: What was checked.
        ok: Whether it is as it must be.
        text: What was found; of a fault, its place and what it must be.
    """

    name: str
    ok: bool
    text: str


def judge(name: str, faults: list[str], fine: str) -> Finding:
    """Return the finding of a check: its faults, or what is fine if there are none."""
    return Finding(name=name, ok=not faults, text="; ".join(faults) or fine)
