"""How `Lanes` come from memory and go back: consecutive, strided, or as a 4×4 block of an image."""

from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from panoless.kernels.cpu.simd import (
    FLOAT,
    INT32,
    INT64,
    LANES,
    VECTOR,
    call_intrinsic,
    constant_vector,
    host_has,
    lanes_type,
    mask_type,
    splat,
)

_ROW = ir.VectorType(FLOAT, 4)
_PAIR = ir.VectorType(FLOAT, 8)
_WORD = ir.IntType(16)


def _element_pointer(context, builder, array_type, array, offset):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


@intrinsic
def load_lanes(typingctx, array, offset):
    """Load sixteen consecutive float32 of a C-contiguous array, from flat index `offset`."""

    def build(context, builder, sig, args):
        pointer = _element_pointer(context, builder, sig.args[0], *args)
        return builder.load(builder.bitcast(pointer, VECTOR.as_pointer()), align=4, typ=VECTOR)

    return lanes_type(array, types.intp), build


@intrinsic
def store_lanes(typingctx, array, offset, value):
    """Store sixteen consecutive float32 of a C-contiguous array, from flat index `offset`."""

    def build(context, builder, sig, args):
        pointer = _element_pointer(context, builder, sig.args[0], *args[:2])
        builder.store(args[2], builder.bitcast(pointer, VECTOR.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes_type), build


@intrinsic
def load_some(typingctx, array, offset, active):
    """Load the `active` ones of sixteen consecutive float32 of a C-contiguous array; the others are 0 and not read."""

    def build(context, builder, sig, args):
        pointer = _element_pointer(context, builder, sig.args[0], *args[:2])
        operands = [builder.bitcast(pointer, VECTOR.as_pointer()), ir.Constant(INT32, 4), args[2]]
        return call_intrinsic(builder, "llvm.masked.load.v16f32.p0", VECTOR, [*operands, ir.Constant(VECTOR, None)])

    return lanes_type(array, types.intp, mask_type), build


@intrinsic
def store_some(typingctx, array, offset, active, value):
    """Store the `active` ones of sixteen consecutive float32 of a C-contiguous array, from flat index `offset`."""

    def build(context, builder, sig, args):
        pointer = _element_pointer(context, builder, sig.args[0], *args[:2])
        operands = [args[3], builder.bitcast(pointer, VECTOR.as_pointer()), ir.Constant(INT32, 4), args[2]]
        call_intrinsic(builder, "llvm.masked.store.v16f32.p0", ir.VoidType(), operands)
        return context.get_dummy_value()

    return types.void(array, types.intp, mask_type, lanes_type), build


@intrinsic
def load_at(typingctx, array, places, active):
    """Load float32 elements of a C-contiguous array by flat index, a whole number below 2²⁴; 0 where not `active`."""

    def build(context, builder, sig, args):
        start = _element_pointer(context, builder, sig.args[0], args[0], ir.Constant(INT64, 0))
        whole = builder.fptosi(args[1], ir.VectorType(INT32, LANES))
        vector = ir.VectorType(INT64, LANES)
        bytes_from_start = builder.shl(builder.sext(whole, vector), constant_vector([2] * LANES, INT64))
        addresses = builder.add(splat(builder, builder.ptrtoint(start, INT64), vector), bytes_from_start)
        pointers = builder.inttoptr(addresses, ir.VectorType(FLOAT.as_pointer(), LANES))
        operands = [pointers, ir.Constant(INT32, 4), args[2], ir.Constant(VECTOR, None)]
        return call_intrinsic(builder, "llvm.masked.gather.v16f32.v16p0", VECTOR, operands)

    return lanes_type(array, lanes_type, mask_type), build


@intrinsic
def add_color(typingctx, array, offset, weight, red, green, blue):
    """Add weight·(red, green, blue, 0) to four float32 of a C-contiguous array, from flat index `offset` on."""

    def build(context, builder, sig, args):
        pointer = builder.bitcast(_element_pointer(context, builder, sig.args[0], *args[:2]), _ROW.as_pointer())
        color = ir.Constant(_ROW, None)
        for channel in range(3):
            color = builder.insert_element(color, args[3 + channel], ir.Constant(INT32, channel))
        share = builder.fmul(color, splat(builder, args[2], _ROW), flags=("contract",))
        total = builder.fadd(builder.load(pointer, align=4, typ=_ROW), share, flags=("contract",))
        builder.store(total, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, *[types.float32] * 4), build


@intrinsic
def load_cell(typingctx, array, upper, lower):
    """Load eight consecutive float32 of a C-contiguous array from flat index `upper`, and eight from `lower`: the four
    texels, of four channels each, around a place.
    """

    def build(context, builder, sig, args):
        pointers = (_element_pointer(context, builder, sig.args[0], args[0], place) for place in args[1:])
        rows = [builder.load(builder.bitcast(pointer, _PAIR.as_pointer()), align=4, typ=_PAIR) for pointer in pointers]
        return builder.shuffle_vector(*rows, constant_vector(range(LANES), INT32))

    return lanes_type(array, types.intp, types.intp), build


@intrinsic
def add_cell(typingctx, array, upper, lower, value):
    """Add to what `load_cell` loads, a texel after the other: a load that only overlaps the store before it would wait
    for that.
    """

    def build(context, builder, sig, args):
        for texel in range(4):
            place = builder.add(args[1 + texel // 2], ir.Constant(args[1].type, 4 * (texel % 2)))
            pointer = builder.bitcast(
                _element_pointer(context, builder, sig.args[0], args[0], place), _ROW.as_pointer()
            )
            own = constant_vector(range(4 * texel, 4 * texel + 4), INT32)
            share = builder.shuffle_vector(args[3], args[3], own)
            total = builder.fadd(builder.load(pointer, align=4, typ=_ROW), share, flags=("contract",))
            builder.store(total, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, lanes_type), build


@intrinsic
def cell_weights(typingctx, upper_left, upper_right, lower_left, lower_right):
    """Weights of four texels, each repeated for their four channels."""

    def build(context, builder, sig, args):
        row = ir.Constant(_ROW, ir.Undefined)
        for texel, weight in enumerate(args):
            row = builder.insert_element(row, weight, ir.Constant(INT32, texel))
        return builder.shuffle_vector(row, row, constant_vector([lane // 4 for lane in range(LANES)], INT32))

    return lanes_type(*[types.float32] * 4), build


@intrinsic
def load_color(typingctx, array, offset):
    """Load four consecutive float32 of a C-contiguous array, repeated for four texels."""

    def build(context, builder, sig, args):
        pointer = builder.bitcast(_element_pointer(context, builder, sig.args[0], *args), _ROW.as_pointer())
        row = builder.load(pointer, align=4, typ=_ROW)
        return builder.shuffle_vector(row, row, constant_vector([lane % 4 for lane in range(LANES)], INT32))

    return lanes_type(array, types.intp), build


@intrinsic
def store_color(typingctx, array, offset, value):
    """Store the sum over four texels of their four channels, from flat index `offset` on."""

    def build(context, builder, sig, args):
        value, flags = args[2], ("contract", "reassoc", "nsz")
        texels = [
            builder.shuffle_vector(value, value, constant_vector(range(4 * k, 4 * k + 4), INT32)) for k in range(4)
        ]
        upper, lower = (builder.fadd(*texels[k : k + 2], flags=flags) for k in (0, 2))
        pointer = builder.bitcast(_element_pointer(context, builder, sig.args[0], *args[:2]), _ROW.as_pointer())
        builder.store(builder.fadd(upper, lower, flags=flags), pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes_type), build


def _row_mask(builder, mask, row):
    return builder.shuffle_vector(mask, mask, constant_vector(range(4 * row, 4 * row + 4), INT32))


@intrinsic
def load_block(typingctx, plane, offset, row_stride, inside):
    """Load a 4×4 block of a float32 image whose first element has flat index `offset`; 0 where `inside` fails."""

    def build(context, builder, sig, args):
        rows = []
        for row in range(4):
            start = builder.add(args[1], builder.mul(args[2], ir.Constant(INT64, row)))
            pointer = _element_pointer(context, builder, sig.args[0], args[0], start)
            pointer = builder.bitcast(pointer, _ROW.as_pointer())
            operands = [pointer, ir.Constant(INT32, 4), _row_mask(builder, args[3], row), ir.Constant(_ROW, None)]
            rows.append(call_intrinsic(builder, "llvm.masked.load.v4f32.p0", _ROW, operands))
        halves = [builder.shuffle_vector(*rows[i : i + 2], constant_vector(range(8), INT32)) for i in (0, 2)]
        return builder.shuffle_vector(*halves, constant_vector(range(16), INT32))

    return lanes_type(plane, types.intp, types.intp, mask_type), build


@intrinsic
def store_block(typingctx, plane, offset, row_stride, inside, value):
    """Store a 4×4 block of a float32 image where `inside` holds."""

    def build(context, builder, sig, args):
        for row in range(4):
            start = builder.add(args[1], builder.mul(args[2], ir.Constant(INT64, row)))
            pointer = _element_pointer(context, builder, sig.args[0], args[0], start)
            pointer = builder.bitcast(pointer, _ROW.as_pointer())
            part = builder.shuffle_vector(args[4], args[4], constant_vector(range(4 * row, 4 * row + 4), INT32))
            operands = [part, pointer, ir.Constant(INT32, 4), _row_mask(builder, args[3], row)]
            call_intrinsic(builder, "llvm.masked.store.v4f32.p0", ir.VoidType(), operands)
        return context.get_dummy_value()

    return types.void(plane, types.intp, types.intp, mask_type, lanes_type), build


def _lane_pointers(context, builder, array_type, array, first, stride):
    """Pointers to element first + lane·stride of the array, one a lane."""
    start = _element_pointer(context, builder, array_type, array, first)
    steps = builder.mul(splat(builder, stride, ir.VectorType(INT64, LANES)), constant_vector(range(LANES), INT64))
    vector = ir.VectorType(INT64, LANES)
    base = splat(builder, builder.ptrtoint(start, INT64), vector)
    addresses = builder.add(base, builder.mul(steps, constant_vector([4] * LANES, INT64)))
    return builder.inttoptr(addresses, ir.VectorType(FLOAT.as_pointer(), LANES))


@intrinsic
def load_strided(typingctx, array, first, stride, active):
    """Load float32 elements first, first + stride, … of a C-contiguous array; 0 where `active` fails."""

    def build(context, builder, sig, args):
        pointers = _lane_pointers(context, builder, sig.args[0], *args[:3])
        operands = [pointers, ir.Constant(INT32, 4), args[3], ir.Constant(VECTOR, None)]
        return call_intrinsic(builder, "llvm.masked.gather.v16f32.v16p0", VECTOR, operands)

    return lanes_type(array, types.intp, types.intp, mask_type), build


@intrinsic
def store_strided(typingctx, array, first, stride, active, value):
    """Store float32 elements first, first + stride, … of a C-contiguous array where `active` holds."""

    def build(context, builder, sig, args):
        pointers = _lane_pointers(context, builder, sig.args[0], *args[:3])
        operands = [args[4], pointers, ir.Constant(INT32, 4), args[3]]
        call_intrinsic(builder, "llvm.masked.scatter.v16f32.v16p0", ir.VoidType(), operands)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, mask_type, lanes_type), build


@intrinsic
def load_bit(typingctx, array, offset, bit):
    """Which of sixteen consecutive uint16 of a C-contiguous array, from flat index `offset`, have bit `bit` set."""

    def build(context, builder, sig, args):
        words = ir.VectorType(_WORD, LANES)
        pointer = _element_pointer(context, builder, sig.args[0], *args[:2])
        loaded = builder.load(builder.bitcast(pointer, words.as_pointer()), align=2, typ=words)
        wanted = splat(builder, builder.shl(ir.Constant(_WORD, 1), builder.trunc(args[2], _WORD)), words)
        return builder.icmp_unsigned("!=", builder.and_(loaded, wanted), ir.Constant(words, None))

    return mask_type(array, types.intp, types.int64), build


@intrinsic
def store_chosen(typingctx, array, offset, first, mask):
    """Store the int32 numbers first + lane of the lanes in `mask` one after another, from flat index `offset`.

    Up to sixteen elements from there on may be overwritten, whatever the mask.
    """

    def build(context, builder, sig, args):
        vector = ir.VectorType(INT32, LANES)
        start = splat(builder, builder.trunc(args[2], INT32), vector)
        numbers = builder.add(start, constant_vector(range(LANES), INT32))
        pointer = _element_pointer(context, builder, sig.args[0], *args[:2])
        if host_has("avx512f"):
            # The store that compresses is slow on some processors; compressing in a register is not.
            operands = [numbers, ir.Constant(vector, None), args[3]]
            packed = call_intrinsic(builder, "llvm.x86.avx512.mask.compress.v16i32", vector, operands)
            builder.store(packed, builder.bitcast(pointer, vector.as_pointer()), align=4)
        else:
            operands = [numbers, pointer, args[3]]
            call_intrinsic(builder, "llvm.masked.compressstore.v16i32", ir.VoidType(), operands)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.int64, mask_type), build


@intrinsic
def fetch_add(typingctx, counter, amount):
    """Add `amount` to element 0 of an int64 array atomically and return the value before."""

    def build(context, builder, sig, args):
        pointer = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", pointer, args[1], "monotonic")

    return types.int64(counter, types.int64), build


@intrinsic
def thread_slot(typingctx, counter):
    """Return a number of its own for each thread that works on `counter`, which `run_shared` made: 0, 1, …"""

    def build(context, builder, sig, args):
        data = context.make_array(sig.args[0])(context, builder, args[0]).data
        pointer = builder.gep(data, [ir.Constant(INT64, 1)])
        return builder.atomic_rmw("add", pointer, ir.Constant(INT64, 1), "monotonic")

    return types.int64(counter), build
