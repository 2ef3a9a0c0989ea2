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
    lanes_type,
    mask_type,
    splat,
)

_ROW = ir.VectorType(FLOAT, 4)


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
def fetch_add(typingctx, counter, amount):
    """Add `amount` to element 0 of an int64 array atomically and return the value before."""

    def build(context, builder, sig, args):
        pointer = context.make_array(sig.args[0])(context, builder, args[0]).data
        return builder.atomic_rmw("add", pointer, args[1], "monotonic")

    return types.int64(counter, types.int64), build
