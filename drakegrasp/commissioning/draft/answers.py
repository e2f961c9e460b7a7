"""What a person says of a hand, in place of a guess."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from drakegrasp.frames import Array


@dataclass(frozen=True, kw_only=True)
class Answers:
    """What overrides the guesses; names are those of the vendor's model.

    Attributes:
        palm: The link that carries the fingers.
        approach: (3,), +Gz in the palm link, out of the palm.
        fingers: Fingertip links, all that grasp.
        joints: Positions of joints that no finger closes [rad or m].
        reverse: Closing joints that close the other way.
        effort: Largest effort of the motors [N m or N], where it is one for all.
        settings: Lines KEY=VALUE of the hand file.
    """

    palm: str | None = None
    approach: Array | None = None
    fingers: tuple[str, ...] = ()
    joints: Mapping[str, float] = field(default_factory=dict)
    reverse: tuple[str, ...] = ()
    effort: float | None = None
    settings: tuple[str, ...] = ()
