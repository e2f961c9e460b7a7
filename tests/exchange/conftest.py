"""A small dataset with samples in all three splits, and its samples."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from drakegrasp.exchange.closed_grasps import ClosedGrasp, read_closed_grasps
from drakegrasp.exchange.export import Format, export_dataset


@pytest.fixture(scope="session")
def grasps(sound: Path) -> list[ClosedGrasp]:
    return list(read_closed_grasps(sound))


@pytest.fixture(scope="session")
def exported(sound: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[Format], Path]:
    """Returns the folder of a format. Read only."""

    @cache
    def export(form: Format) -> Path:
        to = tmp_path_factory.mktemp(form) / "to"
        export_dataset(sound, to, form, licence="cc-by-4.0")
        return to

    return export
