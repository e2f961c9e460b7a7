"""Which BLAS kernels a CPU supports, and which one several machines have in common."""

from __future__ import annotations

from pathlib import Path

import pytest

from drakegrasp.runtime import kernels
from drakegrasp.runtime.blas import running_kernel
from drakegrasp.runtime.kernels import (
    KERNELS,
    agreed_kernel,
    common_kernel,
    supported_kernel,
)


@pytest.mark.parametrize(
    ("flags", "kernel"),
    [
        ("fpu avx fma avx2 avx512f avx512cd avx512bw avx512dq avx512vl", "SkylakeX"),
        ("fpu sse2 pni avx fma avx2 avx512f", "Haswell"),
        ("fpu sse2 pni avx avx2", "Prescott"),  # without fused multiply-add
        ("fpu sse2 pni avx fma", "Prescott"),
        ("fpu sse2", "Prescott"),
    ],
)
def test_kernel_needs_the_flags_of_the_cpu(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, flags: str, kernel: str
) -> None:
    cpuinfo = tmp_path / "cpuinfo"
    cpuinfo.write_text(f"processor : 0\nmodel name : avx2 fma\nflags\t\t: {flags}\n")
    monkeypatch.setattr(kernels, "_CPUINFO", cpuinfo)
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    assert supported_kernel() == kernel


def test_other_machines_support_no_known_kernel(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("platform.machine", lambda: "x86_64")
    monkeypatch.setattr(kernels, "_CPUINFO", tmp_path / "none")
    assert supported_kernel() is None
    monkeypatch.undo()
    monkeypatch.setattr("platform.machine", lambda: "aarch64")
    assert supported_kernel() is None


def test_common_kernel_is_the_slowest() -> None:
    fast, *_, slow = KERNELS
    assert common_kernel([fast, fast]) == fast
    assert common_kernel([fast, slow, fast]) == slow
    assert common_kernel([fast, None]) is None
    assert common_kernel([]) is None


@pytest.mark.parametrize(
    ("ours", "running", "supported", "agreed"),
    [
        ("SkylakeX", ["SkylakeX"] * 2, ["SkylakeX"] * 2, "SkylakeX"),
        ("Cooperlake", ["Cooperlake"], ["SkylakeX"], "Cooperlake"),  # nothing to set
        ("Haswell", ["SkylakeX"], ["SkylakeX"], "Haswell"),  # the client's, though slower
        ("SkylakeX", ["SkylakeX", "Haswell"], ["SkylakeX", "Haswell"], "Haswell"),
        ("Cooperlake", ["SkylakeX", "Haswell"], ["SkylakeX", "Haswell"], "Haswell"),
        ("Haswell", ["Haswell", "ThunderX"], ["Haswell", None], None),
        ("Haswell", [], [], "Haswell"),
    ],
)
def test_workers_agree_on_the_kernel_of_the_client_where_they_can(
    ours: str, running: list[str], supported: list[str | None], agreed: str | None
) -> None:
    assert agreed_kernel(ours, running, supported) == agreed


def test_running_kernel_has_a_name() -> None:
    assert running_kernel()
