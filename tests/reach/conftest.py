"""A made-up arm of six joints, as a file."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.arms import write_arm


@pytest.fixture(scope="package")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_arm(tmp_path_factory.mktemp("arm"))
