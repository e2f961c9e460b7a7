"""Proposals for what a camera sees have the same bits on every machine."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import numpy.typing as npt

import drakegrasp as dg
from drakegrasp.arithmetic import multiply
from drakegrasp.frames import rotation_about
from drakegrasp.hand.finger_sweep import reach


def short_hash(values: npt.ArrayLike) -> str:
    return hashlib.sha256(np.asarray(values, dtype=float).tobytes()).hexdigest()[:8]


def square_box(turn: float) -> np.ndarray:
    """Return points on the top and on two sides of a box with a square base, turned [rad]."""
    x, z = np.linspace(-0.03, 0.03, 20), np.linspace(0.0, 0.1, 20)
    faces = [(x, x, z[-1:]), (x[-1:], x, z), (x, x[-1:], z)]
    points = [np.stack(np.meshgrid(*face), axis=-1).reshape(-1, 3) for face in faces]
    return multiply(np.concatenate(points), rotation_about([0.0, 0.0, 1.0], turn).T)


def computed() -> dict[str, str]:
    """Return hashes of proposals and the extent of the hand."""
    hand, cloud = dg.load_hand(), square_box(0.7)
    directions = rotation_about([0.6, 0.8, 0.0], 0.7)
    return {
        "cloud": short_hash(cloud),
        "palms": short_hash(dg.propose(cloud, hand).X_FG),
        "reach": short_hash([reach(hand, direction) for direction in directions]),
    }


def test_an_old_cpu_proposes_the_same() -> None:
    """With other kernels of BLAS, of NumPy and of the C library's sines."""
    from helpers import draws

    simd = draws.kernels()["simd"]
    assert isinstance(simd, list)
    settings = {
        "OPENBLAS_CORETYPE": "Prescott",
        "NPY_DISABLE_CPU_FEATURES": " ".join(simd),
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-FMA4,-AVX2",
    }
    result = subprocess.run(
        [sys.executable, __file__],
        env=os.environ | settings, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert json.loads(result.stdout) == computed()


if __name__ == "__main__":
    sys.stdout.write(json.dumps(computed()))
