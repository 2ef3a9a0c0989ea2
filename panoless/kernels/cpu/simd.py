"""Sixteen float32 lanes as one Numba value, so that vector code is written down instead of hoped for.

LLVM's loop vectorizer gives up on small changes (a second accumulator array is enough), silently and at a cost of
several times. Here a 4×4 block of pixels, or a group of sixteen surfels, is one value of type `Lanes`, lowered to the
LLVM vector `<16 x float>`: one register with AVX-512, two with AVX2, four with NEON or SSE. Arithmetic and
comparisons are the usual operators; a comparison gives a `LaneMask`, used through `where`, `&`, `|`, `~`, `any_lane`,
`lane_count` and `mask_bits`.

Operators may be contracted (a·b + c as one rounding), reassociated and use reciprocal estimates, but NaN and infinity
keep their meaning: a masked lane may hold either. Functions that use lanes must therefore not be compiled with
`fastmath=True`, which would add the no-NaN flags to every instruction of the module.

Numba's disk cache watches only the file of the compiled function: after an edit here, remove the `__pycache__` folders.
"""

import operator

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

LANES = 16
"""Lanes of one value; also the pixels of a 4×4 block."""

INT32, INT64 = ir.IntType(32), ir.IntType(64)
FLOAT = ir.FloatType()
VECTOR = ir.VectorType(FLOAT, LANES)
_INT_VECTOR = ir.VectorType(INT32, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)
_RELAXED = ("nsz", "arcp", "contract", "reassoc")


class LanesType(types.Type):
    """Numba type of sixteen float32 values."""

    def __init__(self):
        super().__init__(name="Lanes")


class LaneMaskType(types.Type):
    """Numba type of sixteen truth values."""

    def __init__(self):
        super().__init__(name="LaneMask")


lanes_type = LanesType()
mask_type = LaneMaskType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, VECTOR)


@register_model(LaneMaskType)
class _LaneMaskModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _MASK)


def constant_vector(values, element=FLOAT):
    """An LLVM vector of the given numbers."""
    vector = ir.VectorType(element, len(values))
    return ir.Constant(vector, [ir.Constant(element, value) for value in values])


def splat(builder, scalar, vector=VECTOR):
    """Emit code that repeats a scalar in every lane."""
    single = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(INT32, 0))
    return builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(INT32, vector.count), None))


@lower_cast(types.Float, LanesType)
@lower_cast(types.Integer, LanesType)
def _scalar_to_lanes(context, builder, from_type, to_type, value):
    return splat(builder, context.cast(builder, value, from_type, types.float32))


def _is_operand(numba_type):
    return numba_type == lanes_type or isinstance(numba_type, (types.Float, types.Integer))


def _define_binary(python_operator, result_type, build):
    """Let `python_operator` act on two lanes, or on lanes and a scalar that is repeated."""

    @infer_global(python_operator)
    class _Template(AbstractTemplate):
        def generic(self, args, kws):
            if len(args) == 2 and lanes_type in args and all(_is_operand(a) for a in args):
                return signature(result_type, lanes_type, lanes_type)
            return None

    @lower_builtin(python_operator, lanes_type, lanes_type)
    def _lower(context, builder, sig, args):
        return build(builder, *args)


def _relaxed(method):
    return lambda builder, left, right: getattr(builder, method)(left, right, flags=_RELAXED)


def _comparison(symbol):
    return lambda builder, left, right: builder.fcmp_ordered(symbol, left, right)


for _operator, _method in (
    (operator.add, "fadd"),
    (operator.iadd, "fadd"),
    (operator.sub, "fsub"),
    (operator.isub, "fsub"),
    (operator.mul, "fmul"),
    (operator.imul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define_binary(_operator, lanes_type, _relaxed(_method))
for _operator, _symbol in (
    (operator.lt, "<"),
    (operator.le, "<="),
    (operator.gt, ">"),
    (operator.ge, ">="),
    (operator.eq, "=="),
):
    _define_binary(_operator, mask_type, _comparison(_symbol))


def _define_mask_operator(python_operator, method):
    @infer_global(python_operator)
    class _Template(AbstractTemplate):
        def generic(self, args, kws):
            if args == (mask_type, mask_type):
                return signature(mask_type, mask_type, mask_type)
            return None

    @lower_builtin(python_operator, mask_type, mask_type)
    def _lower(context, builder, sig, args):
        return getattr(builder, method)(*args)


for _operator, _method in (
    (operator.and_, "and_"),
    (operator.iand, "and_"),
    (operator.or_, "or_"),
    (operator.ior, "or_"),
):
    _define_mask_operator(_operator, _method)


def _define_unary(python_operator, operand_type, build):
    @infer_global(python_operator)
    class _Template(AbstractTemplate):
        def generic(self, args, kws):
            return signature(operand_type, operand_type) if args == (operand_type,) else None

    @lower_builtin(python_operator, operand_type)
    def _lower(context, builder, sig, args):
        return build(builder, args[0])


_define_unary(operator.neg, lanes_type, lambda builder, value: builder.fneg(value))
_define_unary(operator.invert, mask_type, lambda builder, value: builder.not_(value))


@intrinsic
def lanes(typingctx, scalar):
    """Repeat a scalar in every lane."""

    def build(context, builder, sig, args):
        return context.cast(builder, args[0], sig.args[0], lanes_type)

    return lanes_type(scalar), build


def _index_intrinsic(values):
    @intrinsic
    def constant(typingctx):
        return lanes_type(), lambda context, builder, sig, args: constant_vector([float(v) for v in values])

    return constant


lane_columns = _index_intrinsic([lane % 4 for lane in range(LANES)])
"""0, 1, 2, 3, 0, 1, …: the column of each lane in a 4×4 block."""
lane_rows = _index_intrinsic([lane // 4 for lane in range(LANES)])
"""0, 0, 0, 0, 1, 1, …: the row of each lane in a 4×4 block."""
lane_indices = _index_intrinsic(list(range(LANES)))
"""0, 1, …, 15."""


@intrinsic
def where(typingctx, mask, chosen, otherwise):
    """Take `chosen` where the mask holds, else `otherwise`; scalars are repeated."""

    def build(context, builder, sig, args):
        return builder.select(*args)

    return lanes_type(mask_type, lanes_type, lanes_type), build


@intrinsic
def any_lane(typingctx, mask):
    """Whether the mask holds in at least one lane."""

    def build(context, builder, sig, args):
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask_type), build


@intrinsic
def mask_bits(typingctx, mask):
    """Return the mask as an integer, lane i in bit i."""

    def build(context, builder, sig, args):
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), INT64)

    return types.int64(mask_type), build


@intrinsic
def lane_count(typingctx, mask):
    """Return in how many lanes the mask holds."""

    def build(context, builder, sig, args):
        bits = builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), INT64)
        return builder.ctpop(bits)

    return types.int64(mask_type), build


def call_intrinsic(builder, name, result, arguments, **options):
    """Emit a call of one of LLVM\'s intrinsic functions."""
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)
    return builder.call(function, arguments, **options)


def _unary_function(name, doc):
    @intrinsic
    def function(typingctx, value):
        def build(context, builder, sig, args):
            return call_intrinsic(builder, f"llvm.{name}.v16f32", VECTOR, args)

        return lanes_type(lanes_type), build

    function.__doc__ = doc
    return function


square_root = _unary_function("sqrt", "Return the square root of each lane.")
absolute = _unary_function("fabs", "Return the magnitude of each lane.")
round_down = _unary_function("floor", "Return the largest whole number that is not above each lane.")


_LOG2_SERIES = tuple(2 / np.log(2) / power for power in (9, 7, 5, 3, 1))


@intrinsic
def log2(typingctx, value):
    """Return the base-2 logarithm of each lane, positive and not denormal, to 10⁻⁷; anything else gives garbage.

    log₂(2ᵉ m) = e + 2/ln 2 · artanh((m − 1)/(m + 1)), with m in [√½, √2) and the series up to the ninth power.
    """

    def build(context, builder, sig, args):
        integers = lambda number: constant_vector([number] * LANES, INT32)  # noqa: E731
        one = splat(builder, ir.Constant(FLOAT, 1.0))
        bits = builder.bitcast(args[0], _INT_VECTOR)
        shifted = builder.sub(bits, integers(0x3F3504F3))
        exponent = builder.ashr(shifted, integers(23))
        mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, integers(23))), VECTOR)
        above, below = builder.fadd(mantissa, one), builder.fsub(mantissa, one)
        ratio = builder.fdiv(below, above, flags=_RELAXED)
        square = builder.fmul(ratio, ratio, flags=_RELAXED)
        series = constant_vector([np.float32(_LOG2_SERIES[0])] * LANES)
        for coefficient in _LOG2_SERIES[1:]:
            product = builder.fmul(series, square, flags=_RELAXED)
            series = builder.fadd(product, constant_vector([np.float32(coefficient)] * LANES), flags=_RELAXED)
        series = builder.fmul(series, ratio, flags=_RELAXED)
        return builder.fadd(builder.sitofp(exponent, VECTOR), series, flags=_RELAXED)

    return lanes_type(lanes_type), build


def host_has(feature):
    """Whether the processor that code is compiled for, which is this one, has a feature by LLVM's name for it."""
    return bool(get_host_cpu_features().get(feature, False))


@intrinsic
def reciprocal(typingctx, value):
    """Return 1 over each lane, to two units in the last place; not finite for 0 and for what is not finite.

    With AVX-512 by an estimate of 14 bits and one Newton step: a third of the time of the division instruction.
    """

    def build(context, builder, sig, args):
        one = splat(builder, ir.Constant(FLOAT, 1.0))
        if not host_has("avx512f"):
            return builder.fdiv(one, args[0], flags=_RELAXED)
        everywhere = ir.Constant(ir.IntType(LANES), -1)
        operands = [args[0], ir.Constant(VECTOR, None), everywhere]
        estimate = call_intrinsic(builder, "llvm.x86.avx512.rcp14.ps.512", VECTOR, operands)
        short = builder.fsub(one, builder.fmul(args[0], estimate, flags=_RELAXED), flags=_RELAXED)
        return builder.fadd(estimate, builder.fmul(estimate, short, flags=_RELAXED), flags=_RELAXED)

    return lanes_type(lanes_type), build


@intrinsic
def minimum(typingctx, left, right):
    """Return the smaller value in each lane; `right` where either is NaN."""

    def build(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered("<", *args), *args)

    return lanes_type(lanes_type, lanes_type), build


@intrinsic
def maximum(typingctx, left, right):
    """Return the larger value in each lane; `right` where either is NaN."""

    def build(context, builder, sig, args):
        return builder.select(builder.fcmp_ordered(">", *args), *args)

    return lanes_type(lanes_type, lanes_type), build


_EXP2_POLYNOMIAL = (1.3276464e-3, 9.6755410e-3, 5.5507135e-2, 2.4022120e-1, 6.9314694e-1, 1.0000001)


@intrinsic
def exp2(typingctx, value):
    """Return 2 to the power of each lane, for −126 ≤ value ≤ 126; anything outside gives garbage, to be masked.

    The nearest integer is found by adding 1.5·2²³, which leaves it in the low bits of the sum and needs no rounding
    instruction; a polynomial of degree five covers the rest, [−½, ½], to 2·10⁻⁷.
    """

    def build(context, builder, sig, args):
        magic = splat(builder, ir.Constant(FLOAT, 12582912.0))
        shifted = builder.fadd(args[0], magic)
        fraction = builder.fsub(args[0], builder.fsub(shifted, magic))
        power = splat(builder, ir.Constant(FLOAT, np.float32(_EXP2_POLYNOMIAL[0])))
        for coefficient in _EXP2_POLYNOMIAL[1:]:
            product = builder.fmul(power, fraction, flags=_RELAXED)
            power = builder.fadd(product, constant_vector([np.float32(coefficient)] * LANES), flags=_RELAXED)
        exponent = builder.shl(builder.bitcast(shifted, _INT_VECTOR), constant_vector([23] * LANES, INT32))
        return builder.bitcast(builder.add(builder.bitcast(power, _INT_VECTOR), exponent), VECTOR)

    return lanes_type(lanes_type), build


def _step(stride):
    """Shuffles of one step of the transposing sum: lanes whose `stride` bit is clear go on with the left operand,
    the others with the right one; the second shuffle fetches the partner of each.
    """
    sides = [LANES if lane & stride else 0 for lane in range(LANES)]
    own = [lane + side for lane, side in enumerate(sides)]
    partner = [(lane ^ stride) + side for lane, side in enumerate(sides)]
    return constant_vector(own, INT32), constant_vector(partner, INT32)


@intrinsic
def sum_each(typingctx, rows):
    """Sum the lanes of each of up to sixteen values: lane i of the result is the sum of `rows[i]`; lanes without a row
    hold nothing of use.

    A transposing reduction of fifteen shuffles, blends and sums instead of sixteen horizontal sums. The blends matter:
    they run beside the shuffles, for which there is one port.
    """

    def build(context, builder, sig, args):
        vectors = [builder.extract_value(args[0], i) for i in range(sig.args[0].count)]
        stride = 1
        while stride < LANES:
            own, partner = _step(stride)
            pairs = [(*vectors[i : i + 2], vectors[i])[:2] for i in range(0, len(vectors), 2)]
            vectors = [
                builder.fadd(
                    builder.shuffle_vector(left, right, own),
                    builder.shuffle_vector(left, right, partner),
                    flags=_RELAXED,
                )
                for left, right in pairs
            ]
            stride *= 2
        return vectors[0]

    return lanes_type(rows), build


@intrinsic
def float_bits(typingctx, value):
    """Return the bit pattern of a float32; for positive values it sorts like the value."""

    def build(context, builder, sig, args):
        return builder.bitcast(args[0], INT32)

    return types.uint32(types.float32), build
