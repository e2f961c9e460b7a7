"""What the docs say is what the code does; the site has every page, and no strangers."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import builtin_objects
import click
import dataset_format
import pytest
import yaml
from helpers.commands import arguments_of
from helpers.scripts import load_script

import drakegrasp
from drakegrasp.cli.main import COMMANDS, app
from drakegrasp.config import Config

ROOT = Path(__file__).resolve().parents[1]
FORMAT_PAGE = ROOT / "docs" / "reference" / "dataset-format.md"
BUILTIN_PAGE = ROOT / "docs" / "reference" / "builtin-objects.md"
COMMAND_PAGE = ROOT / "docs" / "reference" / "command-line.md"
CONFIG_PAGE = ROOT / "docs" / "reference" / "configuration.md"
DOCS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
#: Columns of the README's lines.
README_COLUMNS = 120


def page_id(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, language: str) -> list[str]:
    """Return the code blocks of a page that are marked with a language; "" for plain ones."""
    fences = re.findall(r"^```(\w*)\n(.*?)^```$", read(page), flags=re.DOTALL | re.MULTILINE)
    return [block for name, block in fences if name == language]


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub gives a page's headings."""
    prose = re.sub(r"^```.*?^```", "", read(page), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.*)$", prose, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in headings}


@pytest.mark.parametrize(
    ("main", "page", "right", "wrong"),
    [
        (dataset_format.main, FORMAT_PAGE, "float64", "float16"),
        (builtin_objects.main, BUILTIN_PAGE, "mm", "cm"),
    ],
)
def test_generated_page_is_what_the_code_says(
    tmp_path: Path, main: Callable[[list[str]], int], page: Path, right: str, wrong: str
) -> None:
    assert main(["--check", str(page)]) == 0
    stale = tmp_path / "page.md"
    stale.write_text(read(page).replace(right, wrong), encoding="utf-8")
    assert main(["--check", str(stale)]) == 1
    assert main([str(stale)]) == 0
    assert stale.read_bytes() == page.read_bytes()


@pytest.mark.parametrize("page", DOCS, ids=page_id)
def test_links_lead_somewhere(page: Path) -> None:
    missing = []
    for path, anchor in re.findall(r"\]\((?!https?://)([^)#]*)#?([^)]*)\)", read(page)):
        target = page.parent / path if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            missing.append(f"{path}#{anchor}")
    assert not missing


def test_every_page_is_reached_from_the_index() -> None:
    index = read(ROOT / "docs" / "index.md")
    pages = {page.relative_to(ROOT / "docs").as_posix() for page in DOCS if page.parent != ROOT}
    assert {page for page in pages if f"]({page})" not in index} == {"index.md"}


def test_pages_that_the_code_names_exist() -> None:
    files = [ROOT / "Makefile", ROOT / "CHANGELOG.md"]
    for folder in ("drakegrasp", "pipelines", "tests"):
        files += [p for p in (ROOT / folder).rglob("*") if p.suffix in (".py", ".sh", ".yaml")]
    named = {
        (path.name, page)
        for path in files
        for page in re.findall(r"docs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert named
    assert not {(name, page) for name, page in named if not (ROOT / page).is_file()}


@pytest.mark.parametrize("page", DOCS, ids=page_id)
def test_files_that_the_docs_name_exist(page: Path) -> None:
    """A module is named by its path below the package, a test by its file's name alone."""
    tests = {path.name for path in (ROOT / "tests").rglob("*.py")}
    named = set(re.findall(r"`([\w/]+\.(?:py|sh|sbatch))`", read(page)))
    written = set(re.findall(r"Write this as `(\w+\.py)`", read(page)))  # by the reader
    missing = {
        name
        for name in named - tests - written
        if not any((base / name).is_file() for base in _bases(page, name))
    }
    assert not missing


def test_each_stop_of_a_walk_is_a_function_of_its_module() -> None:
    page = read(ROOT / "docs" / "explanation" / "architecture.md")
    stops = re.findall(r"^\| \d+ \| `([\w/]+\.py)` `(\w+)` \|", page, re.MULTILINE)
    assert len(stops) > 15
    for module, name in stops:
        source = read(ROOT / "drakegrasp" / module)
        assert re.search(rf"^(def|class) {name}\b", source, re.MULTILINE), f"{module} {name}"


def test_pictures_of_the_architecture_name_modules() -> None:
    page = ROOT / "docs" / "explanation" / "architecture.md"
    named = {
        name for text in blocks(page, "text") for name in re.findall(r"\w+(?:/\w+)+\.py", text)
    }
    assert len(named) > 20
    assert not {name for name in named if not (ROOT / "drakegrasp" / name).is_file()}


def guards(page: Path) -> Iterator[str]:
    """Yield the tests that a page names as guards, by `pytest -k`: in its tables, or in prose."""
    table = False
    for line in read(page).splitlines():
        table = line.startswith("|") and (table or line.endswith("| guarded by |"))
        if table:
            yield from re.findall(r"`(\w+)`", line.split("|")[-2])
    text = " ".join(read(page).split())
    for names in re.findall(r"[Gg]uarded by ((?:`\w+`(?:, | and )?)+)", text):
        yield from re.findall(r"`(\w+)`", names)
    yield from re.findall(r"`(\w+)` guards", text)


def test_tests_that_the_docs_name_exist() -> None:
    sources = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")]
    tests = [name for source in sources for name in re.findall(r"^def (test_\w+)", source, re.M)]
    named = {name for page in DOCS for name in guards(page)}
    assert len(named) > 30
    assert not {name for name in named if not any(name in test for test in tests)}


def _bases(page: Path, name: str) -> list[Path]:
    """Return the folders in which a file that the docs name may lie."""
    package = ROOT / "drakegrasp"
    # Pages on one room, the recipes beside the scripts, and the gallery name files by less.
    rooms = [package / "verification"] if page.stem == "wrist-problem" else []
    return [ROOT, page.parent, package, ROOT / "pipelines" / "recipes", *rooms]


def command_lines(page: Path) -> Iterator[tuple[str, set[str], list[str]]]:
    """Yield the commands of a page's plain code blocks with their options and arguments."""
    text = "\n".join(blocks(page, "")).replace("\\\n", " ")
    for name, rest in re.findall(r"^drakegrasp ([a-z][a-z-]*)(.*)", text, re.M):
        yield name, options_of(name), shlex.split(rest, comments=True)
    # The baseline cannot be loaded without torch; tests/test_baseline.py runs it.
    for script, rest in re.findall(r"^python pipelines/(?!baseline/)([\w/]+)\.py(.*)", text, re.M):
        command = load_script(script).main
        if isinstance(command, click.Command):  # the others are tested as commands
            options = {name for each in command.params for name in each.opts}
            yield script, options, shlex.split(rest, comments=True)


def options_of(*command: str) -> set[str]:
    """Return the options of a command, of a group those of all its commands."""
    here = app
    for name in command:
        here = here[name]
    below = [name for name in here if not name.startswith("-")]
    options = {"--help", "-h"}.union(*(options_of(*command, name) for name in below))
    if here.default_command is not None:
        options |= {name for each in arguments_of(*command) for name in each.names}
    return {name for name in options if name.startswith("-")}


def test_commands_and_options_in_the_docs_exist() -> None:
    for page in DOCS:
        assert set(re.findall(r"`drakegrasp ([a-z][a-z-]*)", read(page))) <= COMMANDS.keys()
    lines = [(page, *line) for page in DOCS for line in command_lines(page)]
    assert len(lines) > 20
    for page, name, options, words in lines:
        unknown = {word for word in words if re.match("--?[a-z]", word)} - options
        assert not unknown, f"{page_id(page)}: {name} {words}"


def test_the_command_page_has_every_command_and_its_options() -> None:
    sections = dict(re.findall(r"^## (\S+)\n(.*?)(?=^## |\Z)", read(COMMAND_PAGE), re.M | re.S))
    assert list(sections) == list(COMMANDS)
    shared = options_of("build")
    for name in COMMANDS:
        named = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", sections[name]))
        options = options_of(name) - {"--help", "-h"}
        assert named <= options | shared, name
        # `submit` takes the options of a build, which its section refers to.
        assert options <= named | (shared if name == "submit" else set()), name


def test_the_configuration_page_has_every_setting() -> None:
    text = read(CONFIG_PAGE)
    sections = dict(re.findall(r"^## ([\w*, ]+)\n(.*?)(?=^## |\Z)", text, re.M | re.S))
    named = {
        (heading.replace("*", ""), key)
        for heading, table in sections.items()
        for row in re.findall(r"^\| (`[^|]*)\|", table, re.M)
        for key in re.findall(r"`([\w.]+)`", row)
    }
    on_page = set()
    for heading, key in named:
        if heading == "Top level":
            on_page.add(key)
        elif heading != "Presets":
            on_page.add(key if "." in key else f"{heading.strip()}.{key}")
    settings = set()
    for name, field in Config.model_fields.items():
        keys = getattr(field.annotation, "model_fields", None)
        settings |= {name} if keys is None else {f"{name}.{key}" for key in keys}
    assert on_page == settings


def test_the_readme_is_wrapped_and_begins_with_a_verdict() -> None:
    lines = read(ROOT / "README.md").splitlines()
    assert max(map(len, lines)) <= README_COLUMNS
    assert any("dg.verify_grasp(" in line for line in lines[:20])


RESULTS = [page for page in DOCS if page.parent.name == "results" and page.stem != "index"]


@pytest.mark.parametrize("page", RESULTS, ids=page_id)
def test_results_are_dated_and_of_now(page: Path) -> None:
    text = read(page)
    for section in re.split(r"^## ", text, flags=re.M)[1:]:
        assert re.search(r"\b20\d\d-\d\d-\d\d\b", section), section.splitlines()[0]
    # A hash of our commits says nothing to a reader, and an older number belongs to the changelog.
    assert not re.findall(r"(?<!commit )\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b", text)
    assert not re.findall(r"^\|.*\bbefore \|.*\bnow \|", text, re.M)


#: Pages with Python that runs; those of the first tier show the public calls.
FIRST = ("README.md", "docs/reference/python.md")
PYTHON_PAGES = [
    pytest.param(page, id=name, marks=() if name in FIRST else pytest.mark.nightly)
    for page, name in ((page, page_id(page)) for page in DOCS if blocks(page, "python"))
]


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("page", PYTHON_PAGES)
def test_python_of_the_docs_runs(
    page: Path,
    small_dataset: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """All blocks of a page, one after the other as a reader would, on the small dataset.

    Blocks marked `py` in place of `python` are in the list of test_doc_blocks.py.
    """
    (tmp_path / "demo").mkdir()
    for name in ("OUT", "demo/dataset"):
        (tmp_path / name).symlink_to(small_dataset, target_is_directory=True)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in blocks(page, "python"):
        # torch is no dependency.
        if "torch" in block and find_spec("torch") is None:
            continue
        # A build takes hours; its result is there.
        lines = [line for line in block.splitlines() if not line.startswith("dg.build_dataset")]
        exec(compile("\n".join(lines), page_id(page), "exec"), names)
    for figure in tmp_path.glob("*.png"):
        assert figure.read_bytes().startswith(b"\x89PNG")
    for recording in tmp_path.glob("*.html"):
        assert recording.stat().st_size > 1_000_000
    if page.name == "README.md":
        replayed, verdict, explanation = capsys.readouterr().out.splitlines()[-3:]
        assert replayed == "True"
        assert verdict.split()[0] in ("True", "False")
        assert explanation.startswith("The grasp of ")
        assert (tmp_path / "grasp.html").is_file()


def test_the_table_of_scripts_names_every_script_and_no_other() -> None:
    table = read(ROOT / "pipelines" / "README.md")
    files = {path.name for path in (ROOT / "pipelines").rglob("*.py")}
    assert set(re.findall(r"\b(\w+\.py)`", table)) == files


def test_scripts_that_the_nightly_run_names_exist() -> None:
    names = re.findall(r"[\w/]+\.py\b", read(ROOT / ".ci" / "nightly"))
    assert names
    for name in names:
        assert (ROOT / name).is_file() or (ROOT / "pipelines/measurements" / name).is_file(), name


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
