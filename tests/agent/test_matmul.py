"""Matrix products within compiled passes."""

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from rcdsac_trl.agent.kernels import matmul
from rcdsac_trl.agent.kernels.matmul import matmul as multiply
from rcdsac_trl.agent.kernels.matmul import matmul_nt, matmul_tn

Array = np.ndarray[Any, Any]
Product = Callable[[Array, Array, Array, bool], None]

PRODUCTS: list[tuple[Product, Callable[[Array, Array], tuple[Array, Array]]]] = [
    (multiply, lambda a, b: (a, b)),
    (matmul_nt, lambda a, b: (a, np.ascontiguousarray(b.T))),
    (matmul_tn, lambda a, b: (np.ascontiguousarray(a.T), b)),
]


def matrices(m: int, k: int, n: int, kind: type) -> tuple[Array, Array]:
    stream = np.random.default_rng(0)
    return stream.standard_normal((m, k)).astype(kind), stream.standard_normal((k, n)).astype(kind)


@pytest.mark.parametrize(("product", "laid_out"), PRODUCTS)
@pytest.mark.parametrize("size", [(3, 5, 7), (1, 4, 1), (1, 1, 1), (70, 33, 20), (0, 3, 2), (3, 0, 2)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_products_equal_numpys(product: Product, laid_out: Callable, size: tuple[int, int, int], kind: type) -> None:
    a, b = matrices(*size, kind)
    expected, tolerance = a @ b, 1e-5 if kind is np.float32 else 1e-12
    out = np.full(expected.shape, 5.0, kind)
    product(*laid_out(a, b), out, False)
    np.testing.assert_allclose(out, expected, atol=tolerance)
    product(*laid_out(a, b), out, True)
    np.testing.assert_allclose(out, 2.0 * expected, atol=2.0 * tolerance)


@pytest.mark.parametrize(("product", "laid_out"), PRODUCTS)
def test_columns_of_a_wider_matrix(product: Product, laid_out: Callable) -> None:
    a, b = matrices(4, 6, 5, np.float64)
    wide_a, wide_b = (np.pad(each, ((0, 0), (2, 3))) for each in laid_out(a, b))
    out = np.zeros((4, 9))
    product(wide_a[:, 2:-3], wide_b[:, 2:-3], out[:, 1:6], False)
    np.testing.assert_allclose(out[:, 1:6], a @ b)
    assert not out[:, 0].any()
    assert not out[:, 6:].any()


@pytest.mark.parametrize("product", [product for product, _ in PRODUCTS])
@pytest.mark.parametrize(
    ("a", "b", "out"),
    [((3, 4), (5, 6), (3, 6)), ((3, 3), (3, 3), (3, 4)), ((3, 3), (3, 3), (2, 3))],
)
def test_what_does_not_fit_is_refused(product: Product, a: Any, b: Any, out: Any) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        product(np.ones(a), np.ones(b), np.ones(out), False)


@pytest.mark.parametrize("product", [product for product, _ in PRODUCTS])
@pytest.mark.parametrize("wrong", [0, 1, 2])
def test_rows_that_are_not_contiguous_are_refused(product: Product, wrong: int) -> None:
    given = [np.ones((3, 6))[:, ::2] if number == wrong else np.ones((3, 3)) for number in range(3)]
    with pytest.raises(ValueError, match="contiguous"):
        product(*given, False)


@pytest.mark.parametrize("in_torch", [True, False])
def test_either_librarys_routine_multiplies(in_torch: bool) -> None:
    address = matmul.find("dgemm", in_torch=in_torch)
    if address is None:
        assert in_torch
        assert matmul.LIBRARY == "SciPy's"
        return
    a, b, out = np.array([[1.0, 2.0]]), np.array([[3.0], [4.0]]), np.zeros(1)
    numbers = [ctypes.c_int(value) for value in (1, 1, 2)]
    one, zero, (m, n, k) = ctypes.c_double(1.0), ctypes.c_double(0.0), numbers
    given: list[Any] = [b"N", b"N", m, n, k, one, a, m, b, k, zero, out, m]
    by_address = [
        each if isinstance(each, bytes) else each.ctypes if isinstance(each, np.ndarray) else ctypes.byref(each)
        for each in given
    ]
    ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 13)(address)(*by_address)
    assert out[0] == 11.0


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_empty_aligned_begins_where_torchs_tensors_do(kind: type) -> None:
    for size in range(1, 40):  # of many sizes, some would not by themselves
        given = matmul.empty_aligned((size, 3), np.zeros(1, kind))
        assert (given.shape, given.dtype) == ((size, 3), np.dtype(kind))
        assert given.ctypes.data % 64 == 0
        given[:] = 1.0
        assert torch.empty(size).data_ptr() % 64 == 0
