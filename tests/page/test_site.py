"""The pages as files: every file that a page names is there, and none is a server's."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from click.testing import CliRunner
from helpers.pages import Tags, coded, missing_files, surface_of
from helpers.predictions import write_predictions

from drakegrasp.cli.main import main
from drakegrasp.dataset.assemble import assemble
from drakegrasp.dataset.rejections import AttemptKey, Decisions, write_decisions
from drakegrasp.errors import DataError
from drakegrasp.page import site as site_module
from drakegrasp.page.catalog import Catalog
from drakegrasp.page.site import Written, write_site


@pytest.fixture(scope="module")
def site(boxes: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages of the boxes, and of predictions for them."""
    folder = tmp_path_factory.mktemp("site")
    results = write_predictions(boxes, folder / "run.h5")
    written = write_site(boxes, folder / "pages", results=results)
    assert written == Written(grasps=9, successes=9)
    return folder / "pages"


@pytest.fixture(scope="module")
def first(boxes: Path) -> str:
    """The label of the first attempt."""
    return coded(Catalog(boxes).current(), "0-0-0")


def test_every_address_is_a_file_of_the_folder(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) == 16
    assert {page.name: missing_files(page) for page in pages} == {page.name: [] for page in pages}
    # The pages of a server ask for its own files alone, so nothing leaves the folder.
    for page in pages:
        assert not re.search('(src|href)="(/|http)', page.read_text(encoding="utf-8")), page.name


def test_meshes_of_a_page_are_scripts_that_hold_their_data(site: Path, first: str) -> None:
    page = (site / "grasp" / f"{first}.html").read_text(encoding="utf-8")
    addresses = re.findall(r'"(\.\./mesh/[^"]+)"', page)
    assert len(addresses) == 10
    for address in addresses:
        script = (site / "grasp" / address).read_text(encoding="utf-8")
        name, text = re.findall(r'drakegraspMeshes\["(.+)"\] = (.+);', script)[0]
        assert name == Path(address).stem
        assert len(surface_of(text).faces)


def test_cards_carry_what_filters_need(site: Path, first: str) -> None:
    def cards(name: str) -> list[dict[str, str | None]]:
        tags = Tags((site / name).read_text(encoding="utf-8")).tags
        return [a for tag, a in tags if tag == "li" and "data-label" in a]

    grasps, predictions = cards("index.html"), cards("predictions.html")
    assert len(grasps) == 9
    card = next(a for a in grasps if a["data-label"] == first)
    assert card["data-object"] == "1_box_a"
    assert card["data-slip"] == "2"
    # In an order that is not a set's, which differs from run to run.
    assert card["data-hold"] == "held precision stable"
    assert [card["data-label"] for card in predictions] == ["2", "3", "1", "0"]
    verdicts = [str(card["data-verdict"]).split()[0] for card in predictions]
    assert verdicts == ["fails", "fails", "held", "held"]
    assert predictions[2]["data-contact-error"] == "12"
    assert "2 of 4" in (site / "prediction" / "3.html").read_text(encoding="utf-8")


@pytest.mark.usefixtures("without_plots")
def test_files_cannot_decide_but_show_decisions(out: Path, tmp_path: Path) -> None:
    key = AttemptKey("1_box_a", 0, 0)
    write_decisions(out / "reject.json", Decisions(rejected=frozenset([key])))
    write_site(out, tmp_path / "site")
    index = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert index.count("card rejected") == 1
    for page in (tmp_path / "site").rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        assert not re.search("<button data-(decide|undo|record)", text)
        assert '<meta name="token" content="">' in text  # that of a run would differ


@pytest.mark.usefixtures("without_plots")
def test_what_is_left_out_is_told(
    boxes: Path, site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(site_module, "MAX_GRASPS", 2)
    result = CliRunner().invoke(main, ["inspect", str(boxes), "--static", str(tmp_path / "site")])
    assert result.exit_code == 0, result.stderr
    assert "2 grasps in " in result.stdout
    assert "the most suspicious of 9" in result.stdout
    index = (tmp_path / "site" / "index.html").read_text(encoding="utf-8")
    assert "Only the 2 most suspicious of 9 successes are here." in index
    whole = (site / "index.html").read_text(encoding="utf-8")
    shown, all_of_them = (re.findall('<li .*data-label="(.+?)"', text) for text in (index, whole))
    assert shown == all_of_them[:2] and len(all_of_them) == 9
    pages = (tmp_path / "site" / "grasp").glob("*.html")
    assert sorted(page.stem for page in pages) == sorted(shown)
    # Failures are not there, so none can be asked for.
    assert 'name="outcome"' not in index


@pytest.mark.usefixtures("without_plots")
@pytest.mark.parametrize("how", [KeyboardInterrupt, DataError])
def test_a_run_that_ends_early_leaves_nothing(
    out: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: type[BaseException]
) -> None:
    """After Ctrl-C, and where the dataset was assembled anew, even after its last row was read."""
    monkeypatch.setattr(site_module, "MAX_GRASPS", 2)

    def end(done: int, total: int) -> None:
        if how is KeyboardInterrupt:
            raise KeyboardInterrupt
        if done == total:
            assemble(out, rejected=[0])

    with pytest.raises(how):
        write_site(out, tmp_path / "site", progress=end)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]
    assert write_site(out, tmp_path / "site").grasps == 2


def test_a_folder_with_files_is_refused_and_left_alone(boxes: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DataError, match="--static must be a new or empty directory"):
        write_site(boxes, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
