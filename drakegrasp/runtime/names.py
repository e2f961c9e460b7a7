"""Names of objects, which become names of files and stand on terminals and pages."""

from __future__ import annotations

#: Longest name of an object [bytes]: file systems allow 255, and we append to it.
MAX_NAME = 200
#: What a name must be, for error messages.
NAME_RULE = (
    "printable, not empty, without slashes, not begin with a dot, and have at most "
    f"{MAX_NAME} bytes"
)


def is_name(text: str) -> bool:
    """Return whether a text may be the name of an object or a class."""
    bad = any(c in "/\\" or not c.isprintable() for c in text) or text.startswith(".")
    return bool(text.strip()) and not bad and len(text.encode()) <= MAX_NAME
