"""The Numba rasterizer as a differentiable torch operator.

Memory between a forward and its backward belongs to that forward alone, so several may be in flight; buffers that
nothing refers to any more are used again. Results are the same bit for bit whatever the number of threads.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from panoless.kernels.cpu import records as rec
from panoless.kernels.cpu.binning import count_entries, fill_tiles, sort_by_depth
from panoless.kernels.cpu.blend import SAVED_SIZE, Planes, blend_curved, blend_flat
from panoless.kernels.cpu.blend_backward import blend_curved_backward, blend_flat_backward
from panoless.kernels.cpu.buffers import take
from panoless.kernels.cpu.project import project
from panoless.kernels.cpu.project_backward import project_backward
from panoless.kernels.cpu.simd import LANES
from panoless.kernels.cpu.workers import run_shared

_PARAMETER_WIDTHS = (3, 4, 2, 1, 3, 3, 2)
"""Columns of means, quats, scales, opacities, colors, curvatures and screen offsets."""


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
    def bins(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Where each tile's list starts, the surfels on the lists, and the longest list's length."""
        return self.tile_starts, self.entry_surfels, self.longest


@dataclass(frozen=True)
class Saved:
    """What a backward needs beside the inputs and the images."""

    footprints: Footprints
    camera: np.ndarray
    camera_plane: tuple[int, int, np.float32]
    moments: np.ndarray
    masks: np.ndarray
    curved: bool


def _camera_array(camera) -> np.ndarray:
    matrix = camera.world_to_camera.detach().cpu().numpy()
    packed = np.empty(rec.CAMERA_SIZE, np.float32)
    packed[: rec.CAMERA_TRANSLATION] = matrix[:3, :3].ravel()
    packed[rec.CAMERA_TRANSLATION : rec.CAMERA_FX] = matrix[:3, 3]
    packed[rec.CAMERA_FX :] = camera.fx, camera.fy, camera.cx, camera.cy, camera.near
    return packed


def _find_footprints(surfels, camera_array, width, height, curved) -> Footprints:
    count = surfels[3].size
    table = take((count, rec.RECORD_SIZE))
    keys = take((count,), np.uint32)
    tile_ranges = take((count, 4), np.int32)
    run_shared(project, surfels, camera_array, width, height, curved, table, keys, tile_ranges)
    tiles_across = -(-width // rec.TILE)
    tile_starts = np.empty(tiles_across * -(-height // rec.TILE) + 1, np.int64)
    slot_starts = take((count + 1,), np.int64)
    longest = count_entries(keys, tile_ranges, tiles_across, tile_starts, slot_starts)
    order = take((count,), np.int32)
    spares = take((count,), np.int32), take((count,), np.uint32), take((count,), np.uint32)
    drawn = sort_by_depth(keys, order, *spares)
    entry_surfels = take((int(tile_starts[-1]),), np.int32)
    entry_slots = take((int(tile_starts[-1]),), np.int32)
    fill_tiles(order, drawn, tile_ranges, tiles_across, tile_starts, slot_starts, entry_surfels, entry_slots)
    return Footprints(table, tile_starts, slot_starts, entry_surfels, entry_slots, longest, keys != rec.CULLED)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, means, quats, scales, opacities, colors, curvatures, screen_offsets):
        parameters = (means, quats, scales, opacities, colors, curvatures, screen_offsets)
        surfels = _as_arrays(parameters)
        curved = curvatures is not None
        width, height = camera.width, camera.height
        camera_array = _camera_array(camera)
        footprints = _find_footprints(surfels, camera_array, width, height, curved)
        distance = np.float32(camera.far * camera.near / (camera.far - camera.near))
        camera_plane = width, height, distance
        image = (height, width)
        planes = Planes(take((3, *image)), take((3, *image)), take(image), take(image), take(image), take(image))
        moments = take((footprints.tile_starts.size - 1, LANES, SAVED_SIZE, LANES))
        masks = take((footprints.entry_surfels.size,), np.uint16)
        kernel = blend_curved if curved else blend_flat
        run_shared(kernel, footprints.table, footprints.bins, camera_plane, planes, moments, masks)
        outputs = tuple(torch.from_numpy(plane) for plane in planes)
        drawn = torch.from_numpy(footprints.drawn)
        ctx.mark_non_differentiable(drawn)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*parameters, *outputs)
        ctx.saved = Saved(footprints, camera_array, camera_plane, moments, masks, curved)
        return *outputs, drawn

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *cotangents):
        saved: Saved = ctx.saved
        parameters = ctx.saved_tensors[: len(_PARAMETER_WIDTHS)]
        outputs = Planes(*(tensor.numpy() for tensor in ctx.saved_tensors[len(_PARAMETER_WIDTHS) :]))
        footprints = saved.footprints
        size = rec.CURVED_GRADIENT_SIZE if saved.curved else rec.FLAT_GRADIENT_SIZE
        slots = take((footprints.entry_surfels.size, size))
        kernel = blend_curved_backward if saved.curved else blend_flat_backward
        run_shared(
            kernel,
            footprints.table,
            footprints.bins,
            saved.camera_plane,
            outputs,
            _cotangent_planes(cotangents[:-1], outputs),
            saved.moments,
            saved.masks,
            footprints.entry_slots,
            slots,
        )
        gradients = _zero_gradients(parameters)
        run_shared(
            project_backward,
            _as_arrays(parameters),
            saved.camera,
            saved.curved,
            slots,
            footprints.slot_starts,
            tuple(gradient.numpy() for gradient in gradients),
        )
        needed = (
            gradient if need and parameter is not None else None
            for gradient, need, parameter in zip(gradients, ctx.needs_input_grad[1:], parameters, strict=True)
        )
        return None, *needed


def _as_arrays(parameters: tuple[Tensor | None, ...]) -> tuple[np.ndarray, ...]:
    """Contiguous arrays; curvatures that are not there are never read, and missing offsets are zero."""
    count = parameters[0].shape[0]
    arrays = []
    for parameter, width in zip(parameters, _PARAMETER_WIDTHS, strict=True):
        if parameter is None:
            arrays.append(np.zeros(count * width, np.float32))
        else:
            arrays.append(parameter.detach().contiguous().numpy().reshape(-1))
    return tuple(arrays)


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


def _zero_gradients(parameters) -> tuple[Tensor, ...]:
    count = parameters[0].shape[0]
    gradients = []
    for parameter, width in zip(parameters, _PARAMETER_WIDTHS, strict=True):
        array = take((count, width) if parameter is None else tuple(parameter.shape))
        array[:] = 0
        gradients.append(torch.from_numpy(array))
    return tuple(gradients)


def rasterize_cpu(means, quats, scales, opacities, colors, curvatures, screen_offsets, camera):
    """Rasterize float32 surfels on the CPU; see `panoless.kernels.rasterize.rasterize` for what it computes.

    The first call in a fresh installation compiles for some seconds; the result is cached on disk.
    """
    return _Rasterize.apply(camera, means, quats, scales, opacities, colors, curvatures, screen_offsets)
