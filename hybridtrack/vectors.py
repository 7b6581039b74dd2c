"""A vector of lanes as one number: what the recursion calculates with.

A lane is a run. `vectors(array)` shows memory whose last axis has WIDTH lanes as an array of
vectors without that axis; kernels calculate with its elements as they would with floats. The
compiler makes a few of the machine's vector instructions of each operation, without a loop to
begin and to end, and keeps in registers what fits. A comparison gives a mask, and `select` takes
the place of a branch. An index is not counted from the end when negative.

Uncompiled (NUMBA_DISABLE_JIT=1) a vector is a NumPy array.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typeconv import Conversion
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model
from numpy.typing import NDArray

from hybridtrack.compiled import COMPILED

WIDTH = 32
CACHE_LINE_BYTES = 64
SQRT_HALF_BITS = 0x3FE6A09E667F3BCD
MANTISSA_BITS = 52

_DOUBLES = ir.VectorType(ir.DoubleType(), WIDTH)
_INTEGERS = ir.VectorType(ir.IntType(64), WIDTH)
_BITS = ir.VectorType(ir.IntType(1), WIDTH)


# ---- the types -------------------------------------------------------------------------------


class _Vector(types.Type):
    """WIDTH floats; a float stands for its repetitions."""

    def can_convert_from(self, typing_context: Any, other: Any) -> Any:
        return Conversion.safe if isinstance(other, types.Float) else None


class _Mask(types.Type):
    """WIDTH truth values."""


vector = _Vector(name=f"vector{WIDTH}")
mask = _Mask(name=f"mask{WIDTH}")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _DOUBLES)


@register_model(_Mask)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _BITS)


@lower_cast(types.Float, _Vector)
def _cast(context: Any, builder: Any, given: Any, wanted: Any, value: Any) -> Any:
    return _repeated(context, builder, given, value)


def _repeated(context: Any, builder: Any, given: Any, value: Any) -> Any:
    """The vector of an operand that is a vector or a float."""
    if given == vector:
        return value
    value = context.cast(builder, value, given, types.float64)
    undefined = ir.Constant(_DOUBLES, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    pattern = ir.Constant(ir.VectorType(ir.IntType(32), WIDTH), [0] * WIDTH)
    return builder.shuffle_vector(first, undefined, pattern)


def _integers(value: int) -> Any:
    return ir.Constant(_INTEGERS, [value] * WIDTH)


# ---- operators -------------------------------------------------------------------------------


def _define(operators: Any, signatures: Any, instruction: Callable[..., Any]) -> None:
    """Operators by the signatures they take and the one LLVM instruction that they are."""

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            return next((sig for sig in signatures if sig.args == args), None)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        if vector in sig.args:
            pairs = zip(sig.args, args, strict=True)
            args = [_repeated(context, builder, *pair) for pair in pairs]
        return instruction(builder, *args)

    for operation in operators:
        infer_global(operation)(Template)
        for sig in signatures:
            lower_builtin(operation, *sig.args)(generate)


def _of_numbers(result: Any) -> list[Any]:
    pairs = ((vector, vector), (vector, types.float64), (types.float64, vector))
    return [signature(result, *pair) for pair in pairs]


_define((operator.add, operator.iadd), _of_numbers(vector), lambda build, x, y: build.fadd(x, y))
_define((operator.sub, operator.isub), _of_numbers(vector), lambda build, x, y: build.fsub(x, y))
_define((operator.mul, operator.imul), _of_numbers(vector), lambda build, x, y: build.fmul(x, y))
_define((operator.truediv,), _of_numbers(vector), lambda build, x, y: build.fdiv(x, y))
_define((operator.neg,), [signature(vector, vector)], lambda build, x: build.fneg(x))
_define((operator.lt,), _of_numbers(mask), lambda build, x, y: build.fcmp_ordered("<", x, y))
_define((operator.le,), _of_numbers(mask), lambda build, x, y: build.fcmp_ordered("<=", x, y))
_define((operator.gt,), _of_numbers(mask), lambda build, x, y: build.fcmp_ordered(">", x, y))
_define((operator.eq,), _of_numbers(mask), lambda build, x, y: build.fcmp_ordered("==", x, y))
_define((operator.and_,), [signature(mask, mask, mask)], lambda build, x, y: build.and_(x, y))


# ---- functions -------------------------------------------------------------------------------


@intrinsic
def repeat(typing_context: Any, value: Any) -> Any:
    """A vector of equal lanes."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _repeated(context, builder, sig.args[0], args[0])

    return vector(value), generate


@intrinsic
def select(typing_context: Any, condition: Any, one: Any, other: Any) -> Any:
    """`one` where the condition holds, `other` elsewhere."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pairs = zip(sig.args[1:], args[1:], strict=True)
        return builder.select(args[0], *(_repeated(context, builder, *pair) for pair in pairs))

    return vector(mask, one, other), generate


def _of_llvm(name: str) -> Any:
    @intrinsic
    def function(typing_context: Any, value: Any) -> Any:
        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            kind = ir.FunctionType(_DOUBLES, [_DOUBLES])
            full = f"llvm.{name}.v{WIDTH}f64"
            return builder.call(cgutils.get_or_insert_function(builder.module, kind, full), args)

        return vector(vector), generate

    return function


sqrt = _of_llvm("sqrt")
rint = _of_llvm("rint")


@intrinsic
def two_to(typing_context: Any, n: Any) -> Any:
    """2**n for integers n from -1022 to 1023."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        # Adding 1.5 * 2**52 leaves n as an integer in the low bits; shifted, it is the exponent.
        bias = ir.Constant(_DOUBLES, [6755399441055744.0] * WIDTH)
        bits = builder.bitcast(builder.fadd(args[0], bias), _INTEGERS)
        bits = builder.shl(builder.add(bits, _integers(1023)), _integers(MANTISSA_BITS))
        return builder.bitcast(bits, _DOUBLES)

    return vector(vector), generate


@intrinsic
def exponent(typing_context: Any, x: Any) -> Any:
    """n of x = m 2**n with m in [sqrt(1/2), sqrt(2)), for normal x > 0."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.sub(builder.bitcast(args[0], _INTEGERS), _integers(SQRT_HALF_BITS))
        return builder.sitofp(builder.ashr(bits, _integers(MANTISSA_BITS)), _DOUBLES)

    return vector(vector), generate


@intrinsic
def mantissa(typing_context: Any, x: Any) -> Any:
    """m of x = m 2**n with m in [sqrt(1/2), sqrt(2)), for normal x > 0."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.sub(builder.bitcast(args[0], _INTEGERS), _integers(SQRT_HALF_BITS))
        bits = builder.and_(bits, _integers((1 << MANTISSA_BITS) - 1))
        return builder.bitcast(builder.add(bits, _integers(SQRT_HALF_BITS)), _DOUBLES)

    return vector(vector), generate


# ---- memory ----------------------------------------------------------------------------------


def aligned_zeros(*shape: int) -> NDArray[np.float64]:
    """Zeros at a cache line's beginning: vectors that straddle two lines cost a quarter more."""
    size = math.prod(shape)
    memory = np.zeros(size + CACHE_LINE_BYTES // 8)
    first = -memory.ctypes.data % CACHE_LINE_BYTES // 8
    return memory[first : first + size].reshape(shape)


class _Rows(types.Type):
    """Vectors in C order, indexed by `ndim` integers: where they are, and the strides."""

    def __init__(self, ndim: int) -> None:
        self.ndim = ndim
        super().__init__(name=f"rows({vector.name}, {ndim})")


@register_model(_Rows)
class _RowsModel(models.StructModel):
    def __init__(self, manager: Any, of: Any) -> None:
        strides = types.UniTuple(types.intp, of.ndim - 1)
        super().__init__(manager, of, [("data", types.CPointer(vector)), ("strides", strides)])


@intrinsic
def vectors(typing_context: Any, array: Any) -> Any:
    """An array (..., WIDTH) of float64, C-contiguous, as rows (...) of vectors."""
    shown = _Rows(array.ndim - 1)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        given = context.make_array(array)(context, builder, args[0])
        out = cgutils.create_struct_proxy(shown)(context, builder)
        out.data = builder.bitcast(given.data, out.data.type)
        size = ir.Constant(ir.IntType(64), 8 * WIDTH)
        strides = cgutils.unpack_tuple(builder, given.strides)[:-2]
        counts = [builder.sdiv(stride, size) for stride in strides]
        out.strides = context.make_tuple(builder, types.UniTuple(types.intp, len(counts)), counts)
        return out._getvalue()

    return shown(array), generate


def _indices(index: Any) -> int:
    """How many integers an index has; 0 for anything else."""
    if isinstance(index, types.Integer):
        return 1
    integers = isinstance(index, types.BaseTuple) and all(
        isinstance(part, types.Integer) for part in index
    )
    return len(index) if integers else 0


@infer_global(operator.getitem)
class _GetItem(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        rows, index = args
        if not isinstance(rows, _Rows) or not 1 <= _indices(index) <= rows.ndim:
            return None
        left = rows.ndim - _indices(index)
        return signature(_Rows(left) if left else vector, rows, index)


@infer_global(operator.setitem)
class _SetItem(AbstractTemplate):
    def generic(self, args: Any, kws: Any) -> Any:
        rows, index, _ = args
        if not isinstance(rows, _Rows) or _indices(index) != rows.ndim:
            return None
        return signature(types.void, rows, index, vector)


def _at(context: Any, builder: Any, rows: Any, value: Any, index: Any, given: Any) -> Any:
    """Pointer to the place of an index, and the strides that are left."""
    shown = cgutils.create_struct_proxy(rows)(context, builder, value=value)
    strides = cgutils.unpack_tuple(builder, shown.strides)
    pointer = shown.data
    parts = [given] if isinstance(index, types.Integer) else cgutils.unpack_tuple(builder, given)
    for part, stride in zip(parts, [*strides, None], strict=False):
        part = builder.zext(part, ir.IntType(64)) if part.type.width < 64 else part
        pointer = builder.gep(pointer, [part if stride is None else builder.mul(part, stride)])
    return pointer, strides[len(parts) :]


@lower_builtin(operator.getitem, _Rows, types.Integer)
@lower_builtin(operator.getitem, _Rows, types.BaseTuple)
def _get(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    pointer, strides = _at(context, builder, sig.args[0], args[0], sig.args[1], args[1])
    if sig.return_type == vector:
        return builder.load(pointer, align=8)
    out = cgutils.create_struct_proxy(sig.return_type)(context, builder)
    out.data = pointer
    out.strides = context.make_tuple(builder, types.UniTuple(types.intp, len(strides)), strides)
    return out._getvalue()


@lower_builtin(operator.setitem, _Rows, types.Integer, _Vector)
@lower_builtin(operator.setitem, _Rows, types.BaseTuple, _Vector)
def _set(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    pointer, _ = _at(context, builder, sig.args[0], args[0], sig.args[1], args[1])
    builder.store(args[2], pointer, align=8)
    return context.get_dummy_value()


def _address(context: Any, builder: Any, row_type: Any, row: Any, index: Any) -> Any:
    data = context.make_array(row_type)(context, builder, row).data
    return builder.gep(builder.bitcast(data, _DOUBLES.as_pointer()), [index])


@intrinsic
def load(typing_context: Any, row: Any, index: Any) -> Any:
    """The index-th WIDTH lanes of a row (lanes,)."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.load(_address(context, builder, row, *args), align=8)

    return vector(row, types.intp), generate


@intrinsic
def store(typing_context: Any, row: Any, index: Any, value: Any) -> Any:
    """Put a vector at the index-th WIDTH lanes of a row (lanes,)."""

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        builder.store(args[2], _address(context, builder, row, *args[:2]), align=8)
        return context.get_dummy_value()

    return types.void(row, types.intp, vector), generate


# ---- without compilation ---------------------------------------------------------------------


class _Shown:
    """Rows of vectors: what is taken from them does not change when they do."""

    def __init__(self, array: Any) -> None:
        self._array = array

    def __getitem__(self, index: Any) -> Any:
        found = self._array[index]
        return found.copy() if found.ndim == 1 else _Shown(found)

    def __setitem__(self, index: Any, value: Any) -> None:
        self._array[index] = value


def _lanes(index: int) -> slice:
    return slice(index * WIDTH, (index + 1) * WIDTH)


def _parts(x: Any) -> tuple[Any, Any]:
    """Mantissa in [sqrt(1/2), sqrt(2)) and exponent."""
    fraction, power = np.frexp(x)
    low = fraction < np.sqrt(0.5)
    return np.where(low, 2.0 * fraction, fraction), (power - low).astype(np.float64)


if not COMPILED:
    vectors = _Shown
    load = lambda row, index: row[_lanes(index)].copy()  # noqa: E731
    store = lambda row, index, value: np.copyto(row[_lanes(index)], value)  # noqa: E731
    repeat = lambda value: np.full(WIDTH, value, dtype=np.float64)  # noqa: E731
    select, sqrt, rint = np.where, np.sqrt, np.rint
    two_to = lambda n: np.ldexp(1.0, np.nan_to_num(n).astype(np.int64))  # noqa: E731
    mantissa = lambda x: _parts(x)[0]  # noqa: E731
    exponent = lambda x: _parts(x)[1]  # noqa: E731
