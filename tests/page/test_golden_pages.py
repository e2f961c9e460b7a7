"""Whole pages of small datasets, compared with stored texts; see `helpers/golden.py`."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import pytest
from helpers.golden import Golden, flat, rounded
from helpers.pages import get, inspection_of, open_pages
from helpers.predictions import write_predictions

#: Data in a page.
DATA = re.compile(r'(<script type="application/json"[^>]*>)(.*?)(</script>)', re.DOTALL)


def tags(page: str, **replaced: object) -> str:
    """Return a page with a tag in each line and data value by value.

    Texts are replaced by names, so that a page does not depend on the folder of a test.
    """
    for name, text in replaced.items():
        page = page.replace(str(text), name)
    data = [content for _, content, _ in DATA.findall(page)]
    lines = re.sub(r">\s+|>(?=<)", ">\n", DATA.sub(r"\1\3", page)).splitlines()
    values = [line for content in data for line in flat(json.loads(html.unescape(content)))]
    return rounded("\n".join([*(line.strip() for line in lines if line.strip()), *values]))


@pytest.mark.parametrize(
    ("name", "address"),
    [
        ("gallery", "/?object=1_box_a&outcome=any&sort=row&order=up"),
        ("grasp", "/grasp/1-3-2?sort=slip"),
        ("grasp_failed", "/grasp/0-1-1?outcome=any"),
        ("predictions", "/predictions?sort=row&order=up"),
        ("prediction", "/prediction/1"),
        ("prediction_not_closed", "/prediction/2"),
    ],
)
def test_page(out: Path, tmp_path: Path, golden: Golden, name: str, address: str) -> None:
    client = open_pages(out, write_predictions(out, tmp_path / "run.h5"))
    answer = get(client, address)
    assert answer.status_code == 200
    # The head and the dialogs of all pages are those of the gallery.
    text = answer.text
    if name != "gallery":
        text = "".join(re.findall(r"<script type=.*?</script>|<main.*?</main>", text, re.DOTALL))
    golden(f"pages/{name}", tags(text, OUT=out, TOKEN=inspection_of(client).token))
