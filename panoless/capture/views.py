"""Dataset folder → training views: cropped tensors with cameras in a normalized frame."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from panoless.capture.background import Background
from panoless.capture.encoding import LDR, RadianceEncoding
from panoless.capture.ground import Ground, SeenGround, ground_of, seen_ground
from panoless.capture.masks import MASK_LEVEL, estimate_object_frame, without_specks
from panoless.capture.object_frame import ObjectFrame
from panoless.capture.rays import pose_of, raster_camera, unit_rays_camera
from panoless.kernels.camera import RasterCamera
from shinypartial.core.camera import Camera
from shinypartial.core.conventions import SOLID_ALPHA
from shinypartial.core.errors import InputError
from shinypartial.dataset.read import read_statement, read_view, read_whole_view
from shinypartial.dataset.schema import Dataset
from shinypartial.io.progress import Progress

#: Of the views, this one in turn is held out to judge by.
HELD_OUT_EVERY = 5
SIZED_VIEWS = 5
"""From so many views at most the size of the object is taken."""
NAMED_VIEWS = 5
"""So many of the views with empty masks are named at most."""
Item = TypeVar("Item")


@dataclass(frozen=True)
class Photograph:
    """A picture around its object, in world coordinates. Radiance is as in `TrainView`."""

    camera: Camera
    radiance: Float[Tensor, "3 H W"]
    mask: Float[Tensor, "H W"]
    pose_covariance: Float[np.ndarray, "6 6"] | None = None


@dataclass(frozen=True)
class TrainView:
    """One cropped training view. Radiance is linear, premultiplied, clipped to [0, 1].

    Under another `RadianceEncoding` than the usual one its encoding stands in place of radiance.
    """

    camera: RasterCamera
    radiance: Float[Tensor, "3 H W"]
    mask: Float[Tensor, "H W"]
    solid: Int[Tensor, "P"]
    """Flat indices of the pixels that lie wholly on the object."""
    pose_covariance: Float[np.ndarray, "6 6"] | None = None
    """Of the camera's turn (rad, world axes) and shift (normalized frame), where the dataset states it."""

    def to(self, device: torch.device) -> "TrainView":
        """The same view on a device."""
        return replace(
            self,
            camera=replace(self.camera, world_to_camera=self.camera.world_to_camera.to(device)),
            radiance=self.radiance.to(device),
            mask=self.mask.to(device),
            solid=self.solid.to(device),
        )

    @property
    def rays_camera(self) -> Float[Tensor, "3 H W"]:
        """Unit ray directions in the camera frame through pixel centers, made again: a view is 16 bytes a pixel."""
        return unit_rays_camera(self.camera, self.mask.device)

    def directions_world(self, pixels: Int[Tensor, "P"]) -> Float[Tensor, "P 3"]:
        """Unit world directions of the rays through the centers of pixels (flat indices)."""
        return (self.camera_to_world_rotation @ self.rays_camera.flatten(1)[:, pixels]).T.contiguous()

    def radiance_at(self, pixels: Int[Tensor, "P"]) -> Float[Tensor, "P 3"]:
        """What pixels (flat indices) show."""
        return self.radiance.flatten(1)[:, pixels.to(self.radiance.device)].T.contiguous()

    @property
    def camera_to_world_rotation(self) -> Float[Tensor, "3 3"]:
        """Rotates camera directions into the world: R of the pose."""
        return self.camera.world_to_camera[:3, :3].T

    @property
    def position(self) -> Float[np.ndarray, "3"]:
        """Camera center in the normalized frame."""
        return pose_of(self.camera)[1]


@dataclass(frozen=True)
class MaskRepairs:
    """What other views contradicted in masks, and was mended."""

    holes: int = 0
    """Holes that were filled."""
    pieces: int = 0
    """Pieces that were removed."""
    views: int = 0
    """Views in which that was done."""


@dataclass(frozen=True)
class Views:
    """All training views of a dataset and the frame they live in."""

    train: tuple[TrainView, ...]
    object_frame: ObjectFrame
    near: float
    """Near plane in normalized units: a tenth of the smallest camera distance."""
    repairs: MaskRepairs = MaskRepairs()
    blur_px: float = 0.0
    """Standard deviation of a Gaussian that blurred the pictures, in pixels of the views."""
    background: Background | None = None
    """What was seen past the object, where that is data for the map, too."""
    ground: Ground | None = None
    """What the object stands on, where that is stated."""
    mask_sigma_px: float = 0.0
    """Standard deviation of the masks' contours, where they are stated as rough."""
    focal_sigma: float | None = None
    """Standard deviation of the stated focal length, as a share of it; None: it is not stated."""

    @property
    def num_solid(self) -> int:
        """Number of pixels that lie wholly on the object."""
        return sum(len(view.solid) for view in self.train)

    @property
    def camera_extent(self) -> float:
        """1.1 × the largest distance of a camera from the cameras' mean (Kerbl et al. 2023), in normalized units."""
        positions = np.stack([view.position for view in self.train])
        return 1.1 * float(np.linalg.norm(positions - positions.mean(0), axis=1).max())

    def to(self, device: torch.device) -> "Views":
        """The same views on a device."""
        background = None if self.background is None else self.background.to(device)
        ground = None if self.ground is None else replace(self.ground, light=self.ground.light.to(device))
        train = tuple(view.to(device) for view in self.train)
        return replace(self, train=train, background=background, ground=ground)


def load_views(
    dataset: Dataset,
    crop_margin_px: int,
    downscale: int = 1,
    encoding: RadianceEncoding = LDR,
    least_object_px: float = 0.0,
    known_radius: float = 0.0,
) -> Views:
    """Read the training split, averaged over blocks of `downscale` pixels a side, its radiance encoded.

    Blocks are smaller where the object, the root of its area, would have fewer than `least_object_px` pixels across.
    Raises InputError for unreadable images and for masks that are all empty.
    """
    progress = Progress("reading views", len(dataset.train))
    photographs, empty, seen = list[Photograph](), list[str](), list[SeenGround]()
    stated = read_statement(dataset)
    plane = stated.ground
    downscale = max(1, min(downscale, int(_object_px(dataset) / least_object_px))) if least_object_px else downscale
    for frame in dataset.train:
        if plane is None:
            view = read_view(frame)
        else:
            view, color, shown = read_whole_view(frame)
        alpha = _block_means(np.clip(view.alpha, 0, 1), downscale)
        if (alpha >= MASK_LEVEL).any():
            radiance = encoding.encoded(_block_means(encoding.clipped(frame, view), downscale), alpha)
            camera = frame.camera.downscaled(downscale)
            if plane is not None:
                whole = replace(view, radiance=color, alpha=shown)
                light = encoding.encoded(_block_means(encoding.clipped(frame, whole), downscale))
                seen.append(seen_ground(camera, light, alpha, _block_means(shown, downscale), plane))
            photograph = cropped(camera, radiance, alpha, crop_margin_px)
            photographs.append(replace(photograph, pose_covariance=frame.pose_covariance))
        else:
            empty.append(frame.name)
        progress.advance()
    if empty:
        more = f" and {len(empty) - NAMED_VIEWS} more" if len(empty) > NAMED_VIEWS else ""
        raise InputError(
            expected="the object in every training view: some mask pixel of at least one half",
            found=f"{len(empty)} of {len(dataset.train)} masks empty: {', '.join(empty[:NAMED_VIEWS])}{more}",
            remedy="Correct these masks, or remove their frames from transforms_train.json.",
        )
    sigma_px = stated.mask_sigma_px / downscale
    views = replace(views_of(photographs, known_radius), focal_sigma=stated.focal_sigma, mask_sigma_px=sigma_px)
    return views if plane is None else replace(views, ground=ground_of(plane, views.object_frame, seen))


def _object_px(dataset: Dataset) -> float:
    """√area of the object's mask: the median over a few views."""
    views = dataset.train[:: -(-len(dataset.train) // SIZED_VIEWS)]
    return float(np.median([np.sqrt(read_view(frame).alpha.clip(0, 1).sum()) for frame in views]))


def views_of(photographs: Sequence[Photograph], known_radius: float = 0.0) -> Views:
    """The same pictures in the normalized frame that their masks determine; see `estimate_object_frame`."""
    masks = [(photograph.camera, photograph.mask.numpy()) for photograph in photographs]
    object_frame = estimate_object_frame(masks, known_radius)
    near = 0.1 * min(
        float(np.linalg.norm(photograph.camera.position_world - object_frame.center)) / object_frame.radius
        for photograph in photographs
    )
    train = tuple(
        TrainView(
            camera=raster_camera(photograph.camera, object_frame, near),
            radiance=photograph.radiance,
            mask=photograph.mask,
            solid=torch.nonzero(photograph.mask.flatten() > SOLID_ALPHA)[:, 0],
            pose_covariance=object_frame.pose_covariance(photograph.pose_covariance),
        )
        for photograph in photographs
    )
    return Views(train, object_frame, near)


def concatenated(parts: Sequence[Item]) -> Item:
    """Dataclasses of arrays as one: each field's arrays one after the other."""
    names = [item.name for item in fields(parts[0])]  # type: ignore[arg-type]
    return type(parts[0])(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def split_held_out(views: Sequence[Item]) -> tuple[list[Item], list[Item]]:
    """Things that stand for the views: four fifths to solve from, and every fifth to predict."""
    phase = HELD_OUT_EVERY // 2
    return [view for i, view in enumerate(views) if i % HELD_OUT_EVERY != phase], list(views[phase::HELD_OUT_EVERY])


def held_out_parts(views: Views) -> tuple[Views, Views] | None:
    """Four fifths of the views, and the others; None where there are too few."""
    kept, held_out = split_held_out(views.train)
    if not kept or not held_out:
        return None
    return replace(views, train=tuple(kept)), replace(views, train=tuple(held_out))


def every_kth_pixel(views: Views, most: int) -> Iterator[tuple[TrainView, Int[Tensor, "P"]]]:
    """About `most` pixels of all views that lie wholly on the object, and less than twice as many."""
    return _pixels_at(views, views.num_solid // most)


def at_most_pixels(views: Views, most: int) -> Iterator[tuple[TrainView, Int[Tensor, "P"]]]:
    """No more than about `most` pixels of all views that lie wholly on the object, and more than half as many."""
    return _pixels_at(views, -(-views.num_solid // most))


def _pixels_at(views: Views, stride: int) -> Iterator[tuple[TrainView, Int[Tensor, "P"]]]:
    """Every k-th solid pixel, beginning elsewhere in each view; all for a stride of zero."""
    stride = max(stride, 1)
    for index, view in enumerate(views.train):
        yield view, view.solid[index % stride :: stride]


def _block_means(image: Float[np.ndarray, "H W *C"], side: int) -> Float[np.ndarray, "h w *C"]:
    """Means over squares of `side` pixels; what is left over at the right and at the bottom is cut off."""
    if side == 1:
        return image
    height, width = (size // side for size in image.shape[:2])
    whole = image[: height * side, : width * side]
    return whole.reshape(height, side, width, side, *image.shape[2:]).mean((1, 3))


def cropped(
    camera: Camera, radiance: Float[np.ndarray, "H W 3"], alpha: Float[np.ndarray, "H W"], margin_px: int
) -> Photograph:
    """The picture around its object, without specks; a negative margin leaves it whole.

    A margin is at least a pixel, so that a mask touches the border of the crop only where it touches the picture's.
    """
    clean = without_specks(alpha)
    if clean is not alpha:
        radiance, alpha = radiance * (clean > 0)[..., None], clean
    if margin_px >= 0:
        margin = max(margin_px, 1)
        rows, columns = np.nonzero(alpha.any(1))[0], np.nonzero(alpha.any(0))[0]
        top, left = (max(int(places[0]) - margin, 0) for places in (rows, columns))
        bottom = min(int(rows[-1]) + 1 + margin, camera.height)
        right = min(int(columns[-1]) + 1 + margin, camera.width)
        radiance, alpha = radiance[top:bottom, left:right], alpha[top:bottom, left:right]
        center = camera.cx - left, camera.cy - top
        camera = Camera(camera.camera_to_world, camera.fx, camera.fy, *center, right - left, bottom - top)
    # Copies, so that nothing keeps the whole picture.
    planes, mask = (np.array(image, np.float32, order="C") for image in (radiance.transpose(2, 0, 1), alpha))
    return Photograph(camera, torch.from_numpy(planes), torch.from_numpy(mask))
