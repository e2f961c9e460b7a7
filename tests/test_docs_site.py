"""The site of the docs: every page is in it, links lead somewhere, nothing comes from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

import drakegrasp

ROOT = Path(__file__).resolve().parents[1]
SITE = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
#: The page that is made of a file outside of `docs/`, see pipelines/docs/site_hooks.py.
MODELS = "reference/models.md"
#: What a page would load from another host.
FOREIGN = re.compile(r"<(?:script|link|img|iframe)\b[^>]*(?:src|href)=\"(?:https?:)?//[^>]*>")


def pages_of(nav: Any) -> Iterator[str]:
    if isinstance(nav, str):
        yield nav
    else:
        for entry in nav.values() if isinstance(nav, dict) else nav:
            yield from pages_of(entry)


def test_navigation_names_every_page() -> None:
    named = list(pages_of(SITE["nav"]))
    docs = ROOT / "docs"
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")}
    assert sorted(named) == sorted(pages | {MODELS})


def test_the_site_is_strict() -> None:
    assert SITE["strict"] is True
    assert set(SITE["validation"]["links"].values()) == {"warn"}


def test_every_public_name_is_in_the_reference() -> None:
    text = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    homes = {f"drakegrasp.{home}.{name}" for name, home in drakegrasp._HOMES.items()}
    # The configuration has a page of its own.
    assert homes - set(re.findall(r"^::: (\S+)$", text, re.M)) == {"drakegrasp.config.Config"}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.skipif(find_spec("mkdocs") is None, reason="the site needs the extra docs")
def test_the_site_is_built_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    # Docstrings are read, not imported: with a Drake that fails to load it is built all the same.
    (tmp_path / "path" / "pydrake").mkdir(parents=True)
    (tmp_path / "path" / "pydrake" / "__init__.py").write_text("raise RuntimeError('loaded')\n")
    paths = (str(tmp_path / "path"), *filter(None, [os.environ.get("PYTHONPATH")]))
    built = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--site-dir", tmp_path / "site"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
    )
    assert built.returncode == 0, built.stderr
    pages = list((tmp_path / "site").rglob("*.html"))
    assert len(pages) > 25
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert not FOREIGN.findall(text)
    # A link that leads out of docs/ in the repository leads to a page of the site.
    physics = (tmp_path / "site" / "explanation" / "physics.html").read_text(encoding="utf-8")
    assert 'href="../reference/models.html"' in physics
    models = (tmp_path / "site" / "reference" / "models.html").read_text(encoding="utf-8")
    assert 'href="../how-to/add-a-hand.html#2-the-hand-file"' in models
    # Arguments come from the docstrings.
    api = (tmp_path / "site" / "reference" / "api.html").read_text(encoding="utf-8")
    assert "Directory of meshes" in api
