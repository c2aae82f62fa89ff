"""Tiles of matrix products whose sums stay in registers, written in LLVM's vectors.

Loops in Python become vector instructions, but their sums go to memory and back at every step,
which makes them two to three times slower.

``np.dot`` in their place, the BLAS that numba takes from SciPy, needs this many times the tiles'
time (medians of 25, in turn; Intel Xeon, family 6, model 167, with AVX-512, one thread):

==========================================  ===================  ===================
hidden layers: what                         blocks of 16 rows    blocks of 64 rows
==========================================  ===================  ===================
[256, 128, 64], Mish: flow of 1024 rows     1.07                 1.28
[256, 128, 64], Mish: gradients, 6144 rows  1.46                 1.43
[64, 64], Tanh: flow of 1024 rows           1.11                 1.05
[64, 64], Tanh: gradients of 6144 rows      1.16                 1.05
==========================================  ===================  ===================

Single layers of 64 rows need from 0.77 (6 to 64 units) to 1.37 (256 to 128) of it. With a BLAS an
action would also depend on who else acts, in its last bits, and numba would need SciPy.
"""

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array

_HAS_AVX512 = binding.get_host_cpu_features().get("avx512f", False)

TALL = 8 if _HAS_AVX512 else 4
"""Rows of a tall tile."""
WIDE = 32 if _HAS_AVX512 else 16
"""Columns of a wide tile: with it, a tall tile's sums take half of the registers."""
LONG = 2 * WIDE
"""Columns of a tile of one row, which would else wait for each sum."""

_FLOAT = ir.FloatType()
_FUSED = ("contract",)


def _make_tile(n_rows: int, n_columns: int) -> Any:
    """Make the function that computes a tile of this size.

    tile(inputs, weights, outputs, row, column) adds inputs @ weights to the part of the outputs
    that begins at the given row and column. Rows of weights and outputs are contiguous. The terms
    of a sum are added in their order, so that the result for a row does not depend on its tile.
    """

    def tile(_typing: Any, inputs: Any, weights: Any, outputs: Any, row: Any, column: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            arrays = [
                make_array(kind)(context, builder, array)
                for kind, array in zip(signature.args[:3], arguments[:3], strict=True)
            ]
            _emit(builder, arrays, arguments[3:], (n_rows, n_columns))
            return context.get_dummy_value()

        return types.void(inputs, weights, outputs, row, column), codegen

    return intrinsic(tile)


def _emit(builder: Any, arrays: Any, begin: Any, size: tuple[int, int]) -> None:
    """Write a tile's instructions: load its sums, add all terms, store them.

    :param builder: Takes the instructions.
    :param arrays: Inputs, weights and outputs.
    :param begin: Row and column of the outputs where the tile begins.
    :param size: Rows and columns of the tile.
    """
    inputs, weights, outputs = arrays
    row, column = begin
    vector = ir.VectorType(_FLOAT, size[1])
    rows = [builder.add(row, ir.Constant(row.type, r)) for r in range(size[0])]
    places = [_place(builder, outputs, r, column, vector) for r in rows]
    sums = [cgutils.alloca_once_value(builder, _load(builder, place)) for place in places]
    n_terms = cgutils.unpack_tuple(builder, weights.shape)[0]
    with cgutils.for_range(builder, n_terms) as loop:
        term = _load(builder, _place(builder, weights, loop.index, column, vector))
        for r, total in zip(rows, sums, strict=True):
            factor = builder.load(_place(builder, inputs, r, loop.index, _FLOAT))
            product = builder.fmul(_repeat(builder, factor, vector), term, flags=_FUSED)
            builder.store(builder.fadd(builder.load(total), product, flags=_FUSED), total)
    for place, total in zip(places, sums, strict=True):
        builder.store(builder.load(total), place).align = 4


def _place(builder: Any, array: Any, row: Any, column: Any, kind: Any) -> Any:
    """Where an element of a matrix is, as the place of something of a kind that begins there."""
    strides = cgutils.unpack_tuple(builder, array.strides)
    offset = builder.add(builder.mul(row, strides[0]), builder.mul(column, strides[1]))
    return cgutils.pointer_add(builder, array.data, offset, kind.as_pointer())


def _load(builder: Any, place: Any) -> Any:
    """Load a vector that may begin at any number."""
    loaded = builder.load(place)
    loaded.align = 4
    return loaded


def _repeat(builder: Any, number: Any, vector: Any) -> Any:
    """A vector of one number."""
    undefined = ir.Constant(vector, ir.Undefined)
    zero = ir.Constant(ir.IntType(32), 0)
    everywhere = ir.Constant(ir.VectorType(zero.type, vector.count), [0] * vector.count)
    first = builder.insert_element(undefined, number, zero)
    return builder.shuffle_vector(first, undefined, everywhere)


tall_wide, tall_half, tall_slim = (_make_tile(TALL, n) for n in (WIDE, WIDE // 2, 4))
long, half, slim = (_make_tile(1, n) for n in (LONG, WIDE // 2, 4))
