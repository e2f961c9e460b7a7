"""Check that the parts of a release agree, and print the commands that tag and push it.

`make release` runs this script after it has built and tried the archives. The script itself sends
nothing.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
#: In place of the date in the title of a version that is not released yet.
UNRELEASED = "unreleased"
#: Maximum number of lines of a release's section in the changelog, so that users read it.
SECTION_LINES = 70


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; return its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.parse_args(argv)
    version, faults = read_version(ROOT), disagreements(ROOT)
    if "date-released" not in read_citation(ROOT):
        faults.append("CITATION.cff: date-released must be the date of the release, got none")
    if git("status", "--porcelain"):
        faults.append("the work tree must have no changes: commit them first")
    if git("tag", "--list", f"v{version}"):
        faults.append(f"there must be no tag v{version} yet: raise the version in pyproject.toml")
    if faults:
        raise SystemExit("\n".join(faults))
    sys.stdout.write(
        f"{version} can be released:\n"
        f"  git tag --annotate v{version} --message 'drakegrasp {version}'\n"
        f"  git push origin v{version}\n"
    )
    return 0


def read_version(root: Path) -> str:
    """Return the version of the package, which `pyproject.toml` states."""
    stated = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))
    return str(stated["project"]["version"])


def read_citation(root: Path) -> dict[str, Any]:
    """Return `CITATION.cff`, which states no date before the release."""
    citation: dict[str, Any] = yaml.safe_load((root / "CITATION.cff").read_text("utf-8"))
    return citation


def disagreements(root: Path) -> list[str]:
    """Return how the changelog and the citation disagree with the version, one line each."""
    version = read_version(root)
    _, *sections = re.split(r"^## ", (root / "CHANGELOG.md").read_text("utf-8"), flags=re.M)
    newest, citation = sections[0].splitlines() if sections else [""], read_citation(root)
    title = f"{version} ({citation.get('date-released', UNRELEASED)})"
    faults = []
    if str(citation["version"]) != version:
        faults.append(f"CITATION.cff: version must be {version}, got {citation['version']}")
    if newest[0] != title:
        faults.append(
            f"CHANGELOG.md: the first section of a version must be {title}, got {newest[0]}"
        )
    if len(newest) >= SECTION_LINES:
        faults.append(
            "CHANGELOG.md: the first section of a version must have fewer than "
            f"{SECTION_LINES} lines, got {len(newest)}"
        )
    return faults


def git(*words: str) -> str:
    """Return what a git command prints."""
    return subprocess.run(
        ["git", *words], cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True
    ).stdout.strip()


if __name__ == "__main__":
    raise SystemExit(main())
