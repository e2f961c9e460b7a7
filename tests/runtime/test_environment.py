"""What this process may use."""

from __future__ import annotations

import resource

import pytest

from drakegrasp.config import CameraConfig
from drakegrasp.errors import MachineError
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.environment import require_render_memory
from drakegrasp.vision.rendering import build_renderer


def test_too_little_memory_for_opengl_is_a_line(
    cube: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in (resource.RLIM_INFINITY, 2 * 10**9):
        monkeypatch.setattr(resource, "getrlimit", lambda _, limit=limit: (limit, limit))
        require_render_memory()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (10**9, 10**9))
    with pytest.raises(MachineError, match=r"at least 1\.5 GB to render, got 1 GB: raise `ulimit"):
        build_renderer(cube, CameraConfig())
