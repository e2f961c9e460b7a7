"""What this process may use."""

from __future__ import annotations

import resource
import sys
from pathlib import Path

import pytest

from drakegrasp.config import CameraConfig
from drakegrasp.errors import MachineError
from drakegrasp.objects.model import ObjectModel
from drakegrasp.runtime.environment import prepare_rendering
from drakegrasp.vision.rendering import build_renderer


def test_too_little_memory_for_opengl_is_a_line(
    cube: ObjectModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in (resource.RLIM_INFINITY, 2 * 10**9):
        monkeypatch.setattr(resource, "getrlimit", lambda _, limit=limit: (limit, limit))
        prepare_rendering()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (10**9, 10**9))
    with pytest.raises(MachineError, match=r"at least 1\.5 GB to render, got 1 GB: raise `ulimit"):
        build_renderer(cube, CameraConfig())


@pytest.mark.parametrize("content", ["", "raise RuntimeError('broken')"])
def test_triton_is_loaded_before_opengl_or_nothing_is_said(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "triton.py").write_text(f"import sys; sys.seen_triton = True\n{content}")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "triton", raising=False)
    monkeypatch.setattr(sys, "seen_triton", False, raising=False)
    prepare_rendering()
    assert sys.seen_triton
    monkeypatch.delitem(sys.modules, "triton", raising=False)
