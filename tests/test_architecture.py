"""The walls: imports point one way, reading needs no simulator, Dask stays in its place."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from types import ModuleType

import pytest

import drakegrasp

PACKAGE = Path(drakegrasp.__file__).parent

PAGE = PACKAGE.parent / "docs" / "explanation" / "architecture.md"
#: The rooms, which are folders or single modules, as the page lists them; each may import only from
#: those before it. The first is the vocabulary: the other modules at the top.
_, *_BELOW = re.findall(
    r"^(\S+)  ", PAGE.read_text().partition("## The rooms")[2].split("```")[1], re.M
)
ORDER = ("(root)", *_BELOW)
#: Folders of data, without code.
DATA = {"models", "presets"}
#: What only some places may import, at any depth of their code.
WALLS = {
    "dask": ("cluster",),
    "distributed": ("cluster",),
    "cyclopts": ("cli",),
    "starlette": ("page",),
    "uvicorn": ("page",),
    "jinja2": ("page",),
    "matplotlib": ("pictures",),
    "pydrake": ("hand", "vision", "simulation", "mjcf", "pictures", "reach"),
    "mujoco": ("mjcf", "hand.draft.mujoco_model", "protocols.scene", "exchange.mjcf"),
    "coacd": ("mjcf",),
    "pyarrow": ("exchange.hub",),
    "torch": ("dataset.reader",),
}
#: Modules that name a type of a library for the type checker alone: what callers give or get.
NAMES_TYPES = {
    *((f"api.{module}", "distributed") for module in ("building", "scoring", "verifying"))
}
#: Reading data: NumPy and h5py, and nothing of these.
HEAVY = (
    *("pydrake", "dask", "distributed", "trimesh", "scipy", "matplotlib", "rich", "pydantic"),
    *("yaml", "cyclopts", "torch"),
)
READERS = (
    *("grasp", "dataset.schema", "dataset.shards", "dataset.reader", "dataset.trials"),
    "dataset.scenes",
)
CHECKERS = ("dataset.check", "dataset.assemble")


def modules() -> dict[str, Path]:
    """Return every module that is no `__init__`, by its name below the package."""
    paths = sorted(path for path in PACKAGE.rglob("*.py") if path.stem != "__init__")
    return {".".join(path.relative_to(PACKAGE).with_suffix("").parts): path for path in paths}


MODULE_NAMES = modules()


def room_of(module: str) -> str:
    """Return the place of a module in the order."""
    top, _, rest = module.partition(".")
    # `python -m drakegrasp` is the command line.
    return top if rest or top in ORDER else "cli" if top == "__main__" else "(root)"


@cache
def tree_of(module: str) -> ast.Module:
    return ast.parse(MODULE_NAMES[module].read_text(encoding="utf-8"))


@cache
def imports_of(module: str, *, types: bool = True) -> set[str]:
    """Return what a module imports at any depth of its code, as dotted names.

    Args:
        module: Its name below the package.
        types: Whether imports for the type checker alone count.
    """
    found: set[str] = set()
    for node in _nodes(tree_of(module), types):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module} must import by absolute names"
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _nodes(node: ast.AST, types: bool) -> Iterator[ast.AST]:
    yield node
    for child in ast.iter_child_nodes(node):
        skipped = isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"
        if types or not skipped:
            yield from _nodes(child, types)


def libraries_of(module: str, *, types: bool) -> set[str]:
    return {name.partition(".")[0] for name in imports_of(module, types=types)}


def own_imports(module: str, *, types: bool = True) -> set[str]:
    """Return which modules of the package a module imports."""
    names = {
        name.removeprefix("drakegrasp.")
        for name in imports_of(module, types=types)
        if name.startswith("drakegrasp.")
    }
    return names & MODULE_NAMES.keys()


def loaded_by(modules: tuple[str, ...], names: tuple[str, ...]) -> str:
    """Return which libraries a process has loaded after it imported modules of the package."""
    imports = ", ".join(["drakegrasp", *(f"drakegrasp.{module}" for module in modules)])
    code = (
        f"import sys, {imports}; "
        f"print(sorted(name for name in {names} if sys.modules.get(name) is not None))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return result.stdout.strip()


def test_every_folder_is_in_the_order() -> None:
    folders = {path.name for path in PACKAGE.iterdir() if path.is_dir() and path.name[0] != "_"}
    assert folders - DATA <= set(ORDER)
    assert {room_of(module) for module in MODULE_NAMES} == set(ORDER)
    assert not [path for name in DATA for path in (PACKAGE / name).rglob("*.py")]


def test_imports_point_to_rooms_before() -> None:
    place = {module: ORDER.index(room_of(module)) for module in MODULE_NAMES}
    behind = {(m, name) for m in MODULE_NAMES for name in own_imports(m) if place[name] > place[m]}
    assert not behind


def test_no_module_imports_itself_through_others() -> None:
    """Imports within functions count; those for the type checker alone do not."""
    graph = {module: own_imports(module, types=False) for module in MODULE_NAMES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_rooms_load_nothing_by_themselves() -> None:
    """The walls below depend on it."""
    for path in sorted(PACKAGE.rglob("*/__init__.py")):
        (docstring,) = ast.parse(path.read_text(encoding="utf-8")).body
        assert isinstance(docstring, ast.Expr), path


def test_libraries_stay_in_their_rooms() -> None:
    strangers = {
        (module, library)
        for library, places in WALLS.items()
        for module in MODULE_NAMES
        if not any(f"{module}.".startswith(f"{place}.") for place in places)
        and library in libraries_of(module, types=(module, library) not in NAMES_TYPES)
    }
    assert not strangers


@pytest.mark.parametrize(
    ("modules", "names"),
    [
        ((), (*HEAVY, "numpy", "h5py")),
        (READERS, HEAVY),
        (CHECKERS, ("pydrake", "dask", "distributed")),
        (("exchange.dexgraspbench",), ("matplotlib",)),
    ],
    ids=[
        "the package",
        "readers: NumPy and h5py only",
        "checkers: no Drake and no Dask",
        "exporters: no pictures",
    ],
)
def test_imports_load_nothing_heavy(modules: tuple[str, ...], names: tuple[str, ...]) -> None:
    assert loaded_by(modules, names) == "[]"


def test_no_package_hides_a_public_name() -> None:
    """An imported module becomes an attribute of the package, in place of the name."""
    assert not set(drakegrasp.__all__) & {path.stem for path in PACKAGE.iterdir()}


def test_public_names_are_sorted_and_exist() -> None:
    """Also after every module was imported."""
    assert drakegrasp.__all__ == sorted(drakegrasp.__all__)
    assert dir(drakegrasp) == sorted([*drakegrasp.__all__, "__version__"])
    for name in MODULE_NAMES:
        importlib.import_module(f"drakegrasp.{name}")
    for name in drakegrasp.__all__:
        found = getattr(drakegrasp, name)
        assert found is not None
        assert not isinstance(found, ModuleType)
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = drakegrasp.magic


def test_code_names_a_hand_only_as_a_default() -> None:
    texts = [
        (module, node.value)
        for module in MODULE_NAMES
        for node in ast.walk(tree_of(module))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    named = [(module, text) for module, text in texts if text.lower().startswith("barrett")]
    assert sorted(named) == [("config", "barrett"), ("hand.description", "barrett")]
