"""Vectors of LANES samples as values in compiled loops: explicit SIMD.

Left to choose the width, numba's compiler uses narrow registers where float64 and float32 meet, and keeps sums over
taps in memory. The types are LLVM's own vectors, which lower to the registers of any CPU.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped, unused-ignore]
from numba import extending, njit, types
from numpy.polynomial import chebyshev

from blocksar.kernels.loops import COMPILED, PART

LANES = 32  # samples processed at a time: two of the widest vector registers, to hide the latency of one
FEW = 16  # lanes of `load_few`, for loops with so many values in use that LANES would not leave enough registers
NEAR = -FEW + 1, FEW - 2  # offsets that `load_near` takes
WEIGHED_ROWS = 12  # rows that `weigh_rows` sums: the taps along range of most windows

_numba: Any = extending  # only partly annotated; Any, or every argument would need a type ignore
_tuple: Any = types.UniTuple  # carries no types either


class Lanes(types.Type):
    """`count` real numbers as one value of a compiled loop, with +, - and * between vectors or with one number.

    To LLVM it is a vector, which occupies as many registers as the CPU needs for it. `count` is LANES, or FEW.
    """

    def __init__(self, element: Any, count: int = LANES) -> None:
        self.element, self.count = element, count
        super().__init__(name=f"Lanes({element}, {count})")


FLOATS: Any = Lanes(types.float32)


@_numba.register_model(Lanes)
def _vector(manager: Any, lanes: Any) -> Any:
    element = manager.lookup(lanes.element).get_value_type()
    return _numba.models.PrimitiveModel(manager, lanes, ir.VectorType(element, lanes.count))


def _indices(places: Any) -> Any:
    values = list(places)
    return ir.Constant(ir.VectorType(ir.IntType(32), len(values)), values)


@_numba.lower_cast(types.Float, Lanes)
def _spread(context: Any, builder: Any, scalar: Any, lanes: Any, value: Any) -> Any:
    return _repeat(builder, context.cast(builder, value, scalar, lanes.element), lanes.count)


def _repeat(builder: Any, value: Any, count: int) -> Any:
    """Broadcast one value to all lanes."""
    undefined = ir.Constant(ir.VectorType(value.type, count), ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, _indices([0] * count))


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
    """Address of array[index] as a pointer to a vector. The array's length is not checked."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), vector.as_pointer())


def _load(count: int) -> Any:
    """Make the intrinsic that loads array[index : index + count] of real numbers or integers."""

    def load(typing_context: Any, array: Any, index: Any) -> Any:
        lanes = Lanes(array.dtype, count)

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            address = _address(context, builder, context.get_value_type(lanes), signature.args[0], *values)
            return builder.load(address, align=array.dtype.bitwidth // 8)

        return lanes(array, types.intp), generate

    return _numba.intrinsic(load)


load, load_few = _load(LANES), _load(FEW)


@_numba.intrinsic
def weigh_rows(typing_context: Any, array: Any, index: Any, stride: Any, weights: Any) -> Any:
    """Sum over p < WEIGHED_ROWS of weights[p] array[index + p stride : index + p stride + FEW], float32.

    Written out: the weights stay in one register, whose lanes are spread, rather than being loaded again one by one.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        samples, place, step, weight = values
        column = None
        for p in range(WEIGHED_ROWS):
            address = _address(context, builder, weight.type, signature.args[0], samples, place)
            row = builder.load(address, align=array.dtype.bitwidth // 8)
            term = builder.fmul(builder.shuffle_vector(weight, weight, _indices([p] * FEW)), row)
            column = term if column is None else builder.fadd(column, term)
            place = builder.add(place, step)
        return column

    return weights(array, types.intp, types.intp, weights), generate


@_numba.intrinsic
def totals(typing_context: Any, a: Any, b: Any) -> Any:
    """Sums over the lanes of two vectors, (sum of a, sum of b): halves are added until one number of each is left.

    From the first step on one vector holds the partial sums of both.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        half = a.count // 2
        lower, upper = (
            builder.shuffle_vector(*values, _indices([*range(i, i + half), *range(i + a.count, i + a.count + half)]))
            for i in (0, half)
        )
        part, width = builder.fadd(lower, upper), half
        while width > 1:
            width //= 2
            other = builder.shuffle_vector(part, part, _indices(k ^ width for k in range(a.count)))
            part = builder.fadd(part, other)
        ends = [builder.extract_element(part, ir.Constant(ir.IntType(32), k)) for k in (0, half)]
        return context.make_tuple(builder, signature.return_type, ends)

    return _tuple(a.element, 2)(a, b), generate


@_numba.intrinsic
def store(typing_context: Any, array: Any, index: Any, lanes: Any) -> Any:
    """Store a vector: array[index : index + LANES] = lanes."""

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
    """Store a complex vector: array[index : index + LANES] = real + 1j imag, complex64."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        interleaved = [k // 2 + LANES * (k % 2) for k in range(2 * LANES)]
        both = builder.shuffle_vector(values[2], values[3], _indices(interleaved))
        builder.store(both, _address(context, builder, both.type, signature.args[0], *values[:2]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, real, imag), generate


@_numba.intrinsic
def spread(typing_context: Any, number: Any) -> Any:
    """Broadcast a number to all lanes."""
    lanes = Lanes(number)
    return lanes(number), lambda context, builder, signature, values: context.cast(builder, values[0], number, lanes)


@_numba.intrinsic
def spread_few(typing_context: Any, number: Any) -> Any:
    """Broadcast a number to FEW lanes."""
    lanes = Lanes(number, FEW)
    return lanes(number), lambda context, builder, signature, values: context.cast(builder, values[0], number, lanes)


@_numba.intrinsic
def count_lanes(typing_context: Any) -> Any:
    """Make the vector 0, 1, ..., LANES - 1, float32."""
    return FLOATS(), lambda context, *_: ir.Constant(context.get_value_type(FLOATS), [float(k) for k in range(LANES)])


@_numba.intrinsic
def remainder(typing_context: Any, cycles: Any) -> Any:
    """Subtract the nearest integer from cycles (float64); float32."""
    lanes = Lanes(types.float32, cycles.count)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        double = values[0].type
        kind = ir.FunctionType(double, [double])
        rint = builder.module.declare_intrinsic(f"llvm.rint.v{cycles.count}f64", fnty=kind)
        return builder.fptrunc(builder.fsub(values[0], builder.call(rint, values)), context.get_value_type(lanes))

    return lanes(cycles), generate


@_numba.intrinsic
def single(typing_context: Any, value: Any) -> Any:
    """Convert float64 lanes to float32."""
    lanes = Lanes(types.float32, value.count)
    return lanes(value), lambda context, builder, signature, values: builder.fptrunc(
        values[0], context.get_value_type(lanes)
    )


@_numba.intrinsic
def nearest(typing_context: Any, value: Any) -> Any:
    """Round float32 lanes below 2^22 to int32, and return the remainder too."""
    numbers = Lanes(types.int32, value.count)

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        # The sum with this has no bits of a fraction, and in its low bits the whole number.
        ones = ir.Constant(values[0].type, [1.5 * 2.0**23] * value.count)
        raised = builder.fadd(values[0], ones)
        kind = context.get_value_type(numbers)
        number = builder.sub(builder.bitcast(raised, kind), builder.bitcast(ones, kind))
        left = builder.fsub(values[0], builder.fsub(raised, ones))
        return context.make_tuple(builder, signature.return_type, [number, left])

    pair: Any = types.Tuple  # carries no types
    return pair([numbers, value])(value), generate


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


# ---------------------------------------------------------------- functions of float64 lanes


@_numba.intrinsic
def square_root(typing_context: Any, value: Any) -> Any:
    """Take the square root of float64 lanes."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        vector = values[0].type
        name = f"llvm.sqrt.v{vector.count}f64"
        return builder.call(builder.module.declare_intrinsic(name, fnty=ir.FunctionType(vector, [vector])), values)

    return value(value), generate


def _choice(comparison: str) -> Any:
    """Make the intrinsic that selects a where a < b (or >), else b."""

    def choice(typing_context: Any, a: Any, b: Any) -> Any:
        lanes = a if isinstance(a, Lanes) else b

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            a, b = (context.cast(builder, v, kind, lanes) for v, kind in zip(values, signature.args, strict=True))
            return builder.select(builder.fcmp_ordered(comparison, a, b), a, b)

        return lanes(a, b), generate

    return _numba.intrinsic(choice)


smaller, larger = _choice("<"), _choice(">")


@_numba.intrinsic
def within(typing_context: Any, value: Any, begin: Any, number: Any, end: Any) -> Any:
    """Select the value in lanes where begin <= number < end, else 0; begin and end are int32 lanes."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        every = _repeat(builder, builder.trunc(values[2], ir.IntType(32)), value.count)
        inside = builder.and_(builder.icmp_signed("<=", values[1], every), builder.icmp_signed("<", every, values[3]))
        return builder.select(inside, values[0], ir.Constant(values[0].type, [0.0] * value.count))

    return value(value, begin, types.int64, end), generate


# ---------------------------------------------------------------- fixed point, and samples at computed indices

# A float64 in -FIXED_RANGE .. FIXED_RANGE plus FIXED_POINT is a number in fixed point: the low 32 bits of its
# representation are the fraction, the high ones the whole number. Both come out by a shuffle, without conversions.
FIXED_RANGE = 2.0**19
FIXED_POINT = 3 * FIXED_RANGE
_HIGH_WORD = int(np.float64(FIXED_POINT).view(np.uint64)) >> 32


def _words(builder: Any, lanes: Any, half: int) -> Any:
    """Extract the low (0) or high (1) 32 bits of 64-bit lanes, little-endian."""
    count = lanes.type.count
    both = builder.bitcast(lanes, ir.VectorType(ir.IntType(32), 2 * count))
    return builder.shuffle_vector(both, both, _indices(range(half, 2 * count, 2)))


def _fraction(flip: int) -> Any:
    """Make the intrinsic that returns the low 32 bits, with `flip` inverted, as a signed fraction."""

    def fraction(typing_context: Any, number: Any) -> Any:
        lanes = Lanes(types.float32, number.count)

        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            words = _words(builder, values[0], 0)
            words = builder.xor(words, ir.Constant(words.type, [flip] * number.count))
            vector = context.get_value_type(lanes)
            return builder.fmul(builder.sitofp(words, vector), ir.Constant(vector, [2.0**-32] * number.count))

        return lanes(number), generate

    return _numba.intrinsic(fraction)


# Of lanes in fixed point, as float32 in -1/2 .. 1/2: the number minus the nearest whole one; the number minus the
# middle between the whole ones below and above it.
from_whole, from_half = _fraction(0), _fraction(1 << 31)


@_numba.intrinsic
def whole(typing_context: Any, number: Any) -> Any:
    """Floor of fixed-point lanes, int32."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        words = _words(builder, values[0], 1)
        return builder.sub(words, ir.Constant(words.type, [_HIGH_WORD] * number.count))

    return Lanes(types.int32, number.count)(number), generate


@_numba.intrinsic
def load_triples(typing_context: Any, array: Any, origin: Any, indices: Any, first: Any) -> Any:
    """Load array[m - 1], array[m] and array[m + 1] for FEW places m = origin + indices[first], ...

    The array is of complex64 viewed as float64, so that samples are loaded whole; the real parts of the three are
    returned, and then their imaginary parts. The array's ends are not checked.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        samples, start, index, lane = values
        places = builder.gep(context.make_array(signature.args[2])(context, builder, index).data, [lane])
        each = [builder.load(builder.gep(places, [ir.Constant(start.type, k)])) for k in range(FEW)]
        data = context.make_array(signature.args[0])(context, builder, samples).data
        return context.make_tuple(builder, signature.return_type, _gathered(builder, data, start, each))

    return _tuple(Lanes(types.float32, FEW), 6)(array, types.intp, indices, types.intp), generate


@_numba.intrinsic
def load_near(typing_context: Any, array: Any, origin: Any, offsets: Any) -> Any:
    """Load samples at places origin + offsets, int32 lanes from NEAR[0] to NEAR[1].

    All that is as near lies in four registers, which are permuted on CPUs that can; so all of it has to be there.
    """

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        samples, start, offset = values
        data = context.make_array(signature.args[0])(context, builder, samples).data
        if "+avx512f" in context.codegen().magic_tuple()[2]:
            return context.make_tuple(builder, signature.return_type, _permuted(builder, data, start, offset))
        each = [builder.extract_element(offset, ir.Constant(ir.IntType(32), k)) for k in range(FEW)]
        return context.make_tuple(builder, signature.return_type, _gathered(builder, data, start, each))

    return _tuple(Lanes(types.float32, FEW), 6)(array, types.intp, offsets), generate


def _permuted(builder: Any, data: Any, start: Any, offset: Any) -> list[Any]:
    """Load as `load_near`, from two registers for the real and two for the imaginary parts."""
    number, vector = start.type, ir.VectorType(ir.FloatType(), FEW)
    first = builder.gep(data, [builder.add(start, ir.Constant(number, NEAR[0] - 1))])
    both = ir.VectorType(ir.FloatType(), 2 * FEW).as_pointer()
    pairs = [
        builder.load(builder.bitcast(builder.gep(first, [ir.Constant(number, k)]), both), align=8) for k in (0, FEW)
    ]
    kind = ir.FunctionType(vector, [vector, offset.type, vector])
    permute = builder.module.declare_intrinsic("llvm.x86.avx512.vpermi2var.ps.512", fnty=kind)
    found = []
    for part in (0, 1):
        low, high = (builder.shuffle_vector(pair, pair, _indices(range(part, 2 * FEW, 2))) for pair in pairs)
        for k in (0, 1, 2):
            at = builder.add(offset, ir.Constant(offset.type, [k - NEAR[0]] * FEW))
            found.append(builder.call(permute, [low, at, high]))
    return found


def _gathered(builder: Any, data: Any, start: Any, each: list[Any]) -> list[Any]:
    """Load as `load_triples`, at places start + each.

    The elements m - 2 to m + 1 of each place are loaded as one vector and the vectors transposed, since gathers take
    twice the time.
    """
    number, four = start.type, ir.VectorType(ir.DoubleType(), 4).as_pointer()
    data = builder.gep(data, [builder.sub(start, ir.Constant(number, 2))])
    addresses = [builder.gep(data, [builder.sext(index, number)]) for index in each]
    rows = [builder.load(builder.bitcast(address, four), align=8) for address in addresses]
    eights = [_last_columns(builder, rows[lane : lane + 8]) for lane in range(0, FEW, 8)]
    joined = [builder.shuffle_vector(*halves, _indices(range(FEW))) for halves in zip(*eights, strict=True)]
    vector = ir.VectorType(ir.FloatType(), FEW)
    return [builder.bitcast(_words(builder, samples, half), vector) for half in (0, 1) for samples in joined]


def _last_columns(builder: Any, rows: Any) -> Any:
    """Transpose the last three columns of eight rows of four elements, by shuffles within quarters of a register."""
    pairs = [builder.shuffle_vector(rows[i], rows[i + 2], _indices(range(8))) for i in (0, 1, 4, 5)]
    even, odd = (
        [builder.shuffle_vector(*two, _indices(k + i for k in range(part, 8, 2) for i in (0, 8))) for two in halves]
        for part, halves in ((0, (pairs[:2], pairs[2:])), (1, (pairs[:2], pairs[2:])))
    )
    low, high = [0, 1, 4, 5, 8, 9, 12, 13], [2, 3, 6, 7, 10, 11, 14, 15]
    return [builder.shuffle_vector(*two, _indices(taken)) for two, taken in ((odd, low), (even, high), (odd, high))]


def fit_even(function: Any, degree: int, most: float = 0.5) -> tuple[float, ...]:
    """Power coefficients, in x^2, of an even function on |x| <= most, by Chebyshev interpolation."""
    series = chebyshev.Chebyshev.interpolate(lambda s: function(np.sqrt(s)), degree, domain=[0.0, most**2])
    return tuple(float(c) for c in series.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1]).coef)


_S = fit_even(lambda x: np.where(x > 1e-9, np.sin(np.pi * x) / np.maximum(x, 1e-9), np.pi), 4)
_C = fit_even(lambda x: np.cos(np.pi * x), 5)
_S0, _S1, _S2, _S3, _S4 = (np.float32(c) for c in _S)
_C0, _C1, _C2, _C3, _C4, _C5 = (np.float32(c) for c in _C)


@njit(inline="always")
def _half_sine(x: Any) -> Any:
    s = x * x
    return x * (_S0 + s * (_S1 + s * (_S2 + s * (_S3 + s * _S4))))


@njit(inline="always")
def _half_cosine(x: Any) -> Any:
    s = x * x
    return _C0 + s * (_C1 + s * (_C2 + s * (_C3 + s * (_C4 + s * _C5))))


# Sine and cosine come from those of half the angle: polynomials for the whole angle have terms that cancel near half a
# cycle, and err twice as much.


@njit(inline="always")
def sine(x: Any) -> Any:
    """Compute sin(2 pi x) in float32, |x| <= 1/2."""
    half = _half_sine(x)
    return (half + half) * _half_cosine(x)


@njit(inline="always")
def cosine(x: Any) -> Any:
    """Compute cos(2 pi x) in float32, |x| <= 1/2."""
    half_sine, half_cosine = _half_sine(x), _half_cosine(x)
    return half_cosine * half_cosine - half_sine * half_sine


@njit(**PART, **COMPILED)
def cosine_and_sine(x: Any) -> Any:
    """Compute cosine and sine at the cost of one."""
    half_sine, half_cosine = _half_sine(x), _half_cosine(x)
    return half_cosine * half_cosine - half_sine * half_sine, (half_sine + half_sine) * half_cosine


@njit(**PART, **COMPILED)
def horner(c: Any, order: Any, u: Any) -> Any:
    """Evaluate sum_k c[k] u^k for the vector u, k up to `order`."""
    value = spread(c[order])
    for k in range(order):
        value = c[order - 1 - k] + u * value
    return value
