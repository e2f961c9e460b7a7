"""What the docs say is what the code does."""

from __future__ import annotations

import re
from pathlib import Path

import dataset_format
import pytest

from drakegrasp.cli.main import main
from drakegrasp.dataset.schema import (
    DATA_FIELDS,
    LOOK_FIELDS,
    OBJECT_FIELDS,
    SUCCESS_FIELDS,
    TRIAL_FIELDS,
    VERIFICATION_FIELDS,
)
from drakegrasp.outcomes import Outcome

ROOT = Path(__file__).resolve().parents[1]
TABLES = (
    DATA_FIELDS,
    TRIAL_FIELDS,
    LOOK_FIELDS,
    OBJECT_FIELDS,
    SUCCESS_FIELDS,
    VERIFICATION_FIELDS,
)
DOCS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])


def test_format_page_is_what_the_schema_says(tmp_path: Path) -> None:
    page = ROOT / "docs" / "reference" / "dataset-format.md"
    assert dataset_format.main(["--check", str(page)]) == 0
    stale = tmp_path / "page.md"
    stale.write_text(page.read_text(encoding="utf-8").replace("float64", "float16"))
    assert dataset_format.main(["--check", str(stale)]) == 1
    assert dataset_format.main([str(stale)]) == 0
    assert stale.read_bytes() == page.read_bytes()


def test_every_field_is_on_the_format_page() -> None:
    text = (ROOT / "docs" / "reference" / "dataset-format.md").read_text(encoding="utf-8")
    for field in (field for table in TABLES for field in table):
        assert f"`{field.name}`" in text
    for outcome in Outcome:
        # Files of a dataset and results of verification both list theirs.
        count = text.count(f"{outcome.value} {outcome.label}")
        assert count == (1 if outcome.verification_only else 2)


def test_field_names_are_unique_in_their_table() -> None:
    for table in TABLES:
        names = [field.name for field in table]
        assert len(names) == len(set(names))


@pytest.mark.parametrize("page", DOCS, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\((?!https?://)([^)#]+)", page.read_text(encoding="utf-8"))
    missing = [t for t in targets if not (page.parent / t).exists()]
    assert not missing


@pytest.mark.parametrize("page", DOCS, ids=lambda p: p.name)
def test_commands_in_the_docs_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for command in re.findall(r"^drakegrasp ([a-z]+)", text, flags=re.MULTILINE):
        assert command in main.commands


@pytest.mark.sim
@pytest.mark.slow
def test_session_of_the_readme_runs(
    small_dataset: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All but the build itself, and then what is done with predictions, on the small dataset."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    session, predictions = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    lines = [line for line in session.splitlines() if not line.startswith("dg.build_dataset")]
    assert len(session.splitlines()) == len(lines) + 1
    monkeypatch.chdir(small_dataset.parent)
    names: dict[str, object] = {}
    code = "\n".join([*lines, predictions]).replace('"OUT', '"out')
    try:
        exec(compile(code, "README.md", "exec"), names)
        assert Path("grasp.html").stat().st_size > 1_000_000
        assert Path("grasp.png").read_bytes().startswith(b"\x89PNG")
    finally:
        for made in ("grasp.html", "grasp.png"):
            Path(made).unlink(missing_ok=True)
    replayed, verdict, explanation = capsys.readouterr().out.splitlines()[-3:]
    assert replayed == "True"
    assert verdict.split()[0] in ("True", "False")
    assert explanation.startswith("The grasp of ")
