"""The walls: imports point one way, reading needs no simulator, Dask stays in its place."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import drakegrasp

PACKAGE = Path(drakegrasp.__file__).parent

#: Each line may import only from lines above it (docs/architecture.md).
LAYERS: tuple[frozenset[str], ...] = tuple(
    frozenset(line.split())
    for line in (
        "errors executor frames memory network progress processes build_log threads",
        "grasp outcomes hand_files config curves surfaces distance_field pads prediction "
        "prediction_files faults build_lock",
        "schema hand solids bodies wavefront build_options commands",
        "shards camera filters shapes vessels fruit holes union decimation hand_shapes",
        "builtin manifest mend journal",
        "meshes",
        "object_model",
        "audit candidates kinematics violations wrenches contact_surface tally",
        "parts scene render dataset contact_forces wrist_problem hand_paths",
        "samples construction contacts clock figures postures screen",
        "assemble layout_rules sample_rules image_rules trial_rules scenes wrist_fit lifting",
        "stats resting trial open_file doc_figures plan peer",
        "prepared tables dataset_rules theatre lift_path placed certify",
        "workbench check force_lift force_margin",
        "rows preparing",
        "units",
        "build snapshots verified bench",
        "recording verification_figure",
        "replay verification",
        "verify verification_files",
        "verify_plan",
        "verifying verify_request workers crew tls",
        "cluster cluster_request doctor format_docs",
        "clusters",
        "cli",
    )
)
READERS = ("grasp", "schema", "shards", "dataset")
#: Modules that may know Dask.
KNOWS_DASK = {"cluster", "cluster_request", "clusters", "crew", "tls", "workers"}


def imports_of(module: str) -> set[str]:
    """Return what a module imports at any depth of its code, as dotted names."""
    tree = ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def modules() -> list[str]:
    return sorted(p.stem for p in PACKAGE.glob("*.py") if p.stem != "__init__")


def test_every_module_has_its_layer() -> None:
    assert sorted(name for layer in LAYERS for name in layer) == modules()


@pytest.mark.parametrize("module", modules())
def test_imports_point_to_layers_above(module: str) -> None:
    (own,) = (i for i, layer in enumerate(LAYERS) if module in layer)
    allowed = {name for layer in LAYERS[:own] for name in layer}
    ours = {
        name.split(".")[1]
        for name in imports_of(module)
        if name.startswith("drakegrasp.") and name.split(".")[1] in modules()
    }
    assert ours <= allowed, f"{module} imports {sorted(ours - allowed)}"


@pytest.mark.parametrize("module", modules())
def test_only_the_cluster_modules_know_dask(module: str) -> None:
    knows = any(name.split(".")[0] in ("dask", "distributed") for name in imports_of(module))
    assert not knows or module in KNOWS_DASK


@pytest.mark.parametrize("module", [*READERS, "check"])
def test_reading_data_loads_no_drake_and_no_dask(module: str) -> None:
    forbidden = ["pydrake", "dask", "distributed"]
    if module in READERS:
        forbidden += ["trimesh", "matplotlib", "rich", "scipy"]
    code = (
        f"import sys, drakegrasp.{module}; "
        f"print([name for name in {forbidden} if name in sys.modules])"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_no_module_hides_a_public_name() -> None:
    """An imported module becomes an attribute of the package, in place of the name."""
    assert not set(drakegrasp.__all__) & set(modules())


def test_public_names_are_sorted_and_exist() -> None:
    """Also after every module was imported."""
    assert drakegrasp.__all__ == sorted(drakegrasp.__all__)
    for name in modules():
        importlib.import_module(f"drakegrasp.{name}")
    for name in drakegrasp.__all__:
        found = getattr(drakegrasp, name)
        assert found is not None
        assert not isinstance(found, ModuleType)
    with pytest.raises(AttributeError, match="no attribute 'magic'"):
        _ = drakegrasp.magic


@pytest.mark.parametrize("module", modules())
def test_code_names_a_hand_only_as_a_default(module: str) -> None:
    tree = ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))
    texts = [n.value for n in ast.walk(tree) if isinstance(n, ast.Constant)]
    named = [t for t in texts if isinstance(t, str) and t.lower().startswith("barrett")]
    assert named == (["barrett"] if module in ("config", "hand") else [])
