"""What the objective compares one view with, and the tiles in which it does."""

from dataclasses import dataclass

from jaxtyping import Bool
from torch import Tensor

from panoless.capture.views import TrainView
from panoless.splats.kernels.objective import MirrorView
from panoless.splats.kernels.rasterize import tiles_of
from shinypartial.core.conventions import SOLID_ALPHA


@dataclass(frozen=True)
class Target:
    """Of one view, made once for all steps."""

    mirror: MirrorView
    """The photograph, its mask and its camera."""
    solid_tiles: Bool[Tensor, "tile_rows tile_columns"]
    """Tiles of the rasterizer with a pixel that lies wholly on the object."""
    mask_tiles: Bool[Tensor, "tile_rows tile_columns"]
    """Tiles of the rasterizer within a pixel of the mask."""

    @classmethod
    def of(cls, view: TrainView) -> "Target":
        """That of a view."""
        camera, rotation = view.camera, view.camera_to_world_rotation.contiguous()
        intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
        mirror = MirrorView(view.radiance, view.mask, rotation, *intrinsics, solid_alpha=SOLID_ALPHA)
        return cls(mirror, tiles_of(view.mask > SOLID_ALPHA), tiles_of(view.mask > 0, margin_px=1))
