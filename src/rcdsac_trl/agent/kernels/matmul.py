"""Matrix products within compiled passes, by the BLAS that torch multiplies with.

A call of ``torch.mm`` and the slices around it take as long as the product of a hundred rows, and come back to Python
between any two. Numba's own ``@`` calls SciPy's BLAS, which is a quarter slower than the MKL that torch has on x86, and
whose threads torch knows nothing of.
"""

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite.binding
import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import get_cython_function_address, intrinsic

from rcdsac_trl.system.jit import njit

#: BLAS's names of the product of two matrices, by their type.
ROUTINES = {types.float32: "sgemm", types.float64: "dgemm"}
_NAME = "rcdsac_trl_{}"


def find(routine: str, *, in_torch: bool) -> int | None:
    """Return the address of a routine of Fortran BLAS in torch's library or in SciPy's; None if torch's hides it."""
    if not in_torch:
        return get_cython_function_address("scipy.linalg.cython_blas", routine)
    for path in sorted((Path(torch.__file__).parent / "lib").glob("*torch_cpu.*")):
        found = getattr(ctypes.CDLL(str(path)), f"{routine}_", None)
        if found is not None:
            return ctypes.cast(found, ctypes.c_void_p).value
    return None


def bind(routine: str, address: int) -> None:
    """Let compiled passes that are yet to be loaded call a routine there, under a name of ours that caches keep."""
    llvmlite.binding.add_symbol(_NAME.format(routine), address)


def _bind_all() -> str:
    """Bind the routines of one library and return whose it is."""
    whose, addresses = "torch's", {routine: find(routine, in_torch=True) for routine in ROUTINES.values()}
    if None in addresses.values():
        whose, addresses = "SciPy's", {routine: find(routine, in_torch=False) for routine in ROUTINES.values()}
    for routine, address in addresses.items():
        assert address is not None  # SciPy has them all
        bind(routine, address)
    return whose


LIBRARY = _bind_all()
# Bytes, a multiple of which the places of torch's tensors are, too; numba's own arrays begin at half of that.
_ALIGNMENT = 64
_compiled = njit(nogil=True, error_model="numpy")
_intrinsic: Any = intrinsic  # the caller does not pass the first argument, which its type does not say


@_intrinsic
def _gemm(
    _: Any,
    flip_a: Any,
    flip_b: Any,
    m: Any,
    n: Any,
    k: Any,
    a: Any,
    lda: Any,
    b: Any,
    ldb: Any,
    add: Any,
    c: Any,
    ldc: Any,
) -> tuple[Any, Callable[..., Any]]:
    """Call BLAS's ``c = op(a) op(b)``, or ``+=`` where ``add``, on matrices column by column; flips are bools."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = signature.args[5].dtype
        real = context.get_value_type(kind)

        def place(value: Any) -> Any:
            return cgutils.alloca_once_value(builder, value)

        def letter(flip: Any) -> Any:
            chosen = builder.select(flip, *(ir.Constant(ir.IntType(8), ord(each)) for each in "TN"))
            return place(chosen)

        def integer(value: Any) -> Any:
            return place(builder.trunc(value, ir.IntType(32)))

        def data(index: int) -> Any:
            return context.make_array(signature.args[index])(context, builder, values[index]).data

        one, zero = ir.Constant(real, 1.0), ir.Constant(real, 0.0)
        arguments = [
            *(letter(builder.trunc(value, ir.IntType(1))) for value in values[:2]),
            *(integer(value) for value in values[2:5]),
            place(one),
            data(5),
            integer(values[6]),
            data(7),
            integer(values[8]),
            place(builder.select(builder.trunc(values[9], ir.IntType(1)), one, zero)),
            data(10),
            integer(values[11]),
        ]
        pointer = cgutils.voidptr_t
        routine = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.VoidType(), [pointer] * 13), _NAME.format(ROUTINES[kind])
        )
        builder.call(routine, [builder.bitcast(argument, pointer) for argument in arguments])
        return context.get_dummy_value()

    flags, sizes = types.boolean, types.intp
    return types.void(flags, flags, sizes, sizes, sizes, a, sizes, b, sizes, flags, c, sizes), generate


@_compiled
def _has_rows(a: np.ndarray) -> bool:
    return a.size == 0 or a.shape[1] == 1 or a.strides[1] == a.itemsize


@_compiled
def _check(fits: bool, a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Refuse matrices that do not fit or whose rows are not contiguous: BLAS would write anywhere."""
    if not (fits and _has_rows(a) and _has_rows(b) and _has_rows(out)):
        raise ValueError("the matrices of a product do not fit each other, or a row is not contiguous")


@_compiled
def _leading(a: np.ndarray) -> int:
    """Return the distance of two rows in elements."""
    return max(a.strides[0] // a.itemsize, a.shape[1], 1)


@_compiled
def empty_aligned(shape: tuple[int, ...], like: np.ndarray) -> np.ndarray:
    """Return an array of like's type, its elements not set; where a matrix begins may decide how BLAS rounds."""
    size, elements = 1, _ALIGNMENT // like.itemsize
    for number in shape:
        size *= number
    wider = np.empty(size + elements, like.dtype)
    first = -(wider.ctypes.data // like.itemsize) % elements
    return wider[first : first + size].reshape(shape)


# BLAS goes column by column, so that it sees every matrix transposed, and is asked for the transposed product.
@_compiled
def matmul(a: np.ndarray, b: np.ndarray, out: np.ndarray, add: bool) -> None:
    """Write ``a @ b`` into out, or add it."""
    (m, k), n = a.shape, b.shape[1]
    _check(b.shape[0] == k and out.shape == (m, n), a, b, out)
    _gemm(False, False, n, m, k, b, _leading(b), a, _leading(a), add, out, _leading(out))


@_compiled
def matmul_nt(a: np.ndarray, b: np.ndarray, out: np.ndarray, add: bool) -> None:
    """Write ``a @ b.T`` into out, or add it."""
    (m, k), n = a.shape, b.shape[0]
    _check(b.shape[1] == k and out.shape == (m, n), a, b, out)
    _gemm(True, False, n, m, k, b, _leading(b), a, _leading(a), add, out, _leading(out))


@_compiled
def matmul_tn(a: np.ndarray, b: np.ndarray, out: np.ndarray, add: bool) -> None:
    """Write ``a.T @ b`` into out, or add it."""
    (k, m), n = a.shape, b.shape[1]
    _check(b.shape[0] == k and out.shape == (m, n), a, b, out)
    _gemm(False, True, n, m, k, b, _leading(b), a, _leading(a), add, out, _leading(out))
