"""What a lens, a sensor and a file do to linear light, as pure functions on arrays.

In the order of a camera: blur and distortion, vignette, exposure and white balance, noise, clipping and coding.
"""

import numpy as np
from jaxtyping import Float

from shinypartial.core.camera import Camera
from shinypartial.core.conventions import PIXEL_CENTER
from shinypartial.core.errors import InputError

#: Radii at which the distortion is tabulated for its inverse; linear interpolation is then exact to 1e-7.
TABLE_SIZE = 20_000
#: Distorted radii are met within this multiple of themselves, or the lens folds the picture.
TABLE_REACH = 4.0


def blur(image: Float[np.ndarray, "H W C"], sigma_px: float) -> Float[np.ndarray, "H W C"]:
    """Gaussian blur; beyond the border the outermost pixels continue."""
    from scipy.ndimage import gaussian_filter

    return gaussian_filter(image, (sigma_px, sigma_px, 0), mode="nearest")


def undistorted_pixels(camera: Camera, k1: float) -> Float[np.ndarray, "2 H W"]:
    """Where (row, column) in a pinhole picture each pixel of the distorted one looks, in array indices.

    OpenCV's radial model: a point at (x, y) in front of the pinhole camera appears at (x, y)·(1 + k1 r²),
    r² = x² + y². Raises InputError when some of the picture has no such point: the distortion folds it.
    """
    y, x = np.indices((camera.height, camera.width)) + PIXEL_CENTER
    x, y = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    distorted = np.hypot(x, y)
    radius = np.linspace(0, TABLE_REACH * distorted.max(), TABLE_SIZE)
    image = radius * (1 + k1 * radius**2)
    beyond = np.flatnonzero(image > distorted.max())
    end = beyond[0] + 1 if beyond.size else 0
    if end == 0 or (np.diff(image[:end]) <= 0).any():
        raise InputError(
            expected="a distortion whose radius grows out to the corners of the picture",
            found=f"k1 = {k1:g}, which folds it",
            remedy="Lower --sensor.k1.",
        )
    scale = np.interp(distorted, image[:end], radius[:end]) / np.maximum(distorted, 1e-12)
    column, row = x * scale * camera.fx + camera.cx, y * scale * camera.fy + camera.cy
    return np.stack([row, column]) - PIXEL_CENTER


def warp(image: Float[np.ndarray, "H W C"], places: Float[np.ndarray, "2 H W"]) -> Float[np.ndarray, "H W C"]:
    """The picture looked up bilinearly at (row, column) array indices; zero outside of it."""
    from scipy.ndimage import map_coordinates

    planes = [map_coordinates(plane, places, order=1, mode="constant") for plane in np.moveaxis(image, -1, 0)]
    return np.stack(planes, -1).astype(image.dtype)


def vignette_gain(height: int, width: int, corner_stops: float) -> Float[np.ndarray, "H W"]:
    """2^(−s ρ²), ρ the distance of a pixel's center from the picture's middle as a share of the corner's."""
    y, x = np.indices((height, width)) + PIXEL_CENTER
    squared = (x - width / 2) ** 2 + (y - height / 2) ** 2
    return 2.0 ** (-corner_stops * squared / ((width / 2) ** 2 + (height / 2) ** 2))


def noise_std(radiance: Float[np.ndarray, "..."], shot: float, read: float) -> Float[np.ndarray, "..."]:
    """Standard deviation at each radiance x: √(σ_shot² max(x, 0) + σ_read²), photon and read noise."""
    return np.sqrt(shot**2 * np.maximum(radiance, 0) + read**2)


def add_noise(
    radiance: Float[np.ndarray, "..."], shot: float, read: float, random: np.random.Generator
) -> Float[np.ndarray, "..."]:
    """Gaussian noise of `noise_std`, clipped below at zero, where a sensor records black."""
    noise = random.standard_normal(radiance.shape) * noise_std(radiance, shot, read)
    return np.maximum(radiance + noise, 0).astype(radiance.dtype)
