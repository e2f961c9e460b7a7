"""What is drawn is the same on every machine: the same hashes, whatever kernels compute it."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import draws
from helpers.meshes import G3DB

pytestmark = [pytest.mark.sim, pytest.mark.slow]

HASHES = json.loads((Path(__file__).parent / "helpers" / "draws.json").read_text())
SIMD = draws.kernels()["simd"]
assert isinstance(SIMD, list)


def cpu_flags() -> set[str]:
    """Return what this CPU says that it can do; nothing where Linux does not say it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return set()
    return {flag for line in lines if line.startswith("flags") for flag in line.split()}


def drawn_with(**settings: str) -> dict[str, object]:
    """Return what a process with other settings in its environment draws, and its kernels."""
    ours = ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES", "GLIBC_TUNABLES")
    env = {k: v for k, v in os.environ.items() if k not in ours} | settings
    command = [sys.executable, draws.__file__, *([str(G3DB)] if G3DB.is_dir() else [])]
    result = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    found: dict[str, object] = json.loads(result.stdout)
    return found


def check(found: dict[str, object]) -> dict[str, list[str]]:
    """Compare with the stated hashes; return the kernels."""
    kernels = found.pop("kernels")
    assert isinstance(kernels, dict)
    assert len(found) > 15
    assert found == {name: HASHES[name] for name in found}
    return kernels


def test_this_process_draws_the_same(tmp_path: Path) -> None:
    """For three objects; for the others, and for other CPUs, in the second tier."""
    found = {
        f"{source.name}: {what}": value
        for source in draws.objects(tmp_path, None)
        if source.name != "3_block"
        for what, value in draws.object_draws(source)
    }
    assert len(found) > 5
    assert found == {name: HASHES[name] for name in found}


@pytest.mark.nightly
def test_newest_blas_kernel_changes_no_draw() -> None:
    """The newest of this CPU; all that are older lie between it and the next test's."""
    flags = cpu_flags()
    kernel = "SkylakeX" if {"avx512f", "avx512vl"} <= flags else "Haswell"
    if not {"avx2", "fma"} <= flags:
        pytest.skip("this CPU has the kernels of the next test only")
    assert set(check(drawn_with(OPENBLAS_CORETYPE=kernel))["blas"]) <= {kernel}


@pytest.mark.nightly
def test_oldest_cpu_draws_the_same() -> None:
    """Without any instruction beyond the least, in BLAS, in NumPy and in the C library's sines."""
    settings = {"OPENBLAS_CORETYPE": "Prescott"}
    if SIMD:
        settings["NPY_DISABLE_CPU_FEATURES"] = " ".join(SIMD)
    other_sines = "fma" in cpu_flags() and platform.libc_ver()[0] == "glibc"
    if other_sines:
        settings["GLIBC_TUNABLES"] = "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2"
    kernels = check(drawn_with(**settings))
    assert set(kernels["blas"]) <= {"Katmai", "Prescott"}
    assert not set(SIMD) & set(kernels["simd"])
    if other_sines:
        assert kernels["libm"] != draws.kernels()["libm"] or "GLIBC_TUNABLES" in os.environ
