"""The Triton rasterizer as a differentiable torch operator.

Images are the same bit for bit in every run; gradients are not, because atomic additions come in any order.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from panoless.kernels.gpu import launch
from panoless.kernels.gpu.launch import ELEMENTS_PER_PROGRAM, TileLaunch, programs
from panoless.splats.kernels.gpu.binning import TileLists, tile_lists
from panoless.splats.kernels.gpu.blend import blend
from panoless.splats.kernels.gpu.blend_backward import blend_backward
from panoless.splats.kernels.gpu.project import project
from panoless.splats.kernels.gpu.project_backward import project_backward
from panoless.splats.kernels.gpu.records import GRADIENT_SIZE, RECORD_SIZE


@dataclass(frozen=True)
class Setting:
    """What a forward and its backward share beside tensors."""

    width: int
    height: int
    focal: tuple[float, float]
    center: tuple[float, float]
    near: float
    distance: float
    """far · near / (far − near): m = far/(far − near) − distance / z."""
    curved: bool
    tiles: TileLaunch

    @property
    def tiles_across(self) -> int:
        """Tiles in a row of the image."""
        return -(-self.width // self.tiles.tile)

    @property
    def tile_count(self) -> int:
        """Tiles of the image."""
        return self.tiles_across * -(-self.height // self.tiles.tile)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx, camera, means, quats, scales, opacities, colors, curvatures, screen_offsets):
        given = (means, quats, scales, opacities, colors, curvatures, screen_offsets)
        # A parameter that is not there is never read; any pointer will do.
        parameters = tuple(means.detach() if p is None else p.detach().contiguous() for p in given)
        setting = Setting(
            width=camera.width,
            height=camera.height,
            focal=(float(camera.fx), float(camera.fy)),
            center=(float(camera.cx), float(camera.cy)),
            near=float(camera.near),
            distance=camera.far * camera.near / (camera.far - camera.near),
            curved=curvatures is not None,
            tiles=launch.TILES,
        )
        world_to_camera = camera.world_to_camera.detach().to(means.device, torch.float32).contiguous()
        table, candidates, lists = _find_footprints(
            parameters, world_to_camera, setting, moved=screen_offsets is not None
        )
        image = (setting.height, setting.width)
        outputs = (
            *(means.new_empty(3, *image) for _ in range(2)),
            *(means.new_empty(image) for _ in range(4)),
        )
        saved = means.new_empty(3, *image)
        saved_places = torch.empty(2, *image, dtype=torch.int32, device=means.device)
        blend[(setting.tile_count,)](
            table,
            lists.surfels,
            lists.starts,
            *outputs,
            saved,
            saved_places,
            setting.width,
            setting.height,
            setting.distance,
            CURVED=setting.curved,
            TILE=setting.tiles.tile,
            CHUNK=setting.tiles.chunk,
            num_warps=setting.tiles.warps,
        )
        drawn = candidates > 0
        ctx.mark_non_differentiable(drawn)
        ctx.set_materialize_grads(False)
        ctx.setting = setting
        ctx.save_for_backward(*parameters, world_to_camera, table, candidates, *lists, saved, saved_places)
        return *outputs, drawn

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *cotangents):
        setting: Setting = ctx.setting
        *parameters, world_to_camera, table, candidates, surfels, starts, saved, saved_places = ctx.saved_tensors
        means, quats, scales, opacities, colors, curvatures, _ = parameters
        count = len(means)
        sums = means.new_zeros(count, GRADIENT_SIZE.value)
        blend_backward[(setting.tile_count,)](
            table,
            surfels,
            starts,
            *_cotangent_planes(cotangents[:-1], setting, means),
            saved,
            saved_places,
            sums,
            setting.width,
            setting.height,
            setting.distance,
            CURVED=setting.curved,
            TILE=setting.tiles.tile,
            num_warps=setting.tiles.warps,
        )
        shapes = (means, quats, scales, opacities, colors, means, means[:, :2])
        gradients = [torch.zeros(like.shape, dtype=like.dtype, device=like.device) for like in shapes]
        if count:
            project_backward[programs(count)](
                means,
                quats,
                scales,
                opacities,
                curvatures,
                world_to_camera,
                candidates,
                sums,
                *gradients,
                count,
                *setting.focal,
                CURVED=setting.curved,
                BLOCK=ELEMENTS_PER_PROGRAM,
            )
        needed = ctx.needs_input_grad[1:]
        return None, *(gradient if need else None for gradient, need in zip(gradients, needed, strict=True))


def _find_footprints(
    parameters: tuple[Tensor, ...], world_to_camera: Tensor, setting: Setting, moved: bool
) -> tuple[Tensor, Tensor, TileLists]:
    """Records, candidates (0 for culled surfels) and tile lists."""
    means = parameters[0]
    count, tile = len(means), setting.tiles.tile
    table = means.new_empty(count, RECORD_SIZE.value)
    tile_boxes = torch.empty(count, 4, dtype=torch.int32, device=means.device)
    candidates = torch.empty(count, dtype=torch.int32, device=means.device)
    if count:
        project[programs(count)](
            *parameters,
            world_to_camera,
            table,
            tile_boxes,
            candidates,
            count,
            setting.width,
            setting.height,
            *setting.focal,
            *setting.center,
            setting.near,
            CURVED=setting.curved,
            MOVED=moved,
            TILE=tile,
            BLOCK=ELEMENTS_PER_PROGRAM,
        )
    return table, candidates, tile_lists(table, tile_boxes, candidates, setting.tiles_across, setting.tile_count, tile)


def _cotangent_planes(cotangents, setting: Setting, like: Tensor) -> list[Tensor]:
    """Contiguous gradients of the images; those that do not exist share one block of zeros."""
    zeros = None
    planes = []
    for cotangent in cotangents:
        if cotangent is None and zeros is None:
            zeros = like.new_zeros(3, setting.height, setting.width)
        planes.append(zeros if cotangent is None else cotangent.contiguous())
    return planes


def rasterize_gpu(means, quats, scales, opacities, colors, curvatures, screen_offsets, camera):
    """Rasterize float32 surfels on the GPU; see `panoless.splats.kernels.rasterize.rasterize` for what it computes.

    The first call with a new combination of options compiles for some seconds; Triton caches the result on disk.
    """
    return _Rasterize.apply(camera, means, quats, scales, opacities, colors, curvatures, screen_offsets)
