"""Triples of blocks: vectors and rotations inside kernels."""

import triton
import triton.language as tl


@triton.jit
def dot(a, b):
    """Scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """Vector product of two triples."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@triton.jit
def scaled(a, s):
    """A triple times a number each."""
    return a[0] * s, a[1] * s, a[2] * s


@triton.jit
def added(a, b):
    """Sum of two triples."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@triton.jit
def load_rotation(world_to_camera):
    """The three rows of the rotation in a 4×4 matrix."""
    row_1, row_2 = world_to_camera + 4, world_to_camera + 8
    return (
        (tl.load(world_to_camera), tl.load(world_to_camera + 1), tl.load(world_to_camera + 2)),
        (tl.load(row_1), tl.load(row_1 + 1), tl.load(row_1 + 2)),
        (tl.load(row_2), tl.load(row_2 + 1), tl.load(row_2 + 2)),
    )


@triton.jit
def load_translation(world_to_camera):
    """The last column of a 4×4 matrix without its last number."""
    return tl.load(world_to_camera + 3), tl.load(world_to_camera + 7), tl.load(world_to_camera + 11)


@triton.jit
def rotate(rows, a):
    """World to camera, directions."""
    return dot(rows[0], a), dot(rows[1], a), dot(rows[2], a)


@triton.jit
def rotate_back(rows, a):
    """Camera to world, directions; also the adjoint of `rotate`."""
    return added(added(scaled(rows[0], a[0]), scaled(rows[1], a[1])), scaled(rows[2], a[2]))


@triton.jit
def load_vector(pointers, mask):
    """Three consecutive numbers each; 0 outside the mask."""
    return (
        tl.load(pointers, mask=mask, other=0.0),
        tl.load(pointers + 1, mask=mask, other=0.0),
        tl.load(pointers + 2, mask=mask, other=0.0),
    )


@triton.jit
def store_vector(pointers, mask, a):
    """Store a triple as three consecutive numbers each."""
    tl.store(pointers, a[0], mask=mask)
    tl.store(pointers + 1, a[1], mask=mask)
    tl.store(pointers + 2, a[2], mask=mask)
