"""The Numba rasterizer as a differentiable torch operator.

Memory between a forward and its backward belongs to that forward alone, so several may be in flight; buffers that
nothing refers to any more are used again. Results are the same bit for bit whatever the number of threads.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from panoless.kernels.cpu.simd import LANES
from panoless.kernels.cpu.workers import run_shared, thread_count
from panoless.splats.kernels.cpu import records as rec
from panoless.splats.kernels.cpu.binning import count_entries, fill_tiles, sort_by_depth
from panoless.splats.kernels.cpu.blend import CHUNK, FRAGMENT_SIZE, NO, YES, Features, Planes, blend
from panoless.splats.kernels.cpu.blend_backward import PULLED_SIZE, blend_backward
from panoless.splats.kernels.cpu.buffers import take
from panoless.splats.kernels.cpu.project import project
from panoless.splats.kernels.cpu.project_backward import project_backward

_PARAMETERS = 7
"""Means, quats, scales, opacities, colors, curvatures and screen offsets."""
_NOTHING = np.zeros(0, np.float32)


@dataclass(frozen=True)
class Footprints:
    """The projected surfels, sorted into tiles."""

    table: np.ndarray
    tile_starts: np.ndarray
    slot_starts: np.ndarray
    entry_surfels: np.ndarray
    entry_slots: np.ndarray
    longest: int
    drawn: np.ndarray

    @property
    def bins(self) -> tuple[np.ndarray, np.ndarray]:
        """Where each tile's list starts, and the surfels on the lists."""
        return self.tile_starts, self.entry_surfels

    @property
    def positions(self) -> np.ndarray:
        """Scratch for the list of a block, one row a thread."""
        return take((thread_count(), self.longest + LANES), np.int32)


@dataclass(frozen=True)
class Saved:
    """What a backward needs beside the inputs and the images."""

    footprints: Footprints
    camera: np.ndarray
    camera_plane: tuple[int, int, np.float32]
    blocks: np.ndarray
    masks: np.ndarray
    features: Features


def _camera_array(camera) -> np.ndarray:
    matrix = camera.world_to_camera.detach().cpu().numpy()
    packed = np.empty(rec.CAMERA_SIZE, np.float32)
    packed[: rec.CAMERA_TRANSLATION] = matrix[:3, :3].ravel()
    packed[rec.CAMERA_TRANSLATION : rec.CAMERA_FX] = matrix[:3, 3]
    packed[rec.CAMERA_FX :] = camera.fx, camera.fy, camera.cx, camera.cy, camera.near
    return packed


def _find_footprints(surfels, camera_array, width, height, curved, active) -> Footprints:
    """Project the surfels and sort them into the tiles that are `active` (flat; None for all)."""
    count = surfels[3].size
    table = take((count, rec.RECORD_SIZE))
    keys = take((count,), np.uint32)
    tile_ranges = take((count, 4), np.int32)
    scratch = take((thread_count(), 5, LANES))
    run_shared(project, surfels, camera_array, width, height, curved, table, keys, tile_ranges, scratch)
    tiles_across = -(-width // rec.TILE)
    tiles = tiles_across * -(-height // rec.TILE)
    active = np.ones(tiles, np.bool_) if active is None else active
    tile_starts = np.empty(tiles + 1, np.int64)
    slot_starts = take((count + 1,), np.int64)
    longest = count_entries(keys, tile_ranges, tiles_across, active, tile_starts, slot_starts)
    order = take((count,), np.int32)
    spares = take((count,), np.int32), take((count,), np.uint32), take((count,), np.uint32)
    drawn = sort_by_depth(keys, order, *spares)
    entry_surfels = take((int(tile_starts[-1]),), np.int32)
    entry_slots = take((int(tile_starts[-1]),), np.int32)
    lists = tile_starts, slot_starts, entry_surfels, entry_slots
    fill_tiles(order, drawn, tile_ranges, tiles_across, active, *lists)
    return Footprints(table, *lists, longest, keys != rec.CULLED)


def _empty_planes(image: tuple[int, int], features: Features) -> Planes:
    """Memory for the images; those that nobody wants have no pixels."""

    def plane(wanted, *channels):
        return take((*channels, *image)) if wanted else np.zeros((*channels, 0, 0), np.float32)

    return Planes(
        colors=plane(features.colors, 3),
        normals=plane(YES, 3),
        depth=plane(features.depth),
        alpha=plane(YES),
        median=plane(features.depth),
        distortion=plane(features.distortion),
    )


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, channels, active, means, quats, scales, opacities, colors, curvatures, screen_offsets):
        parameters = (means, quats, scales, opacities, colors, curvatures, screen_offsets)
        surfels = _as_arrays(parameters)
        wanted = (curvatures is not None, channels.colors, channels.depth, channels.distortion)
        features = Features(*(YES if want else NO for want in wanted))
        width, height = camera.width, camera.height
        camera_array = _camera_array(camera)
        footprints = _find_footprints(surfels, camera_array, width, height, curvatures is not None, active)
        distance = np.float32(camera.far * camera.near / (camera.far - camera.near))
        camera_plane = width, height, distance
        planes = _empty_planes((height, width), features)
        vectors = 3 if channels.distortion else 1
        blocks = take((footprints.tile_starts.size - 1, LANES, vectors, LANES))
        masks = take((footprints.entry_surfels.size + LANES,), np.uint16)
        scene = features, footprints.table, footprints.bins, camera_plane
        chunks = take((thread_count(), CHUNK * FRAGMENT_SIZE, LANES))
        run_shared(blend, *scene, planes, blocks, masks, footprints.positions, chunks)
        outputs = tuple(torch.from_numpy(plane) for plane in planes)
        drawn = torch.from_numpy(footprints.drawn)
        ctx.mark_non_differentiable(drawn)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*parameters, *outputs)
        ctx.saved = Saved(footprints, camera_array, camera_plane, blocks, masks, features)
        return *outputs, drawn

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *cotangents):
        saved: Saved = ctx.saved
        parameters = ctx.saved_tensors[:_PARAMETERS]
        outputs = Planes(*(tensor.numpy() for tensor in ctx.saved_tensors[_PARAMETERS:]))
        footprints = saved.footprints
        curved = bool(saved.features.curved)
        size = rec.CURVED_GRADIENT_SIZE if curved else rec.FLAT_GRADIENT_SIZE
        slots = take((footprints.entry_surfels.size, size))
        rows = take((thread_count(), footprints.longest, 2 * LANES if curved else LANES))
        run_shared(
            blend_backward,
            saved.features,
            footprints.table,
            footprints.bins,
            saved.camera_plane,
            outputs,
            _cotangent_planes(cotangents[:-1], outputs),
            saved.blocks,
            saved.masks,
            footprints.entry_slots,
            slots,
            footprints.positions,
            take((thread_count(), CHUNK * PULLED_SIZE, LANES)),
            rows,
        )
        needed = list(ctx.needs_input_grad[-_PARAMETERS:])
        needed[_COLORS] &= bool(saved.features.colors)
        gradients = _zero_gradients(parameters, needed)
        run_shared(
            project_backward,
            _as_arrays(parameters),
            saved.camera,
            curved,
            slots,
            footprints.slot_starts,
            tuple(gradient.numpy() for gradient in gradients),
            take((thread_count(), LANES + 1, size)),
        )
        return None, None, None, *(g if need else None for g, need in zip(gradients, needed, strict=True))


def _as_arrays(parameters: tuple[Tensor | None, ...]) -> tuple[np.ndarray, ...]:
    """Flat contiguous arrays; empty for what is not there."""
    return tuple(
        _NOTHING if parameter is None else parameter.detach().contiguous().numpy().reshape(-1)
        for parameter in parameters
    )


def _cotangent_planes(cotangents, outputs: Planes) -> Planes:
    """Contiguous gradients of the images; those that do not exist share one plane of zeros."""
    zeros = None
    planes = []
    for cotangent, output in zip(cotangents, outputs, strict=True):
        if cotangent is not None:
            planes.append(cotangent.contiguous().numpy())
            continue
        if zeros is None:
            zeros = take(outputs.colors.shape)
            zeros[:] = 0
        planes.append(zeros if output.ndim == 3 else zeros[0])
    return Planes(*planes)


_COLORS = 4
_OPTIONAL_GRADIENTS = {_COLORS, 5, 6}
"""Places of colors, curvatures and screen offsets, whose gradients the kernel leaves out where nobody needs them."""


def _zero_gradients(parameters, needed) -> tuple[Tensor, ...]:
    gradients = []
    for place, (parameter, need) in enumerate(zip(parameters, needed, strict=True)):
        if place in _OPTIONAL_GRADIENTS and not need:
            gradients.append(torch.from_numpy(_NOTHING))
            continue
        array = take(tuple(parameter.shape))
        array[:] = 0
        gradients.append(torch.from_numpy(array))
    return tuple(gradients)


def rasterize_cpu(means, quats, scales, opacities, colors, curvatures, screen_offsets, camera, channels, active_tiles):
    """Rasterize float32 surfels on the CPU; see `panoless.splats.kernels.rasterize.rasterize` for what it computes.

    The first call in a fresh installation compiles for some seconds; the result is cached on disk. Images of channels
    that are not wanted have no pixels.
    """
    active = None if active_tiles is None else active_tiles.numpy().reshape(-1)
    surfels = means, quats, scales, opacities, colors, curvatures, screen_offsets
    return _Rasterize.apply(camera, channels, active, *surfels)
