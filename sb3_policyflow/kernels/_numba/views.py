"""Views of parts of arrays, and arrays at addresses, in a few instructions each.

Slices and reshapes of numba's take care of signs, bounds and layouts, which kernels need not: they
were half of all that there was to compile. Nothing is checked here. A view keeps the memory of its
array, which must be contiguous.
"""

from typing import Any

from numba import extending, types
from numba.core import cgutils
from numba.core.imputils import impl_ret_borrowed
from numba.np.arrayobj import make_array, populate_array

# To type checkers an intrinsic takes what the function that writes its code does.
intrinsic: Any = extending.intrinsic


def _make(context: Any, builder: Any, kind: Any, data: Any, shape: Any, owner: Any = None) -> Any:
    """Make a contiguous array of a numba type.

    :param kind: Its type.
    :param data: Where it begins.
    :param shape: Its shape.
    :param owner: The array whose memory it is; None for memory that somebody else keeps.
    """
    size = context.get_constant(types.intp, kind.dtype.bitwidth // 8)
    strides = [size]
    for length in reversed(shape[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    array = make_array(kind)(context, builder)
    memory = None if owner is None else owner.meminfo
    populate_array(array, data, list(shape), strides, size, memory)
    return impl_ret_borrowed(context, builder, kind, array._getvalue())


def _at_address(number: Any, n_dims: int) -> Any:
    """Make the function that takes the numbers of a type at an address for an array."""
    kind = types.Array(number, n_dims, "C")

    def codegen(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        address, *shape = arguments
        pointer = context.get_data_type(number).as_pointer()
        return _make(context, builder, kind, builder.inttoptr(address, pointer), shape)

    def of_vector(_context: Any, address: Any, size: Any) -> Any:  # noqa: ARG001  # read by name
        return kind(types.intp, types.intp), codegen

    def of_matrix(_context: Any, address: Any, n_rows: Any, n_columns: Any) -> Any:  # noqa: ARG001
        return kind(types.intp, types.intp, types.intp), codegen

    return intrinsic(of_vector if n_dims == 1 else of_matrix)


vector = _at_address(types.float32, 1)
"""The numbers at an address: vector(address, size)."""
bits = _at_address(types.int32, 1)
"""Their bits, as integers: bits(address, size)."""
matrix = _at_address(types.float32, 2)
"""The matrix at an address: matrix(address, n_rows, n_columns)."""


@intrinsic
def span(_context: Any, array: Any, _start: Any, _size: Any) -> Any:
    """Some neighboring numbers of a vector or matrix, flat: where they start, and how many."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, start, size = arguments
        owner = make_array(signature.args[0])(context, builder, array)
        data = cgutils.gep(builder, owner.data, start)
        return _make(context, builder, signature.return_type, data, (size,), owner)

    return types.Array(array.dtype, 1, "C")(array, types.intp, types.intp), codegen


@intrinsic
def block(_context: Any, array: Any, _start: Any, _n_rows: Any, _n_columns: Any) -> Any:
    """Some neighboring numbers of a vector as a matrix: where they start, and its shape."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, start, *shape = arguments
        owner = make_array(signature.args[0])(context, builder, array)
        data = cgutils.gep(builder, owner.data, start)
        return _make(context, builder, signature.return_type, data, shape, owner)

    size = types.intp
    return types.Array(array.dtype, 2, "C")(array, size, size, size), codegen


@intrinsic
def rows(_context: Any, array: Any, _start: Any, _stop: Any) -> Any:
    """Some rows of a matrix: the first, and the one behind the last."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, start, stop = arguments
        owner = make_array(signature.args[0])(context, builder, array)
        width = cgutils.unpack_tuple(builder, owner.shape)[1]
        data = cgutils.gep(builder, owner.data, builder.mul(start, width))
        shape = (builder.sub(stop, start), width)
        return _make(context, builder, signature.return_type, data, shape, owner)

    return types.Array(array.dtype, 2, "C")(array, types.intp, types.intp), codegen


def _strided(is_turned: bool) -> Any:
    """Make the function that takes a matrix, or its transpose, for one of any layout."""

    def strided(_context: Any, array: Any) -> Any:
        kind = types.Array(array.dtype, 2, "A")

        def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            old = make_array(signature.args[0])(context, builder, arguments[0])
            shape, strides = (cgutils.unpack_tuple(builder, x) for x in (old.shape, old.strides))
            if is_turned:
                shape, strides = shape[::-1], strides[::-1]
            new = make_array(kind)(context, builder)
            populate_array(new, old.data, shape, strides, old.itemsize, old.meminfo)
            return impl_ret_borrowed(context, builder, kind, new._getvalue())

        return kind(array), codegen

    return intrinsic(strided)


strided = _strided(is_turned=False)
"""strided(matrix): of one type for all layouts, so that a function of it is compiled once."""
turned = _strided(is_turned=True)
"""turned(matrix): the transpose."""


@intrinsic
def place(_context: Any, array: Any, _index: Any) -> Any:
    """The address of one of an array's numbers."""

    def codegen(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array = make_array(signature.args[0])(context, builder, arguments[0])
        data = cgutils.gep(builder, array.data, arguments[1])
        return builder.ptrtoint(data, context.get_value_type(types.intp))

    return types.intp(array, types.intp), codegen
