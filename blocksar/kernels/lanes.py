"""Vectors of LANES samples as values in compiled loops: explicit SIMD instead of automatic vectorisation.

Left to choose the width, numba's compiler uses narrow registers where float64 and float32 meet, and keeps sums over
taps in memory. The types are LLVM's own vectors, which lower to the registers of any CPU.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
from numba import extending, types

LANES = 32  # samples processed at a time: two of the widest vector registers, to hide the latency of one

_numba: Any = extending  # only partly annotated; Any, or every argument would need a type ignore


class Lanes(types.Type):
    """LANES real numbers as one value of a compiled loop, with +, - and * between vectors or with one number.

    To LLVM it is a vector, which occupies as many registers as the CPU needs for it.
    """

    def __init__(self, element: Any) -> None:
        self.element = element
        super().__init__(name=f"Lanes({element})")


FLOATS: Any = Lanes(types.float32)


@_numba.register_model(Lanes)
def _vector(manager: Any, lanes: Any) -> Any:
    element = manager.lookup(lanes.element).get_value_type()
    return _numba.models.PrimitiveModel(manager, lanes, ir.VectorType(element, LANES))


def _indices(values: Any) -> Any:
    return ir.Constant(ir.VectorType(ir.IntType(32), len(values)), list(values))


@_numba.lower_cast(types.Float, Lanes)
def _spread(context: Any, builder: Any, scalar: Any, lanes: Any, value: Any) -> Any:
    undefined = ir.Constant(context.get_value_type(lanes), ir.Undefined)
    number = context.cast(builder, value, scalar, lanes.element)
    one = builder.insert_element(undefined, number, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, _indices([0] * LANES))


def _arithmetic(operation: Callable[..., Any], instruction: str) -> None:
    """Register an arithmetic operator for Lanes."""

    @_numba.type_callable(operation)
    def typed(context: Any) -> Any:
        return lambda a, b: next((operand for operand in (a, b) if isinstance(operand, Lanes)), None)

    def lowered(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        lanes = signature.return_type
        operands = [
            context.cast(builder, value, kind, lanes) for value, kind in zip(values, signature.args, strict=True)
        ]
        return getattr(builder, instruction)(*operands)

    for pair in ((Lanes, Lanes), (Lanes, types.Float), (types.Float, Lanes)):
        _numba.lower_builtin(operation, *pair)(lowered)


_arithmetic(operator.add, "fadd")
_arithmetic(operator.sub, "fsub")
_arithmetic(operator.mul, "fmul")


def _address(context: Any, builder: Any, vector: Any, array_type: Any, array: Any, index: Any) -> Any:
    """The address of array[index] as that of a vector. The array's length is not checked."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


@_numba.intrinsic
def load(typing_context: Any, array: Any, index: Any) -> Any:
    """array[index : index + LANES] of real numbers."""
    lanes = Lanes(array.dtype)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        address = _address(context, builder, context.get_value_type(lanes), signature.args[0], *values)
        return builder.load(address, align=array.dtype.bitwidth // 8)

    return lanes(array, types.intp), generate


@_numba.intrinsic
def store(typing_context: Any, array: Any, index: Any, lanes: Any) -> Any:
    """array[index : index + LANES] = lanes."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        address = _address(context, builder, values[2].type, signature.args[0], *values[:2])
        builder.store(values[2], address, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


def _load_part(part: int) -> Any:
    """Make the intrinsic that loads the real (0) or imaginary (1) parts of array[index : index + LANES], complex64."""

    def load(typing_context: Any, array: Any, index: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            pairs = ir.VectorType(ir.FloatType(), 2 * LANES)
            both = builder.load(_address(context, builder, pairs, signature.args[0], *values), align=4)
            return builder.shuffle_vector(both, both, _indices(range(part, 2 * LANES, 2)))

        return FLOATS(array, types.intp), generate

    return _numba.intrinsic(load)


load_real, load_imag = _load_part(0), _load_part(1)


@_numba.intrinsic
def store_complex(typing_context: Any, array: Any, index: Any, real: Any, imag: Any) -> Any:
    """array[index : index + LANES] = real + 1j imag, complex64."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        interleaved = [k // 2 + LANES * (k % 2) for k in range(2 * LANES)]
        both = builder.shuffle_vector(values[2], values[3], _indices(interleaved))
        builder.store(both, _address(context, builder, both.type, signature.args[0], *values[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, real, imag), generate


@_numba.intrinsic
def spread(typing_context: Any, number: Any) -> Any:
    """One number in all lanes."""
    lanes = Lanes(number)
    return lanes(number), lambda context, builder, signature, values: context.cast(builder, values[0], number, lanes)


@_numba.intrinsic
def count_lanes(typing_context: Any) -> Any:
    """0, 1, ..., LANES - 1, float32."""
    return FLOATS(), lambda context, *_: ir.Constant(context.get_value_type(FLOATS), [float(k) for k in range(LANES)])


@_numba.intrinsic
def remainder(typing_context: Any, cycles: Any) -> Any:
    """Cycles (float64) minus the nearest whole number, as float32."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        double = values[0].type
        kind = ir.FunctionType(double, [double])
        rint = builder.module.declare_intrinsic(f"llvm.rint.v{LANES}f64", fnty=kind)
        return builder.fptrunc(builder.fsub(values[0], builder.call(rint, values)), context.get_value_type(FLOATS))

    return FLOATS(cycles), generate


@_numba.intrinsic
def prefetch(typing_context: Any, array: Any, row: Any, column: Any) -> Any:
    """Prefetch array[row, column] into the cache: only a hint, so any address is allowed."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        fields = context.make_array(signature.args[0])(context, builder, values[0])
        row_step, column_step = (builder.extract_value(fields.strides, k) for k in (0, 1))
        offset = builder.add(builder.mul(values[1], row_step), builder.mul(values[2], column_step))
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        intrinsic = builder.module.declare_intrinsic("llvm.prefetch.p0i8", fnty=kind)
        hints = [ir.Constant(number, k) for k in (int(array.mutable), 3, 1)]  # write or read; highest locality; data
        builder.call(intrinsic, [builder.gep(builder.bitcast(fields.data, byte), [offset]), *hints])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp), generate
