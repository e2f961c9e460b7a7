"""Numbers of text files."""

from __future__ import annotations

from collections.abc import Iterable


def read_floats(words: Iterable[bytes]) -> list[float]:
    """Return words as numbers.

    Raises:
        ValueError: If one is no number; it gives the word.
    """
    words = list(words)
    try:
        return [float(word) for word in words]
    except ValueError:
        bad = next(word for word in words if not _is_number(word))
        raise ValueError(f"{bad[:40].decode(errors='replace')!r} in place of a number") from None


def _is_number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
