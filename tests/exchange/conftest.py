"""A small dataset with samples in all three splits, and its samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
from helpers.datasets import make_dataset

from drakegrasp.exchange.export import ClosedGrasp, export_dataset, options_of, read_closed_grasps


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exchange")
    (folder / "meshes").mkdir()
    return make_dataset(folder / "out", folder / "meshes")


@pytest.fixture(scope="session")
def grasps(dataset: Path) -> list[ClosedGrasp]:
    return list(read_closed_grasps(dataset))


@pytest.fixture(scope="session")
def exported(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Returns the folder of a format. Read only."""

    @cache
    def export(form: str) -> Path:
        to = tmp_path_factory.mktemp(form) / "to"
        said = {"licence": "cc-by-4.0"} if "licence" in options_of(form) else {}
        export_dataset(dataset, to, form, **said)
        return to

    return export
