"""A training view on its way from the source to the copy: light, masks and ground truth change place together."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera
from shinypartial.dataset.perturb import masks, sensor
from shinypartial.dataset.perturb.options import MaskErrors, SensorErrors
from shinypartial.dataset.read import read_whole_view
from shinypartial.dataset.schema import Frame, View

Resampling = Callable[[np.ndarray], np.ndarray]
#: A pixel that is covered less than this shows nothing.
SMALLEST_SHARE = 1e-4


@dataclass(frozen=True)
class Picture:
    """A view that is not yet cut out by its mask.

    `straight` is linear color; `shown` is the share of each pixel in which there is any, which is alpha where nothing
    lies behind the object. The rest is as in `View`; ground truth stays with the object whatever the mask says.
    """

    straight: Float[np.ndarray, "H W 3"]
    shown: Float[np.ndarray, "H W"]
    alpha: Float[np.ndarray, "H W"]
    normals_world: Float[np.ndarray, "H W 3"] | None
    depth: Float[np.ndarray, "H W"] | None
    self_reflection: Float[np.ndarray, "H W"] | None

    @property
    def photograph(self) -> Float[np.ndarray, "H W 3"]:
        """Straight color as the mask has it: darker where that takes in black beside the object."""
        share = np.where(self.alpha > self.shown, self.shown / np.maximum(self.alpha, SMALLEST_SHARE), 1)
        return (self.straight * share[..., None]).astype(np.float32)

    @property
    def view(self) -> View:
        """Cut out by the mask."""
        radiance = (self.photograph * self.alpha[..., None]).astype(np.float32)
        return View(radiance, self.alpha, self.normals_world, self.depth, True, self.self_reflection)


def read_uncut(frame: Frame) -> Picture:
    """Read a view together with what lies beyond its mask."""
    view, straight, shown = read_whole_view(frame)
    return Picture(straight, shown, view.alpha, view.normals_world, view.depth, view.self_reflection)


def shrunk(picture: Picture, scale: float) -> Picture:
    """Smaller by `scale` about the middle of the frame, averaged over areas; black comes in from beyond the border."""
    rows, columns = (_overlaps(size, scale) for size in picture.alpha.shape)
    return _resampled(picture, lambda image: np.einsum("ri,cj,ijk->rck", rows, columns, image, optimize=True))


def shrunk_camera(camera: Camera, scale: float) -> Camera:
    """The camera whose pictures `shrunk` makes: u' = s (u − W/2) + W/2."""
    cx, cy = (
        scale * (center - size / 2) + size / 2
        for center, size in ((camera.cx, camera.width), (camera.cy, camera.height))
    )
    return replace(camera, fx=scale * camera.fx, fy=scale * camera.fy, cx=cx, cy=cy)


def _overlaps(size: int, scale: float) -> Float[np.ndarray, "N N"]:
    """Share of each new pixel (row) that each old one (column) fills when a line of pixels is shrunk."""
    edges = (np.arange(size + 1) - size / 2) / scale + size / 2
    old = np.arange(size)
    common = np.minimum(edges[1:, None], old + 1) - np.maximum(edges[:-1, None], old)
    return (np.clip(common, 0, None) * scale).astype(np.float32)


def _resampled(picture: Picture, sample: Resampling) -> Picture:
    """Everything moved by one linear map of pictures; ground truth is the mean of what the object has there."""
    normals, depth, self_reflection = picture.normals_world, picture.depth, picture.self_reflection
    if normals is not None:
        length = np.linalg.norm(moved := sample(normals), axis=-1, keepdims=True)
        normals = np.where(length > SMALLEST_SHARE, moved / np.maximum(length, SMALLEST_SHARE), 0)
    if depth is not None:
        known = sample((depth > 0)[..., None].astype(np.float32))[..., 0]
        mean = sample(depth[..., None])[..., 0] / np.maximum(known, SMALLEST_SHARE)
        depth = np.where(known > SMALLEST_SHARE, mean, 0)
    if self_reflection is not None:
        self_reflection = (sample(self_reflection[..., None])[..., 0] > 0.5).astype(np.float32)
    return replace(_mixed(picture, sample), normals_world=normals, depth=depth, self_reflection=self_reflection)


def _mixed(picture: Picture, sample: Resampling) -> Picture:
    """Light and masks alone, weighted by what the pixels show."""
    stacked = np.dstack([picture.straight * picture.shown[..., None], picture.shown, picture.alpha])
    light, shown, alpha = np.split(sample(stacked.astype(np.float32)), (3, 4), axis=-1)
    straight = np.where(shown > SMALLEST_SHARE, light / np.maximum(shown, SMALLEST_SHARE), 0)
    return replace(picture, straight=straight, shown=shown[..., 0], alpha=alpha[..., 0].clip(0, 1))


def cropped(picture: Picture, margin_px: int) -> Picture:
    """Without that many pixels on the left."""
    arrays = {name: array for name, array in vars(picture).items() if array is not None}
    return replace(picture, **{name: array[:, margin_px:] for name, array in arrays.items()})


def cropped_camera(camera: Camera, margin_px: int) -> Camera:
    """The camera of a cropped picture."""
    return replace(camera, cx=camera.cx - margin_px, width=camera.width - margin_px)


def through_lens(picture: Picture, camera: Camera, options: SensorErrors) -> Picture:
    """Blurred, distorted and vignetted; `camera` is the true one."""
    if options.blur_px:
        picture = _mixed(picture, lambda image: sensor.blur(image, options.blur_px))
    if options.k1:
        places = sensor.undistorted_pixels(camera, options.k1)
        picture = _resampled(picture, lambda image: sensor.warp(image, places))
    gain = sensor.vignette_gain(camera.height, camera.width, options.vignette_stops)
    return replace(picture, straight=(picture.straight * gain[..., None]).astype(np.float32))


def recorded(
    picture: Picture, stops: Float[np.ndarray, "3"], options: SensorErrors, random: np.random.Generator
) -> Picture:
    """Exposed by so many stops in each channel, with the sensor's noise."""
    straight = (picture.straight * 2.0**stops).astype(np.float32)
    if options.shot_noise or options.read_noise:
        straight = sensor.add_noise(straight, options.shot_noise, options.read_noise, random)
    return replace(picture, straight=straight)


def masked_wrongly(picture: Picture, options: MaskErrors, is_empty: bool, random: np.random.Generator) -> Picture:
    """With another mask; ground truth stays."""
    alpha, (wobble, shift) = picture.alpha, random.spawn(2)  # Holes and blobs stay where they were.
    if options.erode_px:
        alpha = masks.eroded(alpha, options.erode_px)
    if options.dilate_px:
        alpha = masks.dilated(alpha, options.dilate_px)
    if options.offset_px:
        offset = shift.uniform(-options.offset_px, options.offset_px)
        alpha = masks.dilated(alpha, offset) if offset > 0 else masks.eroded(alpha, -offset)
    if options.wobble_px:
        alpha = masks.wobbling(alpha, options.wobble_px, wobble)
    alpha_before = alpha
    if options.holes:
        alpha = masks.with_holes(alpha_before, options.holes, random)
    if options.stray:  # Blobs lie outside of the silhouette, so none fills a hole.
        alpha = alpha + masks.with_stray_blobs(alpha_before, options.stray, random) - alpha_before
    alpha = np.zeros_like(alpha) if is_empty else alpha.clip(0, 1).astype(np.float32)
    return replace(picture, alpha=alpha)
