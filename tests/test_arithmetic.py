"""Products bit by bit as loops over floats give them; sines against the C library's."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest

from drakegrasp.arithmetic import Array, cube_root, dot, multiply, norm, sin_cos, sin_cos_deg

#: Largest error of a sine or cosine in [-1, 1].
TOLERANCE = 1e-15


def numbers(*shape: int) -> Array:
    return np.random.default_rng(sum(shape)).uniform(-1.0, 1.0, shape)


def summed(terms: list[float]) -> float:
    """Return the sum of terms, each rounded, in their order."""
    total = terms[0]
    for term in terms[1:]:
        total += term
    return total


@pytest.mark.parametrize("k", [1, 2, 3, 4, 7])
def test_product_adds_its_terms_in_order(k: int) -> None:
    A, B = numbers(5, k), numbers(k, 6)
    loops = [
        [summed([A[i, n].item() * B[n, j].item() for n in range(k)]) for j in range(6)]
        for i in range(5)
    ]
    np.testing.assert_array_equal(multiply(A, B), loops)
    np.testing.assert_allclose(multiply(A, B), A @ B, atol=1e-15)


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ((4, 4), (4, 4)),
        ((8, 4, 4), (4, 4)),
        ((4, 4), (8, 4, 4)),
        ((2, 1, 3, 3), (5, 3, 7)),
        ((0, 4, 4), (4, 4)),
        ((6, 4, 3), (3,)),
        ((4, 3), (3,)),
    ],
)
def test_product_has_the_shape_of_matmul(left: tuple[int, ...], right: tuple[int, ...]) -> None:
    A, B = numbers(*left), numbers(*right)
    product = multiply(A, B)
    assert product.shape == (A @ B).shape and product.dtype == np.float64
    np.testing.assert_allclose(product, A @ B, atol=1e-15)


@pytest.mark.parametrize("k", [3, 20])
def test_dot_and_norm_are_those_of_loops(k: int) -> None:
    a, b = numbers(9, k), numbers(8, 9, k)
    loops = [
        [
            summed([x * y for x, y in zip(p, q, strict=True)])
            for p, q in zip(a.tolist(), row, strict=True)
        ]
        for row in b.tolist()
    ]
    np.testing.assert_array_equal(dot(a, b), loops)
    np.testing.assert_array_equal(
        norm(a), [math.sqrt(summed([x * x for x in p])) for p in a.tolist()]
    )


def test_integers_are_taken_for_real_numbers() -> None:
    assert multiply([[1, 2]], [[3], [4]]).tolist() == [[11.0]]
    assert dot([2**40, 1], [2**40, 1]) == 2.0**80 + 1.0


@pytest.mark.parametrize("largest", [np.pi / 4, 2.0 * np.pi, 100.0, 1e4, 2e6 * np.pi])
def test_sine_and_cosine_agree_with_the_c_library(largest: float) -> None:
    """Near quarter turns, too, where one vanishes: the error is of the reduced angle."""
    angles = np.random.default_rng(0).uniform(-largest, largest, 20_000)
    quarters = np.rint(angles[:200] / (np.pi / 2.0)) * (np.pi / 2.0)
    near = quarters + np.array([[0.0], [1e-9], [-1e-3], [np.pi / 4]])
    for given in (angles, near.ravel()):
        for ours, exact in zip(sin_cos(given), (math.sin, math.cos), strict=True):
            reference = [exact(x) for x in given.tolist()]
            np.testing.assert_allclose(ours, reference, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("turns", [0, 1, -1, -7, 1_000_000])
def test_degrees_are_exact_at_quarter_turns(turns: int) -> None:
    sine, cosine = sin_cos_deg(360.0 * turns + np.array([0.0, 90.0, 180.0, 270.0]))
    assert sine.tolist() == [0.0, 1.0, 0.0, -1.0]
    assert cosine.tolist() == [1.0, 0.0, -1.0, 0.0]


@pytest.mark.parametrize("function", [sin_cos, sin_cos_deg])
@pytest.mark.parametrize("shape", [(), (0,), (5,), (2, 3), (2, 0, 4)])
def test_sines_keep_the_shape(
    function: Callable[[Array], tuple[Array, Array]], shape: tuple[int, ...]
) -> None:
    angles = numbers(*shape)
    for result in function(angles):
        assert result.shape == shape and result.dtype == np.float64
    alone = [function(x) for x in angles.ravel()]
    np.testing.assert_array_equal(np.reshape([s for s, _ in alone], shape), function(angles)[0])


def test_bits_are_frozen() -> None:
    """A change here changes every dataset; NumPy's and the C library's sines have other bits."""
    bits = [float(x).hex() for x in (*sin_cos(1.0), *sin_cos_deg(30.0))]
    assert bits == [
        "0x1.aed548f090ceep-1",
        "0x1.14a280fb5068cp-1",
        "0x1.fffffffffffffp-2",
        "0x1.bb67ae8584cabp-1",
    ]
    angles = np.arange(-5000, 5001) / 64.0
    many = np.array([*sin_cos(angles), *sin_cos_deg(angles)])
    assert hashlib.sha256(many.tobytes()).hexdigest()[:16] == "e688c8d9b86423d3"


def test_lengths_that_do_not_fit_are_refused() -> None:
    for right in (np.ones((4, 3)), np.ones(4)):
        with pytest.raises(ValueError, match="shapes must fit a product"):
            multiply(np.eye(3), right)
    with pytest.raises(ValueError, match="must be of one length"):
        dot(np.ones(3), np.ones(4))


def test_cube_root_is_the_nearest_double() -> None:
    assert cube_root(27.0) == 3.0
    for x in np.random.default_rng(0).uniform(1e-9, 1e-6, 200).tolist():
        root = cube_root(x)
        off = [
            abs(Fraction(y) ** 3 - Fraction(x)) for y in (math.nextafter(root, s) for s in (0, 1))
        ]
        assert abs(Fraction(root) ** 3 - Fraction(x)) < min(off)
