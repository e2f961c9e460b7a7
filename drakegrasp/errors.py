"""The exceptions that drakegrasp raises because of a caller's mistake.

* DrakegraspError
  * ConfigError          a configuration value, key or preset that cannot be used
  * MeshError            a mesh that cannot become a simulated object
  * HandError            a hand description (SDFormat and YAML) that cannot be used
  * DataError            a dataset, shard or manifest that is missing, foreign or broken
  * GraspError           a grasp vector, or its frame, that cannot be verified
  * MachineError         something that the machine lacks (EGL, a usable Drake, workers)
    * DiskFullError      no space left to write; the same command continues later
    * BlankImageError    OpenGL rendered a blank image

Failures of the physics are values and not exceptions, see `drakegrasp.outcomes`. Messages about an
argument follow one pattern: which argument, what it must be, what it was. `first_line` and
`one_line` quote errors of other libraries in our messages. `printable` makes texts of strangers
safe to show.
"""

from __future__ import annotations

import codecs
from collections.abc import Sequence

#: Maximum number of names in a line that lists names.
NAMED = 10
#: Maximum number of characters of a message that `one_line` keeps.
LONGEST_MESSAGE = 200


class DrakegraspError(Exception):
    """Base class of all errors raised on purpose; catch this one."""


class ConfigError(DrakegraspError, ValueError):
    """A configuration value, key or preset that cannot be used."""


class MeshError(DrakegraspError, ValueError):
    """A mesh that cannot become a simulated object, with the reason."""


class HandError(DrakegraspError, ValueError):
    """A hand description that cannot be used."""


class DataError(DrakegraspError, ValueError):
    """A dataset, shard or manifest that is missing, damaged or not written by drakegrasp."""


class GraspError(DrakegraspError, ValueError):
    """A grasp vector, or its frame, that cannot be verified."""


class TooLittleSeenError(GraspError):
    """A cloud or a depth image that shows too little of its object for a grasp."""


class MachineError(DrakegraspError, RuntimeError):
    """A resource that this machine lacks; the message states how to get it."""


class DiskFullError(MachineError):
    """No space left to write a file; the partial file has been removed."""


class BlankImageError(MachineError):
    """OpenGL rendered a blank image, which must never become data."""


def printable(text: str) -> str:
    r"""Return a text whose control characters are replaced by harmless codes, e.g. \x1b."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text
    )


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its type if the message is empty."""
    return (_said(error).splitlines() or [type(error).__name__])[0]


def _said(error: BaseException) -> str:
    """Return an error's message, or a clearer one for a text in another encoding than UTF-8."""
    if isinstance(error, UnicodeDecodeError) and error.encoding.startswith("utf-8"):
        wide = error.object.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return f"text in {'UTF-16' if wide else 'another encoding'}: save it in UTF-8"
    return str(error).strip()


def one_line(error: BaseException) -> str:
    """Return an error's whole message on one line, cut at `LONGEST_MESSAGE` characters.

    It is for errors of parsers, whose later lines state where in the file the mistake is.
    """
    return " ".join(_said(error).split())[:LONGEST_MESSAGE] or type(error).__name__


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun: `1 hand`, `2,000 hands`; `plural` if an s is not enough."""
    return f"{count:,} {noun if count == 1 else plural or noun + 's'}"


def listed(names: Sequence[str], total: int | None = None, *, separator: str = ", ") -> str:
    """Return names in one line: at most the first `NAMED`, and how many more there are.

    Args:
        names: All names, or at least the first `NAMED`.
        total: Total number of names; None for the number of given names.
        separator: What is between two names, for names that contain commas.
    """
    more = (len(names) if total is None else total) - NAMED
    return separator.join(names[:NAMED]) + (f" and {more:,} more" if more > 0 else "")
