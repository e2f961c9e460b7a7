"""Steps that the docs site needs besides the folder `docs`; mkdocs loads this file as a hook.

Links that lead out of `docs/` work on GitHub and must lead to a page of the site here: the README
of the hands' models becomes such a page. Headings get GitHub's anchors, so that one link works in
both places.
"""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath
from typing import Any

from mkdocs.structure.files import File, Files
from pymdownx.slugs import slugify

ROOT = Path(__file__).resolve().parents[2]
#: Files outside of `docs/` that become pages of the site, by their path in the repository.
PAGES = {"drakegrasp/models/README.md": "reference/models.md"}
#: A Markdown link to a file of the repository: its text, path and anchor.
LINK = re.compile(r"(\]\()((?:\.\./)*[\w./-]+\.md)((?:#[^)]*)?\))")


def on_config(config: Any) -> Any:
    """Give headings the anchors that GitHub gives them."""
    config.mdx_configs.setdefault("toc", {})["slugify"] = slugify(case="lower")
    return config


def on_files(files: Files, *, config: Any) -> Files:
    """Add the pages that lie outside of `docs/`."""
    for source, page in PAGES.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(text: str, *, page: Any, **_: Any) -> str:
    """Replace links between `docs/` and the files of PAGES by links to the pages of the site."""
    home = PurePosixPath(page.file.src_uri)
    # Path of the page in the repository; its links are relative to this path on GitHub.
    origin = {target: PurePosixPath(source) for source, target in PAGES.items()}.get(
        str(home), PurePosixPath("docs") / home
    )

    def turned(link: re.Match[str]) -> str:
        path = _normal(origin.parent / link[2])
        target = PAGES.get(path, path.removeprefix("docs/"))
        known = path in PAGES or path.startswith("docs/")
        return f"{link[1]}{_relative(target, home)}{link[3]}" if known else link[0]

    return LINK.sub(turned, text)


def _normal(path: PurePosixPath) -> str:
    """Return a path without `..`."""
    parts: list[str] = []
    for part in path.parts:
        if part == "..":
            parts.pop()
        else:
            parts.append(part)
    return "/".join(parts)


def _relative(target: str, page: PurePosixPath) -> str:
    """Return the link from a page to a target, both below `docs/`."""
    return "../" * (len(page.parts) - 1) + target
