"""Matrix products, lengths and sines with the same bits on every CPU, BLAS and C library.

BLAS, NumPy's sines and the C library choose their kernels by the CPU, and each kernel rounds
differently. But IEEE 754 determines sums, products, quotients and square roots if each is rounded
separately in a fixed order. NumPy rounds after each call, so nothing is fused. All random draws and
all decisions before a simulation are computed with these functions.
"""

from __future__ import annotations

from decimal import Decimal, localcontext

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

#: Half of pi in two parts (fdlibm, `e_rem_pio2.c`): multiples of the first up to 2^22 are exact.
_HALF_PI = (1.57079632673412561417e00, 6.07710050650619224932e-11)
#: Coefficients of sine and cosine on -pi/4..pi/4, highest power first (fdlibm, `k_sin.c`,
#: `k_cos.c`); the error is below 2^-57.
_SIN = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
_COS = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)


def multiply(A: npt.ArrayLike, B: npt.ArrayLike) -> Array:
    """Return matrix products, as `A @ B` does; terms are added in the order of k.

    Poses are composed with it: `X_AC = multiply(X_AB, X_BC)`.

    Args:
        A: (..., n, k).
        B: (..., k, m), or one vector (k,); the result is (..., n, m), or (..., n).

    Raises:
        ValueError: If the two k differ.
    """
    left, right = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    if right.ndim == 1:
        return multiply(left, right[:, None])[..., 0]
    if left.shape[-1] != right.shape[-2]:
        raise ValueError(f"shapes must fit a product, got {left.shape} and {right.shape}")
    total = left[..., :, 0, None] * right[..., None, 0, :]
    for k in range(1, left.shape[-1]):
        total = total + left[..., :, k, None] * right[..., None, k, :]
    return np.asarray(total)


def dot(a: npt.ArrayLike, b: npt.ArrayLike) -> Array:
    """Return the dot products (...) of vectors (..., k); terms are added in their order.

    Raises:
        ValueError: If the two k differ.
    """
    left, right = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if left.shape[-1] != right.shape[-1]:
        raise ValueError(f"vectors must be of one length, got {left.shape} and {right.shape}")
    total = left[..., 0] * right[..., 0]
    for k in range(1, left.shape[-1]):
        total = total + left[..., k] * right[..., k]
    return np.asarray(total)


def norm(v: npt.ArrayLike) -> Array:
    """Return the Euclidean lengths (...) of vectors (..., k)."""
    return np.asarray(np.sqrt(dot(v, v)))


def cube_root(x: float) -> float:
    """Return the double nearest to the cube root of a positive number."""
    with localcontext(prec=40):
        return float(Decimal(x) ** (Decimal(1) / 3))


def sin_cos(angle: npt.ArrayLike) -> tuple[Array, Array]:
    """Return sine and cosine of angles of any shape [rad], to 1e-15 up to a million turns."""
    x = np.asarray(angle, dtype=float)
    quarters = np.rint(x * (2.0 / np.pi))
    return _turned(quarters, (x - quarters * _HALF_PI[0]) - quarters * _HALF_PI[1])


def sin_cos_deg(angle: npt.ArrayLike) -> tuple[Array, Array]:
    """Return sine and cosine of angles of any shape [deg]; exact at multiples of 90."""
    x = np.asarray(angle, dtype=float)
    quarters = np.rint(x / 90.0)
    return _turned(quarters, (x - 90.0 * quarters) * (np.pi / 180.0))


def _turned(quarters: Array, rest: Array) -> tuple[Array, Array]:
    """Return sine and cosine of quarter turns and a rest within -pi/4..pi/4 [rad]."""
    square = rest * rest
    sine, cosine = np.full_like(rest, _SIN[0]), np.full_like(rest, _COS[0])
    for a, b in zip(_SIN[1:], _COS[1:], strict=True):
        sine, cosine = sine * square + a, cosine * square + b
    sine = rest + rest * (square * sine)
    cosine = (1.0 - 0.5 * square) + square * (square * cosine)

    # Each quarter turn swaps the two and changes one sign.
    quadrant = quarters.astype(np.int64) % 4
    swapped = quadrant % 2 == 1
    s, c = np.where(swapped, cosine, sine), np.where(swapped, sine, cosine)
    return np.where(quadrant >= 2, -s, s), np.where((quadrant == 1) | (quadrant == 2), -c, c)
