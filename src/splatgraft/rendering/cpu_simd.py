"""A SIMD type for numba kernels: a row of 16 float32 as one LLVM vector value.

The compiler vectorises loops only if it can prove independence, and vectorises short ones badly. This type vectorises
kernels explicitly. Rows add, subtract, multiply and divide with each other and with float32 scalars. LLVM maps them to
the SIMD registers of the machine.
"""

import operator
from typing import no_type_check

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.typing.templates import ConcreteTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_ALGEBRA = ("contract", "reassoc", "nsz")


class _Row(types.Type):
    def __init__(self) -> None:
        super().__init__(name=f"Row(float32 x {LANES})")


_ROW = _Row()


@register_model(_Row)
class _RowModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, _VECTOR)


def _broadcast(builder, value):
    if value.type == _VECTOR:
        return value
    first = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, ir.Constant(_VECTOR, ir.Undefined), mask)


def _define(symbol, instruction: str) -> None:
    """Define the operator `symbol` for rows and float32 scalars."""

    @infer_global(symbol)  # pyright: ignore[reportOptionalCall]
    class _Template(ConcreteTemplate):
        cases = (
            signature(_ROW, _ROW, _ROW),
            signature(_ROW, _ROW, types.float32),
            signature(_ROW, types.float32, _ROW),
        )

    def generate(_context, builder, _signature, args):
        return getattr(builder, instruction)(_broadcast(builder, args[0]), _broadcast(builder, args[1]), flags=_ALGEBRA)

    for left, right in [(_Row, _Row), (_Row, types.Float), (types.Float, _Row)]:
        lower_builtin(symbol, left, right)(generate)


for _symbol, _instruction in [
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
]:
    _define(_symbol, _instruction)


def _place(context, builder, array_type, array, at):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), _VECTOR.as_pointer())


@intrinsic
@no_type_check
def load(_typing, array, at):
    """Read the row of a contiguous float32 array that begins at flat index `at`."""

    def generate(context, builder, sig, args):
        return builder.load(_place(context, builder, sig.args[0], args[0], args[1]), align=4)

    return _ROW(array, types.intp), generate


@intrinsic
@no_type_check
def store(_typing, array, at, row):
    """Write `row` into a contiguous float32 array from flat index `at`."""

    def generate(context, builder, sig, args):
        builder.store(args[2], _place(context, builder, sig.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.none(array, types.intp, row), generate


@intrinsic
@no_type_check
def prefetch(_typing, array, at):
    """Begin to read row `at` of an array into the cache, so that a random access later does not wait."""

    def generate(context, builder, sig, args):
        made = context.make_array(sig.args[0])(context, builder, args[0])
        begin = builder.bitcast(made.data, ir.IntType(8).as_pointer())
        place = builder.gep(begin, [builder.mul(args[1], cgutils.unpack_tuple(builder, made.strides)[0])])
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [place.type, number, number, number])
        # of data, to read, into all levels
        builder.call(
            cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0"),
            [place, ir.Constant(number, 0), ir.Constant(number, 3), ir.Constant(number, 1)],
        )
        return context.get_dummy_value()

    return types.none(array, types.intp), generate


@intrinsic
@no_type_check
def broadcast(_typing, value):
    """Make a row with one float32 in all lanes."""
    return _ROW(types.float32), lambda _context, builder, _signature, args: _broadcast(builder, args[0])


@intrinsic
@no_type_check
def lanes(_typing):
    """Make the row 0, 1, .., 15."""

    def generate(_context, _builder, _signature, _args):
        return ir.Constant(_VECTOR, [ir.Constant(ir.FloatType(), float(x)) for x in range(LANES)])

    return _ROW(), generate


@intrinsic
@no_type_check
def smaller(_typing, row, bound):
    """Take the lesser of each lane and a scalar."""

    def generate(_context, builder, _signature, args):
        other = _broadcast(builder, args[1])
        return builder.select(builder.fcmp_ordered("<", args[0], other), args[0], other)

    return _ROW(row, types.float32), generate


@intrinsic
@no_type_check
def larger(_typing, row, other):
    """Take the greater of two rows, lane by lane."""

    def generate(_context, builder, _signature, args):
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[0], args[1])

    return _ROW(row, other), generate


@intrinsic
@no_type_check
def where_at_least(_typing, tested, bound, row):
    """Take `row` in the lanes where `tested` is at least the scalar `bound`, else 0; nan gives 0."""

    def generate(_context, builder, _signature, args):
        inside = builder.fcmp_ordered(">=", args[0], _broadcast(builder, args[1]))
        return builder.select(inside, args[2], ir.Constant(_VECTOR, None))

    return _ROW(tested, types.float32, row), generate


@intrinsic
@no_type_check
def where_below(_typing, tested, bound, row):
    """Take `row` in the lanes where `tested` is below the scalar `bound`, else 0."""

    def generate(_context, builder, _signature, args):
        inside = builder.fcmp_ordered("<", args[0], _broadcast(builder, args[1]))
        return builder.select(inside, args[2], ir.Constant(_VECTOR, None))

    return _ROW(tested, types.float32, row), generate


def _reduce(name, takes_start):
    def generate(_context, builder, _signature, args):
        start = [ir.FloatType()] if takes_start else []
        function = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(ir.FloatType(), [*start, _VECTOR]), f"llvm.vector.reduce.{name}.v{LANES}f32"
        )
        given = [ir.Constant(ir.FloatType(), 0.0), args[0]] if takes_start else [args[0]]
        return builder.call(function, given, fastmath=("reassoc", "nsz", "nnan"))

    return generate


@intrinsic
@no_type_check
def total(_typing, row):
    """Add the lanes."""
    return types.float32(row), _reduce("fadd", takes_start=True)


@intrinsic
@no_type_check
def largest(_typing, row):
    """Take the greatest lane."""
    return types.float32(row), _reduce("fmax", takes_start=False)
