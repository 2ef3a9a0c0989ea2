"""Sixteen float32 lanes as one Numba value, so that vector code is written down instead of hoped for.

LLVM's loop vectorizer gives up on small changes (a second accumulator array is enough), silently and at a cost of several
times. Here a 4×4 block of pixels, or a group of sixteen surfels, is one value of type `Lanes`, lowered to the LLVM vector
`<16 x float>`: one register with AVX-512, two with AVX2, four with NEON or SSE. Arithmetic and comparisons are the usual operators; a
comparison gives a `LaneMask`, used through `where`, `&`, `|`, `~`, `any_lane` and `mask_bits`.

Operators may be contracted (a·b + c as one rounding), reassociated and use reciprocal estimates, but NaN and infinity keep
their meaning: a masked lane may hold either. Functions that use lanes must therefore not be compiled with `fastmath=True`, which would add
the no-NaN flags to every instruction of the module.

Numba's disk cache watches only the file of the compiled function: after an edit here, remove the `__pycache__` folders.
"""

import operator

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, lower_cast, models, register_model

LANES = 16
"""Lanes of one value; also the pixels of a 4×4 block."""

_INT32, _INT64 = ir.IntType(32), ir.IntType(64)
_FLOAT = ir.FloatType()
_VECTOR = ir.VectorType(_FLOAT, LANES)
_INT_VECTOR = ir.VectorType(_INT32, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)
_ROW = ir.VectorType(_FLOAT, 4)
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
        super().__init__(manager, numba_type, _VECTOR)


@register_model(LaneMaskType)
class _LaneMaskModel(models.PrimitiveModel):
    def __init__(self, manager, numba_type):
        super().__init__(manager, numba_type, _MASK)


def _constant(values, element=_FLOAT):
    vector = ir.VectorType(element, len(values))
    return ir.Constant(vector, [ir.Constant(element, value) for value in values])


def _splat(builder, scalar, vector=_VECTOR):
    single = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(single, single, ir.Constant(ir.VectorType(_INT32, vector.count), None))


@lower_cast(types.Float, LanesType)
@lower_cast(types.Integer, LanesType)
def _scalar_to_lanes(context, builder, from_type, to_type, value):
    return _splat(builder, context.cast(builder, value, from_type, types.float32))


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
        return lanes_type(), lambda context, builder, sig, args: _constant([float(v) for v in values])

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
        return builder.zext(builder.bitcast(args[0], ir.IntType(LANES)), _INT64)

    return types.int64(mask_type), build


@intrinsic
def lowest_bit(typingctx, bits):
    """Return the index of the lowest set bit of an integer that is not zero."""

    def build(context, builder, sig, args):
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), build


def _call_intrinsic(builder, name, result, arguments, **options):
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    function = cgutils.get_or_insert_function(builder.module, function_type, name)
    return builder.call(function, arguments, **options)


def _unary_function(name, doc):
    @intrinsic
    def function(typingctx, value):
        def build(context, builder, sig, args):
            return _call_intrinsic(builder, f"llvm.{name}.v16f32", _VECTOR, args)

        return lanes_type(lanes_type), build

    function.__doc__ = doc
    return function


square_root = _unary_function("sqrt", "Return the square root of each lane.")
absolute = _unary_function("fabs", "Return the magnitude of each lane.")
log2 = _unary_function("log2", "Return the base-2 logarithm of each lane.")


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

    The nearest integer is found by adding 1.5·2²³, which leaves it in the low bits of the sum and needs no rounding instruction;
    a polynomial of degree five covers the rest, [−½, ½], to 2·10⁻⁷.
    """

    def build(context, builder, sig, args):
        magic = _splat(builder, ir.Constant(_FLOAT, 12582912.0))
        shifted = builder.fadd(args[0], magic)
        fraction = builder.fsub(args[0], builder.fsub(shifted, magic))
        power = _splat(builder, ir.Constant(_FLOAT, np.float32(_EXP2_POLYNOMIAL[0])))
        for coefficient in _EXP2_POLYNOMIAL[1:]:
            product = builder.fmul(power, fraction, flags=_RELAXED)
            power = builder.fadd(product, _constant([np.float32(coefficient)] * LANES), flags=_RELAXED)
        exponent = builder.shl(builder.bitcast(shifted, _INT_VECTOR), _constant([23] * LANES, _INT32))
        return builder.bitcast(builder.add(builder.bitcast(power, _INT_VECTOR), exponent), _VECTOR)

    return lanes_type(lanes_type), build


def _element_pointer(context, builder, array_type, array, offset):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


@intrinsic
def load_lanes(typingctx, array, offset):
    """Load sixteen consecutive float32 of a C-contiguous array, from flat index `offset`."""

    def build(context, builder, sig, args):
        pointer = _element_pointer(context, builder, sig.args[0], *args)
        return builder.load(builder.bitcast(pointer, _VECTOR.as_pointer()), align=4, typ=_VECTOR)

    return lanes_type(array, types.intp), build


@intrinsic
def store_lanes(typingctx, array, offset, value):
    """Store sixteen consecutive float32 of a C-contiguous array, from flat index `offset`."""

    def build(context, builder, sig, args):
        pointer = _element_pointer(context, builder, sig.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(pointer, _VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes_type), build


def _row_mask(builder, mask, row):
    return builder.shuffle_vector(mask, mask, _constant(range(4 * row, 4 * row + 4), _INT32))


@intrinsic
def load_block(typingctx, plane, offset, row_stride, inside):
    """Load a 4×4 block of a float32 image whose first element has flat index `offset`; 0 where `inside` fails."""

    def build(context, builder, sig, args):
        rows = []
        for row in range(4):
            start = builder.add(args[1], builder.mul(args[2], ir.Constant(_INT64, row)))
            pointer = _element_pointer(context, builder, sig.args[0], args[0], start)
            pointer = builder.bitcast(pointer, _ROW.as_pointer())
            operands = [pointer, ir.Constant(_INT32, 4), _row_mask(builder, args[3], row), ir.Constant(_ROW, None)]
            rows.append(_call_intrinsic(builder, "llvm.masked.load.v4f32.p0", _ROW, operands))
        halves = [builder.shuffle_vector(*rows[i : i + 2], _constant(range(8), _INT32)) for i in (0, 2)]
        return builder.shuffle_vector(*halves, _constant(range(16), _INT32))

    return lanes_type(plane, types.intp, types.intp, mask_type), build


@intrinsic
def store_block(typingctx, plane, offset, row_stride, inside, value):
    """Store a 4×4 block of a float32 image where `inside` holds."""

    def build(context, builder, sig, args):
        for row in range(4):
            start = builder.add(args[1], builder.mul(args[2], ir.Constant(_INT64, row)))
            pointer = _element_pointer(context, builder, sig.args[0], args[0], start)
            pointer = builder.bitcast(pointer, _ROW.as_pointer())
            part = builder.shuffle_vector(args[4], args[4], _constant(range(4 * row, 4 * row + 4), _INT32))
            operands = [part, pointer, ir.Constant(_INT32, 4), _row_mask(builder, args[3], row)]
            _call_intrinsic(builder, "llvm.masked.store.v4f32.p0", ir.VoidType(), operands)
        return context.get_dummy_value()

    return types.void(plane, types.intp, types.intp, mask_type, lanes_type), build


def _lane_pointers(context, builder, array_type, array, first, stride):
    """Pointers to element first + lane·stride of the array, one a lane."""
    start = _element_pointer(context, builder, array_type, array, first)
    steps = builder.mul(_splat(builder, stride, ir.VectorType(_INT64, LANES)), _constant(range(LANES), _INT64))
    vector = ir.VectorType(_INT64, LANES)
    base = _splat(builder, builder.ptrtoint(start, _INT64), vector)
    addresses = builder.add(base, builder.mul(steps, _constant([4] * LANES, _INT64)))
    return builder.inttoptr(addresses, ir.VectorType(_FLOAT.as_pointer(), LANES))


@intrinsic
def load_strided(typingctx, array, first, stride, active):
    """Load float32 elements first, first + stride, … of a C-contiguous array; 0 where `active` fails."""

    def build(context, builder, sig, args):
        pointers = _lane_pointers(context, builder, sig.args[0], *args[:3])
        operands = [pointers, ir.Constant(_INT32, 4), args[3], ir.Constant(_VECTOR, None)]
        return _call_intrinsic(builder, "llvm.masked.gather.v16f32.v16p0", _VECTOR, operands)

    return lanes_type(array, types.intp, types.intp, mask_type), build


@intrinsic
def store_strided(typingctx, array, first, stride, active, value):
    """Store float32 elements first, first + stride, … of a C-contiguous array where `active` holds."""

    def build(context, builder, sig, args):
        pointers = _lane_pointers(context, builder, sig.args[0], *args[:3])
        operands = [args[4], pointers, ir.Constant(_INT32, 4), args[3]]
        _call_intrinsic(builder, "llvm.masked.scatter.v16f32.v16p0", ir.VoidType(), operands)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, mask_type, lanes_type), build


def _pairing(low, high):
    """The two shuffles of one step of the transposing sum; groups of four lanes are numbered over both operands."""
    return _constant(low, _INT32), _constant(high, _INT32)


_GROUPS = range(0, LANES, 4)
_SUM_STEPS = (
    _pairing(
        [i for g in _GROUPS for i in (g, g + 16, g + 1, g + 17)],
        [i for g in _GROUPS for i in (g + 2, g + 18, g + 3, g + 19)],
    ),
    _pairing(
        [i for g in _GROUPS for i in (g, g + 1, g + 16, g + 17)],
        [i for g in _GROUPS for i in (g + 2, g + 3, g + 18, g + 19)],
    ),
    _pairing([*range(0, 8), *range(16, 24)], [*range(8, 16), *range(24, 32)]),
    _pairing(
        [i for g in (0, 8, 16, 24) for i in range(g, g + 4)],
        [i for g in (4, 12, 20, 28) for i in range(g, g + 4)],
    ),
)


@intrinsic
def sum_each(typingctx, rows):
    """Sum the lanes of each of up to sixteen values: lane i of the result is the sum of `rows[i]`.

    A transposing reduction: fifteen pairs of shuffles instead of sixteen horizontal sums.
    """

    def build(context, builder, sig, args):
        vectors = [builder.extract_value(args[0], i) for i in range(sig.args[0].count)]
        zero = ir.Constant(_VECTOR, None)
        vectors += [zero] * (LANES - len(vectors))
        for low, high in _SUM_STEPS:
            pairs = zip(vectors[::2], vectors[1::2], strict=True)
            vectors = [
                zero
                if left is zero and right is zero
                else builder.fadd(
                    builder.shuffle_vector(left, right, low), builder.shuffle_vector(left, right, high), flags=_RELAXED
                )
                for left, right in pairs
            ]
        return vectors[0]

    return lanes_type(rows), build


@intrinsic
def fetch_add(typingctx, counter, amount):
    """Add `amount` to element 0 of an int64 array atomically and return the value before."""

    def build(context, builder, sig, args):
        pointer = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", pointer, args[1], "monotonic")

    return types.int64(counter, types.int64), build


@intrinsic
def float_bits(typingctx, value):
    """Return the bit pattern of a float32; for positive values it sorts like the value."""

    def build(context, builder, sig, args):
        return builder.bitcast(args[0], _INT32)

    return types.uint32(types.float32), build
