"""The command line of a script that generates one page of the docs from code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path


def main(page: str, description: str, argv: Sequence[str] | None = None) -> int:
    """Write the page, or with `--check` return 1 if the file differs from it.

    Args:
        page: Markdown text of the page.
        description: Description of what the script writes, for its help output.
        argv: Arguments of the command line; those of the process if None.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("target", type=Path, help="file of the page")
    parser.add_argument("--check", action="store_true", help="compare the file, and write nothing")
    arguments = parser.parse_args(argv)

    target = arguments.target
    if not arguments.check:
        target.write_text(page, encoding="utf-8")
        return 0
    if target.exists() and target.read_text(encoding="utf-8") == page:
        return 0
    sys.stderr.write(f"{target}: must be what `make docs-pages` writes, got another text\n")
    return 1
